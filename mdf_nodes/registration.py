"""The node registration: scans in; displacement, deviation and inspection out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from mdf_interfaces.action import RegisterScan
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import Register
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.coarseness import coarseness
from mdf_core.errors import (
    CancelledError,
    DesignMismatchError,
    JobTimeoutError,
    MdfError,
    NoScanError,
    NotActiveError,
    QueueFullError,
    RegistrationFailedError,
)
from mdf_core.inspection import Inspection
from mdf_core.pipeline import inspect
from mdf_core.progress import Progress, ProgressCallback, silent
from mdf_core.settings import Settings
from mdf_nodes.cell_design import (
    CellDesign,
    configured_choice,
    declare_design,
    load_cell_design,
    load_configured_design,
    no_design,
)
from mdf_nodes.conversions import (
    deviation_message,
    displacement_message,
    feedback_message,
    inspection_message,
    refusal_message,
    scan_from_message,
)
from mdf_nodes.jobs import Job
from mdf_nodes.journal import DesignChoice, Entry, Journal, declare_journal, open_journal
from mdf_nodes.managed_node import ManagedNode, run_managed_node
from mdf_nodes.parameters import declare, declare_settings, regions_from, settings_from
from mdf_nodes.qos import LATCHED, REQUESTS, SCAN

_RESULT_SECONDS = 60  # results hold clouds; clients ask for theirs at once
_CANCEL_POLL_SECONDS = 0.02
_RESUME_SECONDS = 1.0
_MOST_ATTEMPTS = 4
_DELIVERY_SECONDS = 5.0  # that a scan on disk is given to come by topic


class Registration(ManagedNode):
    """Registers every `scan`, and those of the service `register` and the action `register_scan`, to the design.

    Publishes `displacement`, `deviation` and, last, `inspection`, whose stamp tells which belong together.
    """

    def __init__(self) -> None:
        super().__init__("registration")
        declare_design(self)
        declare(self, "register_every_scan", True, "Register scans as they come, not only on request")
        declare(
            self,
            "job_timeout",
            600.0,
            "Longest time that a registration may take",
            unit="s",
            minimum=0.001,
            maximum=1e6,
        )
        declare(self, "is_simulated", False, "Mark results as coming from a replay or a simulation")
        declare_journal(self)
        declare_settings(self)
        self._displacement = self.create_lifecycle_publisher(PointCloud2, "displacement", LATCHED)
        self._deviation = self.create_lifecycle_publisher(PointCloud2, "deviation", LATCHED)
        self._inspection = self.create_lifecycle_publisher(InspectionMessage, "inspection", LATCHED)
        self._target: CellDesign | MdfError = no_design(self)  # what scans are registered to, or why they cannot be
        self._former: CellDesign | None = None  # another one that scans were accepted for
        self._latest: PointCloud2 | None = None
        self._latest_delivery: int | None = None  # None: it has been in the journal before
        self._latest_waits = False
        self._latest_lock = threading.Lock()
        self._last_residual = "none yet"
        self._opened_journal: Journal | None = None
        self._taken: set[int] = set()  # numbers of the entries that wait or run here
        self._taking = threading.Lock()

        cloud_node = self.inner_node("clouds")
        cloud_node.create_subscription(PointCloud2, self.resolve_topic_name("scan"), self._on_scan, SCAN)
        self.serve(Register, "register", self._on_register)
        self.create_subscription(
            DesignMessage, "design", self._on_design, LATCHED, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._action = ActionServer(
            self,
            RegisterScan,
            self.resolve_service_name("register_scan"),  # rclpy (Jazzy) remaps only the parts of an action
            self._on_goal,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            goal_service_qos_profile=REQUESTS,
            result_service_qos_profile=REQUESTS,
            cancel_service_qos_profile=REQUESTS,
            result_timeout=_RESULT_SECONDS,
        )
        self.create_steady_timer(_RESUME_SECONDS, self._resume)

    @property
    def _journal(self) -> Journal:
        return self.require_configured(self._opened_journal)

    def configure(self) -> None:
        """Open the journal and load the design."""
        self.close()
        self._opened_journal = open_journal(self)
        self._target = load_configured_design(self, self._journal) or self._target

    def close(self) -> None:
        """Close the journal."""
        journal, self._opened_journal = self._opened_journal, None
        if journal is not None:
            journal.close()

    def activate(self) -> None:
        """Register the scan that came before."""
        self._register_waiting_scan()

    def diagnostics(self) -> dict[str, Any]:
        """The design, the age of the latest scan, and what is in the journal."""
        target, latest, journal = self._target, self._latest, self._opened_journal
        age = "none yet"
        if latest is not None:
            stamp = latest.header.stamp
            age = f"{self.get_clock().now().nanoseconds * 1e-9 - (stamp.sec + stamp.nanosec * 1e-9):.1f} s"
        return {
            "design": target.design.path if isinstance(target, CellDesign) else target,
            "age of the latest scan": age,
            "residual scale of the last inspection": self._last_residual,
            **({} if journal is None else _lines_of(journal)),
        }

    # Design

    def _on_design(self, message: DesignMessage) -> None:
        with self.error_boundary():
            try:
                target = load_cell_design(self, DesignChoice(message.path, message.unit, message.part_id))
                if target.design.file_sha256 != message.sha256:
                    raise DesignMismatchError("changed since it was announced", message.path, "call set_design again")
            except MdfError as error:
                # The design before is not the cell's any more.
                self._target = error
                raise
            if isinstance(self._target, CellDesign):
                self._former = self._target
            self._target = target
            if self._opened_journal is not None and not self._opened_journal.is_durable:
                # Scans are accepted for it from now on; in a journal that both have, compensation notes it.
                self._opened_journal.set_design(configured_choice(self), target.choice)
            self._register_waiting_scan()

    # The three ways in

    def _on_scan(self, message: PointCloud2, info: dict[str, int]) -> None:
        with self._latest_lock:
            self._latest, self._latest_delivery = message, info["source_timestamp"]
            self._latest_waits = True
        self._register_waiting_scan()

    def _register_waiting_scan(self) -> None:
        """Queue the latest scan, if it has not been. Without a design it is refused, and queued again with the next."""
        with self._latest_lock:
            if not (self._latest_waits and self.is_active):
                return
            self._latest_waits = not isinstance(self._target, CellDesign)
            cloud, delivery, self._latest_delivery = self._latest, self._latest_delivery, None
        try:
            with self._taking:
                entry = self._journal.accept(cloud) if delivery is None else self._journal.arrive(cloud, delivery)
                self._note_taken(entry)
        except Exception as error:
            self._refuse(cloud, "not-accepted", error)
            return
        if entry is None:  # it has been answered, or will be
            with self._latest_lock:
                self._latest_waits = self._latest_waits and self._latest is not cloud
        elif self.get_parameter("register_every_scan").value:
            self._submit(entry)
        else:
            self._record_answer(entry, 0)

    def _resume(self) -> None:
        """Queue what was accepted before a crash, and what was handed over on disk and did not come by topic."""
        queue = self._jobs
        if queue is None or not isinstance(self._target, CellDesign):
            return
        with self.error_boundary():
            # A queue that has been closed has room for ever.
            while self._jobs is queue and self.get_parameter("register_every_scan").value and queue.has_room:
                with self._taking:
                    entry = self._journal.waiting(self._taken, _DELIVERY_SECONDS)
                    self._note_taken(entry)
                if entry is None:
                    return
                self._submit(entry)

    def _note_taken(self, entry: Entry | None) -> None:
        if entry is not None:
            self._taken.add(entry.number)

    def _submit(self, entry: Entry) -> None:
        """Queue a scan that nobody waits for."""

        def on_error(error: Exception) -> None:
            if isinstance(error, NotActiveError) and self._journal.is_durable:
                with self.error_boundary():
                    self._journal.postpone(entry.number)
                self._give_back(entry)
            else:
                refusal = self._refuse(entry.cloud, str(entry.number), error)
                self._record_answer(entry, refusal.code)

        job = self._job(entry, on_error=on_error)
        try:
            self.require_active().submit(job)
        except QueueFullError as error:
            if entry.is_on_disk:
                self._give_back(entry)
            else:
                job.answer(error=error)
        except MdfError as error:
            job.answer(error=error)

    def _give_back(self, entry: Entry) -> None:
        """Let it wait on disk until there is room or the node is active again."""
        with self._taking:
            self._taken.discard(entry.number)

    def _record_answer(self, entry: Entry, error_code: int) -> None:
        with self.error_boundary():
            self._journal.answer(entry.number, error_code)
            self._give_back(entry)

    def _on_register(self, request: Register.Request, response: Register.Response) -> Register.Response:
        with self.error_boundary(response):
            job = self._requested(request.scan, request.part_id, request.method)
            response.inspection, response.displacement = self.result_of(job)
        return response

    def _on_goal(self, goal: ServerGoalHandle) -> RegisterScan.Result:
        result = RegisterScan.Result()
        with self.answering():
            with self.error_boundary(result):
                result.inspection, result.displacement = self._run_goal(goal)
            if result.error_code == 0:
                goal.succeed()
            elif result.error_code == CancelledError.code:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _run_goal(self, goal: ServerGoalHandle) -> tuple[InspectionMessage, PointCloud2]:
        self.require_active()  # told first, whether a scan has come or not
        cloud = goal.request.scan
        if goal.request.use_latest:
            if self._latest is None:
                raise NoScanError("no scan has come yet", "topic scan", "send one, or put it into the goal")
            cloud = self._latest
        job = self._requested(
            cloud,
            goal.request.part_id,
            goal.request.method,
            on_progress=lambda progress: goal.publish_feedback(feedback_message(progress)),
        )
        while not job.wait(_CANCEL_POLL_SECONDS):
            if goal.is_cancel_requested and (queue := self._jobs) is not None:
                queue.cancel(job)
        inspection, displacement = self.result_of(job)
        return inspection, displacement

    def _requested(
        self, cloud: PointCloud2, part_id: str, method: str, on_progress: ProgressCallback = silent
    ) -> Job[tuple[InspectionMessage, PointCloud2]]:
        """Queue the scan of a client, who gets the answer."""
        queue = self.require_active()
        if not queue.has_room:
            raise queue.full()
        self._settings_for(method)  # what cannot be done is refused before it is accepted
        with self._taking:
            entry = self._journal.accept(cloud, part_id, method)
            self._note_taken(entry)
        job = self._job(entry, on_progress, lambda error: self._record_answer(entry, _code_of(error)))
        try:
            return queue.submit(job)
        except MdfError as error:
            job.answer(error=error)
            raise

    # The work

    def _job(
        self,
        entry: Entry,
        on_progress: ProgressCallback = silent,
        on_error: Callable[[Exception], object] = lambda _: None,
    ) -> Job[tuple[InspectionMessage, PointCloud2]]:
        return Job(lambda job: self._register(entry, job), on_progress, on_error)

    def _register(self, entry: Entry, job: Job[Any]) -> tuple[InspectionMessage, PointCloud2]:
        began, begun = time.monotonic(), self._journal.begin(entry.number)
        if begun > _MOST_ATTEMPTS:
            raise RegistrationFailedError(
                f"the process has ended {_MOST_ATTEMPTS} times in the middle of it", "scan", "look into the logs"
            )
        target = self._target_of(entry)
        settings = self._settings_for(entry.method)
        limit = self.get_parameter("job_timeout").value

        def progress(step: Progress) -> None:
            if time.monotonic() - began > limit:
                raise JobTimeoutError(f"longer than {limit:g} s", "registration", "thin the scan, or raise job_timeout")
            job.progress(step)

        regions = regions_from(self, target.design)
        inspection = inspect(target.design, scan_from_message(entry.cloud), settings, progress, regions)
        job.finish()
        if warning := coarseness(inspection):
            self.get_logger().warning(f"job {entry.number}: {warning}")
        results = self._publish(inspection, entry, target, began)
        self._record_answer(entry, 0)
        return results

    def _settings_for(self, method: str) -> Settings:
        """The settings as they are now, with the method of a request, if it names one."""
        settings = settings_from(self)
        return settings.replace({"method": method}) if method else settings

    def _target_of(self, entry: Entry) -> CellDesign:
        """The design that the scan was accepted for, which need not be that of the cell any more."""
        target, former = self._target, self._former
        if isinstance(target, MdfError):
            raise target
        configured = configured_choice(self)
        if not target.is_named_by(self._journal.design(configured)):  # it was announced by who has another journal
            return target
        choice = self._journal.design_of(entry.number, configured)
        if choice is None or target.is_named_by(choice):
            return target
        if former is None or not former.is_named_by(choice):
            self._former = former = load_cell_design(self, choice)
        return former

    def _publish(
        self, inspection: Inspection, entry: Entry, target: CellDesign, began: float
    ) -> tuple[InspectionMessage, PointCloud2]:
        header = self._header(entry.cloud)
        job_id = _job_id(header, f"{inspection.scan_sha256[:8]}-{entry.number}")
        message = inspection_message(
            inspection, header, job_id, entry.part_id or target.part_id, self.get_parameter("is_simulated").value
        )
        displacement = displacement_message(inspection, header)
        with self.error_boundary():  # no reason to keep it from those who are there
            self._journal.keep_result(entry.number, message, displacement)
        # The inspection comes last: who has it can expect the others.
        self._displacement.publish(displacement)
        self._deviation.publish(deviation_message(inspection, header))
        self._inspection.publish(message)
        self._last_residual = f"{inspection.residual_scale:.4f} mm"
        self.job_done(
            f"job {job_id}: {inspection.verdict[0].value}, "
            f"RMS displacement {inspection.rms_displacement:.3f} mm, coverage {inspection.coverage:.0%}, "
            f"{message.points} points, {time.monotonic() - began:.2f} s"
        )
        return message, displacement

    def _refuse(self, cloud: PointCloud2, label: str, error: Exception) -> MdfError:
        """Answer a scan that came by topic and could not be registered."""
        reported = self.report(error)
        with self.error_boundary():
            header, target = self._header(cloud), self._target
            self._inspection.publish(
                refusal_message(
                    reported,
                    header,
                    _job_id(header, f"refused-{label}"),
                    target.part_id if isinstance(target, CellDesign) else self.get_parameter("part_id").value,
                    self.get_parameter("method").value,
                    self.get_parameter("is_simulated").value,
                )
            )
        return reported

    def _header(self, cloud: PointCloud2) -> Header:
        return Header(stamp=cloud.header.stamp, frame_id=self.get_parameter("design_frame").value)


def _lines_of(journal: Journal) -> dict[str, Any]:
    """For the diagnostics."""
    accepted, waiting = journal.counts()
    free = journal.free_mib()
    return {
        "scans accepted": accepted,
        "scans waiting for an answer": waiting,
        "free disk space": "no state folder" if free is None else f"{free} MiB",
    }


def _code_of(error: Exception) -> int:
    return error.code if isinstance(error, MdfError) else MdfError.code


def _job_id(header: Header, label: str) -> str:
    return f"{header.stamp.sec}.{header.stamp.nanosec:09d}-{label}"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit status."""
    return run_managed_node(Registration, "Register scans to the design of a part.", args)


if __name__ == "__main__":
    raise SystemExit(main())
