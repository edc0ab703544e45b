"""The node compensation: displacements in, redesigned meshes out; it also sets the design of the cell."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
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

from mdf_core.cycles import (
    NOTHING_LEFT,
    Checked,
    has_its_file,
    next_redesigns,
    propose_all,
    require_distinct,
    require_file,
    require_open,
    require_usable,
)
from mdf_core.errors import (
    CompensationRefusedError,
    CycleStateError,
    DesignMismatchError,
    InvalidSettingError,
    MdfError,
)
from mdf_core.files import require_writable, write_together
from mdf_core.geometry import Design
from mdf_core.ledger import Ledger
from mdf_core.ledger_database import ledger_url
from mdf_core.ledger_entries import Cycle, CycleState, ScanReference
from mdf_core.printed import current_print, doubts_of_beginning, judge_prints
from mdf_core.record import redesign_files
from mdf_core.redesign_names import redesign_stems
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
    cycle_message,
    design_cycle_message,
    displacement_from_message,
    marker_message,
    redesigned_mesh_message,
)
from mdf_nodes.inspected import Pair, Pairing
from mdf_nodes.jobs import Job, JobQueue
from mdf_nodes.journal import DesignChoice, Journal, declare_journal, open_journal
from mdf_nodes.managed_node import ManagedNode, run_managed_node
from mdf_nodes.output import folder_name, free_folder
from mdf_nodes.parameters import (
    OUTPUT_FOLDER,
    declare,
    declare_choice,
    declare_request_folders,
    declare_settings,
    regions_from,
    require_allowed,
    settings_from,
)
from mdf_nodes.pending_redesigns import PendingRedesigns
from mdf_nodes.qos import LATCHED, SCAN

_FORMATS = ("stl", "stl,3mf", "stl,ply", "stl,3mf,ply")
_IN_MEMORY = "sqlite://"
_RECENT_BYTES = 256 * 2**20
_MOST_GAINS = 20
_RESUME_SECONDS = 1.0


class Compensation(ManagedNode):
    """Redesigns the part against every inspection, and on request of the service `compensate`.

    Publishes `redesign_marker`, `redesigned_mesh` and, once the file is complete, `redesigned_mesh_path`; where the
    parameter `publish_redesign` says so, that waits for `release_redesign`. The service `set_design` changes the design
    of the cell, published as `design`. What is printed of it, the design or a released redesign, is kept in the ledger
    and published as `printed`.
    """

    def __init__(self) -> None:
        super().__init__("compensation")
        declare_design(self)
        declare(self, "output_folder", OUTPUT_FOLDER, "Folder for redesigned meshes, one folder in it per job")
        declare(self, "compensate_every_inspection", True, "Redesign with every inspection, not only on request")
        declare(self, "prints_per_cycle", 1, "Inspections that each redesign is made from", minimum=1, maximum=1000)
        declare_choice(
            self,
            "publish_redesign",
            "checked",
            "checked: the path of a redesign is published once it has passed its checks; released: once it is released",
            ("checked", "released"),
        )
        declare_choice(self, "redesign_formats", "stl", "Files of each redesign", _FORMATS)
        declare(
            self,
            "ledger_url",
            "",
            "Database of the cycles; empty: ledger.sqlite in the state folder, or without one in memory",
            read_only=True,
        )
        declare_request_folders(self)
        declare_journal(self)
        declare_settings(self)
        self._design_publisher = self.create_lifecycle_publisher(DesignMessage, "design", LATCHED)
        self._mesh = self.create_lifecycle_publisher(RedesignedMesh, "redesigned_mesh", LATCHED)
        self._path = self.create_lifecycle_publisher(String, "redesigned_mesh_path", LATCHED)
        self._marker = self.create_lifecycle_publisher(Marker, "redesign_marker", LATCHED)
        self._printed = self.create_lifecycle_publisher(CycleMessage, "printed", LATCHED)
        self._target: CellDesign | None = None  # what is redesigned
        self._target_lock = threading.Lock()  # lest something of one part be published after another was set
        self._last_printed = "not known"
        self._pairing = Pairing()
        self._pending = PendingRedesigns(lambda: self._journal, _RECENT_BYTES)
        self._opened_journal: Journal | None = None
        self._opened_ledger: Ledger | None = None
        self._wanted: bool | None = None  # whether results are kept for this node; None: not told yet

        cloud_node = self.inner_node("clouds")
        for type_, topic in ((InspectionMessage, "inspection"), (PointCloud2, "displacement")):
            cloud_node.create_subscription(type_, self.resolve_topic_name(topic), self._on_result, SCAN)
        self.serve(Compensate, "compensate", self._on_compensate)
        self.serve(SetDesign, "set_design", self._on_set_design)
        self.serve(ReleaseRedesign, "release_redesign", self._on_release)
        self.serve(RejectRedesign, "reject_redesign", self._on_reject)
        self.serve(RollBack, "roll_back", self._on_roll_back)
        self.create_steady_timer(_RESUME_SECONDS, self._redesign_waiting)

    @property
    def _journal(self) -> Journal:
        return self.require_configured(self._opened_journal)

    @property
    def _ledger(self) -> Ledger:
        return self.require_configured(self._opened_ledger)

    def configure(self) -> None:
        """Look at the output folder, open journal and ledger, and load the design."""
        require_writable(self._output_folder())
        self.close()
        self._opened_journal = open_journal(self)
        self._opened_ledger = Ledger(self._ledger_url())
        self._wanted = self.get_parameter("compensate_every_inspection").value
        self._journal.take_results(self.get_name(), self._wanted)
        self._pending.retry_deferred()
        self._target = load_configured_design(self, self._journal) or self._target
        self._pending.set_recorded(self._recorded_jobs())

    def close(self) -> None:
        """Close journal and ledger."""
        databases = (self._opened_journal, self._opened_ledger)
        self._opened_journal = self._opened_ledger = None
        for database in databases:
            if database is not None:
                database.close()

    def activate(self) -> None:
        """Tell the cell its design, and what is printed of it."""
        if self._target is not None:
            self._design_publisher.publish(self._design_message(self._target))
            self._tell_printed(self._target)
            if path := self._last_path(self._target):
                self._path.publish(String(data=path))

    def diagnostics(self) -> dict[str, Any]:
        """The design and the output folder."""
        return {
            "design": "none" if self._target is None else self._target.design.path,
            "output folder": self._output_folder(),
            "printed": self._last_printed,
            "prints of this cycle": f"{len(self._pending.collected)} of {self.get_parameter('prints_per_cycle').value}",
        }

    def _output_folder(self) -> Path:
        # Launch files pass an empty text on for "not given".
        return Path(self.get_parameter("output_folder").value or OUTPUT_FOLDER).absolute()

    def _recorded_jobs(self) -> set[str]:
        """Jobs of the inspections that cycles were made from: a late subscriber is sent the last one once more."""
        if self._target is None or not self._journal.is_durable:  # else names of jobs come again
            return set()
        cycles = self._ledger.history(self._target.part_id, self._target.design.file_sha256)
        return {scan.job_id for cycle in cycles for scan in (*cycle.inputs, *cycle.reprints)}

    def _ledger_url(self) -> str:
        folder = self._journal.folder
        own = _IN_MEMORY if folder is None else ledger_url(folder / "ledger.sqlite")
        return self.get_parameter("ledger_url").value or own

    # Design

    def _header(self) -> Header:
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=self.get_parameter("design_frame").value)

    def _design_message(self, target: CellDesign) -> DesignMessage:
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
            target = load_cell_design(self, DesignChoice(request.path, request.unit, request.part_id))
            with self._target_lock:
                self._journal.set_design(configured_choice(self), target.choice)
                former, self._target = self._target, target
                self._pending.retry_deferred()
                if former is None or _identity(former) != _identity(target):
                    self._forget_prints()
                response.design = self._design_message(target)
                self._design_publisher.publish(response.design)
                self._tell_printed(target)
        return response

    # Redesign

    def _on_result(self, message: InspectionMessage | PointCloud2) -> None:
        if isinstance(message, InspectionMessage) and message.error_code != 0:
            return
        pair = self._pairing.add(message)
        if pair is not None:
            is_replaced, queue = self._pending.add(pair), self._jobs
            if is_replaced and queue is not None and not self._journal.is_durable:
                self.report(queue.full())
            self._redesign_waiting()

    def _redesign_waiting(self) -> None:
        """Queue the redesigns that wait: those in the journal, oldest first, then that against the latest inspection.

        So the last one published is that of the last scan. Without a design those in the journal wait for it.
        """
        with self._pending.lock, self.error_boundary():
            queue, wanted = self._jobs, self.get_parameter("compensate_every_inspection").value
            if queue is None:
                return
            if wanted != self._wanted:
                self._journal.take_results(self.get_name(), wanted)
                self._wanted = wanted
            if not wanted:
                self._pending.drop_latest()
                return
            if self._target is None:
                if self._pending.drop_latest():
                    raise no_design(self)
                return
            # A queue that has been closed has room for ever.
            while self._jobs is queue and queue.has_room and (pair := self._pending.take()) is not None:
                self._collect_print(queue, pair)

    def _collect_print(self, queue: JobQueue, pair: Pair) -> None:
        """Queue a redesign once its prints are complete; one that none can be made from does not spoil the others."""
        try:
            self._require_usable(pair, settings_from(self), ambiguous_too=True)
            _require_distinct([*self._pending.collected, pair])
        except MdfError as error:
            self.report(error)
            self._pending.fail([pair], error)
            return
        if prints := self._pending.collect(pair, self.get_parameter("prints_per_cycle").value):
            try:
                self._queue_redesign(queue, prints)
            except MdfError:  # the node is being deactivated, or a request has come in between
                self._pending.give_back(prints)
                raise

    def _require_usable(self, pair: Pair, settings: Settings, ambiguous_too: bool) -> None:
        """Refuse a print that no redesign can be made from; of an ambiguous pose one is made on request."""
        inspection, design = pair.inspection, self._require_target().design
        _check_same_design(design, inspection, pair.displacement.width)
        is_ambiguous = ambiguous_too and inspection.pose_ambiguous
        require_usable(f"inspection {pair.job_id}", is_ambiguous, inspection.outlier_share, settings)

    def _forget_prints(self) -> None:
        """Something else is printed now, whether the journal can note it or not."""
        with self.error_boundary():
            self._pending.forget_prints()

    def _queue_redesign(self, queue: JobQueue, pairs: list[Pair]) -> None:
        settings = settings_from(self)

        def work(job: Job[Any]) -> None:
            _, errors = self._redesign(pairs, settings, job)
            if errors:
                raise errors[0]
            with self.error_boundary():
                self._pending.mark_done(pairs)

        def on_error(error: Exception) -> None:
            self.report(error)
            with self.error_boundary():
                self._pending.fail(pairs, error)

        queue.submit(Job(work, on_error=on_error))

    def _on_compensate(self, request: Compensate.Request, response: Compensate.Response) -> Compensate.Response:
        with self.error_boundary(response):
            self.require_active()
            gains = list(request.gains)
            if gains and request.gain:
                raise InvalidSettingError("both gain and gains are given", "request", "give one of them")
            if len(gains) > _MOST_GAINS:
                raise InvalidSettingError(f"{len(gains)} gains", "request", f"give at most {_MOST_GAINS}")
            changes: dict[str, Any] = {"compensation.gain": request.gain} if request.gain else {}
            changes |= {"compensation.lookup": request.lookup} if request.lookup else {}
            settings = settings_from(self).replace(changes)
            for gain in gains:
                settings.replace({"compensation.gain": gain})
            redesign_stems(gains)
            pairs = self._pending.named([job_id for job_id in request.job_ids if job_id])
            for pair in pairs:
                self._require_usable(pair, settings, ambiguous_too=False)
            _require_distinct(pairs)
            messages, errors = self.run_job(lambda job: self._redesign(pairs, settings, job, gains, on_request=True))
            response.redesigned_meshes = messages
            if errors:
                raise errors[0]
            if not messages:
                raise CompensationRefusedError(
                    NOTHING_LEFT,
                    f"inspection {pairs[-1].job_id}",
                    "keep what is printed",
                )
            response.redesigned_mesh = messages[-1]
        return response

    def _redesign(
        self,
        pairs: Sequence[Pair],
        settings: Settings,
        job: Job[Any],
        gains: Sequence[float] = (),
        on_request: bool = False,
    ) -> tuple[list[RedesignedMesh], list[MdfError]]:
        """The redesigns against the inspections of one or more prints, the last of which names them; one for each gain.

        And the errors of those that may not be released. Neither: nothing is left to change. On request prints that are
        far better than those before are redesigned against as well.
        """
        began = time.monotonic()
        target = self._require_target()
        design, part_id, job_id = target.design, target.part_id, pairs[-1].job_id
        measured = [displacement_from_message(pair.displacement) for pair in pairs]
        for pair, field in zip(pairs, measured, strict=True):
            _check_same_design(design, pair.inspection, len(field))
        scans = [ScanReference(pair.inspection.scan_sha256, pair.job_id) for pair in pairs]
        printed = current_print(self._ledger, part_id, design)
        try:
            judge_prints(self._ledger, printed, measured, scans, may_be_better=on_request)
        finally:  # what is refused may have been noted
            with self._target_lock:
                if self._is_set(target):
                    self._tell_printed(target)
        found = next_redesigns(printed, measured, settings, regions_from(self, design), gains, job.check)
        job.finish()
        if not found:
            self.job_done(f"job {job_id}: {NOTHING_LEFT}")
            return [], []
        with self._target_lock:
            if not self._is_set(target):
                raise DesignMismatchError(
                    "another design was set meanwhile", f"inspection {job_id}", f"set part {part_id} again"
                )
            paths = self._save(found, pairs[-1].inspection)
            passed, errors = _sorted_out(found, propose_all(self._ledger, printed, found, settings, scans, paths))
            messages = [redesigned_mesh_message(checked, cycle, pairs[-1].inspection) for checked, cycle in passed]
            if messages:
                self._publish(messages[-1])  # each topic keeps one
        if messages:
            told = "; ".join(
                f"cycle {cycle.number} ({cycle.id}), largest move {checked.redesign.max_move:.3f} mm, {cycle.stl_path}"
                for checked, cycle in passed
            )
            self.job_done(f"job {job_id}: {told}, {time.monotonic() - began:.2f} s")
        return messages, errors

    def _save(self, found: Sequence[Checked], inspection: InspectionMessage) -> list[str]:
        """Write what passed its checks; where the STL of each lies, or would lie."""
        formats = self.get_parameter("redesign_formats").value.split(",")
        stems = redesign_stems([checked.redesign.gain for checked in found])
        files = [redesign_files(checked.redesign, stem, formats) for checked, stem in zip(found, stems, strict=True)]
        name = folder_name(f"{inspection.part_id or self._require_target().part_id}_{inspection.job_id}")
        folder = free_folder(self._output_folder() / name, {name: each[name] for each in files for name in each})
        if passed := [each for checked, each in zip(found, files, strict=True) if checked.passed]:
            write_together(folder, {name: each[name] for each in passed for name in each})
        return [str(folder / f"{stem}.stl") for stem in stems]

    def _publish(self, message: RedesignedMesh) -> None:
        self._marker.publish(marker_message(Path(message.path), message.header))
        self._mesh.publish(message)
        if self.get_parameter("publish_redesign").value == "checked":
            self._path.publish(String(data=message.path))

    # Cycles

    def _on_release(self, request: ReleaseRedesign.Request, response: ReleaseRedesign.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            cycle = self._named_cycle(request.cycle_id)
            require_file(cycle)
            self._ledger.release(cycle.id, _by(request.by))
            self._go_on(response)
        return response

    def _on_reject(self, request: RejectRedesign.Request, response: RejectRedesign.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            cycle = self._ledger.reject(self._named_cycle(request.cycle_id).id, _by(request.by), request.reason)
            response.cycle = cycle_message(cycle, self._header())
            target = self._require_target()
            told = self._tell_printed(target)
            # Another one may wait for its decision still.
            self._path.publish(String(data=self._last_path(target) or self._intact_path(told)))
        return response

    def _on_roll_back(self, request: RollBack.Request, response: RollBack.Response) -> Any:
        with self.error_boundary(response):
            self.require_active()
            taken_back = self._named_cycle(request.cycle_id) if request.cycle_id else self._released_cycle()
            self._ledger.roll_back(taken_back.id, _by(request.by), request.reason)
            self._go_on(response)
        return response

    def _require_target(self) -> CellDesign:
        if self._target is None:
            raise no_design(self)
        return self._target

    def _is_set(self, target: CellDesign) -> bool:
        """Whether it is still what is redesigned."""
        return self._target is not None and _identity(self._target) == _identity(target)

    def _named_cycle(self, cycle_id: int) -> Cycle:
        """The redesign of this part that a request names; 0: the last one that nobody has decided about."""
        target = self._require_target()
        cycles = self._ledger.history(target.part_id, target.design.file_sha256)
        named = [
            cycle for cycle in cycles if (cycle.id == cycle_id if cycle_id else cycle.state is CycleState.PROPOSED)
        ]
        if not named:
            which = f"no redesign {cycle_id} of this part" if cycle_id else "no redesign waits for a decision"
            raise CycleStateError(which, f"part {target.part_id}", "inspect a scan first, or name another one")
        return named[-1]

    def _released_cycle(self) -> Cycle:
        target = self._require_target()
        current = self._ledger.current(target.part_id, target.design.file_sha256)
        if current is None:
            raise CycleStateError("no redesign is released", f"part {target.part_id}", "there is nothing to go back to")
        return current

    def _go_on(self, response: Any) -> None:
        """Something else is printed now."""
        self._forget_prints()
        response.cycle = self._tell_printed(self._require_target())
        self._path.publish(String(data=self._intact_path(response.cycle)))

    def _intact_path(self, told: CycleMessage) -> str:
        """Its path; empty, and reported, where another file lies there or none: nobody must print that."""
        if told.cycle_id == 0 or has_its_file(self._ledger.cycle(told.cycle_id)):
            return str(told.path)
        self.report(
            CycleStateError(
                "the file is gone, or not the one that was released", told.path, "put that one back from a backup"
            )
        )
        return ""

    def _last_path(self, target: CellDesign) -> str:
        """What late subscribers should know of: the newest redesign that may be printed; empty: none."""
        part = target.part_id, target.design.file_sha256
        current = self._ledger.current(*part)
        printable = [] if current is None else [current]
        if self.get_parameter("publish_redesign").value == "checked":
            printable += self._ledger.waiting(*part, None if current is None else current.id)
        paths = [cycle.stl_path for cycle in printable if has_its_file(cycle)]
        return paths[-1] if paths else ""

    def _tell_printed(self, target: CellDesign) -> CycleMessage:
        cycle = self._ledger.current(target.part_id, target.design.file_sha256)
        if cycle is None:
            message = design_cycle_message(target.design, target.part_id, self._header())
            for doubt in doubts_of_beginning(self._ledger, target.part_id, target.design):
                self.get_logger().warning(doubt)
        else:
            message = cycle_message(cycle, self._header())
        self._last_printed = message.path
        self._printed.publish(message)
        return message


def _identity(target: CellDesign) -> tuple[str, str, str]:
    return target.part_id, target.design.file_sha256, target.unit


def _sorted_out(
    found: Sequence[Checked], cycles: Sequence[Cycle]
) -> tuple[list[tuple[Checked, Cycle]], list[MdfError]]:
    """The redesigns that may be released, and the errors of the others."""
    passed, errors = [], []
    for checked, cycle in zip(found, cycles, strict=True):
        try:
            checked.require_passed()
            require_open(cycle)
        except MdfError as error:
            errors.append(error)
        else:
            passed.append((checked, cycle))
    return passed, errors


def _by(name: str) -> str:
    if not name:
        raise InvalidSettingError("nobody is named", "by", "say who decides")
    return name


def _require_distinct(pairs: Sequence[Pair]) -> None:
    # Not every publisher knows the hash.
    require_distinct([pair.inspection.scan_sha256 or pair.job_id for pair in pairs])


def _check_same_design(design: Design, inspection: InspectionMessage, vertices: int) -> None:
    if inspection.design_sha256 != design.file_sha256 or vertices != len(design.vertices):
        raise DesignMismatchError(
            f"belongs to {inspection.design_path}, sha256 {inspection.design_sha256[:8]}, {vertices} vertices; "
            f"the design is {design.path}, sha256 {design.file_sha256[:8]}, {len(design.vertices)} vertices",
            f"inspection {inspection.job_id}",
            "inspect against this design",
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit status."""
    return run_managed_node(Compensation, "Redesign a part so that its next print comes out right.", args)


if __name__ == "__main__":
    raise SystemExit(main())
