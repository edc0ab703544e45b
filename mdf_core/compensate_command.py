"""``mdf compensate``: inspect one or more prints and redesign the part; with a ledger, as the next of its cycles."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdf_core.command import add_common, add_units, cycle_line, settings_of, tell, warn
from mdf_core.errors import InvalidSettingError
from mdf_core.files import require_writable
from mdf_core.redesign_names import FORMATS, PRINTED_FILE, redesign_stems
from mdf_core.redesign_task import (
    RedesignTask,
    finish,
    inspect_scans,
    outcome_of,
    part_of,
    redesign,
    require_kept,
    require_usable_scans,
)
from mdf_core.settings import Settings

if TYPE_CHECKING:
    from mdf_core.ledger import Ledger


def add_compensate(commands: Any) -> None:
    """The command ``compensate``."""
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
        "--previous",
        metavar="FILE",
        type=Path,
        help="the redesign that was printed, if not the design: its PLY (--format ply), which knows the prints before; "
        "of its STL the new prints count alone",
    )
    printed.add_argument("--ledger", metavar="URL", help="database of the cycles; it knows what was printed")
    compensate.add_argument("--part-id", metavar="NAME", help="name of the part there (default: the design file's)")
    compensate.set_defaults(run=_compensate)


def _compensate(options: argparse.Namespace) -> None:
    settings = settings_of(options)
    require_writable(options.out)
    task = _task_of(options, settings)
    from mdf_core.record import require_removable

    require_removable(options.out)
    if options.ledger is None:
        _redesign_alone(task, options.out)
        return
    from mdf_core.ledger import Ledger

    with Ledger(options.ledger) as ledger:
        _next_cycle(ledger, options.part_id or options.design.stem, task, options.out)


def _task_of(options: argparse.Namespace, settings: Settings) -> RedesignTask:
    """What the options ask for; what makes no sense is refused before the work."""
    redesign_stems(options.gain)
    for gain in options.gain:
        settings.replace({"compensation.gain": gain})
    if options.part_id is not None and options.ledger is None:
        raise InvalidSettingError("says nothing without --ledger", "--part-id", "give --ledger, or leave it out")
    # A redesign is released with its STL.
    always = () if options.ledger is None else ("stl",)
    return RedesignTask(
        design=options.design,
        design_unit=options.design_unit,
        scans=tuple(options.scans),
        scan_unit=options.scan_unit,
        settings=settings,
        regions=options.regions,
        previous=options.previous,
        gains=tuple(options.gain),
        formats=tuple(dict.fromkeys((*always, *options.format))),
    )


def _redesign_alone(task: RedesignTask, folder: Path) -> None:
    """Without a ledger."""
    outcome = redesign(task, folder)
    finish(folder, outcome)
    for checked in outcome.checked:
        checked.require_passed()


def _next_cycle(ledger: Ledger, part_id: str, task: RedesignTask, folder: Path) -> None:
    """Go on from what the ledger says is printed."""
    from mdf_core.cycles import NOTHING_LEFT, next_redesigns, propose_all, require_open
    from mdf_core.estimate_file import estimate_fields
    from mdf_core.ledger_entries import ScanReference
    from mdf_core.mesh_export import ply_bytes
    from mdf_core.printed import current_print, doubts_of_beginning, judge_prints
    from mdf_core.record import source

    require_kept(folder, *task.inputs)
    part = part_of(task)
    printed = current_print(ledger, part_id, part.design)
    if printed.cycle is None:
        for doubt in doubts_of_beginning(ledger, part_id, part.design):
            warn(doubt)
    # What was printed before may be gone back to.
    require_kept(folder, *(Path(path) for path in ledger.kept_files(part_id, part.design.file_sha256)))
    inspected = inspect_scans(task, part, folder)
    inspections = inspected.inspections
    require_usable_scans(task, inspections, ambiguous_too=True)
    scans = [ScanReference(inspection.scan_sha256, "") for inspection in inspections]
    judge_prints(ledger, printed, inspections, scans)
    checked = next_redesigns(printed, inspections, task.settings, part.regions, task.gains)
    if not checked:
        tell(inspections[0], None, folder)
        print(f"{NOTHING_LEFT}: keep what is printed")
        return
    previous, content = None, b""
    if printed.cycle is not None:
        content = ply_bytes(printed.estimate.vertices, part.design.faces, estimate_fields(printed.estimate))
        previous = source(folder / PRINTED_FILE, hashlib.sha256(content).hexdigest(), "mm")
    outcome = outcome_of(task, part, inspected, checked, previous, content)
    finish(folder, outcome)
    paths = [str((folder / f"{stem}.stl").absolute()) for stem in outcome.stems]
    proposed = propose_all(ledger, printed, checked, task.settings, scans, paths)
    for cycle in proposed:
        print(f"ledger: {cycle_line(cycle)}")
    for one, cycle in zip(checked, proposed, strict=True):
        one.require_passed()
        require_open(cycle)
