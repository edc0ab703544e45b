"""The normal equations of a motion whose distances along normals are measured, and what their solution tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dtrtri

from mdf_core.geometry import Array
from mdf_core.threads import in_threads

# Strains cost a little: next to nothing where the scan shows them, much where it does not, as the thickness of a part
# that is seen from one side. Shifts are free.
_STRAIN_RIDGE, _SHIFT_RIDGE = 1e-3, 1e-6
_ALPHA_RANGE = (10.0, 1e9)  # down to a prior sd of a third of the scale; less would let the motion run away
_OFFSET = 1e-3  # of the scale, standard deviation of the prior: a coating, or lines that are printed too wide
_CHUNK = 2_500  # rows of the normal equations at a time
_WORTH_THREADS = 200_000_000  # products; of less, starting the threads would take longer


def normal_matrix(features: Array, normals: Array, weights: Array) -> Array:
    """Σ w (n ⊗ φ)(n ⊗ φ)ᵀ, the matrix (3m, 3m) of the distances to the tangent planes; unknowns axis by axis."""
    size = 3 * features.shape[1]
    used = np.flatnonzero(weights)

    def share(chunk: NDArray[np.intp]) -> Array:
        directions = np.sqrt(weights[chunk])[:, None] * normals[chunk]
        rows = (directions[:, :, None] * features[chunk, None, :]).reshape(len(chunk), size)
        product: Array = rows.T @ rows
        return product

    chunks = np.array_split(used, max(-(-len(used) // _CHUNK), 1))
    is_much = len(used) * size**2 > _WORTH_THREADS
    matrix = np.zeros((size, size))
    for product in in_threads(share, chunks) if is_much else map(share, chunks):
        matrix += product
    return matrix


def normal_sum(features: Array, normals: Array, amounts: Array) -> Array:
    """Σ a n ⊗ φ, (m, 3), of the `amounts` (n,): what they ask of the motion along the normals.

    Of weights times distances it is the residuals' pull.
    """
    total: Array = features.T @ (amounts[:, None] * normals)
    return total


@dataclass(frozen=True, eq=False)
class OffsetSums:
    """Sums over rows with an offset Ψ(x) b along the normals, of functions Ψ (n, q) the last of which is 1.

    What a spray leaves on a part, or lines printed too wide, moves every surface outward, both faces of a wall. No
    smooth motion does that: without unknowns of its own it takes rough ones, which slide along the faces.

    Attributes
    ----------
    cross : (3m, q) float64
        Σ w (n ⊗ φ) ψᵀ
    own : (q, q) float64
        Σ w ψ ψᵀ
    """

    cross: Array
    own: Array

    @classmethod
    def of(cls, offset_features: Array, features: Array, normals: Array, weights: Array) -> OffsetSums:
        """Of rows with the `weights` (n,)."""
        weighted = weights[:, None] * offset_features
        cross = [features.T @ (axis[:, None] * weighted) for axis in normals.T]
        return cls(np.concatenate(cross), offset_features.T @ weighted)

    def __add__(self, other: OffsetSums) -> OffsetSums:
        return OffsetSums(self.cross + other.cross, self.own + other.own)

    def eliminated(self, stiffness: float, sigma: float) -> EliminatedOffset:
        """With the prior of a field, its `stiffness` over the noise's precision; `sigma`: the noise over the scale."""
        total = self.own.copy()
        total[np.diag_indices(len(total) - 1)] += stiffness
        total[-1, -1] += (sigma / _OFFSET) ** 2
        factor: Array = cholesky(total, lower=True, check_finite=False)
        return EliminatedOffset(self.cross, factor, cho_solve((factor, True), self.cross.T))


@dataclass(frozen=True, eq=False)
class EliminatedOffset:
    """An offset that is known once the motion is.

    Attributes
    ----------
    cross : (3m, q) float64
        Of its sums.
    factor : (q, q) float64
        Lower Cholesky factor of its own normal equations.
    taken : (q, 3m) float64
        How it gives way to the motion.
    """

    cross: Array
    factor: Array
    taken: Array

    def without(self, matrix: Array, pull: Array, own_pull: Array) -> tuple[Array, Array]:
        """Normal matrix (3m, 3m) and pull (m, 3) of the motion alone; `own_pull` (q,) is that of the offset."""
        return matrix - self.cross @ self.taken, pull - (own_pull @ self.taken).reshape(3, -1).T

    def beside(self, solution: Array, own_pull: Array) -> Array:
        """The offset's coefficients b (q,) beside the motion's `solution` (m, 3)."""
        coefficients: Array = cho_solve((self.factor, True), own_pull) - self.taken @ solution.T.ravel()
        return coefficients

    def well_determined(self, motion: Array, stiffness: float) -> float:
        """How many of the field's coefficients the data determine; `motion` is the factor of its normal equations."""
        own, _ = dtrtri(self.factor, lower=1)
        by_motion = solve_triangular(motion, self.taken[:-1].T, lower=True, check_finite=False)
        return float(len(own) - 1 - stiffness * ((own[:, :-1] ** 2).sum() + (by_motion**2).sum()))


def newton_step(matrix: Array, pull: Array, solution: Array, stiffness: Array) -> tuple[Array, Array]:
    """Newton step from `solution` (m, 3) by the residuals' `pull` (m, 3) and the prior; and the Cholesky factor.

    The `stiffness` (r,) of each of the basis's coefficients is over the noise's precision.
    """
    size = len(solution)
    prior = np.full(size, _STRAIN_RIDGE)
    prior[: len(stiffness)] = stiffness
    prior[-1] = _SHIFT_RIDGE
    prior = np.tile(prior, 3)
    posterior = matrix.copy()
    posterior[np.diag_indices(len(matrix))] += prior
    factor: Array = cholesky(posterior, lower=True, overwrite_a=True, check_finite=False)
    start = solution.T.ravel()
    stepped = start + cho_solve((factor, True), pull.T.ravel() - prior * start)
    return stepped.reshape(3, size).T, factor


def posterior_covariance(factor: Array, sigma: float) -> Array:
    """Covariance of the unknowns, axis by axis, (3m, 3m) mm², from the lower Cholesky factor (3m, 3m)."""
    covariance: Array = cho_solve((factor, True), np.eye(len(factor)))
    covariance *= sigma**2
    return covariance


def well_determined(factor: Array, stiffness: Array) -> Array:
    """How many of the three coefficients of each function of the basis the data determine, not the prior, (r,)."""
    inverse, _ = dtrtri(factor, lower=1)
    variances = (inverse**2).sum(axis=0).reshape(3, -1).sum(axis=0)
    determined: Array = 3.0 - stiffness * variances[: len(stiffness)]
    return determined


def evident_alpha(determined: float, coefficients: Array, least: float = _ALPHA_RANGE[0]) -> float:
    """The stiffness that the data speak for, from the `coefficients` (r, 3) or (r,) with another one.

    As many of them are `determined` by the data. It is no less than `least`.
    Source: MacKay 1992, equation 4.9: alpha |C|² = that number.
    """
    return float(np.clip(determined / (coefficients**2).sum(), least, _ALPHA_RANGE[1]))
