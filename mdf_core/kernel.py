"""The Gaussian motion kernel and its low-rank basis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.spatial.distance import cdist

from mdf_core.geometry import Array

NEGLIGIBLE_EXPONENT = 60.0
"""exp(-60) ~ 1e-26; beyond it denormals would cost up to 15x."""


def gaussian_kernel(a: Array, b: Array, width: float | Array) -> Array:
    """``exp(-|a_i - b_j|² / (2 width_j²))`` for all pairs.

    Parameters
    ----------
    a : (n, D) float64, mm
    b : (m, D) float64, mm
    width : float, or (m,) float64, mm

    Returns
    -------
    (n, m) float64

    Source: paper section 3.3, the matrix G; ``width`` = β · s.
    """
    exponents: Array = cdist(a, b, "sqeuclidean")
    exponents *= -0.5 / np.square(width)
    np.maximum(exponents, -NEGLIGIBLE_EXPONENT, out=exponents)
    return np.exp(exponents, out=exponents)


@dataclass(frozen=True, eq=False)
class KernelBasis:
    """Functions Φ of position such that Φ(a) Φ(b)ᵀ approximates the kernel between a and b.

    Attributes
    ----------
    centres : (r, D) float64, mm
    width : float, or (r,) float64, mm
        Of each centre's kernel.
    transform : (r, r) float64, or None
        Φ(y) = kernel(y, centres) @ transform; None is the identity: the plain kernel columns of a dense solve.
    """

    centres: Array
    width: float | Array
    transform: Array | None

    def __call__(self, points: Array) -> Array:
        """Φ at `points` (n, D) in mm, (n, r)."""
        values = gaussian_kernel(points, self.centres, self.width)
        return values if self.transform is None else values @ self.transform

    def weights(self, coefficients: Array) -> Array:
        """W (r, D) such that Φ(y) C = kernel(y, centres) W for `coefficients` C (r, D)."""
        return coefficients if self.transform is None else self.transform @ coefficients


def joined(bases: Sequence[KernelBasis]) -> KernelBasis:
    """The functions of all of them, low-rank bases of one width each, in one basis; of one it is that itself."""
    if len(bases) == 1:
        return bases[0]
    widths = [np.broadcast_to(basis.width, len(basis.centres)) for basis in bases]
    transform: Array = block_diag(*[np.asarray(basis.transform) for basis in bases])
    return KernelBasis(np.concatenate([basis.centres for basis in bases]), np.concatenate(widths), transform)


def low_rank_basis(points: Array, width: float, rank: int, tolerance: float = 1e-12) -> KernelBasis:
    """Basis of the kernel over `points` by pivoted Cholesky factorisation.

    Each pivot is the point that the basis so far explains worst, which makes the choice deterministic, spreads the
    centres over the part and leaves a known error: the largest remaining diagonal.

    Parameters
    ----------
    points : (n, D) float64, mm
    width : float, mm
    rank : int
        Most centres.
    tolerance : float
        Stop once no diagonal of the remainder exceeds this (the kernel's diagonal is 1).

    Notes
    -----
    Cost O(n · rank²), memory O(n · rank). Source: Harbrecht, Peters & Schneider 2012, Algorithm 1.
    """
    count = len(points)
    rank = min(rank, count)
    factor = np.empty((rank, count))
    remainder = np.ones(count)
    pivots: list[int] = []
    for step in range(rank):
        pivot = int(remainder.argmax())
        if remainder[pivot] <= tolerance:
            break
        column = gaussian_kernel(points[pivot : pivot + 1], points, width)[0]
        column -= factor[:step, pivot] @ factor[:step]
        column /= np.sqrt(remainder[pivot])
        factor[step] = column
        remainder -= column**2
        remainder[pivot] = 0.0
        pivots.append(pivot)
    # With K_LL = R Rᵀ the Nyström basis is k(y, L) R⁻ᵀ; R holds the factor at the pivots.
    triangle = factor[: len(pivots), pivots].T
    transform: Array = solve_triangular(triangle, np.eye(len(pivots)), lower=True).T
    return KernelBasis(points[pivots].copy(), width, transform)
