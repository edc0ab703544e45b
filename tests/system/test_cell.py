"""The command cell: its nodes start, come back after a crash, and leave nothing behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import REPOSITORY

from mdf_core.mesh_io import stl_bytes
from mdf_core.virtual_cell import build_part
from mdf_nodes.cell import NODES
from mdf_nodes.context import child_environment


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    path = tmp_path_factory.mktemp("design") / "plate.stl"
    part = build_part("plate")
    path.write_bytes(stl_bytes(part.vertices, part.faces))
    return path


@pytest.fixture
def cell(start, wait_until, design, tmp_path):
    """``cell(...)``: a running cell whose nodes are all ready; its results go to tmp_path."""

    def run(*arguments):
        process = start("cell", "--design", design, "--output-folder", tmp_path, *arguments)
        wait_until(lambda: ready(process) == set(NODES) or not process.running, 30, lambda: process.output)
        assert process.running, process.output
        return process

    return run


def ready(process):
    return {name for name in NODES if f"cell: {name}: ready\n" in process.stderr}


def test_an_interrupt_ends_all_nodes_cleanly_and_soon(cell, processes_naming, tmp_path):
    process = cell()
    assert processes_naming(tmp_path).keys() == {"cell", *NODES}
    began = time.monotonic()
    assert process.stop() == 0
    assert time.monotonic() - began < 2.0, process.stderr
    assert processes_naming(tmp_path) == {}
    assert "Traceback" not in process.output


@pytest.fixture
def command():
    """``command("registration", "arguments", ...)``: the installed command in a process of its own."""
    processes = []

    def run(name, *arguments):
        line = [Path(sys.prefix, "bin", name), *arguments]
        processes.append(
            subprocess.Popen(
                line,
                cwd=REPOSITORY,
                env=child_environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("seconds", [0.0, 0.2, 0.6, 1.0, 1.5])
@pytest.mark.parametrize(
    ("name", "option"),
    [("registration", ("--ros-args", "-p", "state_folder:={}")), ("cell", ("--output-folder", "{}"))],
)
def test_an_interrupt_at_any_moment_of_the_start_ends_a_command(
    command, wait_until, processes_naming, tmp_path, name, option, seconds
):
    process = command(name, *(text.format(tmp_path) for text in option))
    # Python's own start is not ours: from the first library of ROS on.
    wait_until(lambda: "_rclpy_pybind11" in Path(f"/proc/{process.pid}/maps").read_text(), 20, lambda: name)
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=5)  # the nodes of a cell have stderr from it: none is left when it is closed
    assert process.returncode in (0, -signal.SIGINT)
    assert "Traceback" not in told
    assert processes_naming(tmp_path) == {}


def test_an_interrupt_ends_a_cell_that_still_reads_its_design(command, wait_until, tmp_path):
    design = tmp_path / "slow.stl"
    os.mkfifo(design)
    process = command("cell", "--design", design)
    end = wait_until(lambda: opened_for_writing(design), 20, lambda: "the design is not read")
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=5)
    os.close(end)
    assert process.returncode == -signal.SIGINT
    assert told == ""


def opened_for_writing(fifo):
    """Its file descriptor; None: nobody reads it."""
    try:
        return os.open(fifo, os.O_WRONLY | os.O_NONBLOCK)
    except OSError:
        return None


def test_a_killed_node_comes_back_and_the_others_stay(cell, wait_until, processes_naming, tmp_path):
    process = cell()
    before = processes_naming(tmp_path)
    os.kill(before["registration"], signal.SIGKILL)
    wait_until(lambda: process.stderr.count("cell: registration: ready\n") == 2, 30, lambda: process.stderr)
    assert "cell: registration: ended by signal SIGKILL; starting it again in 0.5 s" in process.stderr
    after = processes_naming(tmp_path)
    assert after.pop("registration") != before.pop("registration")
    assert after == before
    assert process.stop() == 0
    assert processes_naming(tmp_path) == {}


def kill_again_and_again(process, times, wait_until, processes_naming, folder):
    for death in range(1, times + 1):
        node = wait_until(lambda: processes_naming(folder).get("compensation"), 20, lambda: process.stderr)
        os.kill(node, signal.SIGKILL)
        wait_until(
            lambda death=death: process.stderr.count("compensation: ended by") == death, 20, lambda: process.stderr
        )


def test_a_node_that_never_becomes_active_ends_the_cell(start, design, wait_until, processes_naming, tmp_path):
    process = start("cell", "--design", design, "--output-folder", tmp_path)
    kill_again_and_again(process, 5, wait_until, processes_naming, tmp_path)
    assert process.wait(10) == 1
    assert process.stderr.count("starting it again") == 4
    assert re.search("compensation: ended by signal SIGKILL; giving up", process.stderr)
    assert processes_naming(tmp_path) == {}


def test_a_node_that_has_worked_comes_back_however_often_it_dies(cell, wait_until, processes_naming, tmp_path):
    process = cell()
    kill_again_and_again(process, 6, wait_until, processes_naming, tmp_path)
    wait_until(lambda: process.stderr.count("cell: compensation: ready\n") >= 2, 30, lambda: process.stderr)
    assert "starting it again in 5 s" in process.stderr
    assert process.stop() == 0


def test_no_node_outlives_a_killed_cell(cell, wait_until, processes_naming, tmp_path):
    process = cell()
    process.send(signal.SIGKILL)
    process.wait()
    wait_until(lambda: not processes_naming(tmp_path), 5, lambda: str(processes_naming(tmp_path)))


def test_all_nodes_in_one_process(cell, processes_naming, tmp_path):
    process = cell("--single-process", "--namespace", "cell_2")
    assert processes_naming(tmp_path).keys() == {"cell"}
    assert process.stop() == 0
    assert processes_naming(tmp_path) == {}


@pytest.mark.parametrize("mode", [(), ("--single-process",)])
def test_a_parameter_out_of_range_ends_the_cell_and_is_told(start, design, tmp_path, mode):
    process = start("cell", "--design", design, *mode, "--ros-args", "-p", "surface.rank:=-3")
    assert process.wait(30) == 2
    assert "surface.rank" in process.stderr
    assert "Traceback" not in process.output


def test_a_unit_without_its_design_is_refused(start):
    process = start("cell", "--design-unit", "inch")
    assert process.wait() == 2
    assert "--design-unit says nothing without --design" in process.stderr


def test_a_design_that_cannot_be_read_is_refused_before_anything_starts(start, tmp_path):
    process = start("cell", "--design", tmp_path / "none.stl")
    assert process.wait() == 2
    assert process.stderr.startswith("error: ") and process.stderr.count("\n") == 1
    assert str(tmp_path / "none.stl") in process.stderr
