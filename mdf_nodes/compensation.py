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

from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.msg import RedesignedMesh
from mdf_interfaces.srv import Compensate, SetDesign
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker

from mdf_core.compensation import compensate
from mdf_core.errors import (
    CompensationRefusedError,
    DesignMismatchError,
    NoDesignError,
    NoInspectionError,
    NotActiveError,
    OutputFolderError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design
from mdf_core.settings import Settings
from mdf_core.units import UNITS
from mdf_nodes.conversions import displacement_from_message, marker_message, redesigned_mesh_message
from mdf_nodes.jobs import Job, JobQueue
from mdf_nodes.journal import DesignChoice, Journal, configured_design, declare_journal, open_journal
from mdf_nodes.managed_node import ManagedNode, run_managed_node
from mdf_nodes.parameters import (
    OUTPUT_FOLDER,
    declare,
    declare_request_folders,
    declare_settings,
    require_allowed,
    settings_from,
)
from mdf_nodes.qos import LATCHED, SCAN

_FILE_NAME = "redesigned.stl"
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

    Publishes `redesign_marker`, `redesigned_mesh` and, last, `redesigned_mesh_path`, once the file is complete. The
    service `set_design` changes the design of the cell, which is published as `design`.
    """

    def __init__(self) -> None:
        super().__init__("compensation")
        declare(self, "design_path", "", "Design file, loaded by configure; empty: wait for the service set_design")
        declare(self, "design_unit", "mm", "Unit of the design file", choices=UNITS)
        declare(self, "part_id", "", "Name of the part; empty: the design file's name")
        declare(self, "design_frame", "design", "Frame of the design: the origin of its file")
        declare(self, "output_folder", OUTPUT_FOLDER, "Folder for redesigned meshes, one folder in it per job")
        declare(self, "compensate_every_inspection", True, "Redesign with every inspection, not only on request")
        declare_request_folders(self)
        declare_journal(self)
        declare_settings(self)
        self._design_publisher = self.create_lifecycle_publisher(DesignMessage, "design", LATCHED)
        self._mesh = self.create_lifecycle_publisher(RedesignedMesh, "redesigned_mesh", LATCHED)
        self._path = self.create_lifecycle_publisher(String, "redesigned_mesh_path", LATCHED)
        self._marker = self.create_lifecycle_publisher(Marker, "redesign_marker", LATCHED)
        self._target: _Target | None = None
        self._latest: _Pair | None = None
        self._latest_waits = False
        self._pairing = _Pairing()
        self._journal = Journal()
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
        self.create_steady_timer(_RESUME_SECONDS, self._redesign_waiting)

    def configure(self) -> None:
        """Look at the output folder, open the journal and load the design."""
        _check_writable(self._output_folder())
        self._journal.close()
        self._journal = Journal()  # until the other is open
        self._journal = open_journal(self)
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
        """Tell the cell its design."""
        if self._target is not None:
            self._design_publisher.publish(self._design_message(self._target))

    def diagnostics(self) -> dict[str, Any]:
        """The design and the output folder."""
        return {
            "design": "none" if self._target is None else self._target.design.path,
            "output folder": self._output_folder(),
        }

    def _output_folder(self) -> Path:
        # Launch files pass an empty text on for "not given".
        return Path(self.get_parameter("output_folder").value or OUTPUT_FOLDER).absolute()

    # Design

    def _load_design(self, choice: DesignChoice) -> _Target:
        # Every node of the cell has to find it, whatever its working folder.
        design = load_design(Path(choice.path).absolute(), choice.unit)
        self.get_logger().info(f"design {choice.path}: {len(design.vertices)} vertices, {len(design.faces)} faces")
        return _Target(design, choice.unit, choice.part_id or Path(choice.path).stem)

    def _design_message(self, target: _Target) -> DesignMessage:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.get_parameter("design_frame").value)
        return DesignMessage(
            header=header,
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
            response.design = self._design_message(self._target)
            self._design_publisher.publish(response.design)
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
                    self._queue_redesign(queue, _Pair(*kept))
            else:
                return
            if self._latest is not None and self._latest_waits:
                if self._latest.inspection.job_id not in (*self._queued, *self._put_off, *self._seen_to):
                    self._queue_redesign(queue, self._latest)
                self._latest_waits = False

    def _queue_redesign(self, queue: JobQueue, pair: _Pair) -> None:
        job_id, settings = pair.inspection.job_id, settings_from(self)

        def work(job: Job[Any]) -> None:
            if pair.inspection.pose_ambiguous:
                raise CompensationRefusedError(
                    "the pose is ambiguous",
                    f"inspection {job_id}",
                    "set pose.initial and inspect again, or call compensate if the pose found is right",
                )
            self._redesign(pair, settings, job)
            with self._waiting_lock, self.error_boundary():
                self._see_to(job_id)

        def on_error(error: Exception) -> None:
            self.report(error)
            with self._waiting_lock, self.error_boundary():
                self._queued.discard(job_id)
                if isinstance(error, NotActiveError):  # if it is kept in the journal it waits there
                    self._latest_waits = self._latest_waits or pair is self._latest
                elif isinstance(error, DesignMismatchError) and self._journal.is_durable:
                    self._put_off[job_id] = math.inf  # until another design is set
                elif isinstance(error, OutputFolderError) and self._journal.is_durable:
                    self._put_off[job_id] = time.monotonic() + _RETRY_SECONDS
                else:
                    self._see_to(job_id)

        queue.submit(Job(work, on_error=on_error))
        self._queued.add(job_id)

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
            response.redesigned_mesh = self.run_job(lambda job: self._redesign(pair, settings, job))
        return response

    def _redesign(self, pair: _Pair, settings: Settings, job: Job[Any]) -> RedesignedMesh:
        began = time.monotonic()
        inspection, target = pair.inspection, self._target
        if target is None:
            raise self._no_design()
        measured = displacement_from_message(pair.displacement)
        _check_same_design(target.design, inspection, len(measured))
        redesign = compensate(target.design, [measured], settings)
        part_id = inspection.part_id or target.part_id
        path = self._output_folder() / _file_name(f"{part_id}_{inspection.job_id}") / _FILE_NAME
        job.finish()
        sha256 = redesign.save(path)
        message = redesigned_mesh_message(redesign, settings.compensation, inspection, path, sha256)
        self._marker.publish(marker_message(path, inspection.header))
        self._mesh.publish(message)
        self._path.publish(String(data=str(path)))
        seconds = time.monotonic() - began
        self.job_done(f"job {inspection.job_id}: largest move {redesign.max_move:.3f} mm, {seconds:.2f} s, {path}")
        return message


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
