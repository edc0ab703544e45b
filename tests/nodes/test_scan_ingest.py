"""scan_ingest: from a driver's topic, a folder or a service call to the topic `scan`."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import CellProcess, Graph
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from mdf_interfaces.srv import BeginScan, FinishScan, IngestScan
from rclpy.qos import QoSProfile, ReliabilityPolicy
from samples import cloud_of, parameters, scan_of, write_design
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import (
    CloudFormatError,
    InvalidSettingError,
    NoScanError,
    NotActiveError,
    PathNotAllowedError,
    ScanFileError,
)
from mdf_core.geometry import Design
from mdf_core.sampling import prepare
from mdf_core.settings import Settings
from mdf_nodes.conversions import scan_from_message
from mdf_nodes.qos import SCAN, SENSOR

Start = Callable[..., CellProcess]
FIELDS = ["x", "y", "z", "normal_x", "normal_y", "normal_z", "area"]


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
def test_a_drivers_cloud_becomes_a_scan_whatever_its_qos(
    graph: Graph, start: Start, design: Design, reliability: ReliabilityPolicy
) -> None:
    start("scan_ingest", "--ros-args", "-r", "__ns:=/cell1")
    scans = graph.collect(PointCloud2, "/cell1/scan", SCAN)
    driver = graph.nodes[0].create_publisher(PointCloud2, "/cell1/points", QoSProfile(depth=5, reliability=reliability))
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    cloud = cloud_of(scan_of(design))
    driver.publish(cloud)
    graph.wait_until(lambda: scans)
    assert scans[0].header == cloud.header
    assert [field.name for field in scans[0].fields] == FIELDS
    expected = prepare(scan_from_message(cloud), Settings())
    received = scan_from_message(scans[0])
    np.testing.assert_array_equal(received.points, expected.points)
    np.testing.assert_allclose(received.areas, expected.areas, rtol=1e-6)


def test_a_late_subscriber_gets_the_last_scan(graph: Graph, start: Start, design: Design) -> None:
    node = start("scan_ingest")
    driver = graph.node("driver").create_publisher(PointCloud2, "points", SENSOR)
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    driver.publish(cloud_of(scan_of(design), second=7))
    graph.wait_until(lambda: "published" in node.output)
    scans = graph.collect(PointCloud2, "scan", SCAN)
    graph.wait_until(lambda: scans)
    assert scans[0].header.stamp.sec == 7


def test_the_service_reads_a_file_and_tells_what_is_wrong_with_others(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    start("scan_ingest", "--ros-args", *parameters(scan_frame="turntable"))
    scans = graph.collect(PointCloud2, "scan", SCAN)
    client = graph.nodes[0].create_client(IngestScan, "ingest_scan")
    answer = graph.call(client, IngestScan.Request(path=design.path, unit="mm"))
    assert (answer.error_code, answer.error_msg) == (0, "")
    graph.wait_until(lambda: scans)
    assert scans[0].width == answer.points == len(design.vertices)
    assert scans[0].header.frame_id == "turntable"

    missing = graph.call(client, IngestScan.Request(path=str(tmp_path / "none.stl")))
    assert missing.error_code == ScanFileError.code and "none.stl" in missing.error_msg
    unit = graph.call(client, IngestScan.Request(path=design.path, unit="furlong"))
    assert unit.error_code == InvalidSettingError.code and "furlong" in unit.error_msg
    assert graph.call(client, IngestScan.Request(path=design.path)).error_code == 0


def test_requests_reach_no_file_outside_the_folders_allowed(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    allowed, other = tmp_path / "allowed", tmp_path / "allowed, not"
    allowed.mkdir()
    other.mkdir()
    shutil.copy(design.path, allowed / "part.stl")
    shutil.copy(design.path, other / "part.stl")
    (allowed / "link.stl").symlink_to(other / "part.stl")
    start("scan_ingest", "--ros-args", *parameters(request_folders=f"{tmp_path / 'none'}:{allowed}"))
    client = graph.node("robot").create_client(IngestScan, "ingest_scan")
    assert graph.call(client, IngestScan.Request(path=str(allowed / "part.stl"))).error_code == 0
    for path in (other / "part.stl", allowed / "../allowed, not/part.stl", allowed / "link.stl", Path("part.stl")):
        answer = graph.call(client, IngestScan.Request(path=str(path)))
        assert answer.error_code == PathNotAllowedError.code, path
        assert str(allowed) in answer.error_msg


def test_files_in_the_watched_folder_end_in_done_or_failed(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    start("scan_ingest", "--ros-args", *parameters(watch_folder=tmp_path))
    scans = graph.collect(PointCloud2, "scan", SCAN)
    shutil.copy(design.path, tmp_path / "part.STL")
    graph.wait_until((tmp_path / "done" / "part.STL").exists)
    graph.wait_until(lambda: len(scans) == 1)
    assert scans[0].header.stamp.sec > 0

    (tmp_path / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    reason = tmp_path / "failed" / "broken.ply.txt"
    graph.wait_until(reason.exists)
    assert "SCAN_FILE (106)" in reason.read_text() and "broken.ply" in reason.read_text()
    assert reason.with_suffix("").exists() and not (tmp_path / "broken.ply").exists()

    shutil.copy(design.path, tmp_path / "part.STL")
    graph.wait_until((tmp_path / "done" / "part-2.STL").exists)
    graph.wait_until(lambda: len(scans) == 2)
    assert not (tmp_path / "part.STL").exists()


def test_a_file_that_still_grows_is_left_alone(graph: Graph, start: Start, design: Design, tmp_path: Path) -> None:
    content = Path(design.path).read_bytes()
    node = start("scan_ingest", "--ros-args", *parameters(watch_folder=tmp_path))
    graph.node("waiting")
    graph.wait_until(lambda: "active" in node.output)
    with (tmp_path / "part.stl").open("wb") as file:
        chunk = len(content) // 40
        for begin in range(0, len(content), chunk):
            file.write(content[begin : begin + chunk])
            file.flush()
            graph.executor.spin_once(timeout_sec=0.05)
    graph.wait_until((tmp_path / "done" / "part.stl").exists)
    assert not (tmp_path / "failed").exists()


def test_a_missing_watched_folder_keeps_the_node_unconfigured_until_it_is_mended(
    graph: Graph, start: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "later"
    node = start("scan_ingest", "--ros-args", *parameters(watch_folder=folder))
    own = graph.node("operator")
    ingest = own.create_client(IngestScan, "ingest_scan")
    graph.wait_until(lambda: f"watch_folder {folder}: is no folder" in node.output)
    assert graph.call(ingest, IngestScan.Request(path="x.stl")).error_code == NotActiveError.code
    folder.mkdir()
    assert graph.change_state("scan_ingest", Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    assert graph.call(ingest, IngestScan.Request(path="x.stl")).error_code == ScanFileError.code


def test_an_invalid_transition_is_refused_and_the_node_lives(graph: Graph, start: Start) -> None:
    start("scan_ingest", "--ros-args", *parameters(autostart=False))
    own = graph.node("operator")
    change = own.create_client(ChangeState, "scan_ingest/change_state")
    state = own.create_client(GetState, "scan_ingest/get_state")
    activate = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
    assert not graph.call(change, activate).success
    assert graph.call(state, GetState.Request()).current_state.label == "unconfigured"
    configure = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert graph.call(change, configure).success
    assert graph.call(change, activate).success
    assert graph.call(state, GetState.Request()).current_state.label == "active"


def test_a_stop_signal_ends_the_node_cleanly(start: Start, graph: Graph) -> None:
    node = start("scan_ingest")
    graph.node("waiting")
    graph.wait_until(lambda: "active" in node.output)
    node.send(signal.SIGTERM)
    assert node.wait(2.0) == 0
    assert "Traceback" not in node.output


def test_help_needs_no_ros(start: Start) -> None:
    node = start("scan_ingest", "--help", ROS_DOMAIN_ID="no number")
    assert node.wait() == 0
    assert node.stdout.startswith("usage:")


def test_an_unknown_argument_is_refused(start: Start) -> None:
    node = start("scan_ingest", "--speed", "11")
    assert node.wait() == 2
    assert "--speed" in node.stderr


def test_several_views_become_one_scan(graph: Graph, start: Start, design: Design) -> None:
    node = start("scan_ingest")
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)

    not_begun = graph.call(finish, FinishScan.Request())
    assert not_begun.error_code == NoScanError.code
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    views = [scan_of(design, seed=seed) for seed in (1, 2, 3)]
    elsewhere = cloud_of(views[0], 4)
    elsewhere.header.frame_id = "robot"
    clouds = [cloud_of(view, second) for second, view in enumerate(views, 1)]
    for cloud in (clouds[0], elsewhere, *clouds[1:]):
        driver.publish(cloud)
    answer = graph.call(finish, FinishScan.Request(views=3))
    assert (answer.error_code, answer.views, answer.points) == (0, 3, 9000)
    graph.wait_until(lambda: scans)
    assert scans[0].header.stamp.sec == 3
    received = scan_from_message(scans[0])
    np.testing.assert_allclose(received.points, np.concatenate([view.points for view in views]), atol=1e-4)
    np.testing.assert_allclose(received.areas.sum(), design.face_areas.sum(), rtol=0.2)  # each place counts once
    graph.wait_until(lambda: "a view in frame 'robot', those before are in 'scanner'" in node.output)
    assert f"({CloudFormatError.code})" in node.output

    driver.publish(cloud_of(views[0], 9))  # from now on every cloud is a scan again
    graph.wait_until(lambda: len(scans) == 2)
    assert scans[1].width == 3000
