"""The command ``mdf``: inspect, compensate and replay files without ROS, and a demonstration."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import itertools
import os
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from mdf_core import __version__
from mdf_core.errors import InvalidSettingError, MdfError, NoScanError, OutputFolderError
from mdf_core.progress import Progress, silent
from mdf_core.settings import METHODS, Settings
from mdf_core.units import UNITS

if TYPE_CHECKING:
    from mdf_core.bag import Bag, BagMessage
    from mdf_core.compensation import Redesign
    from mdf_core.geometry import Design, PointSet
    from mdf_core.inspection import Inspection
    from mdf_core.picture import PictureRow

DONE, FAULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: done, a fault of ours, an input that the user can mend, Ctrl-C."""

PICTURE_FILE = "deviation.png"
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
    inspect.add_argument("scan", metavar="SCAN", type=Path, help="STL, PLY, OBJ, PCD, XYZ, TXT, CSV or NPY")
    _add_units(inspect)
    _add_common(inspect)
    inspect.set_defaults(run=_inspect)

    compensate = commands.add_parser("compensate", help="inspect one or more prints and redesign the part")
    compensate.add_argument("design", metavar="DESIGN", type=Path, help="STL, PLY, OBJ or 3MF")
    compensate.add_argument("scans", metavar="SCAN", type=Path, nargs="+", help="scans of prints of this design")
    _add_units(compensate)
    _add_common(compensate)
    compensate.set_defaults(run=_compensate)

    replay = commands.add_parser("replay", help="inspect a scan out of a recorded bag and redesign the part")
    replay.add_argument("bag", metavar="BAG", type=Path, help="folder of the bag, or one MCAP file")
    replay.add_argument("--topic", default="", help="point cloud topic (default: points, or the only one there is)")
    replay.add_argument("--scan-index", type=int, default=-1, help="which scan of the topic, -1: the last (default)")
    replay.add_argument("--design", type=Path, help="STL, PLY, OBJ or 3MF (default: design.stl beside the bag)")
    replay.add_argument("--design-unit", choices=UNITS, default="mm", help="unit of the design file (default: mm)")
    _add_common(replay)
    replay.set_defaults(run=_replay)

    demo = commands.add_parser("demo", help="print, scan, inspect, redesign and print again on a simulated machine")
    demo.add_argument("--part", default="bracket", help="which part (default: bracket)")
    demo.add_argument("--out", metavar="DIR", type=Path, default=Path("demo_output"), help="default: demo_output")
    demo.set_defaults(run=_demo)
    return parser


def _add_units(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--design-unit", choices=UNITS, default="mm", help="unit of the design file (default: mm)")
    parser.add_argument("--scan-unit", choices=UNITS, default="mm", help="unit of the scan files (default: mm)")


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument("--method", help=f"{', '.join(METHODS)} (default: {Settings().method})")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="change a setting, such as surface.rank=150"
    )


def _inspect(options: argparse.Namespace) -> None:
    from mdf_core.mesh_io import load_design, load_scan

    settings = _settings(options)
    _check_writable(options.out)
    design = load_design(options.design, options.design_unit)
    scan = load_scan(options.scan, options.scan_unit)
    inspection = _watched_inspect(design, scan, settings)
    _save(options.out, inspection, None, scan_path=str(options.scan))
    _tell(inspection, None, options.out)


def _compensate(options: argparse.Namespace) -> None:
    from mdf_core.compensation import compensate
    from mdf_core.mesh_io import load_design, load_scan

    settings = _settings(options)
    _check_writable(options.out)
    design = load_design(options.design, options.design_unit)
    scans = [load_scan(path, options.scan_unit) for path in options.scans]
    inspections = [_watched_inspect(design, scan, settings) for scan in scans]
    redesign = compensate(design, inspections, settings)
    hashes = [inspection.scan_sha256 for inspection in inspections]
    for number, (path, inspection) in enumerate(zip(options.scans, inspections, strict=True), 1):
        folder = options.out if number == 1 else options.out / f"scan_{number}"
        _save(folder, inspection, redesign, scan_path=str(path), redesign_scan_sha256=hashes)
    _save_redesign(options.out, redesign)
    _tell(inspections[0], redesign, options.out)


def _replay(options: argparse.Namespace) -> None:
    from mdf_core.bag import open_bag
    from mdf_core.compensation import compensate
    from mdf_core.mesh_io import load_design
    from mdf_core.point_cloud2 import scan_from_cloud
    from mdf_core.sampling import prepare

    settings = _settings(options)
    _check_writable(options.out)
    bag = open_bag(options.bag)
    topic = bag.find_cloud_topic(options.topic or (_POINTS_TOPIC if _POINTS_TOPIC in bag.topics else "")).name
    folder = options.bag if options.bag.is_dir() else options.bag.parent
    design = load_design(options.design or folder / "design.stl", options.design_unit)
    if bag.truncated:
        _warn(f"{options.bag}: cut short; read up to the cut")
    recorded = _pick(bag, topic, options.scan_index)
    # As in the cell, where scan_ingest prepares the scan before it is published.
    inspection = _watched_inspect(design, prepare(scan_from_cloud(recorded.message), settings), settings)
    redesign = compensate(design, [inspection], settings)
    source = {"bag": str(options.bag), "topic": topic, "log_time_ns": recorded.log_time_ns, "truncated": bag.truncated}
    _save(options.out, inspection, redesign, source=source)
    _save_redesign(options.out, redesign)
    _tell(inspection, redesign, options.out)


def _demo(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.table import Table

    from mdf_core.compensation import compensate
    from mdf_core.picture import inspection_row, reprint_row
    from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, distortion_left, scan_part

    _check_writable(options.out)
    design = build_part(options.part)
    printer = Printer(Warp(design, _WARP_MM, seed=_SEED))
    printed = printer.print_part(design.vertices)
    scanner = ScannerSettings(points=_SCANNER_POINTS, density_contrast=10.0, pose="random")
    scan = scan_part(printed, design.faces, scanner, seed=_SEED).scan
    settings = Settings()
    inspection = _watched_inspect(design, scan, settings)
    redesign = compensate(design, [inspection], settings)
    reprinted = printer.print_part(redesign.vertices)
    rows = [inspection_row(inspection), reprint_row(design, reprinted)]
    _save(options.out, inspection, redesign, rows=rows, simulated=True)
    _save_redesign(options.out, redesign)

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
    _tell(inspection, redesign, options.out)


def _settings(options: argparse.Namespace) -> Settings:
    changes: dict[str, str] = {}
    for entry in options.set:
        name, equals, value = entry.partition("=")
        if not equals:
            raise InvalidSettingError("no value", f"--set {entry}", "write --set key=value")
        changes[name.strip()] = value.strip()
    if options.method is not None:
        changes["method"] = options.method
    return Settings().replace(changes)


def _check_writable(folder: Path) -> None:
    """Refuse before the work what could not be written after it; makes nothing."""
    remedy = "choose a writable folder"
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise OutputFolderError(f"{existing} is no folder", str(folder), remedy)
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputFolderError(f"no permission to write in {existing}", str(folder), remedy)


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


def _watched_inspect(design: Design, scan: PointSet, settings: Settings) -> Inspection:
    from mdf_core.pipeline import inspect

    with _progress_bar() as show:
        inspection = inspect(design, scan, settings, show)
    if inspection.pose_ambiguous:
        _warn("more than one pose explains the scan; the result holds for one of them, give --set pose.initial=...")
    return inspection


@contextmanager
def _progress_bar() -> Iterator[Callable[[Progress], None]]:
    """A bar on stderr where somebody watches."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description:<13}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("prepare", total=1.0)
        yield lambda progress: bar.update(task, completed=progress.fraction, description=progress.stage)


def _save(
    folder: Path,
    inspection: Inspection,
    redesign: Redesign | None,
    rows: Sequence[PictureRow] | None = None,
    **more: object,
) -> None:
    from mdf_core.files import write_atomically
    from mdf_core.picture import draw, inspection_row
    from mdf_core.report import report, save_inspection

    save_inspection(folder, inspection, report(inspection, redesign, **more))
    write_atomically(folder / PICTURE_FILE, draw(inspection.design, rows or [inspection_row(inspection)]))


def _save_redesign(folder: Path, redesign: Redesign) -> None:
    from mdf_core.report import REDESIGN_FILE

    redesign.save(folder / REDESIGN_FILE)


def _tell(inspection: Inspection, redesign: Redesign | None, folder: Path) -> None:
    verdict, reasons = inspection.verdict
    print("; ".join((verdict.value, *reasons)))
    print(
        f"displacement RMS {inspection.rms_displacement:.3f} mm, 95 % below {inspection.p95_displacement:.3f} mm, "
        f"largest {inspection.max_displacement:.3f} mm, {inspection.coverage:.0%} of the surface measured"
    )
    if redesign is not None:
        print(f"redesign moves vertices by up to {redesign.max_move:.3f} mm, {redesign.compensated.mean():.0%} of them")
    print(f"results in {folder}")


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)
