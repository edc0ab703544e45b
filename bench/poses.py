"""`python -m bench.poses`: the share of random poses that is found, and whether symmetric parts are told apart."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from rich.console import Console
from rich.live import Live

import mdf_core as mdf
from bench.cases import WARP_LENGTHS_MM, WARP_MM
from bench.report import command_line, figures_table, machine, markdown_table
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import MdfError
from mdf_core.files import write_atomically
from mdf_core.geometry import Design
from mdf_core.virtual_cell import PARTS, ScannerSettings, Warp, build_part, scan_part

_RIGHT = 0.1  # of the scale: RMS distance between the design's points that scan points were taken for and their own
_MEASURED = 0.5  # not recovered: more than this is no measurement
_EDGE_MM = 4.0
HEADINGS = ("part", "poses", "right", "flagged", "wrong, not flagged", "measured", "refused", "median s")


def _designed(mesh: trimesh.Trimesh) -> Design:
    fine = mesh.subdivide_to_size(_EDGE_MM)
    return Design(fine.vertices, fine.faces)


SYMMETRIC: dict[str, Callable[[], Design]] = {
    "box": lambda: _designed(trimesh.creation.box((100.0, 60.0, 30.0))),
    "square plate": lambda: _designed(trimesh.creation.box((80.0, 80.0, 4.0))),
    "square bar": lambda: _designed(trimesh.creation.box((100.0, 20.0, 20.0))),
    "cylinder": lambda: _designed(trimesh.creation.cylinder(radius=25.0, height=80.0, sections=96)),
}
"""Parts that no search can tell from themselves turned; a pose of theirs has to be given."""


@dataclass(frozen=True)
class Trial:
    """What became of one random pose.

    Attributes
    ----------
    seconds : float
        Of the whole inspection.
    is_right : bool
        The part was found where it is.
    is_flagged : bool
        The pose is called ambiguous.
    unrecovered : float
        Share of the distortion that was not found, over what the scanner saw.
    is_refused : bool
        The inspection ended with an error.
    """

    seconds: float
    is_right: bool = False
    is_flagged: bool = False
    unrecovered: float = float("inf")
    is_refused: bool = False


def try_pose(part: str, points: int, hidden: float, seed: int) -> Trial:
    """One random pose, warp and hidden side."""
    design = SYMMETRIC[part]() if part in SYMMETRIC else build_part(part)
    displacement = Warp(design, WARP_MM, WARP_LENGTHS_MM[0], seed)(design.vertices)
    scanner = ScannerSettings(points=points, pose="random", hidden_share=hidden)
    virtual = scan_part(design.vertices + displacement, design.faces, scanner, seed)
    begun = time.perf_counter()
    try:
        inspection = mdf.inspect(design, virtual.scan)
    except MdfError:
        return Trial(time.perf_counter() - begun, is_refused=True)
    seconds = time.perf_counter() - begun
    real = ~virtual.is_outlier
    found = inspection.deformation.apply(virtual.scan.points[real])
    true = np.einsum("nc,ncd->nd", virtual.barycentric[real], design.triangles[virtual.source_faces[real]])
    distance = float(np.sqrt(((found - true) ** 2).sum(axis=1).mean()))
    unrecovered = fraction_unrecovered(design, displacement, inspection.displacement, virtual.seen_vertices)
    return Trial(seconds, distance < _RIGHT * design.scale, inspection.pose_ambiguous, unrecovered)


def summary(part: str, trials: list[Trial]) -> tuple[str, ...]:
    """One line of the table; of a symmetric part there is no right pose."""
    asymmetric = part not in SYMMETRIC
    silent = sum(not (trial.is_flagged or trial.is_refused or (asymmetric and trial.is_right)) for trial in trials)
    return (
        part if asymmetric else f"{part} (symmetric)",
        str(len(trials)),
        str(sum(trial.is_right for trial in trials)) if asymmetric else "",
        str(sum(trial.is_flagged for trial in trials)),
        str(silent),
        str(sum(trial.unrecovered < _MEASURED for trial in trials)) if asymmetric else "",
        str(sum(trial.is_refused for trial in trials)),
        f"{np.median([trial.seconds for trial in trials]):.2f}",
    )


def page(rows: list[tuple[str, ...]], command: str, where: str, told: str) -> str:
    return f"""\
# Random poses

{told} Every trial has a warp, a rotation and a place of its own; the pose is searched at default settings.

- **right**: the scan's points came to lie where they belong on the design, within {_RIGHT:g} of its RMS radius (RMS).
- **flagged**: called ambiguous, so that no verdict and no redesign follow. Symmetric parts should be.
- **wrong, not flagged**: neither right, nor flagged, nor refused; of a symmetric part, not flagged. The bad case.
- **measured**: less than {_MEASURED:g} of the distortion of the seen surface missed.
- **median s**: of the whole inspection.

{markdown_table(HEADINGS, rows, 1)}
Made by

    {command}

on {where}.
"""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.poses", description=__doc__)
    every = [*PARTS, *SYMMETRIC]
    parser.add_argument("--count", type=int, default=20, help="random poses of every part")
    parser.add_argument("--parts", nargs="+", choices=every, default=every)
    parser.add_argument("--points", type=int, default=5_000, help="points of the scans")
    parser.add_argument("--hidden", type=float, default=0.0, help="share of the surface that the scanner does not see")
    parser.add_argument("--jobs", type=int, default=1, help="trials at a time")
    parser.add_argument("--out", type=Path, help="write the table as markdown to this file")
    options = parser.parse_args(arguments)
    command, where = command_line("bench.poses", arguments), machine()

    console = Console()
    table = figures_table(HEADINGS, 1)
    rows = []
    with ProcessPoolExecutor(options.jobs) as pool, Live(table, console=console, auto_refresh=False) as live:
        for part in options.parts:
            trial = partial(try_pose, part, options.points, options.hidden)
            rows.append(summary(part, list(pool.map(trial, range(options.count)))))
            table.add_row(*rows[-1])
            live.refresh()
    if options.out:
        hidden = f", {options.hidden:.0%} of the surface hidden" if options.hidden else ""
        told = f"Scans of {options.points:,} points{hidden}."
        write_atomically(options.out, page(rows, command, where, told).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
