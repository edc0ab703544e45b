"""A cell that is killed again and again answers every scan once. `make soak` runs it for 500 scans."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from samples import QUICK, scan_of, write_design

from mdf_core.errors import CancelledError, NotActiveError
from mdf_nodes.cell import NODES
from mdf_nodes.context import child_environment

SCANS = int(os.environ.get("SOAK_SCANS", "24"))
BAD = 0.15  # share of files that are no scans
EVENTS = 0.4  # share of files after which something is killed, or goes away
CLIENT = Path(__file__).with_name("cancelling_client.py")
MOST_WAITING = 6  # files and jobs; a job that is killed again and again would be given up
BAD_CONTENTS = (b"", b"\x93NUMPY\x01\x00 cut short", b"no numbers")


def shared_memory():
    """Segments that DDS left."""
    return {path.name for path in Path("/dev/shm").glob("fastrtps_*") if not path.name.endswith("_el")}


@pytest.mark.timeout(120 + 20 * SCANS)
def test_every_scan_is_answered_once_whatever_is_killed(start, wait_until, processes_naming, tmp_path):
    watched, output = tmp_path / "watched", tmp_path / "output"
    watched.mkdir()
    design = write_design(tmp_path)
    rng = np.random.default_rng(1)

    def run_cell():
        arguments = ("--design", design.path, "--output-folder", output, "--watch-folder", watched)
        return start("cell", *arguments, "--ros-args", *QUICK)

    def jobs(where):
        if not (output / "state" / "journal.sqlite").exists():
            return 0
        with sqlite3.connect(output / "state" / "journal.sqlite") as database:
            return database.execute(f"SELECT COUNT(*) FROM jobs WHERE {where}").fetchone()[0]

    def files():
        return [path for path in watched.iterdir() if path.is_file()]

    def waiting():
        return len(files()) + jobs("answered IS NULL")

    def told():
        return f"{len(files())} files, {jobs('answered IS NULL')} jobs left\n{cell.output[-3000:]}"

    before = shared_memory()
    cell = run_cell()
    good, clients = 0, []
    for number in range(SCANS):
        hidden = watched / f".scan{number}"
        is_good = rng.uniform() > BAD
        if is_good:
            scan = scan_of(design, points=1_500, seed=number)
            with hidden.open("wb") as file:
                np.save(file, np.hstack([scan.points, scan.normals]))
        else:
            hidden.write_bytes(BAD_CONTENTS[number % len(BAD_CONTENTS)])
        good += is_good
        hidden.rename(watched / f"scan{number}.npy")
        wait_until(lambda cell=cell: waiting() <= MOST_WAITING or not cell.running, 120, told)
        if rng.uniform() < EVENTS:
            victim = str(rng.choice([*NODES, "cell", "cell politely", "subscriber", "client"]))
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
    assert len(list((watched / "failed").glob("*.npy"))) == SCANS - good
    assert len(list((watched / "failed").glob("*.txt"))) == SCANS - good
    assert cell.stop() == 0
    assert processes_naming(output) == {}
    # A process that is killed leaves its segments; whoever starts next must not find ever more of them.
    assert len(shared_memory() - before) < 40
