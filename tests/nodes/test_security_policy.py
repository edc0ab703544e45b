"""The policy for DDS with security: what the nodes of a cell use, and nothing else."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import REPOSITORY, CellProcess, Graph
from samples import write_design

from mdf_nodes.cell import NODES

POLICY = REPOSITORY / "ros_ws" / "src" / "mdf_bringup" / "security" / "policy.xml"
ACTION = re.compile(r"(.*)/_action/\w+")
Rights = set[tuple[str, str]]
"""What may be done and the name it may be done with."""


def allowed() -> dict[str, Rights]:
    """Rights of every node, with full names."""
    rights: dict[str, Rights] = {}
    for profile in ElementTree.parse(POLICY).iter("profile"):
        node, found = profile.attrib["node"], set()
        for group in profile:
            (right,) = group.attrib
            assert group.attrib[right] == "ALLOW"
            for entry in group:
                assert group.tag == f"{entry.tag}s"
                found.add((right, "/" + entry.text.replace("~", node).lstrip("/")))
        rights[node] = found
    return rights


def used(graph: Graph, node: str) -> Rights:
    """What `node` does in the running graph, as far as discovery has told of it."""
    own, names = graph.nodes[0], Rights()
    if node not in own.get_node_names():
        return names
    for right, find in {
        "publish": own.get_publisher_names_and_types_by_node,
        "subscribe": own.get_subscriber_names_and_types_by_node,
        "reply": own.get_service_names_and_types_by_node,
        "request": own.get_client_names_and_types_by_node,
    }.items():
        for name, _ in find(node, "/"):
            action = ACTION.fullmatch(name)
            names.add(("execute", action[1]) if action else (right, name))
    return names


@pytest.fixture(scope="module")
def cell_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cell")
    write_design(folder)
    return folder


def test_the_policy_allows_what_the_cell_does_and_nothing_else(
    graph: Graph, start: Callable[..., CellProcess], cell_folder: Path
) -> None:
    graph.node("looker", enable_rosout=False, start_parameter_services=False)
    (design,) = cell_folder.glob("*.stl")
    cell = start("cell", "--design", design, "--output-folder", cell_folder)
    graph.wait_until(lambda: all(f"cell: {name}: ready\n" in cell.stderr for name in NODES), 40.0, "a ready cell")
    rights = allowed()
    for node, expected in rights.items():
        without_simulated_time = expected - {("subscribe", "/clock")}
        graph.wait_until(
            lambda node=node, expected=without_simulated_time: used(graph, node) == expected,
            what=f"{node} to use what it may",
        )
    of_cell = re.compile(f"cell|_?({'|'.join(NODES)})(_\\w+)?")
    assert set(rights) == {name for name in graph.nodes[0].get_node_names() if of_cell.fullmatch(name)}
