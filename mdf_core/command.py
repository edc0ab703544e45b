"""What the commands of ``mdf`` share: settings and regions from options, progress, and what is written and told."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mdf_core.errors import InvalidSettingError
from mdf_core.progress import Progress, silent
from mdf_core.settings import METHODS, Settings
from mdf_core.units import UNITS

if TYPE_CHECKING:
    from mdf_core.compensation import Redesign
    from mdf_core.geometry import Design, PointSet
    from mdf_core.inspection import Inspection
    from mdf_core.ledger_entries import Cycle
    from mdf_core.picture import PictureRow
    from mdf_core.regions import Region

PICTURE_FILE = "deviation.png"


def add_units(parser: argparse.ArgumentParser) -> None:
    """Options for the units of files."""
    parser.add_argument("--design-unit", choices=UNITS, default="mm", help="unit of the design file (default: mm)")
    parser.add_argument("--scan-unit", choices=UNITS, default="mm", help="unit of the scan files (default: mm)")


def add_common(parser: argparse.ArgumentParser) -> None:
    """Options of whatever inspects."""
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument("--method", help=f"{', '.join(METHODS)} (default: {Settings().method})")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="change a setting, such as surface.rank=150"
    )
    parser.add_argument(
        "--regions", metavar="YAML", type=Path, help="regions that must not move or have tolerances of their own"
    )


def settings_of(options: argparse.Namespace) -> Settings:
    """The settings that the options ask for."""
    changes: dict[str, str] = {}
    for entry in options.set:
        name, equals, value = entry.partition("=")
        if not equals:
            raise InvalidSettingError("no value", f"--set {entry}", "write --set key=value")
        changes[name.strip()] = value.strip()
    if options.method is not None:
        changes["method"] = options.method
    return Settings().replace(changes)


def design_of(path: Path, unit: str, settings: Settings) -> Design:
    """The design of a file, as fine as the settings ask for."""
    from mdf_core.mesh_io import load_design

    return load_design(path, unit, longest_edge_mm=settings.design.longest_edge_mm)


def regions_of(path: Path | None, design: Design) -> tuple[Region, ...]:
    """The regions of a file; none without one."""
    from mdf_core.regions import load_regions

    return () if path is None else load_regions(path, design)


def watched_inspect(design: Design, scan: PointSet, settings: Settings, regions: Sequence[Region] = ()) -> Inspection:
    """Inspect with a progress bar; an ambiguous pose and a design that is too coarse are warned of."""
    from mdf_core.coarseness import coarseness
    from mdf_core.pipeline import inspect

    with progress_bar() as show:
        inspection = inspect(design, scan, settings, show, regions)
    if warning := coarseness(inspection):
        warn(warning)
    if inspection.pose_ambiguous:
        warn("more than one pose explains the scan; the result holds for one of them, give --set pose.initial=...")
    return inspection


@contextmanager
def progress_bar() -> Iterator[Callable[[Progress], None]]:
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


def save_inspection_files(
    folder: Path, inspection: Inspection, rows: Sequence[PictureRow] | None = None, **more: object
) -> None:
    """Write everything about an inspection into a folder; `rows` of the picture, `more` entries of the report."""
    from mdf_core.files import write_atomically
    from mdf_core.picture import draw, inspection_row
    from mdf_core.report import report, save_inspection

    save_inspection(folder, inspection, report(inspection, None, **more))
    write_atomically(folder / PICTURE_FILE, draw(inspection.design, rows or [inspection_row(inspection)]))


def save_report(folder: Path, inspection: Inspection, redesign: Redesign, **more: object) -> None:
    """Write the report again, now that a redesign lies beside it."""
    from mdf_core.files import write_atomically
    from mdf_core.report import REPORT_FILE, json_bytes, report

    write_atomically(folder / REPORT_FILE, json_bytes(report(inspection, redesign, **more)))


def tell(inspection: Inspection, redesign: Redesign | None, folder: Path) -> None:
    """Print what came out."""
    verdict, reasons = inspection.verdict
    print("; ".join((verdict.value, *reasons)))
    print(
        f"displacement RMS {inspection.rms_displacement:.3f} mm, 95 % below {inspection.p95_displacement:.3f} mm, "
        f"largest {inspection.max_displacement:.3f} mm, {inspection.coverage:.0%} of the surface measured"
    )
    if redesign is not None:
        print(f"redesign moves vertices by up to {redesign.max_move:.3f} mm, {redesign.compensated.mean():.0%} of them")
    print(f"results in {folder}")


def cycle_line(cycle: Cycle) -> str:
    """A cycle of the ledger in one line."""
    return f"{cycle.id}: {cycle.part_id}, cycle {cycle.number}, gain {cycle.gain:g}, {cycle.state.value}"


def warn(text: str) -> None:
    """Print a warning on stderr."""
    print(f"warning: {text}", file=sys.stderr)
