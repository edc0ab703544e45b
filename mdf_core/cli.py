"""The command ``mdf``: inspect, compensate and replay files without ROS, and a demonstration."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import itertools
import sys
import traceback
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from mdf_core import __version__
from mdf_core.command import (
    add_common,
    add_units,
    design_of,
    regions_of,
    save_inspection_files,
    save_report,
    settings_of,
    tell,
    warn,
    watched_inspect,
)
from mdf_core.compensate_command import add_compensate
from mdf_core.errors import MdfError, NoScanError
from mdf_core.files import require_writable
from mdf_core.ledger_command import add_ledger
from mdf_core.redesign_names import REDESIGN_FILE
from mdf_core.redesign_task import require_kept
from mdf_core.repeat_command import add_repeat
from mdf_core.settings import Settings
from mdf_core.units import UNITS

if TYPE_CHECKING:
    from mdf_core.bag import Bag, BagMessage
    from mdf_core.compensation import Redesign
    from mdf_core.cycles import Checked
    from mdf_core.inspection import Inspection

DONE, FAULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: done, a fault of ours, an input that the user can mend, Ctrl-C."""

_POINTS_TOPIC = "/points"
_SCANNER_POINTS, _WARP_MM, _SEED = 20_000, 1.5, 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except MdfError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception:
        traceback.print_exc()
        return FAULT
    return DONE


class _Parser(argparse.ArgumentParser):
    """Tells what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"error: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="mdf", description="Measure how a printed part is distorted and redesign it. Lengths in mm.")
    parser.add_argument("--version", action="version", version=f"mdf {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    inspect = commands.add_parser("inspect", help="register a scan to its design and report the distortion")
    inspect.add_argument("design", metavar="DESIGN", type=Path, help="STL, PLY, OBJ or 3MF")
    inspect.add_argument(
        "scan", metavar="SCAN", type=Path, help="STL, PLY, OBJ, PCD, NPY, or text: XYZ, ASC, PTS, TXT, CSV"
    )
    add_units(inspect)
    add_common(inspect)
    inspect.set_defaults(run=_inspect)

    add_compensate(commands)
    add_repeat(commands)
    add_ledger(commands)
    replay = commands.add_parser("replay", help="inspect a scan out of a recorded bag and redesign the part")
    replay.add_argument("bag", metavar="BAG", type=Path, help="folder of the bag, or one MCAP file")
    replay.add_argument("--topic", default="", help="point cloud topic (default: points, or the only one there is)")
    replay.add_argument("--scan-index", type=int, default=-1, help="which scan of the topic, -1: the last (default)")
    replay.add_argument("--design", type=Path, help="STL, PLY, OBJ or 3MF (default: design.stl beside the bag)")
    replay.add_argument("--design-unit", choices=UNITS, default="mm", help="unit of the design file (default: mm)")
    add_common(replay)
    replay.set_defaults(run=_replay)

    demo = commands.add_parser("demo", help="print, scan, inspect, redesign and print again on a simulated machine")
    demo.add_argument("--part", default="bracket", help="which part (default: bracket)")
    demo.add_argument("--out", metavar="DIR", type=Path, default=Path("demo_output"), help="default: demo_output")
    demo.set_defaults(run=_demo)
    return parser


def _inspect(options: argparse.Namespace) -> None:
    from mdf_core.mesh_io import load_scan

    settings = settings_of(options)
    require_writable(options.out)
    design = design_of(options.design, options.design_unit, settings)
    scan = load_scan(options.scan, options.scan_unit)
    inspection = watched_inspect(design, scan, settings, regions_of(options.regions, design))
    save_inspection_files(options.out, inspection, scan_path=str(options.scan))
    tell(inspection, None, options.out)


def _replay(options: argparse.Namespace) -> None:
    from mdf_core.bag import open_bag
    from mdf_core.cycles import redesigns, require_usable
    from mdf_core.point_cloud2 import as_published, scan_from_cloud
    from mdf_core.record import remove_former, require_removable
    from mdf_core.sampling import prepare

    settings = settings_of(options)
    require_writable(options.out)
    require_removable(options.out)
    bag = open_bag(options.bag)
    topic = bag.find_cloud_topic(options.topic or (_POINTS_TOPIC if _POINTS_TOPIC in bag.topics else "")).name
    folder = options.bag if options.bag.is_dir() else options.bag.parent
    design_path = options.design or folder / "design.stl"
    require_kept(options.out, design_path, *([options.regions] if options.regions else []))
    design = design_of(design_path, options.design_unit, settings)
    if bag.truncated:
        warn(f"{options.bag}: cut short; read up to the cut")
    recorded = _pick(bag, topic, options.scan_index)
    # As in the cell, where scan_ingest prepares the scan before it is published.
    scan = as_published(prepare(scan_from_cloud(recorded.message), settings))
    regions = regions_of(options.regions, design)
    inspection = watched_inspect(design, scan, settings, regions)
    source = {"bag": str(options.bag), "topic": topic, "log_time_ns": recorded.log_time_ns, "truncated": bag.truncated}
    remove_former(options.out)
    save_inspection_files(options.out, inspection, source=source)
    require_usable(str(options.bag), False, inspection.outlier_share, settings)
    (checked,) = redesigns(design, [inspection], settings, regions)
    redesign = _save_redesign(options.out, inspection, checked, source=source)
    tell(inspection, redesign, options.out)


def _save_redesign(folder: Path, inspection: Inspection, checked: Checked, **more: object) -> Redesign:
    """Write the redesign, if it passed its checks; `more` of the report."""
    redesign = checked.require_passed()
    redesign.save(folder / REDESIGN_FILE)
    save_report(folder, inspection, redesign, **more)
    return redesign


def _demo(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.table import Table

    from mdf_core.cycles import redesigns
    from mdf_core.distortion import distortion_left
    from mdf_core.picture import inspection_row, reprint_row
    from mdf_core.record import remove_former, require_removable
    from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, scan_part

    require_writable(options.out)
    require_removable(options.out)
    design = build_part(options.part)
    printer = Printer(Warp(design, _WARP_MM, seed=_SEED))
    printed = printer.print_part(design.vertices)
    scanner = ScannerSettings(points=_SCANNER_POINTS, density_contrast=10.0, pose="random")
    scan = scan_part(printed, design.faces, scanner, seed=_SEED).scan
    settings = Settings()
    inspection = watched_inspect(design, scan, settings)
    (checked,) = redesigns(design, [inspection], settings)
    reprinted = printer.print_part(checked.redesign.vertices)
    rows = [inspection_row(inspection), reprint_row(design, reprinted)]
    remove_former(options.out)
    save_inspection_files(options.out, inspection, rows, simulated=True)
    redesign = _save_redesign(options.out, inspection, checked, simulated=True)

    table = Table(title=f"simulated {options.part}, {len(scan):,} scan points", title_justify="left")
    for column in ("distortion", "RMS mm", "largest mm"):
        table.add_column(column, justify="left" if column == "distortion" else "right")
    measured = (inspection.rms_displacement, inspection.max_displacement)
    for name, (rms, largest) in {
        "true, first print": distortion_left(design, printed),
        "measured on the scan": measured,
        "true, print of the redesign": distortion_left(design, reprinted),
    }.items():
        table.add_row(name, f"{rms:.3f}", f"{largest:.3f}")
    console = Console()
    console.print(table)
    tell(inspection, redesign, options.out)


def _pick(bag: Bag, topic: str, index: int) -> BagMessage:
    """The message of `topic` at `index`, negative from the end."""
    messages = bag.messages([topic])
    if index >= 0:
        found = list(itertools.islice(messages, index, index + 1))
    else:
        tail = deque(messages, maxlen=-index)
        found = [tail[0]] if len(tail) == -index else []
    if not found:
        count = sum(1 for _ in bag.messages([topic]))
        cut = " before the cut" if bag.truncated else ""
        remedy = f"use --scan-index {-count} to {count - 1}" if count else "record the bag again"
        raise NoScanError(f"{count or 'no'} scans on {topic}{cut}, none at {index}", str(bag.path), remedy)
    return found[0]
