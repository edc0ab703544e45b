"""The normal equations of a motion whose distances along normals are measured, and what their solution tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
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

    Of weights times distances it is the residuals' pull, of the weights alone how the motion goes with an offset.
    """
    total: Array = features.T @ (amounts[:, None] * normals)
    return total


def without_offset(
    matrix: Array, pull: Array, column: Array, weight: float, residual: float, sigma: float
) -> tuple[Array, Array]:
    """Normal matrix and pull (m, 3) of the motion alone, that of a common offset of all points being eliminated.

    What a spray leaves on a part, or lines printed too wide, moves every surface outward, both faces of a wall. No
    smooth motion does that: without an unknown of its own it takes rough ones, which slide along the faces.

    Parameters
    ----------
    matrix : (3m, 3m) float64
    pull : (m, 3) float64
    column : (m, 3) float64
        `normal_sum` of the weights.
    weight, residual : float
        Sums over all rows of the weights, and of the weights times the distances.
    sigma : float
        The noise of a point over the scale.
    """
    total = weight + (sigma / _OFFSET) ** 2
    flat = column.T.ravel()
    return matrix - np.outer(flat, flat / total), pull - column * (residual / total)


def newton_step(matrix: Array, pull: Array, solution: Array, rank: int, stiffness: float) -> tuple[Array, Array]:
    """Newton step from `solution` (m, 3) by the residuals' `pull` (m, 3) and the prior; and the Cholesky factor."""
    size = len(solution)
    prior = np.full(size, stiffness)
    prior[rank:] = _STRAIN_RIDGE
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


def well_determined(factor: Array, rank: int, stiffness: float) -> float:
    """How many of the basis's coefficients the data determine rather than the prior."""
    is_basis = np.tile(np.arange(len(factor) // 3) < rank, 3)
    inverse, _ = dtrtri(factor, lower=1)
    return float(is_basis.sum() - stiffness * (inverse[:, is_basis] ** 2).sum())


def evident_alpha(determined: float, coefficients: Array) -> float:
    """The stiffness that the data speak for, from the `coefficients` C (r, 3) with another one.

    As many of them are `determined` by the data. Source: MacKay 1992, equation 4.9: alpha |C|² = that number.
    """
    return float(np.clip(determined / (coefficients**2).sum(), *_ALPHA_RANGE))
