"""The Gaussian mixture of coherent point drift and its E-step, with equal or area-proportional components.

The moved scan points T_j are the centroids, the design points X_n the data. Component j has the prior w_j / m and the
variance w_j σ², so that a region counts by its area and not by how densely it was scanned; w_j = 1 is plain CPD.
Lengths are in one unit of the caller's choice; close to 1 and centred keeps the rounding small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array

_CHUNK_BYTES = 4 << 20  # size of one block of responsibilities; larger ones leave the cache and are slower
_NEGLIGIBLE_EXPONENT = 60.0  # exp(-60) ~ 1e-26; beyond it denormals would cost up to 15x
_LEAST_WEIGHT = 0.05  # of the mean; a smaller variance would make its point a spike, zero would divide by zero
_BOX_PADDING = 0.05  # of the diagonal on every side; gives planar and collinear data a volume
_LEAST_EXPLAINED = 1e-9  # share of the data; below it the M-step would divide by nothing


@dataclass(frozen=True, eq=False)
class Expectation:
    """What the M-step needs of the responsibilities P (m, N), which are never held as a whole.

    Attributes
    ----------
    mass : (m,) float64
        P~1 with P~ = diag(1/w) P.
    mean : (m, D) float64
        P~X / P~1, where each centroid is drawn to; the centroid itself where nothing draws it.
    spread : (m,) float64
        Σ_n p~_jn |X_n - mean_j|².
    explained : float
        N_P = 1ᵀP1, the number of data points that are not outliers.
    """

    mass: Array
    mean: Array
    spread: Array
    explained: float

    def variance(self, moved: Array) -> float:
        """σ² of the residuals to `moved` (m, D).

        Both parts are sums of non-negative terms: unlike the three traces that the paper prints, they cannot cancel
        to zero or below.

        Source: paper table 2, with N_P = 1ᵀP1 (the printed 1ᵀP~1 is not a number of points).
        """
        offsets = ((self.mean - moved) ** 2).sum(axis=1)
        return float((self.spread.sum() + self.mass @ offsets) / (moved.shape[1] * self.explained))


def expect(
    moved: Array, target: Array, weights: Array, variance: float, outlier_share: float, outlier_density: float
) -> Expectation:
    """The E-step.

    Parameters
    ----------
    moved : (m, D) float64
        Centroids T.
    target : (N, D) float64
        Data X.
    weights : (m,) float64
        Positive, mean 1.
    variance : float
        σ², positive.
    outlier_share : float
        w, in [0, 1).
    outlier_density : float
        u, density of the outliers.

    Raises
    ------
    RegistrationFailedError
        All data are outliers.

    Notes
    -----
    ``p_jn = w_j^(1-D/2) exp(-|X_n - T_j|² / (2 w_j σ²)) / {Σ_k w_k^(1-D/2) exp(-|X_n - T_k|² / (2 w_k σ²)) + c}`` with
    ``c = w / (1-w) (2πσ²)^(D/2) m u``. Exponents are taken relative to the largest of each data point, so that a point
    far from every centroid is shared out correctly even with w = 0.

    Cost O(m · N) time, memory O(m + N) plus one block of at most 4 MiB (or one row of m). Source: paper section 3.3,
    with the constant c moved out of the exponent and out of the sum.
    """
    count, dimension = moved.shape
    centre = target.mean(axis=0)
    moved_local, target_local = moved - centre, target - centre
    # log(w^(1-D/2)) - |x - t|² / (2 w σ²) for all pairs is one matrix product.
    stiffness = 0.5 / (weights * variance)
    constant = (1.0 - 0.5 * dimension) * np.log(weights) - stiffness * (moved_local**2).sum(axis=1)
    right = np.vstack([2.0 * stiffness * moved_local.T, -stiffness, constant])
    squares = (target_local**2).sum(axis=1, keepdims=True)
    left = np.hstack([target_local, squares, np.ones_like(squares)])
    outliers = outlier_share / (1.0 - outlier_share) * (2.0 * np.pi * variance) ** (0.5 * dimension)
    outliers *= count * outlier_density

    sums = np.zeros((dimension + 2, count))  # of p, p x and p |x|²
    rows = max(1, _CHUNK_BYTES // (8 * count))
    block = np.empty((min(rows, len(target)), count))
    for begin in range(0, len(target), rows):
        chunk = left[begin : begin + rows]
        kernel = np.matmul(chunk, right, out=block[: len(chunk)])
        largest = kernel.max(axis=1)
        kernel -= largest[:, None]
        np.maximum(kernel, -_NEGLIGIBLE_EXPONENT, out=kernel)
        np.exp(kernel, out=kernel)
        with np.errstate(over="ignore"):  # an infinite constant is an outlier for certain
            denominator = kernel.sum(axis=1) + (outliers * np.exp(-largest) if outliers else 0.0)
        features = np.hstack([chunk[:, -1:], chunk[:, :-1]])
        sums += (features / denominator[:, None]).T @ kernel

    probability = sums[0]
    explained = float(probability.sum())
    if not explained > _LEAST_EXPLAINED * len(target):
        raise RegistrationFailedError(
            "every design point counts as an outlier",
            "mixture",
            "check that the scan shows this part in this pose, or lower mixture.outlier_share",
        )
    attracted = probability > 0
    mean = moved_local.copy()
    np.divide(sums[1:-1].T, probability[:, None], out=mean, where=attracted[:, None])
    spread = np.maximum(sums[-1] - probability * (mean**2).sum(axis=1), 0.0) * attracted
    return Expectation(probability / weights, mean + centre, spread / weights, explained)


def initial_variance(centroids: Array, target: Array) -> float:
    """σ²_0, the mean squared distance of all pairs over D; zero only if all points coincide.

    Source: paper table 2, by the identity mean |x - y|² = var(x) + var(y) + |mean x - mean y|².
    """
    offset = centroids.mean(axis=0) - target.mean(axis=0)
    variances = centroids.var(axis=0) + target.var(axis=0)
    return float((variances + offset**2).sum() / target.shape[1])


def area_weights(areas: Array) -> Array:
    """w_j = area_j / mean area, none below a twentieth of the mean, with mean 1, (m,).

    Raises
    ------
    RegistrationFailedError
        A negative area, or none that is positive.
    """
    if not areas.min() >= 0 or not areas.max() > 0:
        raise RegistrationFailedError(
            f"point areas between {areas.min():g} and {areas.max():g} mm²",
            "scan areas",
            "give every point the area it stands for, or use method cpd",
        )
    relative: Array = np.maximum(areas / areas.mean(), _LEAST_WEIGHT)
    relative /= relative.mean()
    return relative


def box_density(target: Array) -> float:
    """u, one over the volume (D = 2: area) of the padded bounding box of `target` (N, D)."""
    extent = np.ptp(target, axis=0)
    diagonal = float(np.linalg.norm(extent)) or 1.0
    return float(1.0 / np.prod(extent + 2.0 * _BOX_PADDING * diagonal))
