"""Starts and ends of a process: bad arguments are told in a line; however many stop signals come, it ends cleanly."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest
from helpers import REPOSITORY, CellProcess, Graph

from mdf_nodes.context import child_environment

Start = Callable[..., CellProcess]
STOP = signal.SIGINT, signal.SIGTERM

HANGING = """
from mdf_nodes import context

context._CLEAN_STOP_SECONDS = 0.5
with context.ros_context() as stop:
    print("running", flush=True)
    stop.wait()
    print("stopping", flush=True)
    while True:
        pass
"""


@pytest.fixture
def hanging() -> Iterator[subprocess.Popen[str]]:
    """A process whose clean stop never ends."""
    command = [sys.executable, "-c", HANGING]
    process = subprocess.Popen(
        command, cwd=REPOSITORY, env=child_environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate()


def send_until_the_end(process: CellProcess) -> int:
    """Send both stop signals at once, again and again; the exit status."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        for number in STOP:
            process.send(number)
        try:
            return process.wait(0.005)
        except AssertionError:
            continue
    raise AssertionError(process.output)


def test_a_bad_log_level_is_told(start: Start) -> None:
    process = start("scan_ingest", "--ros-args", "--log-level", "loud")
    assert process.wait(30.0) == 2
    assert "loud" in process.output and "Traceback" not in process.output


@pytest.mark.parametrize(
    "command", ["scan_ingest", "registration", "virtual_scanner", "cell", "bag_player a.mcap", "bag_recorder a.mcap"]
)
def test_an_unknown_ros_argument_is_told_in_one_line(start: Start, command: str) -> None:
    process = start(*command.split(), "--ros-args", "--nope")
    assert process.wait(30.0) == 2
    assert "--nope" in process.stderr and process.stderr.count("\n") == 1


@pytest.mark.parametrize("module", ["scan_ingest", "virtual_scanner"])
def test_repeated_stop_signals_do_not_disturb_a_clean_stop(graph: Graph, start: Start, module: str) -> None:
    process = start(module)
    own = graph.node("waiting")
    graph.wait_until(lambda: module in own.get_node_names(), what=module)
    assert send_until_the_end(process) == 0
    assert "Traceback" not in process.output


def test_a_process_that_hangs_in_its_stop_is_ended_by_a_later_signal(hanging: subprocess.Popen[str]) -> None:
    assert hanging.stdout is not None
    assert hanging.stdout.readline() == "running\n"
    hanging.send_signal(signal.SIGTERM)
    assert hanging.stdout.readline() == "stopping\n"
    deadline = time.monotonic() + 10.0
    while hanging.poll() is None:
        assert time.monotonic() < deadline
        hanging.send_signal(signal.SIGINT)
        try:
            hanging.wait(0.05)
        except subprocess.TimeoutExpired:
            continue
    assert hanging.returncode == 128 + signal.SIGINT
    assert hanging.stderr is not None and "Traceback" not in hanging.stderr.read()
