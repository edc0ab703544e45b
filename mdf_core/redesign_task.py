"""A redesign from files to files, as ``mdf compensate`` and ``mdf repeat`` make it."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mdf_core.command import design_of, save_inspection_files, save_report, tell, watched_inspect
from mdf_core.errors import OutputFolderError
from mdf_core.redesign_names import PRINTED_FILE, REDESIGN_STEM, redesign_stems
from mdf_core.settings import Settings

if TYPE_CHECKING:
    from mdf_core.compensation import Redesign
    from mdf_core.cycles import Checked
    from mdf_core.geometry import Design
    from mdf_core.inspection import Inspection
    from mdf_core.record import Source, Sources
    from mdf_core.regions import Region


@dataclass(frozen=True)
class RedesignTask:
    """What redesigns are made from, as the command line or a record says; one for each gain."""

    design: Path
    design_unit: str
    scans: tuple[Path, ...]
    scan_unit: str
    settings: Settings
    regions: Path | None
    previous: Path | None
    gains: tuple[float, ...]
    formats: tuple[str, ...]

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files it is made from."""
        others = (path for path in (self.regions, self.previous) if path is not None)
        return self.design, *self.scans, *others


@dataclass(frozen=True, eq=False)
class Part:
    """The design of a task, as fine as its settings ask for, its regions, and the files that both were read from."""

    design: Design
    regions: tuple[Region, ...]
    design_source: Source
    regions_source: Source | None


@dataclass(frozen=True, eq=False)
class Inspected:
    """The inspections of a task's scans, and the files that those were read from."""

    inspections: list[Inspection]
    sources: tuple[Source, ...]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Redesigns that were made together, and what they were made from."""

    task: RedesignTask
    regions: tuple[Region, ...]
    inspections: list[Inspection]
    checked: tuple[Checked, ...]
    stems: list[str]  # of their files
    sources: Sources
    printed: bytes  # PLY of the redesign that was printed, if that lies nowhere else


def redesign(task: RedesignTask, folder: Path) -> Outcome:
    """Inspect the scans, with the files of that in `folder`, and redesign; no redesign is written yet."""
    from mdf_core.cycles import redesigns
    from mdf_core.estimate_file import load_estimate
    from mdf_core.record import source

    require_kept(folder, *task.inputs)
    part = part_of(task)
    printed, previous = None, None
    if task.previous is not None:
        printed, sha256 = load_estimate(task.previous, part.design)
        previous = source(task.previous, sha256, "mm")
    inspected = inspect_scans(task, part, folder)
    require_usable_scans(task, inspected.inspections, ambiguous_too=False)
    checked = redesigns(part.design, inspected.inspections, task.settings, part.regions, printed, task.gains)
    return outcome_of(task, part, inspected, checked, previous)


def part_of(task: RedesignTask) -> Part:
    """Read the design and its regions."""
    from mdf_core.record import source
    from mdf_core.regions import load_regions_and_hash

    design = design_of(task.design, task.design_unit, task.settings)
    design_source = source(task.design, design.file_sha256, task.design_unit)
    if task.regions is None:
        return Part(design, (), design_source, None)
    regions, sha256 = load_regions_and_hash(task.regions, design)
    return Part(design, regions, design_source, source(task.regions, sha256))


def inspect_scans(task: RedesignTask, part: Part, folder: Path) -> Inspected:
    """Inspect every scan, and write what was found in the place of an earlier run, whatever comes of the redesign.

    Raises
    ------
    CompensationRefusedError
        Two of the scans are the same.
    OutputFolderError
        The folder cannot be written.
    """
    from mdf_core.cycles import require_distinct
    from mdf_core.mesh_io import load_scan_and_hash
    from mdf_core.record import remove_former, source

    scans, hashes = zip(*(load_scan_and_hash(path, task.scan_unit) for path in task.scans), strict=True)
    require_distinct([scan.sha256() for scan in scans])
    inspections = [watched_inspect(part.design, scan, task.settings, part.regions) for scan in scans]
    remove_former(folder)
    for number, (path, inspection) in enumerate(zip(task.scans, inspections, strict=True), 1):
        save_inspection_files(_folder_of(folder, number), inspection, scan_path=str(path))
    sources = [source(path, sha256, task.scan_unit) for path, sha256 in zip(task.scans, hashes, strict=True)]
    return Inspected(inspections, tuple(sources))


def require_usable_scans(task: RedesignTask, inspections: Sequence[Inspection], ambiguous_too: bool) -> None:
    """Refuse inspections that no redesign must be made from unseen.

    Those of an ambiguous pose, of which the user has been warned, only if `ambiguous_too`.

    Raises
    ------
    CompensationRefusedError
    """
    from mdf_core.cycles import require_usable

    for path, inspection in zip(task.scans, inspections, strict=True):
        is_ambiguous = ambiguous_too and inspection.pose_ambiguous
        require_usable(str(path), is_ambiguous, inspection.outlier_share, task.settings)


def _folder_of(folder: Path, number: int) -> Path:
    return folder if number == 1 else folder / f"scan_{number}"


def outcome_of(
    task: RedesignTask,
    part: Part,
    inspected: Inspected,
    checked: tuple[Checked, ...],
    previous: Source | None,
    printed: bytes = b"",
) -> Outcome:
    """What came out, with the hashes of the files as they were read: the work takes long, and they may change."""
    from mdf_core.record import Sources

    sources = Sources(part.design_source, inspected.sources, part.regions_source, previous)
    stems = redesign_stems([each.redesign.gain for each in checked])
    return Outcome(task, part.regions, inspected.inspections, checked, stems, sources, printed)


def require_kept(folder: Path, *paths: Path) -> None:
    """Refuse a folder where one of these files may be written over: what is made from, or was printed.

    Raises
    ------
    OutputFolderError
    """
    for path in map(os.path.realpath, paths):
        parent, name = os.path.split(path)
        if name.startswith(REDESIGN_STEM) and parent == os.path.realpath(folder):
            raise OutputFolderError(
                f"{name}, which is needed, may be written over", str(folder), "choose another folder for --out"
            )


def finish(folder: Path, outcome: Outcome) -> None:
    """Write everything, but no mesh that failed a check, and print what came out.

    Raises
    ------
    OutputFolderError
        The folder cannot be written.
    """
    from mdf_core.files import write_together

    if passed := [checked.redesign for checked in outcome.checked if checked.passed]:
        _save_reports(folder, outcome, passed[0])
    write_together(folder, _files(outcome))
    tell(outcome.inspections[0], None, folder)
    _tell_prints(outcome)


def _files(outcome: Outcome) -> dict[str, bytes]:
    """Name and content of the redesigns' files, behind those that say how they came about."""
    from mdf_core.record import RECORD_FILE, record, redesign_entries, redesign_files
    from mdf_core.report import json_bytes

    task, entries = outcome.task, []
    redesigned: dict[str, bytes] = {}
    for checked, stem in zip(outcome.checked, outcome.stems, strict=True):
        files = redesign_files(checked.redesign, stem, task.formats) if checked.passed else {}
        entries.append(redesign_entries(checked.redesign, checked.checks, files))
        redesigned |= files
    any_redesign = outcome.checked[0].redesign
    whole = record(outcome.sources, outcome.inspections, entries, any_redesign, outcome.regions, task.settings)
    printed = {PRINTED_FILE: outcome.printed} if outcome.printed else {}
    return {**printed, RECORD_FILE: json_bytes(whole), **redesigned}


def _save_reports(folder: Path, outcome: Outcome, redesign: Redesign) -> None:
    hashes = [inspection.scan_sha256 for inspection in outcome.inspections]
    for number, (path, inspection) in enumerate(zip(outcome.task.scans, outcome.inspections, strict=True), 1):
        more = {"scan_path": str(path), "redesign_scan_sha256": hashes}
        save_report(_folder_of(folder, number), inspection, redesign, **more)


def _tell_prints(outcome: Outcome) -> None:
    any_redesign = outcome.checked[0].redesign
    prints, evidence = any_redesign.prints, any_redesign.estimate.evidence
    if prints.count > 1:
        print(
            f"{prints.count} prints: systematic {prints.rms_displacement:.3f} mm RMS, known to "
            f"{prints.rms_standard_error:.3f} mm; variation from print to print {prints.variation:.3f} mm"
        )
    if evidence.most_prints > prints.count:
        print(
            f"with the cycles before, a mean of {evidence.most_prints:.1f} prints: known to "
            f"{any_redesign.rms_standard_error:.3f} mm; variation from print to print {evidence.variation:.3f} mm"
        )
    if any_redesign.lasting:
        print(
            f"{any_redesign.lasting:.3f} mm RMS are more than chance explains so far: the last redesign fell short, or "
            "the printer has changed"
        )
    for checked in outcome.checked:
        one = checked.redesign
        print(
            f"redesign with gain {one.gain:g} moves vertices by up to {one.max_move:.3f} mm, "
            f"{one.compensated.mean():.0%} of them; {one.predicted_residual:.3f} mm RMS are expected to be left"
        )
