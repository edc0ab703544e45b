"""Recorded bags through the cell: what comes out is what was true when they were recorded."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import CellProcess, Graph
from mdf_interfaces.msg import Inspection as InspectionMessage
from rclpy.serialization import serialize_message
from recordings import CASES, RESULTS, TOLERANCE_MM, Cell, Recording, running_cell, share_of_area, subscribe
from sensor_msgs.msg import PointCloud2

from mdf_core.bag import open_bag
from mdf_core.cli import main
from mdf_core.compensation import Redesign, compensate
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import BagTopicError
from mdf_core.geometry import Array
from mdf_core.inspection import Inspection, Verdict
from mdf_core.mesh_io import load_design
from mdf_core.pipeline import inspect
from mdf_core.point_cloud2 import scan_from_cloud
from mdf_core.rigid import transform
from mdf_core.sampling import prepare
from mdf_core.settings import Settings
from mdf_nodes.bag_writer import BagWriter
from mdf_nodes.conversions import DisplacementField, cloud_message, displacement_from_message, scan_from_message
from mdf_nodes.message_types import message_definition
from mdf_nodes.qos import SCAN

Start = Callable[..., CellProcess]
SETTINGS = Settings().replace({"verdict.tolerance_mm": TOLERANCE_MM})


@pytest.fixture(scope="module", params=CASES)
def recording(request: pytest.FixtureRequest) -> Recording:
    return Recording(request.param)


@pytest.fixture(scope="module")
def cell(recording: Recording, domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """A cell that the whole recording was played into."""
    with running_cell(recording, tmp_path_factory.mktemp(recording.name)) as running:
        running.play(tmp_path_factory.mktemp("player"))
        yield running


@dataclass(frozen=True, eq=False)
class Direct:
    """What the library makes of the last recorded scan, without ROS."""

    inspection: Inspection
    redesign: Redesign


@pytest.fixture(scope="module")
def direct(recording: Recording) -> Direct:
    scan = prepare(scan_from_cloud(recording.clouds[-1]), SETTINGS)
    inspection = inspect(recording.design, scan, SETTINGS)
    return Direct(inspection, compensate(recording.design, [inspection], SETTINGS))


def measured(cell: Cell) -> DisplacementField:
    return displacement_from_message(cell.last("displacement"))


def reprinted(cell: Cell) -> Any:
    """Vertices of the redesign as the same printer prints them."""
    mesh = cell.last("redesigned_mesh")
    return cell.recording.printer.print_part(load_design(mesh.path, mesh.unit).vertices)


def test_the_recordings_are_there() -> None:
    assert {"bracket", "bracket_rough", "housing_hidden"} <= set(CASES)


def test_the_design_is_the_one_that_was_printed(recording: Recording) -> None:
    expected = recording.expected["design"]
    assert (expected["path"], expected["unit"]) == ("design.stl", "mm")
    assert recording.design.file_sha256 == expected["sha256"]


def test_every_recorded_scan_is_inspected_and_redesigned(cell: Cell) -> None:
    stamps = [(cloud.header.stamp.sec, cloud.header.stamp.nanosec) for cloud in cell.recording.clouds]
    for topic in ("scan", "displacement", "deviation", "inspection", "redesigned_mesh"):
        headers = [message.header for message in cell.published[topic]]
        assert [(header.stamp.sec, header.stamp.nanosec) for header in headers] == stamps, topic
    inspections = cell.published["inspection"]
    assert [message.error_code for message in inspections] == [0] * len(stamps)
    assert {message.design_sha256 for message in inspections} == {cell.recording.design.file_sha256}
    assert [mesh.job_id for mesh in cell.published["redesigned_mesh"]] == [each.job_id for each in inspections]


def test_the_displacement_is_that_of_the_print(cell: Cell, record_property: Callable[[str, Any], None]) -> None:
    recording, field = cell.recording, measured(cell)
    missed = fraction_unrecovered(
        recording.design, recording.printed - recording.design.vertices, field.displacement, field.supported
    )
    record_property(f"{recording.name}: unrecovered share", missed)
    assert missed <= recording.expected["tolerances"]["largest_fraction"]


def test_what_the_scanner_saw_is_what_is_supported(cell: Cell, record_property: Callable[[str, Any], None]) -> None:
    recording, supported = cell.recording, measured(cell).supported
    tolerances, coverage = recording.expected["tolerances"], share_of_area(recording.design, supported)
    record_property(f"{recording.name}: coverage", coverage)
    assert tolerances["least_coverage"] <= coverage <= tolerances["most_coverage"]
    assert cell.last("inspection").coverage == pytest.approx(coverage)
    wrong = share_of_area(recording.design, supported != recording.last_scan.seen_vertices)
    assert wrong < 0.05


def test_the_pose_is_that_of_the_part_on_the_scanner(cell: Cell, direct: Direct) -> None:
    recording = cell.recording
    pose = cell.last("inspection").pose
    np.testing.assert_allclose(
        [pose.translation.x, pose.translation.y, pose.translation.z], direct.inspection.pose[:3, 3] * 1e-3, atol=1e-6
    )
    back = direct.inspection.pose @ np.array(recording.expected["scans"][-1]["T_scan_design_mm"])
    moved = np.linalg.norm(transform(back, recording.design.vertices) - recording.design.vertices, axis=1)
    assert moved.max() < 0.5 * recording.expected["truth"]["max_distortion_mm"]


def test_the_verdict_tells_that_the_print_is_out_of_tolerance(cell: Cell, direct: Direct) -> None:
    inspection = cell.last("inspection")
    assert cell.recording.expected["truth"]["max_distortion_mm"] > TOLERANCE_MM
    assert inspection.verdict == InspectionMessage.FAIL
    assert inspection.tolerance == pytest.approx(TOLERANCE_MM * 1e-3)
    assert list(inspection.reasons) == list(direct.inspection.verdict[1])
    assert f"{inspection.max_displacement * 1e3:.3f} mm above tolerance" in inspection.reasons[0]

    judged = {
        name: replace(direct.inspection, settings=SETTINGS.replace(changes)).verdict[0]
        for name, changes in {
            "wide": {"verdict.tolerance_mm": 10.0, "verdict.max_unseen_share": 0.5},
            "all seen": {"verdict.tolerance_mm": 10.0},
            "none": {"verdict.tolerance_mm": 0.0},
            "whole part": {"verdict.tolerance_mm": 10.0, "verdict.min_coverage": 0.95},
        }.items()
    }
    hidden = cell.recording.expected["tolerances"]["most_coverage"] < 0.95
    assert judged == {
        "wide": Verdict.PASS,
        "all seen": Verdict.NO_DECISION if hidden else Verdict.PASS,
        "none": Verdict.NO_DECISION,
        "whole part": Verdict.NO_DECISION if hidden else Verdict.PASS,
    }


def test_the_redesign_lies_on_disk_with_the_designs_faces(cell: Cell) -> None:
    mesh, path = cell.last("redesigned_mesh"), Path(cell.last("redesigned_mesh_path").data)
    assert path == Path(mesh.path)
    assert path.is_relative_to(cell.output_folder)
    assert mesh.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert mesh.unit == "mm"
    redesigned, design = load_design(path, "mm"), cell.recording.design
    np.testing.assert_array_equal(redesigned.faces, design.faces)
    moves = np.linalg.norm(redesigned.vertices - design.vertices, axis=1)
    assert moves.max() == pytest.approx(mesh.max_move * 1e3, abs=1e-4)
    assert (moves > 1e-4).sum() <= mesh.compensated_vertices <= len(design.vertices)


def test_the_redesign_prints_right(cell: Cell, record_property: Callable[[str, Any], None]) -> None:
    recording, supported = cell.recording, measured(cell).supported
    # What is left of the distortion is what an estimate would miss that takes the improvement for the distortion.
    left = fraction_unrecovered(
        recording.design,
        recording.printed - recording.design.vertices,
        recording.printed - reprinted(cell),
        supported,
    )
    record_property(f"{recording.name}: share left after one reprint", left)
    record_property(f"{recording.name}: s from the last scan to the redesign", cell.seconds)
    assert left <= recording.expected["tolerances"]["largest_fraction_left"]


def test_the_library_alone_comes_to_the_same_result_to_the_last_byte(cell: Cell, direct: Direct) -> None:
    field = measured(cell)
    for name in ("displacement", "inverse_displacement", "std"):
        # Only the change of unit rounds.
        np.testing.assert_allclose(getattr(field, name), getattr(direct.inspection, name), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(field.supported, direct.inspection.supported)
    assert Path(cell.last("redesigned_mesh").path).read_bytes() == direct.redesign.stl()


def on_a_table(part: Array) -> Array:
    """The points of a scan with three times as many of a table under it."""
    table = np.random.default_rng(0).uniform(-500.0, 500.0, (3 * len(part), 3))
    table[:, 2] = part[:, 2].min() - 10.0
    return np.concatenate([part, table])


def write_bag(folder: Path, cloud: PointCloud2) -> None:
    """A bag of one scan on /points."""
    name = "sensor_msgs/msg/PointCloud2"
    writer = BagWriter(folder)
    writer.add_topic("/points", name, message_definition(name), [SCAN])
    writer.write("/points", serialize_message(cloud), 0, 0)
    writer.close()


def test_a_part_on_a_table_is_replayed_as_the_cell_takes_it(graph: Graph, start: Start, tmp_path: Path) -> None:
    recording = Recording("bracket")
    part = scan_from_message(recording.clouds[-1]).points
    # More digits than the cell publishes, and normals that it has to estimate.
    columns = dict(zip("xyz", on_a_table(part).T / 1000.0, strict=True))
    cloud = cloud_message(columns, recording.clouds[-1].header)
    box = [*(part.min(axis=0) - 1.0).tolist(), *(part.max(axis=0) + 1.0).tolist()]
    changes = {
        "crop.box_mm": ",".join(map(str, box)),
        "thinning.target_points": "5000",
        "pose.initial": "0,0,0,0,0,0,1",
    }

    start("scan_ingest", "--ros-args", "-p", f"crop.box_mm:={box}", "-p", "thinning.target_points:=5000")
    scans = graph.collect(PointCloud2, "scan", SCAN)
    driver = graph.nodes[0].create_publisher(PointCloud2, "points", SCAN)
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    driver.publish(cloud)
    graph.wait_until(lambda: scans)
    in_cell = inspect(recording.design, scan_from_message(scans[0]), Settings().replace(changes))
    assert len(in_cell.deviation.points) > 4_000

    write_bag(tmp_path / "bag", cloud)
    shutil.copy(recording.folder / "design.stl", tmp_path / "bag")
    options = [option for change in changes.items() for option in ("--set", "=".join(change))]
    assert main(["replay", str(tmp_path / "bag"), "--out", str(tmp_path / "out"), *options]) == 0
    with np.load(tmp_path / "out" / "inspection.npz") as replayed:
        for name in ("displacement", "std", "supported"):
            np.testing.assert_array_equal(replayed[name], getattr(in_cell, name))
    assert json.loads((tmp_path / "out" / "report.json").read_bytes())["scan_sha256"] == in_cell.scan_sha256


def test_a_late_subscriber_gets_everything_about_the_last_scan(cell: Cell, graph: Graph) -> None:
    late = subscribe(graph, cell.namespace)
    graph.wait_until(
        lambda: all(late[topic][-1:] == [cell.last(topic)] for topic in RESULTS), what="everything latched"
    )
    most = {topic: qos.depth for topic, (_, qos) in RESULTS.items()}
    assert all(len(late[topic]) <= most[topic] for topic in RESULTS)


def test_a_cut_off_recording_is_played_up_to_the_cut(graph: Graph, start: Start, tmp_path: Path) -> None:
    recording = Recording("bracket")
    bag = Path(shutil.copytree(recording.folder, tmp_path / "bag"))
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 3 // 4])
    ingest = start("scan_ingest", "--ros-args", "-r", "__ns:=/cut")
    scans = graph.collect(PointCloud2, "/cut/scan", SCAN)
    graph.wait_until(lambda: "active" in ingest.output)
    player = start("bag_player", bag, "--ros-args", "-r", "/points:=/cut/points")
    assert player.wait() == 0, player.output
    assert f"warning: {bag} is cut off" in player.stderr
    assert "1 messages played" in player.stdout
    graph.wait_until(lambda: scans)
    stamp = recording.clouds[0].header.stamp
    assert [(each.header.stamp.sec, each.header.stamp.nanosec) for each in scans] == [(stamp.sec, stamp.nanosec)]


def test_a_topic_that_the_recording_has_not_is_refused_with_those_it_has(start: Start) -> None:
    folder = Recording("bracket").folder
    with pytest.raises(BagTopicError, match="no topic '/cloud'"):
        open_bag(folder).find_cloud_topic("/cloud")
    player = start("bag_player", folder, "--topics", "/cloud")
    assert player.wait() == 2
    assert player.stderr.startswith(f"error: {folder}: no topic '/cloud'")
    assert "/points (sensor_msgs/msg/PointCloud2)" in player.stderr
    assert player.stderr.count("\n") == 1
