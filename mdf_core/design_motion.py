"""The motion of the design, which is linear in what is measured once every point knows where on the design it lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mdf_core.averages import TUKEY_LIMIT
from mdf_core.facets import Facets
from mdf_core.geometry import Array
from mdf_core.kernel import KernelBasis
from mdf_core.normal_equations import (
    evident_alpha,
    newton_step,
    normal_matrix,
    normal_sum,
    well_determined,
    without_offset,
)

_ROWS = 8_192  # of the normal equations at a time; bounds the memory


@dataclass(frozen=True, eq=False)
class Equations:
    """Rows normal · motion = distance with their weights, and the prior.

    Attributes
    ----------
    facets : Facets
        Where on the design the rows are, g places.
    normals : (g, 3) float64
        Of the printed surface.
    distances : (g,) float64, mm
        Along the normals, from the design to the printed surface.
    weights : (g,) float64
        How many points each row stands for, less what is doubtful.
    origin : (3,) float64, mm
    scale : float, mm
    alpha : float
        Stiffness; 0: the one that the data speak for.
    """

    facets: Facets
    normals: Array
    distances: Array
    weights: Array
    origin: Array
    scale: float
    alpha: float

    def solve(self, basis: KernelBasis, sigma: float, alpha: float, after_chunk: Callable[[], None]) -> DesignMotion:
        """The motion in that basis if the noise of a point is `sigma` mm.

        `alpha` is where the search for the stiffness begins; `after_chunk` is called after every chunk of rows. Cost
        O(g · rank²).
        """
        rank = len(basis.centres)
        pull = np.zeros((rank + 4, 3))
        column, residual = np.zeros_like(pull), 0.0
        matrix = np.zeros((pull.size, pull.size))
        for some in _in_chunks(len(self.distances)):
            features = self._features(basis, some)
            weighted = self.weights[some] * self.distances[some] / self.scale
            matrix += normal_matrix(features, self.normals[some], self.weights[some])
            pull += normal_sum(features, self.normals[some], weighted)
            column += normal_sum(features, self.normals[some], self.weights[some])
            residual += float(weighted.sum())
            after_chunk()
        matrix, pull = without_offset(matrix, pull, column, float(self.weights.sum()), residual, sigma / self.scale)
        rest, variance = np.zeros_like(pull), (sigma / self.scale) ** 2
        stiffness = self.alpha or alpha
        solution, factor = newton_step(matrix, pull, rest, rank, stiffness * variance)
        if self.alpha == 0:
            stiffness = evident_alpha(well_determined(factor, rank, stiffness * variance), solution[:rank])
            solution, factor = newton_step(matrix, pull, rest, rank, stiffness * variance)
        return DesignMotion(self, basis, sigma, stiffness, solution, factor)

    def residuals(self, basis: KernelBasis, solution: Array, some: slice) -> Array:
        """What the motion leaves of the distances of `some` rows, (n,) mm."""
        moved = self.scale * (self._features(basis, some) @ solution)
        left: Array = self.distances[some] - np.einsum("ij,ij->i", moved, self.normals[some])
        return left

    def _features(self, basis: KernelBasis, some: slice) -> Array:
        return self.facets.features(basis, self.origin, self.scale, some)


@dataclass(frozen=True, eq=False)
class DesignMotion:
    """Solution of the equations.

    Attributes
    ----------
    equations : Equations
    basis : KernelBasis
    sigma : float, mm
        The noise of a point that was assumed.
    alpha : float
    solution : (r + 4, 3) float64
        C and A, in units of the scale.
    factor : (3 (r + 4), 3 (r + 4)) float64
        Lower Cholesky factor of the normal equations.
    """

    equations: Equations
    basis: KernelBasis
    sigma: float
    alpha: float
    solution: Array
    factor: Array

    def residuals(self) -> Array:
        """What the motion and an offset that all points share leave of the distances, (g,) mm."""
        chunks = _in_chunks(len(self.equations.distances))
        left = np.concatenate([self.equations.residuals(self.basis, self.solution, some) for some in chunks])
        residuals: Array = left - np.average(left, weights=self.equations.weights)
        return residuals

    def misfit(self) -> float:
        """Sum of the squared residuals in mm², by weight; none counts for more than an outlier would."""
        return float(self.equations.weights @ np.minimum(np.abs(self.residuals()), TUKEY_LIMIT * self.sigma) ** 2)

    def determined(self) -> float:
        """How many of the coefficients the data determine rather than the prior."""
        return well_determined(
            self.factor, len(self.basis.centres), self.alpha * (self.sigma / self.equations.scale) ** 2
        )

    def displacement(self, facets: Facets) -> Array:
        """How far each of these places is moved, (n, 3) mm."""
        equations, moved = self.equations, np.empty((len(facets), 3))
        for some in _in_chunks(len(facets)):
            features = facets.features(self.basis, equations.origin, equations.scale, some)
            moved[some] = equations.scale * (features @ self.solution)
        return moved


def _in_chunks(count: int) -> Iterator[slice]:
    return (slice(begin, begin + _ROWS) for begin in range(0, count, _ROWS))
