"""A cell that is killed again and again answers every scan once. `make soak` runs it for 500 scans."""

from __future__ import annotations

import io
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from samples import QUICK, parameters, scan_of, write_design

from mdf_core.errors import CancelledError, NotActiveError, StorageFullError
from mdf_nodes.cell import NODES
from mdf_nodes.context import child_environment

SCANS = int(os.environ.get("SOAK_SCANS", "16"))
BAD = 0.15  # share of files that are no scans
EVENTS = 0.4  # share of files after which something is killed, or goes away
CLIENT = Path(__file__).with_name("cancelling_client.py")
MOST_WAITING = 6  # files and jobs; a job that is killed again and again would be given up
FULL_EVERY = 50  # scans
DISK_MIB, FLOOR_MIB = 256, 16
BAD_CONTENTS = (b"", b"\x93NUMPY\x01\x00 cut short", b"no numbers")


def abandoned_segments():
    """Segments of DDS whose lock nobody holds."""
    descriptors = Path("/proc").glob("[0-9]*/fd/*")
    held = set()
    for descriptor in descriptors:
        with suppress(OSError):  # just closed
            held.add(str(descriptor.readlink()).removesuffix("_el"))
    return {path for path in Path("/dev/shm").glob("fastrtps_*[0-9a-f]") if str(path) not in held}


def scan_file(design, seed):
    scan, content = scan_of(design, points=1_500, seed=seed), io.BytesIO()
    np.save(content, np.hstack([scan.points, scan.normals]))
    return content.getvalue()


@pytest.fixture
def small_disk(tmp_path):
    """A folder, on a small disk of its own where we may mount one, as root may."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", folder]
    is_mounted = shutil.which("mount") is not None and subprocess.run(mount, capture_output=True).returncode == 0
    yield folder
    if is_mounted:
        subprocess.run(["umount", "--lazy", folder], check=True)


def fill(disk):
    """A file that leaves no byte free; None where the disk is everybody's."""
    if not disk.is_mount():
        return None
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    return filler


@pytest.mark.timeout(120 + 20 * SCANS)
def test_every_scan_is_answered_once_whatever_is_killed(start, wait_until, processes_naming, small_disk, tmp_path):
    watched, output = tmp_path / "watched", small_disk / "output"
    watched.mkdir()
    design = write_design(tmp_path)
    rng = np.random.default_rng(1)

    def run_cell():
        arguments = ("--design", design.path, "--output-folder", output, "--watch-folder", watched)
        return start("cell", *arguments, "--ros-args", *QUICK, *parameters(disk_floor_mib=FLOOR_MIB))

    def jobs(where):
        if not (output / "state" / "journal.sqlite").exists():
            return 0
        with sqlite3.connect(output / "state" / "journal.sqlite") as database:
            if not database.execute("SELECT COUNT(*) FROM sqlite_master WHERE name = 'jobs'").fetchone()[0]:
                return 0  # just being made
            return database.execute(f"SELECT COUNT(*) FROM jobs WHERE {where}").fetchone()[0]

    def files():
        return [path for path in watched.iterdir() if path.is_file()]

    def waiting():
        return len(files()) + jobs("answered IS NULL")

    def refusals(process):
        return process.output.count(f"({StorageFullError.code})")

    def told():
        return f"{len(files())} files, {jobs('answered IS NULL')} jobs left\n{cell.output[-3000:]}"

    before = abandoned_segments()
    cell = run_cell()
    good, bad, clients, next_full = 0, 0, [], SCANS // 2 % FULL_EVERY

    def drop(name, content):
        hidden = watched / f".{name}"
        hidden.write_bytes(content)
        hidden.rename(watched / f"{name}.npy")

    for number in range(SCANS):
        if rng.uniform() > BAD:
            drop(f"scan{number}", scan_file(design, number))
            good += 1
        else:
            drop(f"scan{number}", BAD_CONTENTS[number % len(BAD_CONTENTS)])
            bad += 1
        wait_until(lambda cell=cell: waiting() <= MOST_WAITING or not cell.running, 120, told)
        if rng.uniform() < EVENTS:
            victim = str(rng.choice([*NODES, "cell", "cell politely", "subscriber", "client"]))
            if number > next_full:
                victim, next_full = "disk", next_full + FULL_EVERY
            running = processes_naming(output)
            if victim in running:
                os.kill(running[victim], signal.SIGKILL)
                if victim == "cell":
                    cell.wait()
            elif victim == "cell politely":
                cell.wait_for("ready")  # a Python that is still importing answers with a trace
                assert cell.stop() == 0
            elif victim == "subscriber":
                recorder = start("bag_recorder", tmp_path / f"bag{number}", "--topics", "scan", "displacement")
                recorder.wait_for("recording")
                recorder.send(signal.SIGKILL)
            elif victim == "disk" and (filler := fill(small_disk)) is not None:
                before_it = refusals(cell)
                drop(f"scan{number}_full", scan_file(design, SCANS + number))
                good += 1
                wait_until(lambda cell=cell, count=before_it: refusals(cell) > count, 60, told)
                filler.unlink()
            elif victim == "client":
                clients.append(subprocess.Popen([sys.executable, CLIENT], env=child_environment()))
        if not cell.running:  # killed, stopped, or a node died too often
            wait_until(lambda: not processes_naming(output), 10, lambda: str(processes_naming(output)))
            cell = run_cell()

    if not cell.running:
        cell = run_cell()
    for client in clients:
        assert client.wait(120) == 0
    wait_until(lambda: not files() and not jobs("answered IS NULL"), 120, told)
    assert jobs("error_code = 0 AND source IS NOT NULL") == jobs("source IS NOT NULL") == good
    # A client whose job is stopped with its node is told so.
    assert jobs(f"error_code NOT IN (0, {CancelledError.code}, {NotActiveError.code})") == 0
    wait_until(lambda: len(list(output.glob("*/redesigned.stl"))) == jobs("error_code = 0"), 120, told)
    assert len(list((watched / "done").glob("*.npy"))) == good
    assert len(list((watched / "failed").glob("*.npy"))) == bad
    assert len(list((watched / "failed").glob("*.txt"))) == bad
    assert cell.stop() == 0
    assert processes_naming(output) == {}
    # A process that is killed leaves its segments; whoever starts next must not find ever more of them.
    assert len(abandoned_segments() - before) < 40
