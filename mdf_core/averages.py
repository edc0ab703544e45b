"""Averages and spreads: weighted, and such that outliers hardly move them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdf_core.geometry import Array

TUKEY_LIMIT = 4.685
"""Of Tukey's biweight, in standard deviations: 95 % efficiency for Gaussian noise."""

_MEDIAN_TO_SIGMA = 1.4826  # a normal distribution's standard deviation over its median absolute deviation


def robust_sigma(values: Array) -> float:
    """Standard deviation of `values` (n,) about zero, 1.4826 times the median of their sizes; n ≥ 1."""
    return _MEDIAN_TO_SIGMA * float(np.median(np.abs(values)))


def noise_sigma(distances: Array, determined: float) -> float:
    """`robust_sigma` of the `distances` (n,) that a motion leaves which has spent `determined` degrees of freedom."""
    count = len(distances)
    return robust_sigma(distances) * float(np.sqrt(count / max(count - determined, 0.5 * count)))


def tukey_weights(distances: Array, sigma: float) -> Array:
    """Tukey's biweight of `distances` (n,) with standard deviation `sigma`: 1 at zero, 0 from 4.685 sigma on."""
    relative = np.minimum(np.abs(distances) / (TUKEY_LIMIT * sigma), 1.0)
    weights: Array = (1.0 - relative**2) ** 2
    return weights


def weighted_median(values: Array | NDArray[np.int64], weights: Array | NDArray[np.int64]) -> float:
    """The value (n,) that half of the `weights` (n,), none negative, lie on either side of."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def rms_length(vectors: Array, weights: Array) -> float:
    """Root of the weighted mean squared length of `vectors` (n, D), as `weighted_rms`."""
    return weighted_rms((vectors**2).sum(axis=1), weights)


def weighted_rms(squares: Array, weights: Array) -> float:
    """Root of the weighted mean of `squares` (n,); NaN if no weight is positive.

    Squares without a weight may be NaN. `weights` (n,) are not negative, such as the areas that the squares stand for.
    """
    counts = weights > 0
    if not counts.any():
        return float("nan")
    return float(np.sqrt(np.average(np.where(counts, squares, 0.0), weights=weights)))
