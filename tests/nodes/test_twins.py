"""A second cell whose nodes have the names of the first."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from helpers import Graph

from mdf_nodes import cell


def test_a_node_whose_name_is_taken_twice_is_told_of_once(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cell, "_TWINS_SECONDS", 0.1)
    ages = {"scan_ingest": 20.0, "registration": 30.0, "compensation": 30.0}
    children = [SimpleNamespace(name=name, is_running=False, age=age) for name, age in ages.items()]
    # That of the scan_ingest just started may be the one that was killed before.
    for name in ("scan_ingest", "scan_ingest", "registration", "registration", "compensation"):
        graph.node(name)
    watch = graph.add(cell._Watch(children))
    graph.wait_until(lambda: watch._told)
    told: list[int] = []
    graph.nodes[0].create_timer(0.1, lambda: told.append(1))
    graph.wait_until(lambda: len(told) == 3)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("cell: registration: another node has this name and answers too; ")
