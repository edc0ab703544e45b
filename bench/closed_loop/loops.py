"""Printers, scanners and methods that go round, and what each cycle comes to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

import mdf_core as mdf
from bench.cases import NOISES_MM, WARP_LENGTHS_MM, WARP_MM, Problem
from bench.paper import part as paper
from mdf_core.distortion import distortion_left
from mdf_core.errors import RegistrationFailedError
from mdf_core.estimate import Estimate
from mdf_core.geometry import Array, Design
from mdf_core.prints import MeasuredField
from mdf_core.rigid import inverse, transform
from mdf_core.settings import Settings
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, scan_part

MODELS: tuple[Literal["spatial", "material"], ...] = ("spatial", "material")
_SEEDS_APART = 10_000


@dataclass(frozen=True)
class Loop:
    """A printer, a scanner and a method, and how often they go round.

    Attributes
    ----------
    method : str
        One of `METHODS`.
    model : {"spatial", "material"}
        Of the printer.
    variation : float
        From print to print, relative to the distortion.
    noise_mm : float
        Of the scans.
    hidden : float
        Share of the surface that no scan sees; the same side in every cycle.
    prints : int
        Of every cycle.
    seed : int
        Of warp, prints and scans.
    """

    method: str
    part: str
    points: int
    cycles: int
    seed: int
    model: Literal["spatial", "material"] = "spatial"
    variation: float = 0.0
    noise_mm: float = NOISES_MM[1]
    hidden: float = 0.0
    prints: int = 1


@dataclass(frozen=True)
class Cycle:
    """What one cycle came to; lengths relative to the RMS distortion of the design's mean print.

    Attributes
    ----------
    left, left_seen : float
        RMS distortion of the redesign's mean print, and the same over what the scans of the first cycle support.
    largest : float
        Largest distance left, relative to the largest of the design's mean print.
    predicted, variation : float
        Residual and variation from print to print, as the library estimates them; NaN where it cannot.
    beyond, moved : int
        Vertices farther than the blend from any that the scans support, and how many of them this cycle moved.
    """

    left: float
    left_seen: float
    largest: float
    predicted: float
    variation: float
    beyond: int
    moved: int


@dataclass(frozen=True)
class NearestPoints:
    """What a comparison of the scan with the design says of the design's vertices."""

    displacement: Array
    inverse_displacement: Array
    std: Array
    supported: np.ndarray


def nearest_points(problem: Problem, settings: Settings) -> NearestPoints:
    """The vector from every design vertex to its nearest scan point, the scan laid on the design by its true pose.

    Any point may be the nearest, be it an outlier, on the other side of a wall, or that of other vertices too. The
    vector tells where the print went; its opposite is added to the vertex of the mesh that was printed.
    """
    points = transform(problem.pose, problem.scan.points)
    vectors = points[KDTree(points).query(problem.design.vertices)[1]] - problem.design.vertices
    count = len(vectors)
    return NearestPoints(vectors, -vectors, np.full(count, np.nan), np.ones(count, dtype=bool))


def inspected(problem: Problem, settings: Settings) -> MeasuredField:
    return paper.inspect(problem.design, problem.scan, settings.replace({"pose.initial": problem.pose_numbers}))


@dataclass(frozen=True)
class Method:
    """A way to measure and the settings of measure and redesign.

    Attributes
    ----------
    is_ours : bool
        Whether `compensation.lookup` is told the printer's model, and a cycle of those before it; the others have a
        lookup of their own, and go by the last prints alone.
    """

    measure: Callable[[Problem, Settings], MeasuredField]
    settings: Settings
    is_ours: bool = False

    def redesign(self, problems: Sequence[Problem], model: str, printed: Estimate) -> mdf.Redesign:
        settings = self.settings.replace({"compensation.lookup": model} if self.is_ours else {})
        measured = [self.measure(problem, settings) for problem in problems]
        previous = printed if self.is_ours else printed.vertices
        return mdf.compensate(problems[0].design, measured, settings, previous=previous)


_KNN = paper.KNN[2]
_EVERY_SHIFT = {"compensation.significance": 0.0}  # as the paper and the tools do
_SUBTRACTED = {**_EVERY_SHIFT, "compensation.lookup": "material"}
OURS = "ours"
PAPER = f"MDF + {_KNN.name}"
METHODS = {
    "nearest point": Method(nearest_points, Settings().replace(_SUBTRACTED)),
    "CPD, subtracted": Method(inspected, paper.PAPER.replace({**_SUBTRACTED, "method": "cpd"})),
    PAPER: Method(
        inspected,
        paper.PAPER.replace(
            {**_EVERY_SHIFT, "interpolation.method": _KNN.method, "interpolation.neighbours": _KNN.neighbours}
        ),
    ),
    OURS: Method(inspected, Settings(), is_ours=True),
}


def close(loop: Loop) -> tuple[Cycle, ...]:
    """Print, scan, redesign, and again; it ends early where a registration is refused."""
    printer = build_printer(loop)
    printed, cycles, seen = Estimate.unknown(printer.warp.design.vertices), [], None
    for number in range(loop.cycles):
        first = _SEEDS_APART * loop.seed + number * loop.prints
        problems = [print_and_scan(loop, printer, printed.vertices, seed) for seed in range(first, first + loop.prints)]
        try:
            redesign = METHODS[loop.method].redesign(problems, loop.model, printed)
        except RegistrationFailedError:
            break
        seen = seen or supported_part(redesign)
        cycles.append(judge(printer, redesign, seen))
        printed = redesign.estimate
    return tuple(cycles)


def build_printer(loop: Loop) -> Printer:
    warp = Warp(build_part(loop.part), WARP_MM, WARP_LENGTHS_MM[0], loop.seed)
    return Printer(warp, loop.model, loop.variation)


def print_and_scan(loop: Loop, printer: Printer, vertices: Array, seed: int) -> Problem:
    """One print of `vertices` and its scan, which lies anywhere."""
    design = printer.warp.design
    x, y, z = np.random.default_rng(loop.seed).normal(size=3)
    scanner = ScannerSettings(
        points=loop.points, noise_mm=loop.noise_mm, pose="random", hidden_share=loop.hidden, hidden_direction=(x, y, z)
    )
    printed = printer.print_part(vertices, seed)
    virtual = scan_part(printed, design.faces, scanner, seed)
    return Problem(design, printed - design.vertices, virtual.scan, inverse(virtual.pose))


def supported_part(redesign: mdf.Redesign) -> Design:
    """The design with only those faces that the scans support at every corner."""
    design, supported = redesign.design, redesign.prints.supported
    return Design(design.vertices, design.faces[supported[design.faces].all(axis=1)])


def judge(printer: Printer, redesign: mdf.Redesign, seen: Design) -> Cycle:
    """The redesign against the design, the `seen` part of it, and what was printed before it."""
    design, supported = redesign.design, redesign.prints.supported
    prints = [printer.print_part(vertices) for vertices in (redesign.vertices, design.vertices)]
    (left, largest), (whole, farthest) = (distortion_left(design, each) for each in prints)
    left_seen, whole_seen = (distortion_left(seen, each)[0] for each in prints)
    distances, _ = KDTree(design.vertices[supported]).query(design.vertices)
    beyond = distances > Settings().compensation.blend_mm
    return Cycle(
        left=left / whole,
        left_seen=left_seen / whole_seen,
        largest=largest / farthest,
        predicted=redesign.predicted_residual / whole,
        variation=redesign.estimate.evidence.variation / whole,
        beyond=int(beyond.sum()),
        moved=int((redesign.vertices != redesign.estimate.before).any(axis=1)[beyond].sum()),
    )
