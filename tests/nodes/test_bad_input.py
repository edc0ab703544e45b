"""Whatever is sent to a registration is answered with a code and words, and the next scan is served."""

from __future__ import annotations

import array
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from helpers import CellProcess, Graph
from lifecycle_msgs.msg import Transition
from mdf_interfaces.action import RegisterScan
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import Register
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from samples import QUICK, cloud_of, parameters, scan_of, write_design
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from mdf_core.errors import (
    CloudFormatError,
    DegenerateDesignError,
    DegenerateScanError,
    DesignFileError,
    EmptyScanError,
    MdfError,
    NonFiniteScanError,
    NoScanError,
    TooFewPointsError,
    UnitMismatchError,
    UnknownMethodError,
)
from mdf_core.geometry import Design, PointSet
from mdf_nodes.conversions import cloud_message, displacement_from_message
from mdf_nodes.qos import LATCHED, SCAN

Start = Callable[..., CellProcess]


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.fixture(scope="module")
def node(domain: int, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellProcess]:
    """A registration that has not seen a scan by topic."""
    arguments = ("--ros-args", *parameters(design_path=design.path, register_every_scan=False), *QUICK)
    process = CellProcess("registration", arguments, tmp_path_factory.mktemp("registration"))
    process.wait_for("active")
    yield process
    process.close()


def points_of(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.0, 60.0, (count, 3))


def scaled(design: Design, factor: float) -> PointCloud2:
    scan = scan_of(design)
    return cloud_of(PointSet(scan.points * factor, scan.normals))


def with_value(design: Design, value: float) -> PointCloud2:
    """One x coordinate replaced."""
    cloud = cloud_of(scan_of(design))
    np.frombuffer(cloud.data, dtype=np.float32)[0] = value
    return cloud


def changed(design: Design, **changes: object) -> PointCloud2:
    cloud = cloud_of(scan_of(design))
    for name, value in changes.items():
        setattr(cloud, name, value)
    return cloud


def of_integers(_: Design) -> PointCloud2:
    columns = {name: np.arange(100, dtype=np.int32) for name in "xyz"}
    return cloud_message(columns, Header())


def without_z(_: Design) -> PointCloud2:
    return cloud_message({name: np.arange(100, dtype=np.float32) for name in "xy"}, Header())


def with_unknown_datatype(design: Design) -> PointCloud2:
    cloud = cloud_of(scan_of(design))
    cloud.fields[0].datatype = 77
    return cloud


def line(_: Design) -> PointCloud2:
    return cloud_of(PointSet(np.outer(np.linspace(0.0, 60.0, 500), (1.0, 2.0, 3.0))))


def plane(_: Design) -> PointCloud2:
    return cloud_of(PointSet(points_of(500) * (1.0, 1.0, 0.0)))


BAD_CLOUDS: dict[str, tuple[Callable[[Design], PointCloud2], type[MdfError], str]] = {
    "empty": (lambda _: PointCloud2(), EmptyScanError, "no points"),
    "nan": (lambda design: with_value(design, float("nan")), NonFiniteScanError, "1 of 3000 points"),
    "infinite": (lambda design: with_value(design, float("inf")), NonFiniteScanError, "1 of 3000 points"),
    "one_point": (lambda _: cloud_of(PointSet(points_of(1))), TooFewPointsError, "1 point"),
    "few_points": (lambda _: cloud_of(PointSet(points_of(9))), TooFewPointsError, "9 points"),
    "line": (line, DegenerateScanError, "one line"),
    "plane": (plane, DegenerateScanError, "one plane"),
    "one_spot": (lambda _: cloud_of(PointSet(np.ones((500, 3)))), DegenerateScanError, "one spot"),
    "integers": (of_integers, CloudFormatError, "field x"),
    "no_z": (without_z, CloudFormatError, "field z"),
    "unknown_datatype": (with_unknown_datatype, CloudFormatError, "77"),
    "short_data": (lambda design: changed(design, data=array.array("B", b"abc")), CloudFormatError, "3 bytes"),
    "short_rows": (lambda design: changed(design, row_step=1), CloudFormatError, "row_step"),
    "short_points": (lambda design: changed(design, point_step=5), CloudFormatError, "point_step"),
    "metres_for_millimetres": (lambda design: scaled(design, 1000.0), UnitMismatchError, "1000"),
    "millimetres_for_metres": (lambda design: scaled(design, 0.001), UnitMismatchError, "1000"),
    "inches": (lambda design: scaled(design, 25.4), UnitMismatchError, "25.4"),
    "centimetres": (lambda design: scaled(design, 10.0), UnitMismatchError, "10"),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_a_bad_cloud_is_refused_with_its_code_and_the_next_scan_served(
    graph: Graph, node: CellProcess, design: Design, case: str
) -> None:
    make, error, words = BAD_CLOUDS[case]
    client = graph.node("robot").create_client(Register, "register")
    answer = graph.call(client, Register.Request(scan=make(design)))
    assert answer.error_code == error.code, answer.error_msg
    assert words in answer.error_msg
    good = graph.call(client, Register.Request(scan=cloud_of(scan_of(design))))
    assert (good.error_code, good.error_msg) == (0, "")


def test_a_bad_scan_on_the_topic_is_answered_by_an_inspection(graph: Graph, start: Start, design: Design) -> None:
    start("registration", "--ros-args", "-r", "__ns:=/topic", *parameters(design_path=design.path), *QUICK)
    inspections = graph.collect(InspectionMessage, "/topic/inspection", LATCHED)
    displacements = graph.collect(PointCloud2, "/topic/displacement", LATCHED)
    scanner = graph.nodes[0].create_publisher(PointCloud2, "/topic/scan", SCAN)
    bad = plane(design)
    bad.header.stamp.sec = 31
    scanner.publish(bad)
    graph.wait_until(lambda: inspections)
    refusal = inspections[0]
    assert refusal.verdict == InspectionMessage.NO_DECISION
    assert refusal.error_code == DegenerateScanError.code
    assert refusal.reasons == [f"DEGENERATE_SCAN (104): {refusal.error_msg}"]
    assert (refusal.header.stamp.sec, refusal.header.frame_id) == (31, "design")
    assert refusal.job_id and not displacements
    scanner.publish(cloud_of(scan_of(design), second=32))
    graph.wait_until(lambda: inspections[-1].header.stamp.sec == 32)
    assert inspections[-1].error_code == 0


def test_an_unknown_method_is_refused_and_no_failure_of_the_cell(graph: Graph, start: Start, design: Design) -> None:
    start("registration", "--ros-args", "-r", "__ns:=/method", *parameters(design_path=design.path)).wait_for("active")
    client = graph.node("robot").create_client(Register, "/method/register")
    diagnostics = graph.collect(DiagnosticArray, "/diagnostics", 10)

    def statuses() -> list[DiagnosticStatus]:
        return [each.status[0] for each in diagnostics if each.status[0].name == "/method/registration"]

    answer = graph.call(client, Register.Request(scan=cloud_of(scan_of(design)), method="magic"))
    refused = KeyValue(key="errors", value="1")
    graph.wait_until(lambda: any(refused in status.values for status in statuses()))
    assert {status.level for status in statuses()} == {DiagnosticStatus.OK}
    assert answer.error_code == UnknownMethodError.code
    assert "'magic'" in answer.error_msg and "surface, mdf, cpd" in answer.error_msg


def test_the_latest_scan_cannot_be_registered_before_there_is_one(graph: Graph, node: CellProcess) -> None:
    client = ActionClient(graph.node("robot"), RegisterScan, "register_scan")
    graph.wait_until(client.server_is_ready)
    handle = graph.result(client.send_goal_async(RegisterScan.Goal(use_latest=True)))
    answer = graph.result(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == NoScanError.code


def test_other_layouts_of_the_same_scan_give_the_same_result(graph: Graph, node: CellProcess, design: Design) -> None:
    client = graph.node("robot").create_client(Register, "register")
    scan = scan_of(design)
    packed = graph.call(client, Register.Request(scan=cloud_of(scan)))
    for other in (big_endian(scan), organised(scan)):
        answer = graph.call(client, Register.Request(scan=other))
        assert (answer.error_code, answer.error_msg) == (0, "")
        np.testing.assert_array_equal(
            displacement_from_message(answer.displacement).displacement,
            displacement_from_message(packed.displacement).displacement,
        )


def big_endian(scan: PointSet) -> PointCloud2:
    cloud = cloud_of(scan)
    cloud.data = array.array("B", np.frombuffer(cloud.data, dtype="<f4").astype(">f4").tobytes())
    cloud.is_bigendian = True
    return cloud


def organised(scan: PointSet, height: int = 30, gap: int = 12, padding: int = 40) -> PointCloud2:
    """Rows with padding at their end, points with a gap, and no return in a last row."""
    flat = cloud_of(scan)
    width = len(scan) // height
    rows = np.frombuffer(flat.data, dtype=np.uint8).reshape(height, width, flat.point_step)
    no_return = np.full((1, width, flat.point_step // 4), np.nan, dtype=np.float32).view(np.uint8)
    rows = np.concatenate([rows, no_return])
    wide = np.pad(rows, ((0, 0), (0, 0), (0, gap))).reshape(height + 1, -1)
    data = np.pad(wide, ((0, 0), (0, padding)), constant_values=255)
    fields = [*flat.fields, PointField(name="rgb", offset=flat.point_step, datatype=PointField.FLOAT32, count=3)]
    cloud = PointCloud2(header=flat.header, height=height + 1, width=width, fields=fields, is_dense=False)
    cloud.point_step, cloud.row_step = flat.point_step + gap, data.shape[1]
    cloud.data = array.array("B", data.tobytes())
    return cloud


BAD_DESIGNS: dict[str, tuple[bytes | None, type[MdfError]]] = {
    "missing": (None, DesignFileError),
    "empty": (b"", DesignFileError),
    "corrupt": (b"\x00" * 100, DesignFileError),
    "no_triangles": (b"\x00" * 84, DegenerateDesignError),
}


@pytest.fixture(scope="module")
def badly_designed(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, CellProcess]]:
    """Registrations whose design cannot be loaded, each in the namespace of its case."""
    nodes = {}
    for case, (content, _) in BAD_DESIGNS.items():
        folder = tmp_path_factory.mktemp(case)
        if content is not None:
            (folder / "bad.stl").write_bytes(content)
        arguments = ("--ros-args", "-r", f"__ns:=/{case}", *parameters(design_path=folder / "bad.stl"), *QUICK)
        nodes[case] = CellProcess("registration", arguments, folder)
    yield nodes
    for node in nodes.values():
        node.terminate()
    for node in nodes.values():
        node.close()


@pytest.mark.parametrize("case", BAD_DESIGNS)
def test_a_bad_design_keeps_the_node_unconfigured_until_the_parameter_is_mended(
    graph: Graph, badly_designed: dict[str, CellProcess], design: Design, case: str
) -> None:
    error, node = BAD_DESIGNS[case][1], badly_designed[case]
    own = graph.node("operator", namespace=f"/{case}")
    graph.wait_until(lambda: f"({error.code}): " in node.output, what=f"code {error.code} in the log")
    assert f"{case}0/bad.stl: " in node.output
    set_parameters = own.create_client(SetParameters, "registration/set_parameters")
    assert not graph.change_state("registration", Transition.TRANSITION_ACTIVATE)
    assert not graph.change_state("registration", Transition.TRANSITION_CONFIGURE)
    mended = Parameter("design_path", value=design.path).to_parameter_msg()
    assert graph.call(set_parameters, SetParameters.Request(parameters=[mended])).results[0].successful
    assert graph.change_state("registration", Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    client = own.create_client(Register, "register")
    assert graph.call(client, Register.Request(scan=cloud_of(scan_of(design)))).error_code == 0


DRIVER_CASES = ("empty", "nan", "one_point", "line", "no_z", "unknown_datatype", "short_data")


def test_bad_clouds_of_a_driver_are_told_and_the_next_one_is_published(
    graph: Graph, start: Start, design: Design
) -> None:
    ingest = start("scan_ingest", "--ros-args", "-r", "__ns:=/driver")
    scans = graph.collect(PointCloud2, "/driver/scan", SCAN)
    driver = graph.nodes[0].create_publisher(PointCloud2, "/driver/points", SCAN)
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    for case in DRIVER_CASES:
        make, error, words = BAD_CLOUDS[case]
        told = ingest.output.count("[ERROR]")
        driver.publish(make(design))
        graph.wait_until(lambda told=told: ingest.output.count("[ERROR]") > told, what=case)
        line = [each for each in ingest.output.splitlines() if "[ERROR]" in each][-1]
        assert f"({error.code})" in line and words in line, case
    assert not scans
    driver.publish(cloud_of(scan_of(design), second=41))
    graph.wait_until(lambda: scans)
    assert scans[0].header.stamp.sec == 41


def test_scans_without_normals_are_registered(graph: Graph, node: CellProcess, design: Design) -> None:
    client = graph.node("robot").create_client(Register, "register")
    bare = replace(scan_of(design), normals=None)
    assert graph.call(client, Register.Request(scan=cloud_of(bare))).error_code == 0
