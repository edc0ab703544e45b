"""Experiment 1: the unit square, uniform design, locally refined scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.paper.meshes import Mesh, Refinement, refined_mesh, uniform_mesh
from mdf_core.deformation import Deformation
from mdf_core.geometry import PointSet
from mdf_core.progress import silent
from mdf_core.registration import register_mixture
from mdf_core.settings import MixtureSettings

LEVELS = (0.05, 0.10, 0.15)
PER_SIDE = 21
SCALE = float(np.sqrt(1.0 / 6.0))  # RMS radius of the unit square's area
PARAMETERS = MixtureSettings(beta=3.0, alpha=2.0, outlier_share=0.0, max_iterations=1000)
_POLYNOMIAL = 0.8  # largest coefficient, relative to the shear

_TWO_SPOTS = ((0.3, 0.3), (0.7, 0.7))
MILD = Refinement("two spots", _TWO_SPOTS, finest=0.014, growth=0.2, coarsest=0.075)
STRONG = Refinement("two spots, strongly refined", _TWO_SPOTS, finest=0.008, growth=0.19, coarsest=0.08)
OTHERS = (
    Refinement("two spots, more nodes", _TWO_SPOTS, finest=0.016, growth=0.18, coarsest=0.078),
    Refinement("the middle", ((0.5, 0.5),), finest=0.0135, growth=0.14, coarsest=0.066),
    Refinement("the middle, more nodes", ((0.5, 0.5),), finest=0.0125, growth=0.13, coarsest=0.066),
    Refinement("one corner", ((0.0, 0.0),), finest=0.022, growth=0.06, coarsest=0.1),
)

DESIGN = uniform_mesh(PER_SIDE)
_ON_SIDE = (DESIGN.nodes == 0.0) | (DESIGN.nodes == 1.0)
REGIONS = {
    "corners": _ON_SIDE.all(axis=1),
    "edges": _ON_SIDE.any(axis=1) & ~_ON_SIDE.all(axis=1),
    "interior": ~_ON_SIDE.any(axis=1),
}


def deformed(points: np.ndarray, level: float, seed: int) -> np.ndarray:
    """Quadratic displacement with random coefficients around the shear that makes the square a rhombus."""
    coefficients = _POLYNOMIAL * np.random.default_rng(seed).uniform(-1.0, 1.0, (5, 2))
    coefficients[:2] = [[0.0, 1.0], [1.0, 0.0]]
    x, y = (points - 0.5).T
    return points + level * np.stack([x, y, x * y, x**2, y**2], axis=1) @ coefficients


@dataclass(frozen=True, eq=False)
class Case:
    """One scan of one distorted square, registered by both methods.

    Attributes
    ----------
    motions : dict of str to Deformation
        By method, cpd and mdf.
    errors : dict of str to (n,) float
        Distance of every design node from where the method takes its distorted place back to.
    """

    mesh: Mesh
    level: float
    seed: int
    motions: dict[str, Deformation]
    errors: dict[str, np.ndarray]

    @property
    def scan(self) -> np.ndarray:
        return deformed(self.mesh.nodes, self.level, self.seed)

    @property
    def distortion(self) -> float:
        """RMS displacement of the design nodes."""
        moves = deformed(DESIGN.nodes, self.level, self.seed) - DESIGN.nodes
        return float(np.sqrt((moves**2).sum(axis=1).mean()))

    def error(self, method: str, region: str) -> float:
        """Mean over a region of the design."""
        return float(self.errors[method][REGIONS[region]].mean())


def register(
    scan: np.ndarray, areas: np.ndarray, area_weighted: bool, settings: MixtureSettings = PARAMETERS
) -> Deformation:
    registered = register_mixture(PointSet(scan, areas=areas), DESIGN.nodes, settings, area_weighted, SCALE, silent)
    return registered.deformation


def solve(mesh: Mesh, level: float, seed: int) -> Case:
    scan = deformed(mesh.nodes, level, seed)
    areas = mesh.nodal_areas(scan)
    motions = {"cpd": register(scan, areas, False), "mdf": register(scan, areas, True)}
    distorted = deformed(DESIGN.nodes, level, seed)
    errors = {name: np.linalg.norm(motion.apply(distorted) - DESIGN.nodes, axis=1) for name, motion in motions.items()}
    return Case(mesh, level, seed, motions, errors)


@dataclass(frozen=True, eq=False)
class Family:
    """Cases of one refinement, by level."""

    refinement: Refinement
    cases: dict[float, list[Case]]

    @property
    def meshes(self) -> list[Mesh]:
        return [case.mesh for case in next(iter(self.cases.values()))]

    def error(self, level: float, method: str, region: str) -> float:
        return float(np.mean([case.error(method, region) for case in self.cases[level]]))

    def ratio(self, level: float, region: str = "corners") -> float:
        """Error of CPD over that of MDF, both averaged over the cases first."""
        return self.error(level, "cpd", region) / self.error(level, "mdf", region)

    def single_ratios(self, level: float) -> list[float]:
        """At the corners, case by case."""
        return [case.error("cpd", "corners") / case.error("mdf", "corners") for case in self.cases[level]]


def solve_family(refinement: Refinement, count: int) -> Family:
    """`count` cases per level, each with a mesh and a distortion of its own."""
    meshes = [refined_mesh(refinement, seed) for seed in range(count)]
    cases = {
        level: [solve(mesh, level, 100 * row + column) for column, mesh in enumerate(meshes)]
        for row, level in enumerate(LEVELS)
    }
    return Family(refinement, cases)


def mixture_density(mesh: Mesh, area_weighted: bool, sigma: float, places: np.ndarray) -> np.ndarray:
    """Density of the mixture whose components sit on the mesh's nodes, at `places` (n, 2)."""
    weights = np.ones(len(mesh.nodes))
    if area_weighted:
        areas = mesh.nodal_areas(mesh.nodes)
        weights = areas / areas.mean()
    squares = ((places[:, None] - mesh.nodes) ** 2).sum(axis=2)
    variances = weights * sigma**2
    components = np.exp(-squares / (2.0 * variances)) / (2.0 * np.pi * variances)
    return components @ (weights / len(weights))
