"""``mdf compensate``, ``mdf repeat`` and ``mdf ledger``: redesigns, made, made again, and decided about."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdf_core.command import (
    add_common,
    add_units,
    design_of,
    regions_of,
    save_inspection_files,
    save_report,
    settings_of,
    tell,
    watched_inspect,
)
from mdf_core.errors import CompensationRefusedError, DesignMismatchError, InvalidSettingError, OutputFolderError
from mdf_core.files import require_writable
from mdf_core.redesign_names import FORMATS, REDESIGN_STEM, redesign_stems
from mdf_core.settings import Settings

if TYPE_CHECKING:
    from mdf_core.compensation import Redesign
    from mdf_core.cycles import Checked
    from mdf_core.geometry import Array, Design
    from mdf_core.inspection import Inspection
    from mdf_core.ledger import Ledger
    from mdf_core.ledger_entries import Cycle
    from mdf_core.record import Source, Sources
    from mdf_core.regions import Region

_PIPED_WIDTH = 240
_URL = "such as sqlite:////absolute/path/ledger.sqlite"


def add_compensate(commands: Any) -> None:
    """The commands ``compensate`` and ``repeat``."""
    compensate = commands.add_parser("compensate", help="inspect one or more prints and redesign the part")
    compensate.add_argument("design", metavar="DESIGN", type=Path, help="STL, PLY, OBJ or 3MF")
    compensate.add_argument(
        "scans", metavar="SCAN", type=Path, nargs="+", help="scans of prints of one and the same mesh"
    )
    add_units(compensate)
    add_common(compensate)
    compensate.add_argument(
        "--gain", metavar="SHARE", type=float, nargs="+", default=[], help="a redesign for each; default: the setting"
    )
    compensate.add_argument(
        "--format",
        choices=FORMATS,
        nargs="+",
        default=["stl"],
        help="files of the redesign (default: stl, with a ledger always)",
    )
    printed = compensate.add_mutually_exclusive_group()
    printed.add_argument(
        "--previous", metavar="STL", type=Path, help="the redesign that was printed, if not the design"
    )
    printed.add_argument("--ledger", metavar="URL", help="database of the cycles; it knows what was printed")
    compensate.add_argument("--part-id", metavar="NAME", help="name of the part there (default: the design file's)")
    compensate.set_defaults(run=_compensate)

    repeat = commands.add_parser("repeat", help="make a redesign again from its record, and compare it to the byte")
    repeat.add_argument("record", metavar="RECORD", type=Path, help="record.json that compensate wrote")
    repeat.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    repeat.set_defaults(run=_repeat)


def add_ledger(commands: Any) -> None:
    """The command ``ledger``."""
    steps = commands.add_parser("ledger", help="show the redesigns of parts, release them, or go back").add_subparsers(
        required=True, metavar="STEP"
    )
    shown = steps.add_parser("show", help="all cycles, oldest first")
    shown.add_argument("url", metavar="URL", help=_URL)
    shown.add_argument("--part-id", metavar="NAME", default="", help="only those of this part")
    shown.set_defaults(run=_show)
    for name, run, text in (
        ("release", _release, "from now on this redesign is what is printed"),
        ("reject", _reject, "this redesign is not to be printed"),
        ("roll-back", _roll_back, "print what was printed before this redesign"),
    ):
        step = steps.add_parser(name, help=text)
        step.add_argument("url", metavar="URL", help=_URL)
        step.add_argument("cycle", metavar="ID", type=int, help="of the redesign, as show lists it")
        step.add_argument("--by", metavar="NAME", required=True, help="who decides")
        if run is not _release:
            step.add_argument("--reason", metavar="TEXT", required=True, help="why")
        step.set_defaults(run=run)


# Redesigns


@dataclass(frozen=True)
class _Task:
    """What a redesign is made from, as the command line or a record says."""

    design: Path
    design_unit: str
    scans: tuple[Path, ...]
    scan_unit: str
    settings: Settings
    regions: Path | None
    previous: Path | None
    gains: tuple[float, ...]
    formats: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Made:
    """What came out."""

    task: _Task
    regions: tuple[Region, ...]
    inspections: list[Inspection]
    checked: tuple[Checked, ...]
    stems: list[str]  # of their files
    sources: Sources


def _compensate(options: argparse.Namespace) -> None:
    settings = settings_of(options)
    require_writable(options.out)
    redesign_stems(options.gain)
    for gain in options.gain:
        settings.replace({"compensation.gain": gain})
    if options.part_id is not None and options.ledger is None:
        raise InvalidSettingError("says nothing without --ledger", "--part-id", "give --ledger, or leave it out")
    # A redesign is released with its STL.
    always = () if options.ledger is None else ("stl",)
    task = _Task(
        options.design,
        options.design_unit,
        tuple(options.scans),
        options.scan_unit,
        settings,
        options.regions,
        options.previous,
        tuple(options.gain),
        tuple(dict.fromkeys((*always, *options.format))),
    )
    if options.ledger is None:
        made = _make(task, options.out)
        _finish(options.out, made)
        for checked in made.checked:
            checked.require_passed()
        return
    from mdf_core.ledger import Ledger

    with Ledger(options.ledger) as ledger:
        _next_cycle(ledger, options.part_id or options.design.stem, task, options.out)


def _make(task: _Task, folder: Path) -> _Made:
    from mdf_core.cycles import redesigns
    from mdf_core.record import source

    design, regions = _design(task)
    previous = None
    if task.previous is not None:
        previous = _redesigned_vertices(task.previous, design)
        _require_kept(task.previous, folder)
    inspections = _inspect(task, design, regions, folder)
    _require_usable(task, inspections, ambiguous_too=False)
    checked = redesigns(design, inspections, task.settings, regions, previous, task.gains)
    return _made(task, regions, inspections, checked, None if task.previous is None else source(task.previous, "mm"))


def _design(task: _Task) -> tuple[Design, tuple[Region, ...]]:
    design = design_of(task.design, task.design_unit, task.settings)
    return design, regions_of(task.regions, design)


def _inspect(task: _Task, design: Design, regions: Sequence[Region], folder: Path) -> list[Inspection]:
    """Inspect every scan, and write what was found, whatever comes of the redesign."""
    from mdf_core.cycles import require_distinct
    from mdf_core.mesh_io import load_scan

    scans = [load_scan(path, task.scan_unit) for path in task.scans]
    require_distinct([scan.sha256() for scan in scans])
    inspections = [watched_inspect(design, scan, task.settings, regions) for scan in scans]
    for number, (path, inspection) in enumerate(zip(task.scans, inspections, strict=True), 1):
        save_inspection_files(_folder_of(folder, number), inspection, scan_path=str(path))
    return inspections


def _require_usable(task: _Task, inspections: Sequence[Inspection], ambiguous_too: bool) -> None:
    """Without a ledger a redesign from an ambiguous pose is made; it has been warned of."""
    from mdf_core.cycles import require_usable

    for path, inspection in zip(task.scans, inspections, strict=True):
        is_ambiguous = ambiguous_too and inspection.pose_ambiguous
        require_usable(str(path), is_ambiguous, inspection.outlier_share, task.settings)


def _folder_of(folder: Path, number: int) -> Path:
    return folder if number == 1 else folder / f"scan_{number}"


def _made(
    task: _Task,
    regions: tuple[Region, ...],
    inspections: list[Inspection],
    checked: tuple[Checked, ...],
    previous: Source | None,
) -> _Made:
    from mdf_core.record import Sources, source

    sources = Sources(
        design=source(task.design, task.design_unit),
        scans=tuple(source(path, task.scan_unit) for path in task.scans),
        regions=None if task.regions is None else source(task.regions),
        previous=previous,
    )
    stems = redesign_stems([each.redesign.gain for each in checked])
    return _Made(task, regions, inspections, checked, stems, sources)


def _redesigned_vertices(path: Path, design: Design) -> Array:
    """Vertices of a redesign from its STL, in the design's order."""
    import numpy as np

    from mdf_core.mesh_io import load_design

    triangles = load_design(path, "mm").triangles
    vertices = design.vertices.copy()
    if triangles.shape == design.triangles.shape:
        vertices[design.faces.ravel()] = triangles.reshape(-1, 3)
    if triangles.shape != design.triangles.shape or not np.array_equal(vertices[design.faces], triangles):
        raise DesignMismatchError("is no redesign of this design", str(path), "give the STL that compensate wrote")
    return vertices


def _require_kept(printed: Path, folder: Path) -> None:
    """Refuse a folder where the redesign that was printed may be written over."""
    if printed.resolve().parent == folder.resolve() and printed.name.startswith(REDESIGN_STEM):
        raise OutputFolderError(
            f"{printed.name}, which was printed, may be written over", str(folder), "choose another folder for --out"
        )


def _finish(folder: Path, made: _Made) -> None:
    """Write everything, but no mesh that failed a check, and tell."""
    from mdf_core.files import write_atomically
    from mdf_core.record import record, redesign_entries, redesign_files, remove_former, save_record

    remove_former(folder)
    entries = []
    for checked, stem in zip(made.checked, made.stems, strict=True):
        files = redesign_files(checked.redesign, stem, made.task.formats) if checked.passed else {}
        for name, content in files.items():
            write_atomically(folder / name, content)
        entries.append(redesign_entries(checked.redesign, checked.checks, files))
    if passed := [checked.redesign for checked in made.checked if checked.passed]:
        _save_reports(folder, made, passed[0])
    any_redesign = made.checked[0].redesign
    save_record(folder, record(made.sources, made.inspections, entries, any_redesign, made.regions, made.task.settings))
    tell(made.inspections[0], None, folder)
    _tell_prints(made)


def _save_reports(folder: Path, made: _Made, redesign: Redesign) -> None:
    hashes = [inspection.scan_sha256 for inspection in made.inspections]
    for number, (path, inspection) in enumerate(zip(made.task.scans, made.inspections, strict=True), 1):
        more = {"scan_path": str(path), "redesign_scan_sha256": hashes}
        save_report(_folder_of(folder, number), inspection, redesign, **more)


def _tell_prints(made: _Made) -> None:
    prints = made.checked[0].redesign.prints
    if prints.count > 1:
        print(
            f"{prints.count} prints: systematic {prints.rms_displacement:.3f} mm RMS, known to "
            f"{prints.rms_standard_error:.3f} mm; variation from print to print {prints.variation:.3f} mm"
        )
    for checked in made.checked:
        one = checked.redesign
        print(
            f"redesign with gain {one.gain:g} moves vertices by up to {one.max_move:.3f} mm, "
            f"{one.compensated.mean():.0%} of them; {one.predicted_residual:.3f} mm RMS are expected to be left"
        )


def _repeat(options: argparse.Namespace) -> None:
    from mdf_core.record import read_record

    require_writable(options.out)
    entries = read_record(options.record)
    made = _make(_task_of(entries, options.record), options.out)
    _finish(options.out, made)
    for wanted, checked in zip(entries["redesigns"], made.checked, strict=True):
        found = hashlib.sha256(checked.redesign.stl()).hexdigest()
        if found != wanted["stl_sha256"]:
            raise CompensationRefusedError(
                f"the redesign with gain {wanted['gain']:g} has other bytes: sha256 {found[:8]}, recorded "
                f"{wanted['stl_sha256'][:8]}",
                str(options.record),
                f"compare the versions: recorded {entries['software']}",
            )
    print("the same bytes as recorded")


def _task_of(entries: dict[str, Any], path: Path) -> _Task:
    """What a record says was done; files that have been changed since are refused."""
    try:
        return _recorded_task(entries)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InvalidSettingError(
            f"does not hold what a record holds: {error!r}", str(path), "give the record.json that compensate wrote"
        ) from error


def _recorded_task(entries: dict[str, Any]) -> _Task:
    from mdf_core.record import source

    named = [entries["design"], *entries["scans"]]
    named += [entries[name] for name in ("regions", "previous") if entries[name] is not None]
    named += entries["regions"]["meshes"] if entries["regions"] is not None else []
    for one in named:
        try:
            found = source(one["path"]).sha256
        except OSError as error:
            raise InvalidSettingError(f"cannot be read: {error.strerror}", one["path"], "put it back") from error
        if found != one["sha256"]:
            raise InvalidSettingError("is not the file that was recorded", one["path"], "put that one back")
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in entries["settings"].items()}
    return _Task(
        design=Path(entries["design"]["path"]),
        design_unit=entries["design"]["unit"],
        scans=tuple(Path(scan["path"]) for scan in entries["scans"]),
        scan_unit=entries["scans"][0]["unit"],
        settings=Settings().replace(settings),
        regions=None if entries["regions"] is None else Path(entries["regions"]["path"]),
        previous=None if entries["previous"] is None else Path(entries["previous"]["path"]),
        gains=tuple(float(one["gain"]) for one in entries["redesigns"]),
        formats=("stl",),
    )


# The ledger


def _next_cycle(ledger: Ledger, part_id: str, task: _Task, folder: Path) -> None:
    """Go on from what the ledger says is printed."""
    from mdf_core.cycles import NOTHING_LEFT, next_redesigns, propose_all, require_open
    from mdf_core.ledger_entries import ScanReference
    from mdf_core.printed import current_print, judge_prints
    from mdf_core.record import Source

    design, regions = _design(task)
    printed = current_print(ledger, part_id, design)
    if printed.cycle is not None:
        _require_kept(Path(printed.cycle.stl_path), folder)
    inspections = _inspect(task, design, regions, folder)
    _require_usable(task, inspections, ambiguous_too=True)
    scans = [ScanReference(inspection.scan_sha256, "") for inspection in inspections]
    judge_prints(ledger, printed, inspections, scans)
    checked = next_redesigns(printed, inspections, task.settings, regions, task.gains)
    if not checked:
        tell(inspections[0], None, folder)
        print(f"{NOTHING_LEFT}: keep what is printed")
        return
    cycle = printed.cycle
    previous = None if cycle is None else Source(cycle.stl_path, "mm", cycle.stl_sha256)
    made = _made(task, regions, inspections, checked, previous)
    _finish(folder, made)
    paths = [str((folder / f"{stem}.stl").absolute()) for stem in made.stems]
    proposed = propose_all(ledger, printed, checked, task.settings, scans, paths)
    for cycle in proposed:
        print(f"ledger: {_line(cycle)}")
    for one, cycle in zip(checked, proposed, strict=True):
        one.require_passed()
        require_open(cycle)


def _existing_ledger(url: str) -> Ledger:
    from mdf_core.ledger import Ledger
    from mdf_core.ledger_database import require_existing

    require_existing(url)
    return Ledger(url)


def _show(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.table import Table

    with _existing_ledger(options.url) as ledger:
        cycles = ledger.history(options.part_id)
    table = Table()
    residuals = ("before mm", "expected mm", "last reprint mm")
    for heading in ("id", "part", "cycle", "gain", "state", *residuals, "by", "reason"):
        table.add_column(heading)
    for cycle in cycles:
        figures = (cycle.residual_before_mm, cycle.predicted_residual_mm, cycle.measured_residual_mm)
        shown = ["" if figure is None else f"{figure:.3f}" for figure in figures]
        texts = (cycle.part_id, str(cycle.number), f"{cycle.gain:g}", cycle.state.value)
        table.add_row(str(cycle.id), *texts, *shown, cycle.decided_by, cycle.reason)
    # What is piped on is not cut to the width of a terminal.
    Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH).print(table)


def _line(cycle: Cycle) -> str:
    return f"{cycle.id}: {cycle.part_id}, cycle {cycle.number}, gain {cycle.gain:g}, {cycle.state.value}"


def _release(options: argparse.Namespace) -> None:
    from mdf_core.cycles import require_file

    with _existing_ledger(options.url) as ledger:
        require_file(ledger.cycle(options.cycle))
        print(_line(ledger.release(options.cycle, options.by)))


def _reject(options: argparse.Namespace) -> None:
    with _existing_ledger(options.url) as ledger:
        print(_line(ledger.reject(options.cycle, options.by, options.reason)))


def _roll_back(options: argparse.Namespace) -> None:
    with _existing_ledger(options.url) as ledger:
        current = ledger.roll_back(options.cycle, options.by, options.reason)
    print("printed from now on: " + ("the design" if current is None else _line(current)))
