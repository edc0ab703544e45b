"""scan_ingest: from a driver's topic, a folder or a service call to the topic `scan`."""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from helpers import CellProcess, Graph, set_parameters
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from mdf_interfaces.srv import BeginScan, FinishScan, IngestScan
from rclpy.qos import QoSProfile, ReliabilityPolicy
from samples import cloud_of, parameters, scan_of, write_design
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.errors import (
    CloudFormatError,
    InvalidSettingError,
    MemoryBudgetError,
    NoScanError,
    NotActiveError,
    PathNotAllowedError,
    ScanFileError,
)
from mdf_core.geometry import Design, PointSet
from mdf_core.rigid import homogeneous, inverse, rotate, transform
from mdf_core.sampling import prepare
from mdf_core.settings import Settings
from mdf_nodes import scan_ingest
from mdf_nodes.conversions import scan_from_message, transform_from_message, transform_message
from mdf_nodes.qos import SCAN
from mdf_nodes.scan_ingest import ScanIngest
from mdf_nodes.views import View, ViewPoses, Views

Start = Callable[..., CellProcess]
FIELDS = ["x", "y", "z", "normal_x", "normal_y", "normal_z", "area"]


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.fixture
def node(domain: int) -> Iterator[ScanIngest]:
    """A node in this process, whose races a test can bring about."""
    node = ScanIngest()
    node.start()
    yield node
    node.stop()


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
def test_a_drivers_cloud_becomes_a_scan_whatever_its_qos(
    graph: Graph, start: Start, design: Design, reliability: ReliabilityPolicy
) -> None:
    start("scan_ingest", "--ros-args", "-r", "__ns:=/cell1")
    scans = graph.collect(PointCloud2, "/cell1/scan", SCAN)
    driver = graph.nodes[0].create_publisher(PointCloud2, "/cell1/points", QoSProfile(depth=5, reliability=reliability))
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    cloud = cloud_of(scan_of(design))
    graph.nodes[0].create_timer(0.2, lambda: driver.publish(cloud))  # best effort may lose some
    graph.wait_until(lambda: scans)
    assert scans[0].header == cloud.header
    assert [field.name for field in scans[0].fields] == FIELDS
    expected = prepare(scan_from_message(cloud), Settings())
    received = scan_from_message(scans[0])
    np.testing.assert_array_equal(received.points, expected.points)
    np.testing.assert_allclose(received.areas, expected.areas, rtol=1e-6)


def test_a_late_subscriber_gets_the_last_scan(graph: Graph, start: Start, design: Design) -> None:
    node = start("scan_ingest")
    driver = graph.node("driver").create_publisher(PointCloud2, "points", QoSProfile(depth=5))
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
    nothing = graph.call(client, IngestScan.Request())
    assert nothing.error_code == InvalidSettingError.code and "no path is given" in nothing.error_msg
    unit = graph.call(client, IngestScan.Request(path=design.path, unit="furlong"))
    assert unit.error_code == InvalidSettingError.code and "furlong" in unit.error_msg
    assert graph.call(client, IngestScan.Request(path=design.path)).error_code == 0


def test_the_table_is_cropped_before_anything_is_published(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    start("scan_ingest", "--ros-args", "-p", "crop.box_mm:=[-1.0, -1.0, -1.0, 61.0, 31.0, 41.0]")
    scans = graph.collect(PointCloud2, "scan", SCAN)
    client = graph.node("robot").create_client(IngestScan, "ingest_scan")
    part = scan_of(design).points
    table = np.array([500.0, 500.0, -50.0]) * np.random.default_rng(0).uniform(size=(1_000, 3)) - [0.0, 0.0, 2.0]
    np.save(tmp_path / "scan.npy", np.concatenate([part, table]))
    answer = graph.call(client, IngestScan.Request(path=str(tmp_path / "scan.npy"), unit="mm"))
    assert (answer.error_code, answer.points) == (0, len(part))
    graph.wait_until(lambda: scans)
    np.testing.assert_allclose(scan_from_message(scans[0]).points, part, atol=1e-4)


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

    kept = tmp_path / "failed" / "broken.ply.txt"  # a scan whose name is that of a reason
    kept.parent.mkdir()
    kept.write_text("0 0 0\n")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    reason = tmp_path / "failed" / "broken-2.ply.txt"
    graph.wait_until(reason.exists)
    assert kept.read_text() == "0 0 0\n"
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


def test_a_file_that_somebody_still_writes_is_left_alone_however_long_he_pauses(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    node = start("scan_ingest", "--ros-args", *parameters(watch_folder=tmp_path))
    scans = graph.collect(PointCloud2, "scan", SCAN)
    points = scan_of(design).points
    with (tmp_path / "slow.xyz").open("w") as slow:
        np.savetxt(slow, points[:1_500])
        slow.flush()
        for number in range(3):  # each of them takes two looks at the folder
            shutil.copy(design.path, tmp_path / f"other_{number}.stl")
            graph.wait_until((tmp_path / "done" / f"other_{number}.stl").exists)
        assert not (tmp_path / "done" / "slow.xyz").exists()
        np.savetxt(slow, points[1_500:])
    graph.wait_until((tmp_path / "done" / "slow.xyz").exists)
    graph.wait_until(lambda: scans[-1].width == len(points))
    assert "ERROR" not in node.output


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


def test_what_kept_the_node_from_starting_is_tried_again(graph: Graph, start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "later"
    node = start("scan_ingest", "--ros-args", *parameters(watch_folder=folder))
    graph.node("waiting")
    graph.wait_until(lambda: f"watch_folder {folder}: is no folder" in node.output)
    folder.mkdir()
    graph.wait_until(lambda: "active" in node.output)


def test_a_watched_folder_that_vanishes_is_told_of_once_and_taken_from_when_it_is_back(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    folder = tmp_path / "watched"
    folder.mkdir()
    node = start("scan_ingest", "--ros-args", *parameters(watch_folder=folder))
    told = graph.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    graph.wait_until(lambda: "active" in node.output)
    folder.rmdir()
    graph.wait_until(lambda: f"watch_folder {folder}: cannot be read" in node.output)
    before = len(told)
    graph.wait_until(lambda: len(told) >= before + 3)  # two looks at the folder for each of them
    assert node.output.count("cannot be read") == 1
    folder.mkdir()
    shutil.copy(design.path, folder / "part.stl")
    graph.wait_until((folder / "done" / "part.stl").exists)


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


def test_a_shutdown_stops_what_a_deactivation_stops(graph: Graph, start: Start) -> None:
    start("scan_ingest")
    told = graph.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    own = graph.nodes[0]
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")

    def shows(state: str, views: str) -> bool:
        values = {pair.key: pair.value for array in told[-1:] for pair in array.status[0].values}
        return (values.get("state"), values.get("views")) == (state, views)

    assert graph.call(begin, BeginScan.Request()).error_code == 0
    graph.wait_until(lambda: shows("active", "0"))
    shutdown = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN))
    assert graph.call(own.create_client(ChangeState, "scan_ingest/change_state"), shutdown).success
    graph.wait_until(lambda: shows("finalized", "each a scan"))
    assert graph.call(finish, FinishScan.Request()).error_code == NotActiveError.code


def test_a_stop_signal_ends_the_node_cleanly(start: Start, graph: Graph) -> None:
    node = start("scan_ingest")
    graph.node("waiting")
    graph.wait_until(lambda: "active" in node.output)
    node.send(signal.SIGTERM)
    assert node.wait(10.0) == 0
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
    start("scan_ingest")
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)

    not_begun = graph.call(finish, FinishScan.Request())
    assert not_begun.error_code == NoScanError.code
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    views = [scan_of(design, seed=seed) for seed in (1, 2, 3)]
    for second, view in enumerate(views, 1):
        driver.publish(cloud_of(view, second))
    answer = graph.call(finish, FinishScan.Request(views=3))
    assert (answer.error_code, answer.views, answer.points) == (0, 3, 9000)
    graph.wait_until(lambda: scans)
    assert scans[0].header.stamp.sec == 3
    received = scan_from_message(scans[0])
    np.testing.assert_allclose(received.points, np.concatenate([view.points for view in views]), atol=1e-4)
    np.testing.assert_allclose(received.areas.sum(), design.face_areas.sum(), rtol=0.2)  # each place counts once

    driver.publish(cloud_of(views[0], 9))  # from now on every cloud is a scan again
    graph.wait_until(lambda: len(scans) == 2)
    assert scans[1].width == 3000


def test_views_after_one_too_many_are_no_scans_and_finish_scan_tells_why(
    graph: Graph, start: Start, design: Design
) -> None:
    node = start("scan_ingest", "--ros-args", *parameters(memory_mib=1))
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    view = scan_of(design, points=4000)  # of which a quarter of 1 MiB holds two

    assert graph.call(begin, BeginScan.Request()).error_code == 0
    for second in (1, 2, 3, 4):
        driver.publish(cloud_of(view, second))
    told = f"MEMORY_BUDGET ({MemoryBudgetError.code})"
    graph.wait_until(lambda: node.output.count(told) >= 2)
    for views in (4, 0):
        answer = graph.call(finish, FinishScan.Request(views=views))
        assert answer.error_code == MemoryBudgetError.code and "3 views hold" in answer.error_msg
    driver.publish(cloud_of(view, 5))
    graph.wait_until(lambda: node.output.count(told) >= 5)
    assert not scans

    assert graph.call(begin, BeginScan.Request()).error_code == 0
    driver.publish(cloud_of(view, 6))
    assert graph.call(finish, FinishScan.Request(views=1)).error_code == 0
    graph.wait_until(lambda: scans)
    assert (len(scans), scans[0].header.stamp.sec) == (1, 6)


def test_a_scan_that_nobody_finishes_is_given_up_and_clouds_are_scans_again(
    graph: Graph, node: ScanIngest, design: Design
) -> None:
    set_parameters(node, view_timeout=0.0)  # never
    scans = graph.collect(PointCloud2, "scan", SCAN)
    told = graph.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    assert np.isnan(node.diagnostics()["seconds since begin_scan"])
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    driver.publish(cloud_of(scan_of(design), 1))
    graph.wait_until(lambda: node.diagnostics()["views"] == "1")
    looks = len(told)
    graph.wait_until(lambda: len(told) >= looks + 2)  # two looks at the views for each of them
    assert node.diagnostics()["views"] == "1"
    assert node.diagnostics()["seconds since begin_scan"] >= 0.5

    set_parameters(node, view_timeout=0.1)
    graph.wait_until(lambda: node.diagnostics()["views"] == "each a scan")
    assert np.isnan(node.diagnostics()["seconds since begin_scan"])
    message = "TIMEOUT (306): begin_scan: no view for more than 0.1 s: the 1 that have come are dropped"
    graph.wait_until(lambda: told[-1].status[0].message.startswith(message))
    assert told[-1].status[0].level == DiagnosticStatus.ERROR
    driver.publish(cloud_of(scan_of(design), 2))
    graph.wait_until(lambda: scans)
    assert (scans[0].header.stamp.sec, scans[0].width) == (2, 3000)
    assert graph.call(finish, FinishScan.Request()).error_code == NoScanError.code


def test_a_view_that_waits_for_its_turn_keeps_the_scan(
    graph: Graph, node: ScanIngest, design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def load(path: str, unit: str) -> PointSet:
        assert go_on.wait(60.0)
        return scan_of(design)

    monkeypatch.setattr(scan_ingest, "load_scan", load)
    told = graph.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, ingest = own.create_client(BeginScan, "begin_scan"), own.create_client(IngestScan, "ingest_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    graph.wait_until(ingest.service_is_ready)
    ingest.call_async(IngestScan.Request(path="part.ply"))
    graph.wait_until(lambda: len(node.require_active()) == 1)
    driver.publish(cloud_of(scan_of(design)))
    graph.wait_until(lambda: len(node.require_active()) == 2)
    set_parameters(node, view_timeout=0.1)
    looks = len(told)
    graph.wait_until(lambda: len(told) >= looks + 2)  # two looks at the views for each of them
    assert len(node.require_active()) == 2
    set_parameters(node, view_timeout=300.0)
    go_on.set()
    graph.wait_until(lambda: node.diagnostics()["views"] == "1")


def test_each_view_that_is_kept_is_waited_for_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("mdf_nodes.views.time", SimpleNamespace(monotonic=lambda: now[0]))
    points = np.arange(12.0).reshape(4, 3)
    views = Views("", ViewPoses(), 1.5 * points.nbytes)
    now[0] += 7.0
    assert (views.seconds_waited, views.seconds_open) == (7.0, 7.0)
    views.add(View(PointSet(points), Header()))
    assert (views.seconds_waited, views.seconds_open) == (0.0, 7.0)
    now[0] += 5.0
    with pytest.raises(MemoryBudgetError):
        views.add(View(PointSet(points), Header()))
    assert views.seconds_waited == 5.0


def test_begin_scan_anew_drops_the_views_before_and_tells_of_it(
    graph: Graph, node: ScanIngest, design: Design, capfd: pytest.CaptureFixture[str]
) -> None:
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    driver.publish(cloud_of(scan_of(design), 1))
    graph.wait_until(lambda: node.diagnostics()["views"] == "1")
    assert "dropped" not in capfd.readouterr().err
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    assert "1 views that were not finished are dropped" in capfd.readouterr().err
    driver.publish(cloud_of(scan_of(design), 2))
    assert graph.call(finish, FinishScan.Request(views=1)).views == 1
    graph.wait_until(lambda: scans)
    assert (scans[0].header.stamp.sec, scans[0].width) == (2, 3000)


def test_a_deactivation_forgets_views_and_one_too_many(graph: Graph, start: Start, design: Design) -> None:
    node = start("scan_ingest", "--ros-args", *parameters(memory_mib=1))
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own = graph.nodes[0]
    driver = own.create_publisher(PointCloud2, "points", QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE))
    begin = own.create_client(BeginScan, "begin_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    assert graph.call(begin, BeginScan.Request()).error_code == 0
    driver.publish(cloud_of(scan_of(design, points=12_000), 1))
    graph.wait_until(lambda: f"({MemoryBudgetError.code})" in node.output)
    assert graph.change_state("scan_ingest", Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)
    driver.publish(cloud_of(scan_of(design), 2))
    graph.wait_until(lambda: scans)
    assert scans[0].header.stamp.sec == 2


def test_views_in_other_frames_are_merged_by_their_poses_and_never_without(
    graph: Graph, start: Start, design: Design
) -> None:
    start("scan_ingest")
    scans = graph.collect(PointCloud2, "scan", SCAN)
    own, reliable = graph.nodes[0], QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
    driver = own.create_publisher(PointCloud2, "points", reliable)
    turntable = own.create_publisher(TransformStamped, "view_pose", reliable)
    begin, finish = own.create_client(BeginScan, "begin_scan"), own.create_client(FinishScan, "finish_scan")
    graph.wait_until(lambda: driver.get_subscription_count() == 1 and turntable.get_subscription_count() == 1)

    def tell(second: int, motion: np.ndarray) -> None:
        pose = TransformStamped(child_frame_id="scanner", transform=transform_message(motion))
        pose.header.frame_id, pose.header.stamp.sec = "turntable", second
        turntable.publish(pose)

    assert graph.call(begin, BeginScan.Request(frame_id="turntable")).error_code == 0
    parts, motions = [scan_of(design, seed=seed) for seed in (1, 2)], []
    for second, part in enumerate(parts, 1):
        turn = Rotation.from_euler("z", 90.0 * second, degrees=True).as_matrix()
        motions.append(homogeneous(turn, np.array([10.0, 0.0, 5.0 * second])))  # T_turntable_scanner, mm
        away = inverse(motions[-1])
        seen = PointSet(transform(away, part.points), rotate(away, part.normals))
        driver.publish(cloud_of(seen, second))
    tell(1, motions[0])
    tell(3, motions[1])  # of another view: it says nothing about the second
    answer = graph.call(finish, FinishScan.Request(views=2))
    assert answer.error_code == CloudFormatError.code
    assert "frame 'scanner' at 2.000000000, the scan is in 'turntable'" in answer.error_msg
    assert not scans

    tell(2, motions[1])
    answer = graph.call(finish, FinishScan.Request(views=2))
    assert (answer.error_code, answer.views, answer.points) == (0, 2, 6000)
    graph.wait_until(lambda: scans)
    assert scans[0].header.frame_id == "turntable" and scans[0].header.stamp.sec == 2
    received = scan_from_message(scans[0])
    np.testing.assert_allclose(received.points, np.concatenate([part.points for part in parts]), atol=1e-4)
    np.testing.assert_allclose(received.normals, np.concatenate([part.normals for part in parts]), atol=1e-5)


def test_a_pose_with_stamp_0_holds_for_all_views_in_its_frame() -> None:
    poses, turn = ViewPoses(), np.diag([1.0, -1.0, -1.0, 1.0])
    views = Views("", poses, 1e6)
    points = np.arange(12.0).reshape(4, 3)
    for second, frame_id in enumerate(("front", "back", "back")):
        header = Header(frame_id=frame_id)
        header.stamp.sec = second
        views.add(View(PointSet(points), header))
    assert not views.has_all_poses()
    with pytest.raises(CloudFormatError, match="frame 'back' at 1"):
        views.merged()
    pose = TransformStamped(child_frame_id="back", transform=transform_message(turn))
    pose.header.frame_id = "front"
    poses.add(pose)
    assert views.has_all_poses()
    merged = views.merged()
    assert merged.header.frame_id == "front" and merged.header.stamp.sec == 2
    turned = points * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(merged.scan.points, np.vstack([points, turned, turned]), atol=1e-12)


@pytest.mark.parametrize("number", [0.0, float("nan")])
def test_a_pose_without_a_rotation_is_refused(number: float) -> None:
    message = transform_message(np.eye(4))
    message.rotation.w = number
    with pytest.raises(CloudFormatError, match="rotation of length 0 or numbers that are not finite"):
        transform_from_message(message)


def test_diagnostics_count_the_drivers_clouds(graph: Graph, start: Start, design: Design) -> None:
    start("scan_ingest")
    told = graph.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    driver = graph.nodes[0].create_publisher(PointCloud2, "points", QoSProfile(depth=5))
    graph.wait_until(lambda: driver.get_subscription_count() == 1)
    driver.publish(cloud_of(scan_of(design)))
    driver.publish(PointCloud2())  # nothing that could be registered

    def counts() -> list[str]:
        values = {pair.key: pair.value for array in told[-1:] for pair in array.status[0].values}
        names = ("received", "received in the last minute", "lost on the way", "refused")
        return [values.get(f"clouds {name}", "") for name in names]

    graph.wait_until(lambda: counts() == ["2", "2", "0", "1"])
