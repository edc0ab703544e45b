"""The paper's line: stretched evenly, and scanned at places that are no places of the design's points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.paper.printed import Parameters, register
from mdf_core.geometry import PointSet
from mdf_core.mixture import area_weights
from mdf_core.progress import silent
from mdf_core.registration import register_mixture
from mdf_core.settings import MixtureSettings

STRETCH, DROP = 1.3, 0.3  # of the unit line
SCALE = float(np.sqrt(1.0 / 12.0))  # RMS radius of the unit line
PARAMETERS = MixtureSettings(beta=3.0, alpha=2.0, outlier_share=0.0, max_iterations=1000)
COUNTS = (4, 21)
PAPERS_PLACES = np.array([0.0, 0.15, 0.45, 1.0])  # two points in the middle "chosen arbitrarily"
EVERYWHERE = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, eq=False)
class Line:
    """One scan of the stretched line and where two methods take it back to.

    Attributes
    ----------
    places : (n,) float
        Of the scan points in the material, the truth that is looked for.
    found : dict of str to (n,) float
        The same as found by cpd and mdf.
    errors : dict of str to float
        RMS along the whole line, relative to its length.
    """

    places: np.ndarray
    found: dict[str, np.ndarray]
    errors: dict[str, float]


def distorted(places: np.ndarray, in_plane: bool) -> np.ndarray:
    """Coordinates (n, 1) along the line, or (n, 2) in the plane, where it is moved down as well."""
    along = 0.5 + STRETCH * (places - 0.5)
    return np.stack([along, np.full_like(along, -DROP)], axis=1) if in_plane else along[:, None]


def lengths(scan: np.ndarray) -> np.ndarray:
    """Of the line from halfway to the point before to halfway to the next, (n,)."""
    gaps = np.diff(scan[:, 0])
    return 0.5 * (np.append(gaps, 0.0) + np.insert(gaps, 0, 0.0))


def random_places(points: int, generator: np.random.Generator) -> np.ndarray:
    """Both ends and any places between."""
    return np.concatenate([[0.0], np.sort(generator.random(points - 2)), [1.0]])


def solve(places: np.ndarray, in_plane: bool) -> Line:
    """Register to as many evenly spaced design points: in the plane by the library, which knows no line, else dense."""
    design = np.zeros((len(places), 2 if in_plane else 1))
    design[:, 0] = np.linspace(0.0, 1.0, len(places))
    scan = distorted(places, in_plane)
    areas = lengths(scan)
    found, errors = {}, {}
    for method in ("cpd", "mdf"):
        if in_plane:
            points = PointSet(scan, areas=areas)
            moved = register_mixture(points, design, PARAMETERS, method == "mdf", SCALE, silent).deformation.apply(scan)
        else:
            weights = area_weights(areas) if method == "mdf" else np.ones(len(places))
            moved = SCALE * register(scan / SCALE, design / SCALE, weights, Parameters(PARAMETERS.outlier_share))
        found[method] = moved[:, 0]
        misses = np.interp(EVERYWHERE, places, found[method]) - EVERYWHERE
        errors[method] = float(np.sqrt((misses**2).mean()))
    return Line(places, found, errors)


@dataclass(frozen=True)
class Average:
    """Mean RMS error over scans with random places, by method."""

    points: int
    scans: int
    in_plane: bool
    errors: dict[str, float]


def average(points: int, in_plane: bool, count: int) -> Average:
    generator = np.random.default_rng(points)
    lines = [solve(random_places(points, generator), in_plane) for _ in range(count)]
    errors = {name: float(np.mean([line.errors[name] for line in lines])) for name in ("cpd", "mdf")}
    return Average(points, count, in_plane, errors)
