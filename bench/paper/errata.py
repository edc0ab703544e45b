"""What the paper's misprints do to the result, where that is cheap to show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

import mdf_core as mdf
from bench.paper import line, square
from bench.paper.meshes import Mesh, Refinement, refined_mesh, uniform_mesh
from bench.paper.part import Printed
from bench.paper.printed import CORRECT, Formulas, Parameters, register
from mdf_core.geometry import PointSet
from mdf_core.inspection import Inspection
from mdf_core.mixture import area_weights
from mdf_core.sampling import thin
from mdf_core.settings import Settings, ThinningSettings

LEVEL = 0.10
PER_SIDE = 16
OUTLIER_SHARE = 0.2
_COARSER = (square.PER_SIDE - 1) / (PER_SIDE - 1)
_REFINED = replace(square.MILD, finest=_COARSER * square.MILD.finest, coarsest=_COARSER * square.MILD.coarsest)
_THINNING_BOX = 0.05
_OFFSET, SMALL_SIGMA = 1000.0, 1e-6  # mm


@dataclass(frozen=True)
class Row:
    """A formula and what it yields, averaged over the cases."""

    formula: str
    values: tuple[float, ...]


def _rms(vectors: np.ndarray, weights: np.ndarray | None = None) -> float:
    return float(np.sqrt(np.average((vectors**2).sum(axis=1), weights=weights)))


def _mean(formula: str, rows: list[list[float]]) -> Row:
    return Row(formula, tuple(float(value) for value in np.mean(rows, axis=0)))


# Outliers


def outlier_constant(cases: int) -> list[Row]:
    """Share of the distortion missed with a fifth of the design's points outliers."""

    def missed(formulas: Formulas, share: float, seed: int, unit: float = 1.0) -> list[float]:
        nodes = uniform_mesh(PER_SIDE).nodes
        scan = square.deformed(nodes, LEVEL, seed)
        count = round(OUTLIER_SHARE / (1.0 - OUTLIER_SHARE) * len(nodes))
        outliers = np.random.default_rng(seed).uniform(-0.5, 1.5, (count, 2))
        # Of a length unit no result may depend: beta is a length, alpha one over a squared length.
        length = unit / square.SCALE
        parameters = Parameters(share, beta=3.0 * unit, alpha=2.0 / unit**2, tolerance=1e-4 * unit)
        design = length * np.vstack([nodes, outliers])
        moved = register(length * scan, design, np.ones(len(nodes)), parameters, formulas) / length
        return [_rms(moved - nodes) / _rms(scan - nodes)]

    seeds = range(cases)
    inside, summed = (replace(CORRECT, outlier_constant=place) for place in ("in the exponent", "in the sum"))
    count = replace(CORRECT, outlier_density="1 / N")
    share = OUTLIER_SHARE
    return [
        _mean("corrected", [missed(CORRECT, share, seed) for seed in seeds]),
        _mean("constant in the exponent", [missed(inside, share, seed) for seed in seeds]),
        _mean("no outliers expected, w = 0", [missed(CORRECT, 0.0, seed) for seed in seeds]),
        _mean("constant in the sum over k", [missed(summed, share, seed) for seed in seeds]),
        _mean("1/N for a density", [missed(count, share, seed) for seed in seeds]),
        _mean("1/N for a density, lengths in another unit", [missed(count, share, seed, 100.0) for seed in seeds]),
    ]


# The M-step


def motion_step(cases: int) -> list[Row]:
    """Mean error of the corners and RMS error of all scan points, on a refined square."""

    def errors(formulas: Formulas, seed: int) -> list[float]:
        mesh = refined_mesh(_REFINED, seed)
        scan = square.deformed(mesh.nodes, LEVEL, seed)
        weights = area_weights(mesh.nodal_areas(scan))
        design = uniform_mesh(PER_SIDE).nodes / square.SCALE
        moved = register(scan / square.SCALE, design, weights, Parameters(0.0), formulas) * square.SCALE
        misses = moved - mesh.nodes
        return [float(np.linalg.norm(misses[:4], axis=1).mean()), _rms(misses)]

    def nothing(seed: int) -> list[float]:
        mesh = refined_mesh(_REFINED, seed)
        moves = square.deformed(mesh.nodes, LEVEL, seed) - mesh.nodes
        return [float(np.linalg.norm(moves[:4], axis=1).mean()), _rms(moves)]

    seeds = range(cases)
    weighted = replace(CORRECT, explained="1'P~1")
    opposite = replace(CORRECT, motion_sign="X - y + GV")
    return [
        _mean("corrected", [errors(CORRECT, seed) for seed in seeds]),
        _mean("N_P = 1ᵀP~1", [errors(weighted, seed) for seed in seeds]),
        _mean("exponent with X − y + GV", [errors(opposite, seed) for seed in seeds]),
        _mean("the distortion itself", [nothing(seed) for seed in seeds]),
    ]


def three_traces() -> tuple[float, float]:
    """sigma² of points that lie within a nanometre of their centroids: from the residuals, and from three traces."""
    generator = np.random.default_rng(0)
    centroids = _OFFSET + 100.0 * generator.random((400, 3))
    data = centroids + SMALL_SIGMA * generator.normal(size=centroids.shape)  # P is the identity
    traces = np.trace(data.T @ data) - 2.0 * np.trace(data.T @ centroids) + np.trace(centroids.T @ centroids)
    return float(((data - centroids) ** 2).sum() / data.size), float(traces / data.size)


# The dimension in the weight of a component


def filled_dimension(cases: int) -> tuple[list[Row], list[Row]]:
    """A line in the plane (RMS error) and a bent sheet in space (share missed), each with d = D and with its own d."""
    seeds = range(cases)
    methods = {"equal weights (CPD)": (False, CORRECT), "area weights, d = D": (True, CORRECT)}
    curve = methods | {"area weights, d = 1": (True, replace(CORRECT, filled_dimension=1))}
    sheet = methods | {"area weights, d = 2": (True, replace(CORRECT, filled_dimension=2))}
    return (
        [_mean(name, [_line_error(*method, seed) for seed in seeds]) for name, method in curve.items()],
        [_mean(name, [_sheet_missed(*method, seed) for seed in seeds]) for name, method in sheet.items()],
    )


def _line_error(area_weighted: bool, formulas: Formulas, seed: int) -> list[float]:
    points = max(line.COUNTS)
    places = line.random_places(points, np.random.default_rng(seed))
    scan = line.distorted(places, in_plane=True)
    weights = area_weights(line.lengths(scan)) if area_weighted else np.ones(points)
    design = np.stack([np.linspace(0.0, 1.0, points), np.zeros(points)], axis=1)
    moved = register(scan / line.SCALE, design / line.SCALE, weights, Parameters(0.0), formulas) * line.SCALE
    return [float(np.sqrt(((moved[:, 0] - places) ** 2).mean()))]


_SHEET = Refinement("one side", ((0.0, 0.5),), finest=0.03, growth=0.08, coarsest=0.14)


def _on_sheet(nodes: np.ndarray) -> np.ndarray:
    """The unit square, bent in space."""
    x, y = 2.0 * (nodes - 0.5).T
    return np.stack([x, y, 0.25 * np.sin(3.0 * x) + 0.15 * y**2], axis=1)


def _sheet_areas(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    a, b, c = points[mesh.triangles].transpose(1, 0, 2)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.bincount(mesh.triangles.ravel(), np.repeat(areas / 3.0, 3), minlength=len(points))


def _sheet_missed(area_weighted: bool, formulas: Formulas, seed: int) -> list[float]:
    design = _on_sheet(uniform_mesh(15).nodes)
    scale = _rms(design)
    mesh = refined_mesh(_SHEET, seed)
    true = _on_sheet(mesh.nodes)
    generator = np.random.default_rng(seed)
    frequencies, phases = 1.5 * generator.uniform(-1.0, 1.0, (3, 3)), generator.uniform(0.0, 6.0, 3)
    displacement = 0.06 * np.sin(true @ frequencies + phases)
    scan = true + displacement
    areas = _sheet_areas(mesh, scan)
    weights = area_weights(areas) if area_weighted else np.ones(len(scan))
    moved = register(scan / scale, design / scale, weights, Parameters(0.01), formulas) * scale
    return [_rms(moved - true, areas) / _rms(displacement, areas)]


# Thinning and redesign


def thinned_areas(cases: int) -> list[Row]:
    """Mean error of the corners after thinning the strongly refined scan: who inherits the areas of what is dropped."""

    def errors(seed: int) -> list[float]:
        mesh = refined_mesh(square.STRONG, seed)
        scan = square.deformed(mesh.nodes, LEVEL, seed)
        areas = mesh.nodal_areas(scan)
        kept = thin(PointSet(scan, areas=areas), ThinningSettings(box_mm=_THINNING_BOX), seed)
        _, index = KDTree(scan).query(kept.points)
        corners = square.deformed(square.DESIGN.nodes, LEVEL, seed)[square.REGIONS["corners"]]
        true = square.DESIGN.nodes[square.REGIONS["corners"]]
        motions = [
            square.register(kept.points, given, weighted)
            for given, weighted in ((kept.areas, True), (areas[index], True), (areas[index], False))
        ]
        return [float(np.linalg.norm(motion.apply(corners) - true, axis=1).mean()) for motion in motions]

    found = np.mean([errors(seed) for seed in range(cases)], axis=0)
    names = ("the point that is kept inherits them", "every point keeps its own", "equal weights (CPD)")
    return [Row(name, (float(value),)) for name, value in zip(names, found, strict=True)]


def redesign_sign(printed: Printed, inspection: Inspection) -> list[Row]:
    """What is left of the distortion when u is added, and when its inverse is added once more instead."""
    rows = []
    for name, gain in (("C = X + u", 1.0), ("C = X − u", -1.0)):
        redesign = mdf.compensate(printed.design, [inspection], Settings().replace({"compensation.gain": gain}))
        rows.append(Row(name, (printed.left(redesign.vertices),)))
    return rows
