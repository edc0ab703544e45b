"""registration: scans from the topic, the service and the action, and what the cell gets of them."""

from __future__ import annotations

import math
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers import CellProcess, Graph
from lifecycle_msgs.msg import Transition
from mdf_interfaces.action import RegisterScan
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import Register
from rclpy.action import ActionClient
from samples import QUICK, QUICK_SETTINGS, cloud_of, parameters, scan_of, write_design
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import (
    CancelledError,
    EmptyScanError,
    JobTimeoutError,
    NoDesignError,
    NotActiveError,
    QueueFullError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.pipeline import inspect
from mdf_nodes.conversions import displacement_from_message, scan_from_message
from mdf_nodes.qos import LATCHED, REQUESTS, SCAN

Start = Callable[..., CellProcess]
ENDLESS = parameters(method="mdf", mixture__tolerance=0.0, mixture__max_iterations=100_000)
FIELDS = ["x", "y", "z", "dx", "dy", "dz", "ux", "uy", "uz", "std", "supported"]


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.fixture(scope="module")
def node(domain: int, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellProcess]:
    """A registration in namespace /cell1, known there as reg, that takes its scans from `other`."""
    services = ("-r", "register:=measure", "-r", "register_scan:=measure_scan")
    remappings = ("-r", "__ns:=/cell1", "-r", "__node:=reg", "-r", "scan:=other", *services)
    own = parameters(design_path=design.path, part_id="angle", is_simulated=True)
    folder = tmp_path_factory.mktemp("registration")
    process = CellProcess("registration", ("--ros-args", *remappings, *own, *QUICK), folder)
    process.wait_for("active")
    yield process
    process.close()


class Results:
    """What the cell publishes, in the order of arrival."""

    def __init__(self, graph: Graph, namespace: str = "/cell1") -> None:
        self.displacements = graph.collect(PointCloud2, f"{namespace}/displacement", LATCHED)
        self.deviations = graph.collect(PointCloud2, f"{namespace}/deviation", LATCHED)
        self.inspections = graph.collect(InspectionMessage, f"{namespace}/inspection", LATCHED)

    def of(self, second: int) -> bool:
        """Whether all three of the scan stamped `second` are here."""
        kinds = (self.displacements, self.deviations, self.inspections)
        return all(any(message.header.stamp.sec == second for message in kind) for kind in kinds)


def goal_of(graph: Graph, client: ActionClient, goal: RegisterScan.Goal, feedback: list[Any] | None = None) -> Any:
    """The handle of an accepted goal; on a busy machine it may have been sent twice."""
    graph.wait_until(client.server_is_ready)
    collect = None if feedback is None else lambda message: feedback.append(message.feedback)
    handle = graph.answer(lambda: client.send_goal_async(goal, feedback_callback=collect), 20.0, "register_scan")
    assert handle.accepted
    return handle


def jobs_of(graph: Graph, name: str) -> list[str]:
    """How many jobs wait or run in the node `name`, as its diagnostics tell again and again."""
    jobs: list[str] = []
    graph.nodes[0].create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda message: jobs.extend(
            value.value
            for status in message.status
            if status.name == name
            for value in status.values
            if value.key == "jobs waiting or running"
        ),
        10,
    )
    return jobs


def statuses_of(graph: Graph, name: str) -> list[DiagnosticStatus]:
    """What the diagnostics of the node `name` tell again and again."""
    statuses: list[DiagnosticStatus] = []
    graph.nodes[0].create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda message: statuses.extend(status for status in message.status if status.name == name),
        10,
    )
    return statuses


def assert_same_displacement(message: PointCloud2, cloud: PointCloud2, design: Design) -> None:
    """The message carries what the library computes from the same cloud, to a micrometre."""
    expected = inspect(design, scan_from_message(cloud), QUICK_SETTINGS)
    measured = displacement_from_message(message)
    np.testing.assert_allclose(measured.displacement, expected.displacement, atol=1e-3)
    np.testing.assert_allclose(measured.inverse_displacement, expected.inverse_displacement, atol=1e-3)
    np.testing.assert_allclose(measured.std, expected.std, atol=1e-3)
    np.testing.assert_array_equal(measured.supported, expected.supported)


def test_every_scan_on_the_topic_is_inspected(graph: Graph, node: CellProcess, design: Design) -> None:
    results = Results(graph)
    scanner = graph.nodes[0].create_publisher(PointCloud2, "/cell1/other", SCAN)
    cloud = cloud_of(scan_of(design), second=11)
    scanner.publish(cloud)
    graph.wait_until(lambda: results.of(11))
    displacement, deviation, inspection = results.displacements[-1], results.deviations[-1], results.inspections[-1]

    assert [field.name for field in displacement.fields] == FIELDS
    assert displacement.width == len(design.vertices)
    assert_same_displacement(displacement, cloud, design)
    assert displacement.header == deviation.header == inspection.header
    assert inspection.header.frame_id == "design"
    assert inspection.job_id.startswith(f"11.000000000-{inspection.scan_sha256[:8]}-")

    expected = inspect(design, scan_from_message(cloud), QUICK_SETTINGS)
    assert inspection.rms_displacement == pytest.approx(expected.rms_displacement * 1e-3)
    assert inspection.coverage == pytest.approx(expected.coverage)
    assert inspection.verdict == InspectionMessage.NO_DECISION and "tolerance" in inspection.reasons[0]
    assert inspection.settings_hash == QUICK_SETTINGS.sha256()
    assert (inspection.scan_sha256, inspection.design_sha256) == (expected.scan_sha256, design.file_sha256)
    assert (inspection.part_id, inspection.method, inspection.error_code) == ("angle", "surface", 0)
    assert inspection.is_simulated
    assert math.hypot(*(getattr(inspection.pose.rotation, axis) for axis in "xyzw")) == pytest.approx(1.0)
    assert deviation.width == inspection.points
    assert [field.name for field in deviation.fields] == ["x", "y", "z", "deviation", "outlier"]


def test_a_late_subscriber_gets_the_last_results(graph: Graph, node: CellProcess, design: Design) -> None:
    client = graph.node("robot", namespace="/cell1").create_client(Register, "measure")
    assert graph.call(client, Register.Request(scan=cloud_of(scan_of(design), second=12))).error_code == 0
    results = Results(graph)
    graph.wait_until(lambda: results.of(12))
    assert len(results.inspections) == 1


def test_the_service_answers_with_the_displacement(graph: Graph, node: CellProcess, design: Design) -> None:
    client = graph.node("robot", namespace="/cell1").create_client(Register, "measure")
    cloud = cloud_of(scan_of(design, seed=1), second=13)
    answer = graph.call(client, Register.Request(scan=cloud, part_id="third"))
    assert (answer.error_code, answer.error_msg) == (0, "")
    assert answer.inspection.part_id == "third"
    assert_same_displacement(answer.displacement, cloud, design)


def test_the_action_answers_with_the_displacement_and_tells_its_progress(
    graph: Graph, node: CellProcess, design: Design
) -> None:
    client = ActionClient(graph.node("robot", namespace="/cell1"), RegisterScan, "measure_scan")
    cloud = cloud_of(scan_of(design, seed=2), second=14)
    feedback: list[Any] = []
    handle = goal_of(graph, client, RegisterScan.Goal(scan=cloud), feedback)
    answer = graph.result(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.error_code, answer.result.error_msg) == (0, "")
    assert_same_displacement(answer.result.displacement, cloud, design)
    shares = [message.progress for message in feedback]
    assert len(shares) > 3
    assert shares == sorted(shares) and 0.0 <= shares[0] < shares[-1] <= 1.0
    assert {message.stage for message in feedback} <= {"prepare", "pose", "mixture", "surface", "interpolation"}


def test_the_latest_scan_can_be_registered_again_with_another_method(
    graph: Graph, node: CellProcess, design: Design
) -> None:
    own = graph.node("robot", namespace="/cell1")
    results = Results(graph)
    own.create_publisher(PointCloud2, "other", SCAN).publish(cloud_of(scan_of(design, points=800), second=15))
    graph.wait_until(lambda: results.of(15))
    client = ActionClient(own, RegisterScan, "measure_scan")
    handle = goal_of(graph, client, RegisterScan.Goal(use_latest=True, method="mdf"))
    answer = graph.result(handle.get_result_async(), 60.0)
    assert answer.result.error_code == 0
    assert answer.result.inspection.method == "mdf"
    assert answer.result.inspection.header.stamp.sec == 15


def test_two_goals_at_once_are_both_answered(graph: Graph, node: CellProcess, design: Design) -> None:
    client = ActionClient(graph.node("robot", namespace="/cell1"), RegisterScan, "measure_scan")
    clouds = [cloud_of(scan_of(design, seed=seed), second=seed) for seed in (16, 17)]
    handles = [goal_of(graph, client, RegisterScan.Goal(scan=cloud)) for cloud in clouds]
    futures = [handle.get_result_async() for handle in handles]
    for future, cloud in zip(futures, clouds, strict=True):
        answer = graph.result(future)
        assert answer.status == GoalStatus.STATUS_SUCCEEDED
        assert_same_displacement(answer.result.displacement, cloud, design)


def test_requests_of_many_clients_at_once_are_all_answered(graph: Graph, node: CellProcess, design: Design) -> None:
    robot = graph.node("robot", namespace="/cell1")
    clients = [robot.create_client(Register, "measure") for _ in range(16)]
    for client in clients:
        assert graph.call(client, Register.Request()).error_code == EmptyScanError.code
    slow = clients[0].call_async(Register.Request(scan=cloud_of(scan_of(design))))
    futures = [client.call_async(Register.Request()) for client in clients[1:]]
    assert {graph.result(future).error_code for future in futures} == {EmptyScanError.code}
    assert graph.result(slow).error_code == 0


def test_many_goals_at_once_are_all_answered(graph: Graph, node: CellProcess) -> None:
    qos = {"goal_service_qos_profile": REQUESTS, "result_service_qos_profile": REQUESTS}
    client = ActionClient(graph.node("robot", namespace="/cell1"), RegisterScan, "measure_scan", **qos)
    goal_of(graph, client, RegisterScan.Goal())
    sent = [client.send_goal_async(RegisterScan.Goal()) for _ in range(40)]
    futures = [graph.result(future).get_result_async() for future in sent]
    codes = {graph.result(future).result.error_code for future in futures}
    assert codes <= {EmptyScanError.code, QueueFullError.code}


def test_a_client_that_goes_away_does_no_harm(graph: Graph, start: Start, design: Design) -> None:
    start("registration", "--ros-args", *parameters(design_path=design.path), *QUICK, *ENDLESS)
    own = graph.node("staying")
    jobs = jobs_of(graph, "/registration")
    leaving = Graph()
    client = leaving.node("leaving").create_client(Register, "register")
    leaving.wait_until(client.service_is_ready)
    client.call_async(Register.Request(scan=cloud_of(scan_of(design))))
    graph.wait_until(lambda: jobs[-1:] == ["1"])
    leaving.close()

    assert graph.change_state("registration", Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)
    staying = own.create_client(Register, "register")
    request = Register.Request(scan=cloud_of(scan_of(design)), method="surface")
    assert graph.call(staying, request).error_code == 0


def test_diagnostics_tell_of_the_last_job(graph: Graph, node: CellProcess, design: Design) -> None:
    client = graph.node("robot", namespace="/cell1").create_client(Register, "measure")
    answer = graph.call(client, Register.Request(scan=cloud_of(scan_of(design), second=19)))
    statuses = statuses_of(graph, "/cell1/reg")
    graph.wait_until(lambda: statuses)
    assert statuses[-1].level == DiagnosticStatus.OK
    assert answer.inspection.job_id in statuses[-1].message
    values = {value.key: value.value for value in statuses[-1].values}
    assert values["state"] == "active" and values["design"] == design.path
    residual, memory = values["residual scale of the last inspection"], values["resident memory"]
    assert float(residual.removesuffix(" mm")) == pytest.approx(1e3 * answer.inspection.residual_scale, abs=1e-4)
    assert 50 < int(memory.removesuffix(" MiB")) < 2_000
    assert values["scans waiting for an answer"] == "0" and int(values["scans accepted"]) > 0


def test_diagnostics_tell_of_a_job_that_failed_until_one_succeeds(
    graph: Graph, node: CellProcess, design: Design
) -> None:
    client = graph.node("robot", namespace="/cell1").create_client(Register, "measure")
    statuses = statuses_of(graph, "/cell1/reg")
    assert graph.call(client, Register.Request()).error_code == EmptyScanError.code
    graph.wait_until(lambda: statuses and statuses[-1].level == DiagnosticStatus.ERROR)
    assert f"EMPTY_SCAN ({EmptyScanError.code})" in statuses[-1].message
    answer = graph.call(client, Register.Request(scan=cloud_of(scan_of(design))))
    graph.wait_until(lambda: statuses[-1].level == DiagnosticStatus.OK)
    assert answer.inspection.job_id in statuses[-1].message


def test_a_design_file_that_comes_late_is_loaded_and_what_kept_the_node_is_over(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    late = tmp_path / "late.stl"
    start("registration", "--ros-args", *parameters(design_path=late))
    graph.node("operator")
    statuses = statuses_of(graph, "/registration")
    graph.wait_until(lambda: statuses and statuses[-1].level == DiagnosticStatus.ERROR)
    assert "late.stl" in statuses[-1].message
    shutil.copy(design.path, late)
    assert graph.change_state("registration", Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    graph.wait_until(lambda: statuses[-1].level == DiagnosticStatus.OK)


def test_nothing_of_the_node_is_outside_its_namespace(graph: Graph, node: CellProcess) -> None:
    own = graph.node("observer")
    of_the_node = {(name, "/cell1") for name in ("reg", "_reg_clouds", "_reg_services")}
    graph.wait_until(lambda: of_the_node <= set(own.get_node_names_and_namespaces()))
    graph.wait_until(lambda: "/cell1/displacement" in dict(own.get_topic_names_and_types()))
    topics = {name for name, _ in own.get_topic_names_and_types()}
    outside = {name for name in topics if not name.startswith("/cell1/")}
    assert outside <= {"/diagnostics", "/rosout", "/parameter_events"}
    assert "/cell1/scan" not in topics


def test_a_cancelled_goal_ends_at_its_next_iteration(graph: Graph, start: Start, design: Design) -> None:
    start("registration", "--ros-args", *parameters(design_path=design.path), *QUICK, *ENDLESS)
    client = ActionClient(graph.node("robot"), RegisterScan, "register_scan")
    goal = RegisterScan.Goal(scan=cloud_of(scan_of(design)))
    feedback: list[Any] = []
    running = goal_of(graph, client, goal, feedback)
    graph.wait_until(lambda: feedback)
    waiting = goal_of(graph, client, goal)
    for handle in (waiting, running):
        began = time.monotonic()
        result = handle.get_result_async()
        handle.cancel_goal_async()
        answer = graph.result(result)
        assert time.monotonic() - began < 2.0
        assert answer.status == GoalStatus.STATUS_CANCELED
        assert answer.result.error_code == CancelledError.code


def test_a_scan_that_waits_is_registered_to_the_design_that_it_was_sent_for(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    slow = parameters(design_path=design.path, mixture__tolerance=0.0, mixture__max_iterations=100_000)
    node = start("registration", "--ros-args", *slow, *QUICK)
    robot = graph.node("robot")
    client = ActionClient(robot, RegisterScan, "register_scan")
    jobs = jobs_of(graph, "/registration")
    running = goal_of(graph, client, RegisterScan.Goal(scan=cloud_of(scan_of(design)), method="mdf"))
    waiting = goal_of(graph, client, RegisterScan.Goal(scan=cloud_of(scan_of(design)))).get_result_async()
    graph.wait_until(lambda: jobs and jobs[-1] == "2")

    other = tmp_path / "other.stl"
    other.write_bytes(stl_bytes(1.01 * design.vertices, design.faces))
    announced = DesignMessage(path=str(other), unit="mm", sha256=load_design(other, "mm").file_sha256)
    robot.create_publisher(DesignMessage, "design", LATCHED).publish(announced)
    graph.wait_until(lambda: f"design {other}" in node.output)
    running.cancel_goal_async()
    assert graph.result(waiting).result.inspection.design_path == design.path
    later = goal_of(graph, client, RegisterScan.Goal(scan=cloud_of(scan_of(design))))
    assert graph.result(later.get_result_async()).result.inspection.design_path == str(other)


def test_more_jobs_than_the_queue_takes_are_refused_and_the_others_done(
    graph: Graph, start: Start, design: Design
) -> None:
    start("registration", "--ros-args", *parameters(design_path=design.path, queue_size=1), *QUICK)
    client = ActionClient(graph.node("robot"), RegisterScan, "register_scan")
    goal = RegisterScan.Goal(scan=cloud_of(scan_of(design)))
    graph.wait_until(client.server_is_ready)
    sent = [client.send_goal_async(goal) for _ in range(6)]
    futures = [graph.result(future).get_result_async() for future in sent]
    codes = [graph.result(future).result.error_code for future in futures]
    assert set(codes) == {0, QueueFullError.code}


def test_a_job_that_takes_too_long_ends_and_is_told(graph: Graph, start: Start, design: Design) -> None:
    start("registration", "--ros-args", *parameters(design_path=design.path, job_timeout=0.5), *QUICK, *ENDLESS)
    client = graph.node("robot").create_client(Register, "register")
    answer = graph.call(client, Register.Request(scan=cloud_of(scan_of(design))))
    assert answer.error_code == JobTimeoutError.code
    assert "longer than 0.5 s" in answer.error_msg


@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)])
def test_stop_signals_answer_what_runs_and_waits(
    graph: Graph, start: Start, design: Design, signals: tuple[int, ...]
) -> None:
    node = start("registration", "--ros-args", *parameters(design_path=design.path), *QUICK, *ENDLESS)
    own = graph.node("robot")
    client = ActionClient(own, RegisterScan, "register_scan")
    service = own.create_client(Register, "register")
    assert graph.call(service, Register.Request()).error_code != 0  # each has found the other: no request gets lost
    goal = RegisterScan.Goal(scan=cloud_of(scan_of(design)))
    feedback: list[Any] = []
    futures = [goal_of(graph, client, goal, feedback).get_result_async() for _ in range(2)]
    graph.wait_until(lambda: feedback)
    # Not before: a request may overtake a goal, and while it runs, which it does for ever, no goal has feedback.
    call = service.call_async(Register.Request(scan=goal.scan))
    jobs = jobs_of(graph, "/registration")
    graph.wait_until(lambda: jobs and int(jobs[-1]) >= 3)
    for number in signals:
        node.send(number)
    for future in futures:
        answer = graph.result(future)
        assert answer.status == GoalStatus.STATUS_ABORTED
        assert answer.result.error_code == NotActiveError.code
        assert "shutting down" in answer.result.error_msg
    assert graph.result(call).error_code == NotActiveError.code
    assert node.wait(10.0) == 0
    assert "Traceback" not in node.output


def test_an_inactive_node_refuses_requests_and_catches_up_with_the_last_scan(
    graph: Graph, start: Start, design: Design
) -> None:
    node = start("registration", "--ros-args", *parameters(design_path=design.path, autostart=False), *QUICK)
    own = graph.node("operator")
    results = Results(graph, "")
    scanner = own.create_publisher(PointCloud2, "scan", SCAN)
    scanner.publish(cloud_of(scan_of(design), second=21))
    service = own.create_client(Register, "register")
    assert graph.call(service, Register.Request(scan=cloud_of(scan_of(design)))).error_code == NotActiveError.code
    client = ActionClient(own, RegisterScan, "register_scan")
    answer = graph.result(goal_of(graph, client, RegisterScan.Goal(use_latest=True)).get_result_async())
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == NotActiveError.code
    graph.wait_until(lambda: scanner.get_subscription_count() == 1)
    assert graph.change_state("registration", Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    graph.wait_until(lambda: results.of(21))

    assert graph.change_state("registration", Transition.TRANSITION_DEACTIVATE)
    assert graph.call(service, Register.Request(scan=cloud_of(scan_of(design)))).error_code == NotActiveError.code
    assert node.stop() == 0


def test_a_node_without_a_design_follows_the_topic_design(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    start("registration", "--ros-args", *QUICK)
    own = graph.node("operator")
    results = Results(graph, "")
    own.create_publisher(PointCloud2, "scan", SCAN).publish(cloud_of(scan_of(design), second=22))
    graph.wait_until(lambda: results.inspections)
    refusal = results.inspections[-1]
    assert refusal.error_code == NoDesignError.code
    assert refusal.verdict == InspectionMessage.NO_DECISION
    assert refusal.reasons[0].startswith("NO_DESIGN (204): ")
    assert not results.displacements

    designs = own.create_publisher(DesignMessage, "design", LATCHED)
    designs.publish(DesignMessage(path=design.path, unit="mm", part_id="angle", sha256=design.file_sha256))
    graph.wait_until(lambda: results.of(22) and results.inspections[-1].error_code == 0)
    assert results.inspections[-1].part_id == "angle"

    designs.publish(DesignMessage(path=str(tmp_path / "gone.stl"), unit="mm"))
    service = own.create_client(Register, "register")
    request = Register.Request(scan=cloud_of(scan_of(design)))
    graph.wait_until(lambda: "gone.stl" in graph.call(service, request).error_msg)
