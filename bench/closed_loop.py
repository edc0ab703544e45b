"""`python -m bench.closed_loop`: what is left of the distortion when print, scan and redesign follow one another."""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import mdf_core as mdf
from bench.cases import NOISES_MM, PARTS, WARP_LENGTHS_MM, WARP_MM, Problem
from bench.paper import part as paper
from bench.report import command_line, machine, markdown_table
from mdf_core.cycles import require_usable
from mdf_core.errors import MdfError, RegistrationFailedError
from mdf_core.files import write_atomically
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.prints import MeasuredField
from mdf_core.rigid import homogeneous, inverse, transform
from mdf_core.settings import Settings
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, distortion_left, scan_part

MODELS: tuple[Literal["spatial", "material"], ...] = ("spatial", "material")
HIDDEN = 0.2
DENSER = 25
_FEW_CYCLES = 2  # enough to see how the others go on
_MOST_PRINTS = 16  # of a loop that makes several per cycle
_SEEDS_APART = 10_000
_TOLERANCE_MM = 2.0 * WARP_MM  # so that what is measured right passes
_WANTED = (0.02, 0.01)  # left after one cycle, after two
_RIGHT = 0.1  # left: a pose was found though a wrong one was given
_INCH_MM, _METRE_MM = 25.4, 1000.0
_AWAY_MM = np.array([100.0, 0.0, 0.0])
_DOTS_PER_INCH = 80
_LINE_STYLES = ("-", "--", ":")


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


# Methods


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
    follows_printer : bool
        Whether `compensation.lookup` is told the printer's model; the others have a lookup of their own.
    """

    measure: Callable[[Problem, Settings], MeasuredField]
    settings: Settings
    follows_printer: bool = False

    def redesign(self, problems: Sequence[Problem], model: str, printed: Array) -> mdf.Redesign:
        settings = self.settings.replace({"compensation.lookup": model} if self.follows_printer else {})
        measured = [self.measure(problem, settings) for problem in problems]
        return mdf.compensate(problems[0].design, measured, settings, previous=printed)


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
    OURS: Method(inspected, Settings(), follows_printer=True),
}


# Loops


def close(loop: Loop) -> tuple[Cycle, ...]:
    """Print, scan, redesign, and again; it ends early where a registration is refused."""
    printer = build_printer(loop)
    vertices, cycles, seen = printer.warp.design.vertices, [], None
    for number in range(loop.cycles):
        first = _SEEDS_APART * loop.seed + number * loop.prints
        problems = [print_and_scan(loop, printer, vertices, seed) for seed in range(first, first + loop.prints)]
        try:
            redesign = METHODS[loop.method].redesign(problems, loop.model, vertices)
        except RegistrationFailedError:
            break
        seen = seen or supported_part(redesign)
        cycles.append(judge(printer, redesign, vertices, seen))
        vertices = redesign.vertices
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


def judge(printer: Printer, redesign: mdf.Redesign, printed: Array, seen: Design) -> Cycle:
    """The redesign against the design, the `seen` part of it, and the vertices that were `printed` before it."""
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
        variation=redesign.prints.variation / whole,
        beyond=int(beyond.sum()),
        moved=int((redesign.vertices != printed).any(axis=1)[beyond].sum()),
    )


# What must not get through


@dataclass(frozen=True)
class Fate:
    """What became of a wrong input.

    Attributes
    ----------
    refusal : str
        Name of the error; empty where there is a redesign.
    verdict : str
        Of the inspection.
    left : float
        Of the distortion, in the print of the redesign.
    """

    refusal: str = ""
    verdict: str = ""
    left: float = float("nan")

    def __str__(self) -> str:
        return self.refusal or f"{self.verdict}, {self.left:.3f} left"


def wrong_inputs(part: str, points: int) -> dict[str, Fate]:
    """What becomes of scans that do not belong to the design as they are given."""
    (printer, problem), (_, foreign) = (
        _first_print(Loop(OURS, name, points, cycles=1, seed=0)) for name in (part, other_part(part))
    )
    places, normals = problem.scan.points, problem.scan.normals
    wrong = {
        "of another part": replace(problem, scan=foreign.scan, pose=foreign.pose),
        "in inches": replace(problem, scan=PointSet(places / _INCH_MM, normals)),
        "in metres": replace(problem, scan=PointSet(places / _METRE_MM, normals)),
        "pose 100 mm away": replace(problem, pose=homogeneous(np.eye(3), _AWAY_MM) @ problem.pose),
        "pose turned by 90° about z": replace(problem, pose=_turned(problem.design, "z", 90.0) @ problem.pose),
        "pose turned by 180° about x": replace(problem, pose=_turned(problem.design, "x", 180.0) @ problem.pose),
    }
    return {name: _fate(printer, each) for name, each in wrong.items()}


def other_part(part: str) -> str:
    return PARTS[(PARTS.index(part) + 1) % len(PARTS)]


def _first_print(loop: Loop) -> tuple[Printer, Problem]:
    printer = build_printer(loop)
    return printer, print_and_scan(loop, printer, printer.warp.design.vertices, loop.seed)


def _turned(design: Design, axis: str, degrees: float) -> Array:
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return homogeneous(rotation, design.centre - rotation @ design.centre)


def _fate(printer: Printer, problem: Problem) -> Fate:
    settings = Settings().replace({"pose.initial": problem.pose_numbers, "verdict.tolerance_mm": _TOLERANCE_MM})
    places = problem.design.vertices
    try:
        inspection = mdf.inspect(problem.design, problem.scan, settings)
        # As the cell and the commands do.
        require_usable("scan", inspection.pose_ambiguous, inspection.outlier_share, settings)
        redesign = mdf.compensate(problem.design, [inspection], settings)
    except MdfError as error:
        return Fate(refusal=error.name)
    left, whole = (distortion_left(problem.design, printer.print_part(each))[0] for each in (redesign.vertices, places))
    return Fate(verdict=inspection.verdict[0].value, left=left / whole)


# What is run


@dataclass(frozen=True)
class Row:
    """Loops that differ by part and seed only, and the words before their figures."""

    words: tuple[str, ...]
    loops: list[Loop]


@dataclass(frozen=True)
class Plan:
    """How much is run; every question is answered by rows."""

    parts: Sequence[str]
    prints: Sequence[int]
    variations: Sequence[float]
    cycles: int
    points: int
    seeds: int

    def row(self, words: tuple[str, ...], method: str, parts: Sequence[str] = (), **kind: Any) -> Row:
        """Of all parts, or of those given, with every seed."""
        each = product(parts or self.parts, range(self.seeds))
        cycles = self.cycles if method == OURS else min(self.cycles, _FEW_CYCLES)
        loops = [Loop(method, part, self.points, cycles, seed) for part, seed in each]
        return Row(words, [replace(loop, **kind) for loop in loops])

    @property
    def by_method(self) -> list[Row]:
        kinds = product(self.parts, MODELS, METHODS)
        return [self.row((part, model, name), name, [part], model=model) for part, model, name in kinds]

    def loops_of(self, method: str) -> list[Loop]:
        return [loop for row in self.by_method for loop in row.loops if loop.method == method]

    @property
    def by_points(self) -> list[Row]:
        few, many = self.points, DENSER * self.points
        sparse = [self.row((name, f"{few:,}"), name) for name in METHODS]
        return sparse + [self.row((name, f"{many:,}"), name, points=many, cycles=1) for name in METHODS]

    @property
    def repeated(self) -> list[tuple[float, int]]:
        return list(product(self.variations, self.prints))

    @property
    def by_prints(self) -> list[Row]:
        return [self._repeated(variation, prints) for variation, prints in self.repeated]

    def _repeated(self, variation: float, prints: int) -> Row:
        # Several prints that are all alike only average the noise of the scans: one cycle shows it.
        most = _MOST_PRINTS // prints if variation else 1
        cycles = self.cycles if prints == 1 else min(self.cycles, max(most, 1))
        return self.row((f"{variation:g}", f"{prints}"), OURS, variation=variation, prints=prints, cycles=cycles)

    @property
    def by_noise(self) -> list[Row]:
        return [self.row((f"{1e3 * noise:g}",), OURS, noise_mm=noise) for noise in NOISES_MM]

    @property
    def by_hidden(self) -> list[Row]:
        kinds = product(self.parts, (0.0, HIDDEN))
        return [self.row((part, f"{hidden:g}"), OURS, [part], hidden=hidden) for part, hidden in kinds]

    @property
    def loops(self) -> list[Loop]:
        rows = (*self.by_method, *self.by_points, *self.by_prints, *self.by_noise, *self.by_hidden)
        return list(dict.fromkeys(loop for row in rows for loop in row.loops))


# Figures in words


Results = Mapping[Loop, tuple[Cycle, ...]]
Fates = Mapping[str, Mapping[str, Fate]]
"""By part and by what is wrong."""


def figures(results: Results, loops: Iterable[Loop], number: int, name: str = "left") -> Array:
    """One figure of cycle `number`, from 0, of those loops that came so far."""
    return np.array([getattr(results[loop][number], name) for loop in loops if len(results[loop]) > number])


def span(values: Array) -> str:
    return f"{values.min():.3f} to {values.max():.3f}" if len(values) else "all refused"


def cell(results: Results, row: Row, number: int, name: str = "left") -> str:
    """Mean, with least and most of several, and how many loops were refused by then."""
    loops = [loop for loop in row.loops if loop.cycles > number]
    values = figures(results, loops, number, name)
    told = [f"{values.mean():.3f}"] if len(values) else []
    if len(values) > 1:
        told = [f"{values.mean():.3f} ({values.min():.3f}–{values.max():.3f})"]
    if len(values) < len(loops):
        told.append(f"{len(loops) - len(values)} refused")
    return ", ".join(told)


def mean(results: Results, row: Row, number: int, name: str) -> str:
    values = figures(results, row.loops, number, name)
    return f"{values.mean():.3f}" if len(values) and np.isfinite(values).all() else ""


# Tables


def _after(plan: Plan) -> list[str]:
    return [f"after {number}" for number in range(1, plan.cycles + 1)]


def _left(plan: Plan, results: Results, row: Row) -> list[str]:
    return [cell(results, row, number) for number in range(plan.cycles)]


def method_table(plan: Plan, results: Results) -> str:
    rows = [("any", "any", "no compensation", *["1"] * (plan.cycles + 1))]
    rows += [(*row.words, *_left(plan, results, row), cell(results, row, 0, "largest")) for row in plan.by_method]
    return markdown_table(("part", "printer", "method", *_after(plan), "largest after 1"), rows, 3)


def points_table(plan: Plan, results: Results) -> str:
    rows = [(*row.words, cell(results, row, 0), cell(results, row, 0, "largest")) for row in plan.by_points]
    return markdown_table(("method", "points", "after 1", "largest after 1"), rows, 1)


def prints_table(plan: Plan, results: Results) -> str:
    rows = [
        (*row.words, f"{variation / np.sqrt(prints):.3f}", *_left(plan, results, row))
        for row, (variation, prints) in zip(plan.by_prints, plan.repeated, strict=True)
    ]
    return markdown_table(("variation", "prints", "variation / √prints", *_after(plan)), rows, 0)


def estimates_table(plan: Plan, results: Results) -> str:
    cycles = range(min(plan.cycles, _FEW_CYCLES))
    told = [f"{what} after {number + 1}" for number in cycles for what in ("left", "predicted", "variation found")]
    each = list(product(cycles, ("left", "predicted", "variation")))
    rows = [(*row.words, *(mean(results, row, number, name) for number, name in each)) for row in plan.by_prints]
    return markdown_table(("variation", "prints", *told), rows, 0)


def noise_table(plan: Plan, results: Results) -> str:
    rows = [(*row.words, *_left(plan, results, row)) for row in plan.by_noise]
    return markdown_table(("noise µm", *_after(plan)), rows, 0)


def hidden_table(plan: Plan, results: Results) -> str:
    each = list(product(dict.fromkeys((0, plan.cycles - 1)), ("left", "left_seen")))
    told = [f"{'seen, ' if name == 'left_seen' else ''}after {number + 1}" for number, name in each]
    rows = [
        (
            *row.words,
            *(cell(results, row, number, name) for number, name in each),
            *(f"{count}" for count in unmoved(results, [row])),
        )
        for row in plan.by_hidden
    ]
    return markdown_table(("part", "hidden", *told, "beyond the blend", "of them moved"), rows, 1)


def unmoved(results: Results, rows: Iterable[Row]) -> tuple[int, int]:
    """Vertices beyond the blend, over all cycles of all loops, and how many of them were moved."""
    cycles = [cycle for row in rows for loop in row.loops for cycle in results[loop]]
    return sum(cycle.beyond for cycle in cycles), sum(cycle.moved for cycle in cycles)


def wrong_table(fates: Fates) -> str:
    names = next(iter(fates.values()))
    rows = [(name, *(str(each[name]) for each in fates.values())) for name in names]
    return markdown_table(("scan", *fates), rows, 1 + len(fates))


# What is seen


def kept(results: Results, loops: Sequence[Loop]) -> str:
    """Whether a later cycle ever leaves more than the first."""
    left = [[cycle.left for cycle in results[loop]] for loop in loops if results[loop]]
    growth = np.array([max(values) / values[0] - 1.0 for values in left])
    count = int((growth > 0.0).sum())
    most = f", by {growth.max():.1%} at most" if count else ""
    return f"In {count} of {len(loops)} loops a later cycle leaves more than the first{most}."


def methods_seen(plan: Plan, results: Results) -> str:
    lines = []
    for name in METHODS:
        loops = plan.loops_of(name)
        spans = [f"{span(figures(results, loops, n))} after {n + 1}" for n in range(loops[0].cycles)]
        lines.append(f"- {name}: {', '.join(spans)}")
    ours = plan.loops_of(OURS)
    within = [
        f"at most {limit:g} after {number + 1} in {int((figures(results, ours, number) <= limit).sum())}"
        for number, limit in enumerate(_WANTED[: plan.cycles])
    ]
    return "\n".join([*lines, "", f"Ours leaves {', '.join(within)} of {len(ours)} loops.", kept(results, ours)])


def estimates_seen(plan: Plan, results: Results) -> str:
    every = [loop for row in plan.by_prints for loop in row.loops]
    repeated = [loop for loop in every if loop.prints > 1 and loop.variation > 0]
    told = []
    for name, loops in (("one print", [loop for loop in every if loop.prints == 1]), ("several that vary", repeated)):
        for number in range(min(plan.cycles, _FEW_CYCLES)):
            ratios = figures(results, loops, number, "predicted") / figures(results, loops, number)
            told.append(f"- predicted over left, of {name}, after {number + 1}: {span(ratios)}")
    found = figures(results, repeated, 0, "variation") / np.array([loop.variation for loop in repeated])
    return "\n".join([*told, f"- variation found over the true one, after 1: {span(found)}"])


def wrong_seen(fates: Fates) -> str:
    every = [fate for each in fates.values() for fate in each.values()]
    refused = sum(bool(fate.refusal) for fate in every)
    right = sum(fate.left <= _RIGHT for fate in every)
    wrong = [fate.verdict for fate in every if fate.left > _RIGHT]
    return (
        f"Of {len(every)} inputs {refused} are refused, {right} are measured right all the same, and {len(wrong)} end\n"
        f"in a wrong redesign, {wrong.count(mdf.Verdict.PASS.value)} of these with the verdict PASS."
    )


# Picture


def picture(plan: Plan, results: Results) -> bytes:
    """PNG of what is left against the cycle: of every method, and of ours for every number of prints."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    methods, prints = figure.subplots(1, 2, sharey=True)
    for number, name in enumerate(METHODS):
        loops = plan.loops_of(name)
        _draw(methods, results, loops, label=name, color=f"C{number}", linewidth=2.5 if name == OURS else 1.2)
    methods.axhline(1.0, color="0.5", linestyle=":", label="no compensation")
    for row, (variation, count) in zip(plan.by_prints, plan.repeated, strict=True):
        style = _LINE_STYLES[plan.variations.index(variation) % len(_LINE_STYLES)]
        colour = f"C{plan.prints.index(count)}"
        label = f"variation {variation:g}, prints {count}"
        _draw(prints, results, row.loops, label=label, color=colour, linestyle=style)
    for axes, title in ((methods, "methods, one print, no variation"), (prints, "ours, prints per cycle")):
        axes.set(yscale="log", xlabel="cycle", title=title, xticks=range(plan.cycles + 1))
        axes.grid(which="major", alpha=0.4)
        axes.grid(which="minor", alpha=0.15)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize="small")
    methods.set_ylabel("share of the distortion that is left")
    image = io.BytesIO()
    figure.savefig(image, dpi=_DOTS_PER_INCH, format="png")
    return image.getvalue()


def _draw(axes: Axes, results: Results, loops: Sequence[Loop], **style: Any) -> None:
    """The mean of the loops from cycle to cycle, and between which bounds they lie."""
    cycles = [np.ones(1), *(figures(results, loops, number) for number in range(loops[0].cycles))]
    cycles = [values for values in cycles if len(values)]
    numbers = range(len(cycles))
    axes.plot(numbers, [values.mean() for values in cycles], marker="o", markersize=4, **style)
    least, most = [values.min() for values in cycles], [values.max() for values in cycles]
    axes.fill_between(numbers, least, most, color=style["color"], alpha=0.1, linewidth=0)


# Page


def page(plan: Plan, results: Results, fates: Fates, picture_name: str, made: str) -> str:
    beyond, moved = unmoved(results, plan.by_hidden)
    mixture = paper.PAPER.mixture
    return f"""\
# The closed loop

A virtual printer warps every part by up to {WARP_MM:g} mm ({WARP_LENGTHS_MM[0]:g} mm correlation length); a virtual
scanner sees {plan.points:,} points of every print with {1e3 * NOISES_MM[1]:g} µm noise and 1 % outliers. Print, scan,
inspect, redesign, print the redesign, and so on; what is left counts, not the time.

- **left**: RMS distortion of the printer's mean print of the redesign over that of its mean print of the design, both
  after the best rigid fit: 1 nothing gained, 0 all gone. **largest**: the same of the largest distance of a vertex.
- **variation** from print to print, relative to the distortion; other smooth waves in every print.
- Numbers are means over the seeds ({plan.seeds}: another warp, other prints and scans each) and over the parts where a
  table does not name them, with the least and the most in brackets.
- Every scan lies anywhere, and every method is told its true pose: the loop is measured and not the pose search.
- Printers: *spatial* distorts places in its space, *material* places of the part.

![what is left against the cycle]({picture_name})

## Which method

One print per cycle, no variation. Two cycles are enough to see how the others go on.

- **nearest point**: every vertex is moved by minus the vector to the scan point nearest to it, whichever that is.
- **CPD, subtracted**: plain coherent point drift; its displacement at the vertices is subtracted.
- **{PAPER}**: the paper's pipeline with its parameters (boxes of {paper.BOX_MM:g} mm, β = {mixture.beta:g},
  α = {mixture.alpha:g}, w = {mixture.outlier_share:g}), C = X + u(X). CPD has the same parameters and points.
- **ours**: the defaults, with `compensation.lookup` as the printer is.

{method_table(plan, results)}
Left over all parts, printers and seeds:

{methods_seen(plan, results)}

What a mixture misses lies along the faces, where nothing holds its points; it does not shrink with the distortion, and
further cycles add it up. The nearest point says nothing of a displacement along the face, and the gaps between the scan
points come on top. What ours leaves after one cycle is mostly smaller than the standard error of the next measurement,
and so small a shift is not made: without variation more cycles cost prints and gain little.

## How dense a scan

Spatial printer, one cycle. The paper's own scan is denser than {plan.points:,} points, so here is one of
{DENSER * plan.points:,} for everyone, too.

{points_table(plan, results)}
## How many prints, how many cycles

Ours, spatial printer. In every cycle so many prints are made of one mesh and inspected together. The mean of n prints
is off by variation / √n, and that is what can be expected to be left.

{prints_table(plan, results)}
{kept(results, [loop for row in plan.by_prints for loop in row.loops])}
A cycle knows only its own prints. After a single one it trades the chance of the print before for that of the new one,
which is as large; of several it knows the variation and leaves alone what may be chance. Against variation it is prints
per cycle that help. Without variation they gain less than 1 / √n: part of the error is that of the registration itself,
the same in every scan.

### What the library says itself

Predicted residual and variation of the redesign, relative to the distortion, beside what is left:

{estimates_table(plan, results)}
{estimates_seen(plan, results)}

One print cannot show the variation, and what is predicted from it leaves it out. With several it counts, as the
standard error of their mean.

## Noise of the scanner

Ours, spatial printer, one print per cycle, no variation.

{noise_table(plan, results)}
## A hidden side

Ours, spatial printer, one print per cycle, no variation; {HIDDEN:.0%} of the surface, the same side in every cycle,
is never seen. **seen**: over what the first scan supports. **beyond the blend**: vertices farther than
{Settings().compensation.blend_mm:g} mm from any supported one, over all cycles and seeds; they must not move.

{hidden_table(plan, results)}
Of {beyond:,} vertices beyond the blend {moved:,} were moved. They keep their distortion; nearer ones, as on the other
side of a thin wall, follow what is seen in part. That is most of what is left.

## What must not get through

The scan of a first print, given wrongly, to ours, with the checks of a scan that the cell makes before a redesign. The
tolerance is {_TOLERANCE_MM:g} mm, so that what is measured right passes. Another part is
{", ".join(f"the {other_part(part)} for the {part}" for part in fates)}.

{wrong_table(fates)}
{wrong_seen(fates)}

{made}
"""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.closed_loop", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--prints", nargs="+", type=int, default=(1, 3, 8), help="prints per cycle")
    parser.add_argument("--cycles", type=int, default=4)
    parser.add_argument("--variations", nargs="+", type=float, default=(0.0, 0.1, 0.3), help="from print to print")
    parser.add_argument("--points", type=int, default=8_000, help="points of the scans")
    parser.add_argument("--seeds", type=int, default=3, help="warps, each with prints and scans of its own")
    parser.add_argument("--jobs", type=int, default=1, help="loops at a time")
    parser.add_argument("--out", type=Path, help="write the tables as markdown to this file, and a PNG beside it")
    options = parser.parse_args(arguments)
    if min(*options.prints, options.cycles, options.seeds, options.jobs) < 1:
        parser.error("--prints, --cycles, --seeds and --jobs must be 1 or more")
    command, where = command_line("bench.closed_loop", arguments), machine()
    plan = Plan(options.parts, options.prints, options.variations, options.cycles, options.points, options.seeds)
    console = Console()
    begun = time.perf_counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        cycles = track(pool.map(close, plan.loops), "loops", total=len(plan.loops), console=console)
        results = dict(zip(plan.loops, cycles, strict=True))
        fates = dict(zip(plan.parts, pool.map(partial(wrong_inputs, points=plan.points), plan.parts), strict=True))
    minutes = (time.perf_counter() - begun) / 60.0
    picture_name = options.out.with_suffix(".png").name if options.out else ""
    made = f"Made by\n\n    {command}\n\nin {minutes:.0f} min on {where}."
    text = page(plan, results, fates, picture_name, made)
    console.print(Markdown(text))
    if options.out:
        write_atomically(options.out, text.encode())
        write_atomically(options.out.with_suffix(".png"), picture(plan, results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
