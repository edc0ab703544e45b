"""The motion of the design, which is linear in what is measured once every point knows where on the design it lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mdf_core.averages import TUKEY_LIMIT
from mdf_core.facets import Facets
from mdf_core.geometry import Array
from mdf_core.kernel import KernelBasis, joined
from mdf_core.normal_equations import (
    EliminatedOffset,
    OffsetSums,
    evident_alpha,
    newton_step,
    normal_matrix,
    normal_sum,
    well_determined,
)

EVEN = KernelBasis(np.empty((0, 3)), 1.0, None)
"""Basis of an offset that is the same everywhere."""

_LEAST_OFFSET_ALPHA = 2.5e5  # a standard deviation of two thousandths of the scale: what is more is the part's
_ROWS = 8_192  # of the normal equations at a time; bounds the memory


@dataclass(frozen=True, eq=False)
class Prior:
    """What is assumed of a motion and of the offset along the normals beside it.

    Attributes
    ----------
    bases : sequence of KernelBasis
        Of the motion, one for each width of its kernel.
    alphas : (k,) float64
        Their stiffnesses: the prior's standard deviation of the motion is the scale over the root.
    offset_basis : KernelBasis
        Of what varies of the offset over the part.
    offset_alpha : float
        Its stiffness.
    """

    bases: Sequence[KernelBasis]
    alphas: Array
    offset_basis: KernelBasis = EVEN
    offset_alpha: float = 1.0

    @cached_property
    def basis(self) -> KernelBasis:
        """Of the whole motion."""
        return joined(self.bases)

    @property
    def ranks(self) -> list[int]:
        """How many functions each width has."""
        return [len(basis.centres) for basis in self.bases]

    def stiffness(self, variance: float) -> Array:
        """Of each function of the motion, over the precision of a noise of that `variance`, (r,)."""
        return np.repeat(self.alphas * variance, self.ranks)


@dataclass(frozen=True, eq=False)
class Equations:
    """Rows normal · motion + offset = distance with their weights.

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
    """

    facets: Facets
    normals: Array
    distances: Array
    weights: Array
    origin: Array
    scale: float

    def summed(self, prior: Prior, told: Callable[[], None]) -> Sums:
        """The sums over all rows for the bases of the `prior`. Cost O(g · rank²).

        `told` is called after every chunk of rows.
        """
        rank, offsets = len(prior.basis.centres) + 4, len(prior.offset_basis.centres) + 1
        pull, own_pull, squares = np.zeros((rank, 3)), np.zeros(offsets), 0.0
        matrix = np.zeros((pull.size, pull.size))
        sums = OffsetSums(np.zeros((pull.size, offsets)), np.zeros((offsets, offsets)))
        for some in _in_chunks(len(self.distances)):
            features, offset_features = self._features(prior, some)
            weighted = self.weights[some] * self.distances[some] / self.scale
            matrix += normal_matrix(features, self.normals[some], self.weights[some])
            pull += normal_sum(features, self.normals[some], weighted)
            sums += OffsetSums.of(offset_features, features, self.normals[some], self.weights[some])
            own_pull += weighted @ offset_features
            squares += float(weighted @ self.distances[some]) / self.scale
            told()
        return Sums(matrix, pull, sums, own_pull, squares, self.scale)

    def solve(self, prior: Prior, sigma: float, fixed: bool, told: Callable[[], None]) -> DesignMotion:
        """The motion if the noise of a point is `sigma` mm.

        The stiffnesses make a step to what the data speak for, those of the motion unless they are `fixed`.
        """
        sums = self.summed(prior, told)
        solved = sums.solve(prior, sigma)
        return DesignMotion(self, sigma, sums.solve(solved.more_evident(fixed), sigma))

    def take(self, some: slice) -> Equations:
        """Some of the rows."""
        rows = (self.facets.take(some), self.normals[some], self.distances[some], self.weights[some])
        return Equations(*rows, self.origin, self.scale)

    def residuals(self, solved: Solved, some: slice) -> Array:
        """What motion and offset leave of the distances of `some` rows, (n,) mm."""
        features, offset_features = self._features(solved.prior, some)
        explained = np.einsum("ij,ij->i", features @ solved.solution, self.normals[some])
        left: Array = self.distances[some] - self.scale * (explained + offset_features @ solved.offsets)
        return left

    def _features(self, prior: Prior, some: slice) -> tuple[Array, Array]:
        """What the motion (n, r + 4) and the offset (n, q) of `some` rows are linear in."""
        facets = self.facets.take(some)
        varying = prior.offset_basis(facets.places())
        features = facets.features(prior.basis, self.origin, self.scale)
        return features, np.hstack([varying, np.ones((len(varying), 1))])


@dataclass(frozen=True, eq=False)
class Sums:
    """What the rows come to: the normal equations before any prior, in units of the `scale`.

    Attributes
    ----------
    matrix : (3 (r + 4), 3 (r + 4)) float64
    pull : (r + 4, 3) float64
    offset : OffsetSums
        Of q functions, the last of them constant.
    offset_pull : (q,) float64
    squares : float
        Of the distances, by weight.
    scale : float, mm
    """

    matrix: Array
    pull: Array
    offset: OffsetSums
    offset_pull: Array
    squares: float
    scale: float

    def solve(self, prior: Prior, sigma: float) -> Solved:
        """The solution with that prior if the noise of a point is `sigma` mm. Cost O(rank³)."""
        noise = sigma / self.scale
        variance = noise**2
        stiffness = prior.stiffness(variance)
        offset = self.offset.eliminated(prior.offset_alpha * variance, noise)
        matrix, pull = offset.without(self.matrix, self.pull, self.offset_pull)
        solution, factor = newton_step(matrix, pull, np.zeros_like(pull), stiffness)
        offsets = offset.beside(solution, self.offset_pull)
        left = self.squares - float((self.pull * solution).sum() + self.offset_pull @ offsets)
        log_priors = 3 * np.log(stiffness).sum()
        log_priors += (len(offsets) - 1) * np.log(prior.offset_alpha * variance)
        log_determinants = 2.0 * (np.log(np.diag(factor)).sum() + np.log(np.diag(offset.factor)).sum())
        evidence = -0.5 * float(left / variance + log_determinants - log_priors)
        return Solved(prior, variance, solution, factor, offset, offsets, evidence)


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution of the normal equations, in units of the scale.

    Attributes
    ----------
    prior : Prior
    variance : float
        Of the noise.
    solution : (r + 4, 3) float64
        C and A of the motion.
    factor : (3 (r + 4), 3 (r + 4)) float64
        Lower Cholesky factor of the motion's normal equations, the offset being eliminated.
    offset : EliminatedOffset
    offsets : (q,) float64
        Coefficients of the offset; the last is the part that all points share.
    evidence : float
        Log marginal likelihood up to a constant; comparable between priors for the same rows and noise.
    """

    prior: Prior
    variance: float
    solution: Array
    factor: Array
    offset: EliminatedOffset
    offsets: Array
    evidence: float

    @cached_property
    def determined(self) -> Array:
        """How many coefficients of each function of the motion the data determine rather than the prior, (r,)."""
        return well_determined(self.factor, self.prior.stiffness(self.variance))

    @cached_property
    def offset_determined(self) -> float:
        """How many coefficients of the varying offset."""
        return self.offset.well_determined(self.factor, self.prior.offset_alpha * self.variance)

    @property
    def least_determined(self) -> float:
        """How many coefficients the data determine of that width of the motion, or of the offset, that has fewest."""
        begins = np.cumsum([0, *self.prior.ranks[:-1]])
        motion = float(np.add.reduceat(self.determined, begins).min())
        return min(motion, self.offset_determined) if len(self.offsets) > 1 else motion

    def more_evident(self, fixed: bool) -> Prior:
        """The same prior with the stiffnesses that the data speak for, as far as these coefficients tell.

        Those of the motion may be `fixed`.
        """
        alphas, offset_alpha = self.prior.alphas, self.prior.offset_alpha
        if not fixed:
            ends = np.cumsum(self.prior.ranks)
            widths = zip(np.split(self.determined, ends[:-1]), np.split(self.solution, ends)[:-1], strict=True)
            alphas = np.array([evident_alpha(float(known.sum()), found) for known, found in widths])
        if len(self.offsets) > 1:
            offset_alpha = evident_alpha(self.offset_determined, self.offsets[:-1], _LEAST_OFFSET_ALPHA)
        return replace(self.prior, alphas=alphas, offset_alpha=offset_alpha)


@dataclass(frozen=True, eq=False)
class DesignMotion:
    """Solution of the equations.

    Attributes
    ----------
    equations : Equations
    sigma : float, mm
        The noise of a point that was assumed.
    solved : Solved
    """

    equations: Equations
    sigma: float
    solved: Solved

    @property
    def prior(self) -> Prior:
        """That of the solution."""
        return self.solved.prior

    @property
    def determined(self) -> float:
        """How many coefficients the data determine rather than the prior."""
        return float(self.solved.determined.sum()) + self.solved.offset_determined

    def residuals(self) -> Array:
        """What motion and offset leave of the distances, (g,) mm."""
        chunks = _in_chunks(len(self.equations.distances))
        return np.concatenate([self.equations.residuals(self.solved, some) for some in chunks])

    def misfit(self) -> float:
        """Sum of the squared residuals in mm², by weight; none counts for more than an outlier would."""
        return float(self.equations.weights @ np.minimum(np.abs(self.residuals()), TUKEY_LIMIT * self.sigma) ** 2)

    def displacement(self, facets: Facets) -> Array:
        """How far each of these places is moved, (n, 3) mm."""
        equations, moved = self.equations, np.empty((len(facets), 3))
        for some in _in_chunks(len(facets)):
            features = facets.take(some).features(self.prior.basis, equations.origin, equations.scale)
            moved[some] = equations.scale * (features @ self.solved.solution)
        return moved

    def offset(self, places: Array) -> Array:
        """How far the scan lies off along the normals at these places of the design, (n,) mm, beside the motion."""
        offsets, varying = self.solved.offsets, self.prior.offset_basis(places)
        found: Array = self.equations.scale * (varying @ offsets[:-1] + offsets[-1])
        return found


def _in_chunks(count: int) -> Iterator[slice]:
    return (slice(begin, begin + _ROWS) for begin in range(0, count, _ROWS))
