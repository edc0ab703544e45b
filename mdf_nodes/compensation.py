"""The node compensation: displacements in, redesigned meshes out; it also sets the design of the cell."""

from __future__ import annotations

import math
import os
import re
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mdf_interfaces.msg import Cycle as CycleMessage
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.msg import RedesignedMesh
from mdf_interfaces.srv import Compensate, RejectRedesign, ReleaseRedesign, RollBack, SetDesign
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker

from mdf_core.cycles import current_print, proposal, redesigns, require_better, require_reprint, require_usable
from mdf_core.errors import (
    CycleStateError,
    DesignMismatchError,
    InvalidSettingError,
    LedgerError,
    NoDesignError,
    NoInspectionError,
    NotActiveError,
    OutputFolderError,
)
from mdf_core.geometry import Design
from mdf_core.ledger import Cycle, CycleState, Ledger, ScanReference
from mdf_core.mesh_io import load_design
from mdf_core.prints import combine_prints
from mdf_core.refinement import refined
from mdf_core.settings import Settings
from mdf_core.units import UNITS
from mdf_nodes.conversions import (
    cycle_message,
    design_cycle_message,
    displacement_from_message,
    marker_message,
    redesigned_mesh_message,
)
from mdf_nodes.jobs import Job, JobQueue
from mdf_nodes.journal import DesignChoice, Journal, configured_design, declare_journal, open_journal
from mdf_nodes.managed_node import ManagedNode, run_managed_node
from mdf_nodes.parameters import (
    OUTPUT_FOLDER,
    declare,
    declare_regions,
    declare_request_folders,
    declare_settings,
    regions_from,
    require_allowed,
    settings_from,
)
from mdf_nodes.qos import LATCHED, SCAN

_FILE_NAME = "redesigned.stl"
_IN_MEMORY = "sqlite://"
_MOST_UNPAIRED = 4
_MOST_SEEN_TO = 100
_RESUME_SECONDS, _RETRY_SECONDS = 1.0, 10.0


@dataclass(frozen=True, eq=False)
class _Target:
    """The design that is redesigned."""

    design: Design
    unit: str
    part_id: str


@dataclass(frozen=True, eq=False)
class _Pair:
    """One inspection and its displacement."""

    inspection: InspectionMessage
    displacement: PointCloud2


class _Pairing:
    """Joins inspections and displacements by their stamps, whichever comes first.

    One scan may be registered several times; both topics keep the order, so the oldest ones belong together.
    """

    def __init__(self) -> None:
        self._unpaired: deque[Any] = deque(maxlen=_MOST_UNPAIRED)

    def add(self, message: Any) -> _Pair | None:
        """The pair that `message` completes."""
        for other in self._unpaired:
            if type(other) is not type(message) and other.header.stamp == message.header.stamp:
                self._unpaired.remove(other)
                inspection, displacement = sorted((message, other), key=lambda each: isinstance(each, PointCloud2))
                return _Pair(inspection, displacement)
        self._unpaired.append(message)
        return None


class Compensation(ManagedNode):
    """Redesigns the part against every inspection, and on request of the service `compensate`.

    Publishes `redesign_marker`, `redesigned_mesh` and, once the file is complete, `redesigned_mesh_path`; where the
    parameter `release` is manual, that waits for `release_redesign`. The service `set_design` changes the design of the
    cell, published as `design`. What is printed of it, the design or a released redesign, is kept in the ledger and
    published as `printed`.
    """

    def __init__(self) -> None:
        super().__init__("compensation")
        declare(self, "design_path", "", "Design file, loaded by configure; empty: wait for the service set_design")
        declare(self, "design_unit", "mm", "Unit of the design file", choices=UNITS)
        declare(self, "part_id", "", "Name of the part; empty: the design file's name")
        declare(self, "design_frame", "design", "Frame of the design: the origin of its file")
        declare(self, "output_folder", OUTPUT_FOLDER, "Folder for redesigned meshes, one folder in it per job")
        declare(self, "compensate_every_inspection", True, "Redesign with every inspection, not only on request")
        declare(self, "prints_per_cycle", 1, "Inspections that each redesign is made from", minimum=1, maximum=1000)
        declare(
            self,
            "release",
            "automatic",
            "automatic: a redesign that passes its checks is published at once; manual: once it is released",
            choices=("automatic", "manual"),
        )
        declare(
            self,
            "ledger_url",
            "",
            "Database of the cycles; empty: ledger.sqlite in the state folder, or without one in memory",
            read_only=True,
        )
        declare_regions(self)
        declare_request_folders(self)
        declare_journal(self)
        declare_settings(self)
        self._design_publisher = self.create_lifecycle_publisher(DesignMessage, "design", LATCHED)
        self._mesh = self.create_lifecycle_publisher(RedesignedMesh, "redesigned_mesh", LATCHED)
        self._path = self.create_lifecycle_publisher(String, "redesigned_mesh_path", LATCHED)
        self._marker = self.create_lifecycle_publisher(Marker, "redesign_marker", LATCHED)
        self._printed = self.create_lifecycle_publisher(CycleMessage, "printed", LATCHED)
        self._target: _Target | None = None
        self._latest: _Pair | None = None
        self._latest_waits = False
        self._last_printed = "not known"
        self._pairing = _Pairing()
        self._journal = Journal()
        self._ledger = Ledger(_IN_MEMORY)
        self._gathered: list[_Pair] = []  # prints of a cycle that is not complete
        self._waiting_lock = threading.Lock()
        self._wanted: bool | None = None  # whether results are kept for this node; None: not told yet
        self._queued: set[str] = set()  # job_id of inspections whose redesign waits or runs
        self._put_off: dict[str, float] = {}  # and of those that failed, and when they are tried again
        self._seen_to: deque[str] = deque(maxlen=_MOST_SEEN_TO)  # and of those that are done with

        cloud_node = self.inner_node("clouds")
        for type_, topic in ((InspectionMessage, "inspection"), (PointCloud2, "displacement")):
            cloud_node.create_subscription(type_, self.resolve_topic_name(topic), self._on_result, SCAN)
        service_node = self.inner_node("services")
        service_node.create_service(Compensate, self.resolve_service_name("compensate"), self._on_compensate)
        service_node.create_service(SetDesign, self.resolve_service_name("set_design"), self._on_set_design)
        for type_, name, answer in (
            (ReleaseRedesign, "release_redesign", self._on_release),
            (RejectRedesign, "reject_redesign", self._on_reject),
            (RollBack, "roll_back", self._on_roll_back),
        ):
            service_node.create_service(type_, self.resolve_service_name(name), answer)
        self.create_steady_timer(_RESUME_SECONDS, self._redesign_waiting)

    def configure(self) -> None:
        """Look at the output folder, open the journal and load the design."""
        _check_writable(self._output_folder())
        self._journal.close()
        self._journal = Journal()  # until the other is open
        self._journal = open_journal(self)
        self._ledger.close()
        self._ledger = Ledger(self._ledger_url())
        self._wanted = self.get_parameter("compensate_every_inspection").value
        self._journal.take_results(self.get_name(), self._wanted)
        self._put_off.clear()
        configured = configured_design(self)
        design = self._journal.design(configured)
        if design.path:
            # One that was set by service and is gone can be set again, of a node that is active.
            with nullcontext() if design == configured else self.error_boundary():
                self._target = self._load_design(design)

    def activate(self) -> None:
        """Tell the cell its design, and what is printed of it."""
        if self._target is not None:
            self._design_publisher.publish(self._design_message(self._target))
            self._tell_printed(self._target)

    def diagnostics(self) -> dict[str, Any]:
        """The design and the output folder."""
        return {
            "design": "none" if self._target is None else self._target.design.path,
            "output folder": self._output_folder(),
            "printed": self._last_printed,
            "prints of this cycle": f"{len(self._gathered)} of {self.get_parameter('prints_per_cycle').value}",
        }

    def _output_folder(self) -> Path:
        # Launch files pass an empty text on for "not given".
        return Path(self.get_parameter("output_folder").value or OUTPUT_FOLDER).absolute()

    def _ledger_url(self) -> str:
        folder = self._journal.folder
        return self.get_parameter("ledger_url").value or (f"sqlite:///{folder}/ledger.sqlite" if folder else _IN_MEMORY)

    # Design

    def _load_design(self, choice: DesignChoice) -> _Target:
        # Every node of the cell has to find it, whatever its working folder.
        as_filed = load_design(Path(choice.path).absolute(), choice.unit)
        design = refined(as_filed, settings_from(self).design.longest_edge_mm)
        self.get_logger().info(f"design {choice.path}: {len(design.vertices)} vertices, {len(design.faces)} faces")
        return _Target(design, choice.unit, choice.part_id or Path(choice.path).stem)

    def _header(self) -> Header:
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=self.get_parameter("design_frame").value)

    def _design_message(self, target: _Target) -> DesignMessage:
        return DesignMessage(
            header=self._header(),
            part_id=target.part_id,
            path=target.design.path,
            unit=target.unit,
            sha256=target.design.file_sha256,
        )

    def _on_set_design(self, request: SetDesign.Request, response: SetDesign.Response) -> SetDesign.Response:
        with self.error_boundary(response):
            self.require_active()
            require_allowed(self, request.path)
            target = self._load_design(DesignChoice(request.path, request.unit, request.part_id))
            chosen = DesignChoice(target.design.path, target.unit, target.part_id)
            self._journal.set_design(configured_design(self), chosen)
            self._target = target
            with self._waiting_lock:
                self._put_off.clear()
            self._forget_gathered()
            response.design = self._design_message(target)
            self._design_publisher.publish(response.design)
            self._tell_printed(target)
        return response

    def _no_design(self) -> NoDesignError:
        return NoDesignError("no design is set", self.get_name(), "set the parameter design_path, or call set_design")

    # Redesign

    def _on_result(self, message: InspectionMessage | PointCloud2) -> None:
        if isinstance(message, InspectionMessage) and message.error_code != 0:
            return
        pair = self._pairing.add(message)
        if pair is not None:
            with self._waiting_lock:
                queue, was_full = self._jobs, self._latest_waits
                if was_full and queue is not None and not self._journal.is_durable:
                    self.report(queue.full())
                self._latest, self._latest_waits = pair, True
            self._redesign_waiting()

    def _redesign_waiting(self) -> None:
        """Queue the redesigns that wait: those in the journal, oldest first, then that against the latest inspection.

        So the last one published is that of the last scan. Without a design those in the journal wait for it.
        """
        with self._waiting_lock, self.error_boundary():
            queue, wanted = self._jobs, self.get_parameter("compensate_every_inspection").value
            if queue is None:
                return
            if wanted != self._wanted:
                self._journal.take_results(self.get_name(), wanted)
                self._wanted = wanted
            if not wanted:
                self._latest_waits = False
                return
            if self._target is None:
                if self._latest_waits:
                    self._latest_waits = False
                    raise self._no_design()
                return
            now = time.monotonic()
            self._put_off = {job_id: due for job_id, due in self._put_off.items() if due > now}
            # A queue that has been closed has room for ever.
            while self._jobs is queue and queue.has_room:
                kept = self._journal.next_result(self._queued | self._put_off.keys())
                if kept is None:
                    break
                if kept[0].job_id in self._seen_to:
                    self._journal.forget_result(kept[0].job_id)
                else:
                    self._gather(queue, _Pair(*kept))
            else:
                return
            if self._latest is not None and self._latest_waits:
                if self._latest.inspection.job_id not in (*self._queued, *self._put_off, *self._seen_to):
                    self._gather(queue, self._latest)
                self._latest_waits = False

    def _gather(self, queue: JobQueue, pair: _Pair) -> None:
        """Queue a redesign once enough prints for it are there."""
        self._gathered.append(pair)
        self._queued.add(pair.inspection.job_id)
        if len(self._gathered) >= self.get_parameter("prints_per_cycle").value:
            gathered, self._gathered = self._gathered, []
            self._queue_redesign(queue, gathered)

    def _forget_gathered(self) -> None:
        """The prints of a cycle that will never be complete, because something else is printed now."""
        with self._waiting_lock, self.error_boundary():
            for pair in self._gathered:
                self._see_to(pair.inspection.job_id)
            self._gathered = []

    def _queue_redesign(self, queue: JobQueue, pairs: list[_Pair]) -> None:
        settings = settings_from(self)

        def work(job: Job[Any]) -> None:
            for pair in pairs:
                inspection = pair.inspection
                require_usable(
                    f"inspection {inspection.job_id}", inspection.pose_ambiguous, inspection.outlier_share, settings
                )
            self._redesign(pairs, settings, job)
            with self._waiting_lock, self.error_boundary():
                for pair in pairs:
                    self._see_to(pair.inspection.job_id)

        def on_error(error: Exception) -> None:
            self.report(error)
            with self._waiting_lock, self.error_boundary():
                for pair in pairs:
                    self._put_aside(pair, error)

        queue.submit(Job(work, on_error=on_error))

    def _put_aside(self, pair: _Pair, error: Exception) -> None:
        """Try again later what another try may mend; the rest is done with."""
        job_id = pair.inspection.job_id
        self._queued.discard(job_id)
        if isinstance(error, NotActiveError):  # if it is kept in the journal it waits there
            self._latest_waits = self._latest_waits or pair is self._latest
        elif isinstance(error, DesignMismatchError) and self._journal.is_durable:
            self._put_off[job_id] = math.inf  # until another design is set
        elif isinstance(error, OutputFolderError | LedgerError) and self._journal.is_durable:
            self._put_off[job_id] = time.monotonic() + _RETRY_SECONDS
        else:
            self._see_to(job_id)

    def _see_to(self, job_id: str) -> None:
        """Nothing more is to be done about it; where the journal cannot forget it now, it is asked to again."""
        self._queued.discard(job_id)
        if self._journal.is_durable:  # else a registration that was started again uses the same names again
            self._seen_to.append(job_id)
            self._journal.forget_result(job_id)

    def _on_compensate(self, request: Compensate.Request, response: Compensate.Response) -> Compensate.Response:
        with self.error_boundary(response):
            self.require_active()
            pair = self._latest
            if pair is None:
                raise NoInspectionError("nothing has been inspected yet", "topic inspection", "register a scan first")
            changes: dict[str, Any] = {"compensation.gain": request.gain} if request.gain else {}
            changes |= {"compensation.lookup": request.lookup} if request.lookup else {}
            settings = settings_from(self).replace(changes)
            response.redesigned_mesh = self.run_job(lambda job: self._redesign([pair], settings, job))
        return response

    def _redesign(self, pairs: Sequence[_Pair], settings: Settings, job: Job[Any]) -> RedesignedMesh:
        """The redesign against the inspections of one or more prints, the last of which names it."""
        began = time.monotonic()
        inspection, target = pairs[-1].inspection, self._target
        if target is None:
            raise self._no_design()
        measured = [displacement_from_message(pair.displacement) for pair in pairs]
        for pair, field in zip(pairs, measured, strict=True):
            _check_same_design(target.design, pair.inspection, len(field))
        printed, prints = (
            current_print(self._ledger, target.part_id, target.design),
            combine_prints(target.design, measured),
        )
        scans = [ScanReference(pair.inspection.scan_sha256, pair.inspection.job_id) for pair in pairs]
        require_reprint(target.design, printed, prints)
        if printed.cycle is not None:
            self._ledger.note_reprint(printed.cycle.id, prints.rms_displacement, prints.rms_standard_error, scans)
            self._tell_printed(target)
        require_better(printed, prints)
        regions = regions_from(self, target.design)
        (checked,) = redesigns(target.design, measured, settings, regions, printed.vertices)
        part_id = inspection.part_id or target.part_id
        path = self._output_folder() / _file_name(f"{part_id}_{inspection.job_id}") / _FILE_NAME
        job.finish()
        sha256 = checked.redesign.save(path) if checked.passed else ""
        cycle = self._ledger.propose(
            proposal(target.part_id, printed, checked, settings, str(path), sha256, scans), checked.failures
        )
        redesign = checked.require_passed()
        message = redesigned_mesh_message(checked, cycle, inspection)
        self._marker.publish(marker_message(path, inspection.header))
        self._mesh.publish(message)
        if self.get_parameter("release").value == "automatic":
            self._path.publish(String(data=str(path)))
        seconds = time.monotonic() - began
        self.job_done(
            f"job {inspection.job_id}: cycle {cycle.number} ({cycle.id}), largest move {redesign.max_move:.3f} mm, "
            f"{seconds:.2f} s, {path}"
        )
        return message

    # Cycles

    def _on_release(self, request: ReleaseRedesign.Request, response: ReleaseRedesign.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            cycle = self._ledger.release(request.cycle_id or self._last_proposed().id, _by(request.by))
            self._go_on_from(cycle, response)
        return response

    def _on_reject(self, request: RejectRedesign.Request, response: RejectRedesign.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            cycle_id = request.cycle_id or self._last_proposed().id
            cycle = self._ledger.reject(cycle_id, _by(request.by), request.reason)
            response.cycle = cycle_message(cycle, self._header())
        return response

    def _on_roll_back(self, request: RollBack.Request, response: RollBack.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            target = self._require_target()
            current = self._ledger.current(target.part_id, target.design.file_sha256)
            if current is None:
                raise CycleStateError(
                    "no redesign is released", f"part {target.part_id}", "there is nothing to go back to"
                )
            self._go_on_from(self._ledger.roll_back(current.id, _by(request.by), request.reason), response)
        return response

    def _require_target(self) -> _Target:
        if self._target is None:
            raise self._no_design()
        return self._target

    def _last_proposed(self) -> Cycle:
        target = self._require_target()
        cycles = self._ledger.history(target.part_id, target.design.file_sha256)
        proposed = [cycle for cycle in cycles if cycle.state is CycleState.PROPOSED]
        if not proposed:
            raise CycleStateError("no redesign waits for a decision", f"part {target.part_id}", "inspect a scan first")
        return proposed[-1]

    def _go_on_from(self, cycle: Cycle | None, response: Any) -> None:
        """Something else is printed now."""
        self._forget_gathered()
        target = self._require_target()
        response.cycle = self._tell_printed(target)
        if cycle is not None:
            self._path.publish(String(data=cycle.stl_path))

    def _tell_printed(self, target: _Target) -> CycleMessage:
        cycle = self._ledger.current(target.part_id, target.design.file_sha256)
        if cycle is None:
            message = design_cycle_message(target.design, target.part_id, self._header())
        else:
            message = cycle_message(cycle, self._header())
        self._last_printed = message.path
        self._printed.publish(message)
        return message


def _by(name: str) -> str:
    if not name:
        raise InvalidSettingError("nobody is named", "by", "say who decides")
    return name


def _check_same_design(design: Design, inspection: InspectionMessage, vertices: int) -> None:
    if inspection.design_sha256 != design.file_sha256 or vertices != len(design.vertices):
        raise DesignMismatchError(
            f"belongs to {inspection.design_path}, sha256 {inspection.design_sha256[:8]}, {vertices} vertices; "
            f"the design is {design.path}, sha256 {design.file_sha256[:8]}, {len(design.vertices)} vertices",
            f"inspection {inspection.job_id}",
            "inspect against this design",
        )


def _check_writable(folder: Path) -> None:
    existing = next(each for each in (folder, *folder.parents) if each.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        raise OutputFolderError(f"cannot write to {existing}", f"output_folder {folder}", "choose a writable folder")


def _file_name(text: str) -> str:
    """Text from outside as the name of one folder."""
    return re.sub(r"[^\w.+-]+", "_", text).lstrip(".")


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit status."""
    return run_managed_node(Compensation, "Redesign a part so that its next print comes out right.", args)


if __name__ == "__main__":
    raise SystemExit(main())
