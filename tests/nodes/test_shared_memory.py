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


def segments() -> set[str]:
    return {path.name for path in Path("/dev/shm").iterdir() if re.fullmatch(r"fastrtps_[0-9a-f]{16}", path.name)}


def test_segments_go_with_their_killed_process_and_only_then(
    graph: Graph, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_memory, "_YOUNG_SECONDS", 0.0)
    shared_memory.discard_abandoned_segments()
    before = segments()
    killed, living = start("scan_ingest"), start("registration")
    for process in (killed, living):
        process.wait_for("active")
    both = segments()
    assert len(both) >= len(before) + 2
    shared_memory.discard_abandoned_segments()
    assert segments() == both
    killed.send(signal.SIGKILL)
    killed.wait()
    shared_memory.discard_abandoned_segments()
    left = segments()
    assert before < left < both
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
