"""Shared memory of killed processes is given back, that of living ones is not touched."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import CellProcess, Graph
from lifecycle_msgs.srv import GetState

from mdf_nodes import shared_memory

Start = Callable[..., CellProcess]


def segments_of(process: CellProcess) -> set[Path]:
    """The segments that are the process's own: it holds the lock beside them."""
    held = (re.fullmatch(r"(/dev/shm/fastrtps_[0-9a-f]{16})_el", name) for name in process.open_files())
    return {Path(match[1]) for match in held if match}


def test_segments_go_with_their_killed_process_and_only_then(
    graph: Graph, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_memory, "_YOUNG_SECONDS", 0.0)
    killed, living = start("scan_ingest"), start("registration")
    for process in (killed, living):
        process.wait_for("active")
    of_killed, of_living = segments_of(killed), segments_of(living)
    assert of_killed and of_living
    shared_memory.discard_abandoned_segments()
    assert all(path.exists() for path in of_killed | of_living)
    killed.send(signal.SIGKILL)
    killed.wait()
    shared_memory.discard_abandoned_segments()
    assert not any(path.exists() for path in of_killed)
    assert all(path.exists() for path in of_living)
    # The living one still talks.
    graph.node("client")
    assert graph.nodes[0].create_client(GetState, "registration/get_state").wait_for_service(10.0)


def test_what_is_young_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path)
    names = ("fastrtps_0123456789abcdef", "fastrtps_0123456789abcdef_el", "fastrtps_port7411_el", "other_el")
    for name in names:
        (tmp_path / name).touch()
    shared_memory.discard_abandoned_segments()
    assert len(list(tmp_path.iterdir())) == 4
    monkeypatch.setattr(shared_memory, "_YOUNG_SECONDS", -1.0)
    shared_memory.discard_abandoned_segments()
    assert {path.name for path in tmp_path.iterdir()} == set(names[2:])
