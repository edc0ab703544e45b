"""Each section runs one experiment and tells it: numbers, figures, and what they mean."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.paper import errata, figures, line, part, square
from bench.paper.errata import Row
from bench.paper.part import ITSELF, KNN, LINEAR, METHODS, Measured, Printed, Redesigned
from bench.paper.square import LEVELS, Family

_RANDOM_LINES = 20
_DENSITY_SIGMA = 0.06
_DENSITY_MARGIN = 0.2  # from the edges, where every mixture falls off
_CYCLES = 2
_PAPERS_KNN = KNN[2]
_MIXTURES = ("CPD", "MDF")
_LINE = 120


@dataclass(frozen=True, eq=False)
class Section:
    """Part of the page.

    Attributes
    ----------
    claims : list of (str, str)
        What the paper says, and what came out.
    figures : dict of str to bytes
        PNG by file name.
    """

    title: str
    text: str
    claims: list[tuple[str, str]] = field(default_factory=list)
    figures: dict[str, bytes] = field(default_factory=dict)


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown; the first column is text, the others are numbers."""
    lines = [headings, ["---", *["---:"] * (len(headings) - 1)], *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def _span(values: Iterable[float], digits: int = 1) -> str:
    ordered = sorted(values)
    low, high = f"{ordered[0]:.{digits}f}", f"{ordered[-1]:.{digits}f}"
    return low if low == high else f"{low} to {high}"


def _rows(rows: Sequence[Row], digits: int) -> list[list[str]]:
    return [[row.formula, *(f"{value:.{digits}f}" for value in row.values)] for row in rows]


# The line


def line_section(cases: int) -> Section:
    example = line.solve(line.PAPERS_PLACES, in_plane=False)
    averages = [
        line.average(points, in_plane, _RANDOM_LINES * cases) for points in line.COUNTS for in_plane in (False, True)
    ]
    rows = [["4, the figure's", _where(in_plane=False), *_line_errors(example.errors)]]
    rows += [
        [f"{one.points}, {one.scans} random scans", _where(one.in_plane), *_line_errors(one.errors)] for one in averages
    ]
    text = f"""\
A line of length 1 is stretched evenly by {line.STRETCH:g} and moved down. The scan's points, all but the ends, lie
at places that are no places of the design's points. CPD draws each scan point to a design point, so what it finds is
no even stretch; MDF lets a point that stands for a longer piece reach farther. β = 3, α = 2, w = 0.

![The line: truth, CPD, MDF](line.png)

RMS error along the line, as a share of its length:

{table(("scan points", "registered", "CPD", "MDF", "CPD / MDF"), rows)}
The paper draws the outcome that it wishes for. MDF comes near it where the points fill the space that they are
registered in ("on the line", D = 1; by the dense program of section 4, the library has no D = 1). The same line in the
plane (D = 2) gains less: the weight w^(1 − D/2) of a component counts a dimension that the line does not fill; see
[the misprints](#4-misprints-and-what-they-do).
"""
    ratios = [one.errors["cpd"] / one.errors["mdf"] for one in averages]
    claim = (
        "The line: CPD forces the points onto each other, MDF finds the even stretch",
        f"The direction holds: errors {_span(ratios)} times smaller. It is not exact, least of all with four points.",
    )
    return Section("1. The line", text, [claim], {"line.png": figures.line(example)})


def _where(in_plane: bool) -> str:
    return "in the plane" if in_plane else "on the line"


def _line_errors(errors: dict[str, float]) -> list[str]:
    return [f"{errors['cpd']:.4f}", f"{errors['mdf']:.4f}", f"{errors['cpd'] / errors['mdf']:.1f}"]


# The square


def square_section(cases: int) -> Section:
    main = [square.solve_family(refinement, cases) for refinement in (square.MILD, square.STRONG)]
    others = [square.solve_family(refinement, cases) for refinement in square.OTHERS]
    mild, strong = main
    families = [*main, *others]
    singles = [ratio for family in families for level in LEVELS for ratio in family.single_ratios(level)]
    largest = max(
        float(case.errors["mdf"][square.REGIONS["interior"]].max())
        for family in main
        for cases_of_level in family.cases.values()
        for case in cases_of_level
    )
    firsts = [mild.cases[level][0] for level in LEVELS]
    drawn = {
        "square_meshes.png": figures.meshes(firsts[-1]),
        "square_density.png": figures.densities(firsts[0].mesh, _DENSITY_SIGMA),
        "square_registration.png": figures.registration(firsts),
        "square_displacement.png": figures.displacement(firsts[0]),
        "square_corners.png": figures.corner_errors(main),
    }
    evenness = square_evenness(firsts[0].mesh)
    levels = ", ".join(
        f"{level:.2f} (distortion {case.distortion:.3f} RMS)" for level, case in zip(LEVELS, firsts, strict=True)
    )
    text = f"""\
Design: the unit square with {square.PER_SIDE} x {square.PER_SIDE} nodes. Scan: the nodes of a mesh that is refined
around {len(square.MILD.spots)} spots, made as in the paper (Persson & Strang), then distorted by a quadratic polynomial
with random coefficients around a shear, at three levels: {levels}. Scan points count by the area of the triangles
around them *on the distorted mesh*, which is all that a scanner knows. β = 3, α = 2, w = 0, one length unit for both
sets. Numbers are means over cases, each with a mesh and a distortion of its own; here {cases} per level.

![Design mesh, scan mesh in the material, scan mesh distorted](square_meshes.png)

### Density of the mixture

With equal weights the refined spots become peaks; with area weights the density comes near that of the uniform mesh.
Largest over smallest density at least {_DENSITY_MARGIN:g} from the edges (σ = {_DENSITY_SIGMA:g}):

{table(("point set", "largest / smallest"), [[name, f"{value:.2f}"] for name, value in evenness.items()])}
![Density of the mixtures](square_density.png)

### Corners, edges, interior

The error of a design node is how far the found motion takes its distorted place away from the node.

{_error_table(main)}
![Mean error of the four corners](square_corners.png)

At the corners MDF is {_span(_ratios(mild))} times better at a contrast of the areas (95th over 5th percentile) of about
{_contrast(mild):.0f}, and {_span(_ratios(strong))} times at about {_contrast(strong):.0f}. The paper compares the
corners only. In the interior the ratio CPD / MDF is {_span(_ratios(mild, "interior"), 2)} and
{_span(_ratios(strong, "interior"), 2)}; below 1, CPD is the better one. A corner is held by the end of the set; inside,
only the density holds the points, and MDF leaves smooth shifts of the whole interior: up to {largest:.3f} here, at a
spacing of the design of {1.0 / (square.PER_SIDE - 1):g}.

![Before, after CPD, after MDF, a row per level](square_registration.png)

![Applied and found displacement at level {LEVELS[0]:.2f}](square_displacement.png)

### How much hangs on the mesh

The same experiment with other meshes, whose contrast is like that of the first:

{_mesh_table(families)}
Over all of them the mean error at the corners goes from {_span(_corner_errors(families, "mdf"), 4)} with MDF and from
{_span(_corner_errors(families, "cpd"), 4)} with CPD: what area weights take out of the result is the mesh. Where a mesh
suits CPD, little is gained; of {len(singles)} single cases CPD wins {sum(ratio < 1.0 for ratio in singles)} at the
corners.
"""
    return Section("2. Experiment 1: the square", text, _square_claims(families, evenness), drawn)


def square_evenness(mesh: square.Mesh) -> dict[str, float]:
    """Largest over smallest density away from the edges."""
    axis = np.linspace(_DENSITY_MARGIN, 1.0 - _DENSITY_MARGIN, 61)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    sets = {
        "refined mesh, equal weights": (mesh, False),
        "refined mesh, area weights": (mesh, True),
        "uniform mesh": (square.DESIGN, False),
    }
    densities = {name: square.mixture_density(*one, _DENSITY_SIGMA, places) for name, one in sets.items()}
    return {name: float(values.max() / values.min()) for name, values in densities.items()}


def _ratios(family: Family, region: str = "corners") -> list[float]:
    return [family.ratio(level, region) for level in LEVELS]


def _corner_errors(families: Sequence[Family], method: str) -> list[float]:
    return [family.error(level, method, "corners") for family in families for level in LEVELS]


def _contrast(family: Family) -> float:
    return float(np.mean([mesh.contrast for mesh in family.meshes]))


def _error_table(families: Sequence[Family]) -> str:
    headings = ["contrast", "level"]
    headings += [f"{region}, {method.upper()}" for region in square.REGIONS for method in ("cpd", "mdf")]
    rows = [
        [f"{_contrast(family):.0f}", f"{level:.2f}"]
        + [f"{family.error(level, method, region):.4f}" for region in square.REGIONS for method in ("cpd", "mdf")]
        + [f"{family.ratio(level):.1f}"]
        for family in families
        for level in LEVELS
    ]
    return table([*headings, "corners, CPD / MDF"], rows)


def _mesh_table(families: Sequence[Family]) -> str:
    rows = []
    for family in families:
        singles = [ratio for level in LEVELS for ratio in family.single_ratios(level)]
        errors = [
            _span([family.error(level, method, "corners") for level in LEVELS], 4).replace(" to ", " – ")
            for method in ("cpd", "mdf")
        ]
        rows.append(
            [
                family.refinement.name,
                f"{np.mean([len(mesh.nodes) for mesh in family.meshes]):.0f}",
                f"{_contrast(family):.0f}",
                *errors,
                _span(_ratios(family)).replace(" to ", " – "),
                f"{min(singles):.1f}",
            ]
        )
    headings = ("refined around", "nodes", "contrast", "corners, CPD", "corners, MDF", "CPD / MDF", "worst single case")
    return table(headings, rows)


def _square_claims(families: Sequence[Family], evenness: dict[str, float]) -> list[tuple[str, str]]:
    mild, strong = families[:2]
    equal, weighted, uniform = evenness.values()
    worst = min(ratio for family in families for ratio in _ratios(family))
    return [
        (
            "Area weights give a non-uniform mesh the density of the uniform one",
            f"Holds: largest over smallest density {equal:.1f} with equal weights, {weighted:.2f} with area weights, "
            f"{uniform:.2f} for the uniform mesh.",
        ),
        (
            "MDF is always significantly better than CPD at the corners of the square",
            f"Holds on average: {_span(_ratios(mild))} times at contrast {_contrast(mild):.0f}, "
            f"{_span(_ratios(strong))} times at {_contrast(strong):.0f}; {worst:.1f} times on the mesh that suits CPD "
            "best.",
        ),
        (
            "All cases are well captured by MDF, whereas CPD fails",
            f"At the corners. In the interior the error of CPD is {_span(_ratios(mild, 'interior'), 2)} times that of "
            f"MDF at contrast {_contrast(mild):.0f}: below 1, CPD is the better one.",
        ),
    ]


# The part


def part_section(cases: int) -> Section:
    prints = [part.print_and_scan(case) for case in part.BRACKETS[:cases]]
    measured = [{name: part.measure(one, settings) for name, settings in METHODS.items()} for one in prints]
    others = [part.print_and_scan(case) for case in part.OTHERS]
    others_measured = [{name: part.measure(one, settings) for name, settings in METHODS.items()} for one in others]
    first, found = prints[0], measured[0]
    ways = {
        name: part_ways(first, found[name], name)
        for name in ("MDF", "surface, same points", "surface")
        if found[name].inspection is not None
    }
    redesigns = {
        "printed from the paper's redesign (MDF, KNN k = 8)": _redesigned(first, found["MDF"], _PAPERS_KNN),
        "printed from the product's redesign (surface)": _redesigned(first, found["surface"], ITSELF),
    }
    drawn = {
        "part_registration.png": figures.part_registration(
            first, {name: found[name] for name in ("MDF", "surface, same points")}
        ),
        "part_deviation.png": figures.part_deviation(first, redesigns),
        "part_left.png": figures.part_left(ways),
    }
    case, scanner, design = first.case, part.SCANNER, first.design
    extent = " x ".join(f"{length:.0f}" for length in np.ptp(design.vertices, axis=0))
    outside = {row.way.name: row.outside for row in ways["MDF"]}[LINEAR.name]
    text = f"""\
The paper's part, its scan and its reprint are not published. In their place: a virtual bracket of {extent} mm, a
virtual printer that warps it by up to {case.warp_mm:g} mm (smooth waves, bending, shrinkage; correlation length
{case.correlation_length_mm:g} mm), and a virtual scanner ({scanner.points:,} points, density contrast
{scanner.density_contrast:g}, {1000 * scanner.noise_mm:.0f} µm noise, {scanner.outlier_share:.0%} outliers). All truth
is known.

The paper's pipeline: {part.BOX_MM:g} mm box grid with one random point per box ({found["MDF"].points:,} of the
scan's points stay, and as many of the design), MDF with β = 3, α = 2, w = 0.1, normalised median test, and the
displacement carried to the design's vertices by linear interpolation or KNN (the paper does not tell its k). Beside it
the product, method `surface`, with its default settings on the same scan, and with the very points of the paper's
pipeline. The pose is known to all of them.

### Registration

Share of the distortion that was *not* recovered (0 all, 1 as bad as doing nothing):

{_missed_table([*prints, *others], [*measured, *others_measured])}
{_refusals([*prints, *others], [*measured, *others_measured])}

![Design and scan, before and after registration](part_registration.png)

The points of a mixture end up on the design's surface, but not at their places on it: nothing holds them along a smooth
face. Area weights gain little here, because the box grid has evened out the density before they could. How bad it is
depends on the part and on the boxes: the ribs and edges of the bracket hold on to the points, the thin curved wall of
the clip does not, and on a part of half the size, whose boxes are twice as coarse for it, more is missed.

### Redesign and reprint

u = Y' − y is looked up at the place X and added once, C = X + u(X). In the second cycle the print of the redesign is
scanned and the correction added to the redesign. What is left: RMS distortion of the new print over that of the first.

{_ways_table(ways)}
![What is left after one redesign](part_left.png)

![Deviation of the first print and of the prints of the redesigns](part_deviation.png)

The colours show the displacement across the faces; RMS and largest count that along the faces too, where MDF is worst.

Linear interpolation has no value for {outside:.0%} of the vertices (outside the convex hull of the scan points; the
registration itself fills in). Where the print has bent inwards the design's vertices lie off the printed face, in
tetrahedra that reach across the part: that is what makes linear the worst where the registration is good and the points
are dense. With MDF the ways differ little: the registration limits the result. Its error does not shrink with the
distortion, as the second cycle shows, which has less to find.

### Outliers

{_outlier_text(first, found)}
"""
    return Section("3. Experiment 2: a part in space", text, _part_claims(ways, measured, others_measured), drawn)


def part_ways(printed: Printed, measured: Measured, method: str) -> list[Redesigned]:
    """One cycle for every way, two for those that the paper and the product use."""
    assert measured.inspection is not None
    twice = (LINEAR, _PAPERS_KNN) if method in _MIXTURES else (ITSELF,)
    return [
        part.redesign(printed, measured.inspection, METHODS[method], way, _CYCLES if way in twice else 1)
        for way in part.WAYS
    ]


def _redesigned(printed: Printed, measured: Measured, way: part.Way) -> np.ndarray:
    assert measured.inspection is not None
    return part.redesign_vertices(printed, measured.inspection, way)


def _case_name(printed: Printed) -> str:
    case = printed.case
    longest = np.ptp(printed.design.vertices, axis=0).max()
    return f"{case.part} of {longest:.0f} mm, warp {case.warp_mm:g} mm, seed {case.seed}"


def _missed_table(prints: Sequence[Printed], measured: Sequence[dict[str, Measured]]) -> str:
    def cell(one: Measured) -> str:
        return "refused" if one.refusal else f"{one.missed:.3f}"

    rows = [
        [_case_name(printed), f"{found['MDF'].points:,}", *(cell(found[name]) for name in METHODS)]
        for printed, found in zip(prints, measured, strict=True)
    ]
    return table(("print", "points in boxes", *METHODS), rows)


def _refusals(prints: Sequence[Printed], measured: Sequence[dict[str, Measured]]) -> str:
    told = [
        f"{name} on the {_case_name(printed).partition(',')[0]} is refused: "
        f"{one.refusal.removeprefix('registration: ').partition(';')[0]}."
        for printed, found in zip(prints, measured, strict=True)
        for name, one in found.items()
        if one.refusal
    ]
    return " ".join([*told, "What folds has no inverse, and no redesign comes from it."]) if told else ""


def _ways_table(ways: dict[str, list[Redesigned]]) -> str:
    rows = []
    for method, redesigns in ways.items():
        for one in redesigns:
            left = [f"{value:.3f}" for value in one.left] + [""] * (_CYCLES - len(one.left))
            rows.append([f"{method}: {one.way.name}", f"{one.missed:.3f}", *left])
    cycles = [f"left after {count} cycle{'s' if count > 1 else ''}" for count in range(1, _CYCLES + 1)]
    return table(("registration: redesign by", "not recovered", *cycles), rows)


def _outlier_text(printed: Printed, found: dict[str, Measured]) -> str:
    rows = []
    for name in ("MDF", "surface, same points"):
        inspection = found[name].inspection
        if inspection is None:
            continue
        counts = part.count_outliers(printed, inspection)
        rows += [
            [f"{name}: {test}", f"{right} of {counts.outliers}", f"{wrong} of {counts.points - counts.outliers}"]
            for test, (right, wrong) in counts.found.items()
        ]
    return f"""\
Of the points that the box grid kept, so many outliers are found, and so many points of the surface are taken for some:

{table(("registration: test", "outliers found", "false alarms"), rows)}
The displacement that a registration yields is smooth by construction, also at points that are no part of the surface:
the paper's test sees only outliers that lie where the motion changes quickly."""


def _part_claims(
    ways: dict[str, list[Redesigned]],
    brackets: Sequence[dict[str, Measured]],
    others: Sequence[dict[str, Measured]],
) -> list[tuple[str, str]]:
    def left(method: str, way: part.Way) -> Redesigned:
        return next(one for one in ways[method] if one.way == way)

    linear, knn, product = left("MDF", LINEAR), left("MDF", _PAPERS_KNN), left("surface", ITSELF)
    dense_linear, dense_knn = left("surface", LINEAR).left[0], left("surface", _PAPERS_KNN).left[0]
    return [
        (
            "MDF accurately finds the deformation of a complex printed structure",
            f"Of the bracket's distortion {_missed(brackets, 'MDF')} is not recovered (CPD {_missed(brackets, 'CPD')}, "
            f"method `surface` {_missed(brackets, 'surface')}); of other parts' {_missed(others, 'MDF')} "
            f"(`surface` {_missed(others, 'surface')}).",
        ),
        (
            "KNN regression is significantly better than linear interpolation",
            f"With MDF {knn.left[0]:.3f} (KNN, k = 8) and {linear.left[0]:.3f} (linear) of the distortion are left; "
            f"with method `surface` {dense_knn:.3f} and {dense_linear:.3f}, and {product.left[0]:.3f} without either.",
        ),
        (
            "The redesign yields an un-distorted print",
            f"With the paper's pipeline {knn.left[0]:.2f} of the distortion is left after one cycle, "
            f"{knn.left[-1]:.2f} after {len(knn.left)}; with method `surface` {product.left[0]:.3f} after one.",
        ),
    ]


def _missed(measured: Sequence[dict[str, Measured]], name: str) -> str:
    known = [found[name].missed for found in measured if not found[name].refusal]
    refused = len(measured) - len(known)
    return _span(known, 3 if max(known) < 0.1 else 2) + (f", {refused} refused" if refused else "")


# The misprints


def errata_section(cases: int) -> Section:
    curve, sheet = errata.filled_dimension(cases)
    exact, traces = errata.three_traces()
    printed = part.print_and_scan(part.BRACKETS[0])
    inspection = part.measure(printed, METHODS["surface"]).inspection
    assert inspection is not None
    text = f"""\
The [list of errata](../algorithm.md#errata-of-the-paper) says what the formulas should read. What some of them do, as
means over {cases} cases (plain dense programs of the printed lines, `bench/paper/printed.py`; with the corrected
formulas they agree with `mdf_core`):

**The outlier constant.** A {errata.PER_SIDE} x {errata.PER_SIDE} square at level {errata.LEVEL:.2f},
{errata.OUTLIER_SHARE:.0%} of the design's points outliers, w = {errata.OUTLIER_SHARE:g}; share of the distortion
missed:

{table(("formula", "not recovered"), _rows(errata.outlier_constant(cases), 3))}
Inside the exponential the constant does nothing: the result is that of a run that expects no outliers. 1/N is no
density: the result depends on the unit of length.

**The M-step.** A refined square with area weights, level {errata.LEVEL:.2f}:

{table(("formula", "corners, mean error", "all scan points, RMS"), _rows(errata.motion_step(cases), 4))}
With X and y swapped, as both M-steps are printed, the products have no meaning: P~ is m x N, y is m x D. Where m = N
happens to allow them, they move the wrong set.

**σ² from three traces.** 400 points within a nanometre of their centroids, 1 m from the origin: σ² is {exact:.1e} mm²
from the residuals and {traces:.1e} mm² from the printed traces, which cancel.

**After thinning**, mean error of the corners of the strongly refined square, boxes of one spacing of the design:

{table(("areas", "corners, mean error"), _rows(errata.thinned_areas(cases), 4))}
**"Adding the inverse".** u = Y' − y is the inverse already. The bracket, method `surface`:

{table(("redesign", "distortion left"), _rows(errata.redesign_sign(printed, inspection), 3))}
**The dimension in w^(1 − D/2).** The table of the paper has the factor, its text has not. Derived for points that fill
the space, D is right, and in the plane both agree. For points that fill only a curve or a surface, the areas are those
of a set of dimension d < D, and d is what evens out its density: with d = 2 the factor is 1, as in the text. It tells
where the density changes from one side to the other. RMS error of a line of {max(line.COUNTS)} points in the plane:

{table(("weights", "RMS error"), _rows(curve, 4))}
Share missed of a bent sheet in space that is scanned more densely towards one side:

{table(("weights", "not recovered"), _rows(sheet, 2))}
"""
    return Section("4. Misprints and what they do", text)


SECTIONS: dict[str, Callable[[int], Section]] = {
    "line": line_section,
    "square": square_section,
    "part": part_section,
    "errata": errata_section,
}


def page(sections: Sequence[Section], made_by: str) -> str:
    """The page as markdown."""
    claims = [claim for section in sections for claim in section.claims]
    summary = "\n".join(f"| {said} | {came} |" for said, came in claims)
    parts = [
        f"""\
# The experiments of the paper

> Chao Wang, Shaofan Li, Danielle Zeng, Xinhai Zhu: *An Artificial-intelligence/Statistics Solution to Quantify Material
> Distortion for Thermal Compensation in Additive Manufacturing*

Its experiments run again with this library: coherent point drift (CPD, equal weights) against material deformation
finding (MDF, area weights), with the formulas in their [corrected form](../algorithm.md#errata-of-the-paper). The
paper's meshes, distortions and scans are not published, so ours stand in their place; how much hangs on them is told.

{made_by}

## What the paper says, and what came out

| the paper | here |
|---|---|
{summary}
"""
    ]
    parts += [f"## {section.title}\n\n{section.text}" for section in sections]
    blocks = "\n".join(parts).strip().split("\n\n")
    return "\n\n".join(_wrapped(block.strip("\n")) for block in blocks if block.strip()) + "\n"


def _wrapped(block: str) -> str:
    """A paragraph whose numbers made its lines uneven, wrapped again; everything else as it is."""
    if block.startswith(("|", "#", ">", "![")):
        return block
    return textwrap.fill(block, _LINE, break_long_words=False, break_on_hyphens=False)
