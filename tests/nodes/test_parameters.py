"""Parameters: every setting is one, described, with its range, checked and live."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import CellProcess, Graph
from mdf_interfaces.srv import Register
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter, parameter_value_to_python
from samples import QUICK, cloud_of, parameters, scan_of, write_design

from mdf_core.errors import UnknownMethodError
from mdf_core.geometry import Design
from mdf_core.settings import Settings, leaves

Start = Callable[..., CellProcess]
LEAVES = {name: (leaf, value) for name, leaf, value in leaves(Settings())}


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.fixture(scope="module")
def node(domain: int, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellProcess]:
    """A registration."""
    arguments = ("--ros-args", *parameters(design_path=design.path), *QUICK)
    process = CellProcess("registration", arguments, tmp_path_factory.mktemp("registration"))
    process.wait_for("active")
    yield process
    process.close()


class Remote:
    """The parameters of a node, as tools see them."""

    def __init__(self, graph: Graph, name: str = "registration") -> None:
        self._graph = graph
        self._own = graph.nodes[0] if graph.nodes else graph.node("tool")
        self._name = name

    def _call(self, type_: Any, service: str, request: Any) -> Any:
        client = self._own.create_client(type_, f"{self._name}/{service}")
        return self._graph.call(client, request)

    def names(self) -> list[str]:
        return list(self._call(ListParameters, "list_parameters", ListParameters.Request()).result.names)

    def describe(self, *names: str) -> list[ParameterDescriptor]:
        request = DescribeParameters.Request(names=names)
        return list(self._call(DescribeParameters, "describe_parameters", request).descriptors)

    def get(self, name: str) -> Any:
        request = GetParameters.Request(names=[name])
        return parameter_value_to_python(self._call(GetParameters, "get_parameters", request).values[0])

    def set(self, **values: Any) -> list[Any]:
        request = SetParameters.Request(parameters=_messages(values))
        return list(self._call(SetParameters, "set_parameters", request).results)

    def set_bools(self, name: str, *values: bool) -> Any:
        request = SetParameters.Request(
            parameters=[Parameter(name, Parameter.Type.BOOL_ARRAY, values).to_parameter_msg()]
        )
        return self._call(SetParameters, "set_parameters", request).results[0]

    def set_together(self, **values: Any) -> Any:
        request = SetParametersAtomically.Request(parameters=_messages(values))
        return self._call(SetParametersAtomically, "set_parameters_atomically", request).result


def _messages(values: dict[str, Any]) -> list[ParameterMessage]:
    return [Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()]


def test_every_setting_is_a_described_parameter_with_its_range(graph: Graph, node: CellProcess) -> None:
    remote = Remote(graph)
    for (name, (leaf, value)), descriptor in zip(LEAVES.items(), remote.describe(*LEAVES), strict=True):
        metadata = leaf.metadata
        assert descriptor.description.startswith(metadata["description"]), name
        assert descriptor.description.endswith(f"[{metadata['unit']}]") == bool(metadata["unit"]), name
        assert all(choice in descriptor.additional_constraints for choice in metadata["choices"]), name
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        limits = (metadata["minimum"], metadata["maximum"])
        assert [(each.from_value, each.to_value) for each in ranges] == ([] if limits == (None, None) else [limits])
        kind = {bool: 1, int: 2, float: 3, str: 4, tuple: 8}[type(value)]
        assert descriptor.type == kind, name


def test_every_parameter_of_every_node_is_described(graph: Graph, node: CellProcess, start: Start) -> None:
    start("scan_ingest"), start("compensation")
    for name in ("registration", "scan_ingest", "compensation"):
        remote = Remote(graph, name)
        names = [each for each in remote.names() if each not in ("use_sim_time", "start_type_description_service")]
        assert {"autostart", "queue_size", *LEAVES} <= set(names)
        assert all(descriptor.description for descriptor in remote.describe(*names))


def test_the_defaults_are_those_of_the_library(graph: Graph, start: Start) -> None:
    start("scan_ingest")
    remote = Remote(graph, "scan_ingest")
    for name, (_, value) in LEAVES.items():
        assert remote.get(name) == (list(value) if isinstance(value, tuple) else value), name


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"surface__rank": 2}, "out of range"),
        ({"surface__rank": "many"}, "INTEGER"),
        ({"mixture__outlier_share": 1.5}, "out of range"),
        ({"mixture__outlier_share": float("nan")}, "mixture.outlier_share"),
        ({"method": "magic"}, "use one of surface, mdf, cpd"),
        ({"pose__initial": [1.0, 2.0]}, "give x y z qx qy qz qw"),
        ({"surface__beta": [1.0, 1000.0]}, "setting surface.beta: 1000.0 is outside 0.05 .. 100"),
        ({"compensation__lookup": ""}, "use one of spatial, material"),
        ({"queue_size": 3}, "read-only"),
    ],
)
def test_a_bad_value_is_rejected_with_the_reason(
    graph: Graph, node: CellProcess, values: dict[str, Any], reason: str
) -> None:
    remote = Remote(graph)
    (name,) = values
    before = remote.get(name.replace("__", "."))
    (result,) = remote.set(**values)
    assert not result.successful
    assert reason in result.reason
    assert remote.get(name.replace("__", ".")) == before


def test_a_list_is_emptied_as_ros2_param_set_does_it(graph: Graph, node: CellProcess) -> None:
    remote = Remote(graph)
    (given,) = remote.set(crop__box_mm=[-1.0, -1.0, -1.0, 61.0, 31.0, 41.0])
    assert given.successful
    assert remote.set_bools("crop.box_mm").successful
    assert remote.get("crop.box_mm") == []


@pytest.mark.parametrize(
    ("name", "values", "reason"), [("surface.beta", (), "surface.beta"), ("crop.box_mm", (True,), "BOOL_ARRAY")]
)
def test_a_list_of_bools_is_taken_for_no_other(
    graph: Graph, node: CellProcess, name: str, values: tuple[bool, ...], reason: str
) -> None:
    remote = Remote(graph)
    before = remote.get(name)
    result = remote.set_bools(name, *values)
    assert not result.successful and reason in result.reason
    assert remote.get(name) == before


def test_changes_made_together_are_all_taken_or_none(graph: Graph, node: CellProcess) -> None:
    remote = Remote(graph)
    assert not remote.set_together(seed=5, method="magic").successful
    assert remote.get("seed") == 0
    assert remote.set_together(seed=5, verdict__min_coverage=0.5).successful
    assert (remote.get("seed"), remote.get("verdict.min_coverage")) == (5, 0.5)
    assert remote.set_together(seed=0, verdict__min_coverage=0.7).successful


def test_a_change_takes_effect_with_the_next_job(graph: Graph, node: CellProcess, design: Design) -> None:
    remote = Remote(graph)
    client = graph.nodes[0].create_client(Register, "register")
    request = Register.Request(scan=cloud_of(scan_of(design, bend=0.2)))
    first = graph.call(client, request).inspection
    assert first.tolerance == 0.0 and first.reasons
    assert remote.set(verdict__tolerance_mm=5.0)[0].successful
    second = graph.call(client, request).inspection
    assert second.tolerance == 0.005 and second.verdict == second.PASS
    assert first.settings_hash != second.settings_hash
    assert remote.set(verdict__tolerance_mm=0.0)[0].successful
    assert graph.call(client, request).inspection.settings_hash == first.settings_hash


def test_values_come_from_a_parameters_file(graph: Graph, start: Start, tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text("/**:\n  ros__parameters:\n    seed: 3\n    surface:\n      beta: [2.0, 1.0]\n")
    start("scan_ingest", "--ros-args", "-r", "__ns:=/cell2", "--params-file", file)
    remote = Remote(graph, "/cell2/scan_ingest")
    assert (remote.get("seed"), remote.get("surface.beta")) == (3, [2.0, 1.0])


def test_a_bad_value_at_the_start_ends_the_process_with_one_clear_line(start: Start) -> None:
    reasons = {
        "surface.rank:=2": "surface.rank",
        "surface.rank:=many": "surface.rank",
        "method:=magic": str(UnknownMethodError("unknown value 'magic'", "setting method")),
        "queue_size:=0": "queue_size",
        "design_unit:=parsec": "use one of mm",
    }
    nodes = {text: start("registration", "--ros-args", "-p", text) for text in reasons}
    for text, node in nodes.items():
        assert node.wait() == 2
        assert reasons[text] in node.stderr
        assert len(node.stderr.strip().splitlines()) == 1
