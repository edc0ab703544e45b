"""The Gaussian mixture of coherent point drift and its E-step, with equal or area-proportional components.

The moved scan points T_j are the centroids, the design points X_n the data. Component j has the prior w_j / m and the
variance w_j σ², so that a region counts by its area and not by how densely it was scanned; w_j = 1 is plain CPD.
Lengths are in one unit of the caller's choice; close to 1 and centred keeps the rounding small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from mdf_core.data_cells import DataCells
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array
from mdf_core.kernel import NEGLIGIBLE_EXPONENT

_CHUNK_BYTES = 1 << 20  # of responsibilities at a time; more would leave the cache
_OUT_OF_REACH = 36.0  # exp(-36) ~ 2e-16, the rounding of 1
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
    log_likelihood : float
        Of the data given the centroids and σ; a lower bound of it where points share their responsibilities.
    """

    mass: Array
    mean: Array
    spread: Array
    explained: float
    log_likelihood: float

    def variance(self, moved: Array) -> float:
        """σ² of the residuals to `moved` (m, D).

        Both parts are sums of non-negative terms: unlike the three traces that the paper prints, they cannot cancel
        to zero or below.

        Source: paper table 2, with N_P = 1ᵀP1 (the printed 1ᵀP~1 is not a number of points).
        """
        offsets = ((self.mean - moved) ** 2).sum(axis=1)
        return float((self.spread.sum() + self.mass @ offsets) / (moved.shape[1] * self.explained))


def expect(
    moved: Array, cells: DataCells, weights: Array, variance: float, outlier_share: float, outlier_density: float
) -> Expectation:
    """The E-step.

    Parameters
    ----------
    moved : (m, D) float64
        Centroids T.
    cells : DataCells
        Data X. Points in one cell share their responsibilities.
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
    far from every centroid is shared out correctly even with w = 0. Each block of data looks only at the centroids
    within its reach, the responsibilities of the others being below e^-36, less than the rounding of 1; it finds them
    among those within reach of the block that it is half of.

    Cost O(m · N) time while σ is wide, O((m + N) log N) once it is narrow. Memory O(m + N) and one chunk of 1 MiB (or
    one row of m). Source: paper section 3.3, with the constant c moved out of the exponent and out of the sum; for
    shared responsibilities Verbeek, Nunnink & Vlassis 2006.
    """
    count, dimension = moved.shape
    local = moved - cells.origin
    # log(w^(1-D/2)) - |x - t|² / (2 w σ²) for all pairs is one matrix product.
    stiffness = 0.5 / (weights * variance)
    heights = (1.0 - 0.5 * dimension) * np.log(weights)
    right = np.vstack([2.0 * stiffness * local.T, -stiffness, heights - stiffness * (local**2).sum(axis=1)])
    outliers = outlier_share / (1.0 - outlier_share) * (2.0 * np.pi * variance) ** (0.5 * dimension)
    log_outliers = np.log(outliers * count * outlier_density) if outliers else -np.inf

    features = np.hstack([cells.means, cells.squares[:, None], np.ones((len(cells.means), 1))])
    sums = np.zeros((dimension + 2, count))  # of p x, p |x|² and p
    log_denominators = 0.0
    waiting = [(cells.blocks, np.arange(count))]
    while waiting:
        block, near = waiting.pop()
        distances = cdist(block.centre[None], local[near])[0]
        # Every point of the block has a term at least this large in its denominator.
        assured = max((heights[near] - stiffness[near] * (distances + block.radius) ** 2).max(), log_outliers)
        highest = heights[near] - stiffness[near] * np.maximum(distances - block.radius, 0.0) ** 2
        near = near[highest >= assured - _OUT_OF_REACH]
        inside = slice(block.begin, block.end)
        if len(near) == 0:
            log_denominators += cells.counts[inside].sum() * log_outliers
        elif block.halves:
            waiting.extend((half, near) for half in block.halves)
        else:
            shares, logs = _shared_out(features[inside], cells.counts[inside], right[:, near], log_outliers)
            sums[:, near] += shares
            log_denominators += logs

    probability = sums[-1]
    explained = float(probability.sum())
    points = cells.counts.sum()
    if not explained > _LEAST_EXPLAINED * points:
        raise RegistrationFailedError(
            "every design point counts as an outlier",
            "mixture",
            "check that the scan shows this part in this pose, or lower mixture.outlier_share",
        )
    attracted = probability > 0
    mean = local.copy()
    np.divide(sums[:-2].T, probability[:, None], out=mean, where=attracted[:, None])
    spread = np.maximum(sums[-2] - probability * (mean**2).sum(axis=1), 0.0) * attracted
    # What the denominators lack of the density of the data: (1-w) / m (2πσ²)^(-D/2).
    log_factor = np.log((1.0 - outlier_share) / count) - 0.5 * dimension * np.log(2.0 * np.pi * variance)
    log_likelihood = float(log_denominators + points * log_factor)
    return Expectation(probability / weights, mean + cells.origin, spread / weights, explained, log_likelihood)


def _shared_out(features: Array, counts: Array, right: Array, log_outliers: float) -> tuple[Array, float]:
    """Sums over cells of p x, p |x|² and p, (D+2, m), and of the logarithms of the denominators.

    `features` (n, D+2) and `counts` (n,) are those of the cells; `right` (D+2, m) has a column for every centroid
    within reach.
    """
    sums, log_denominators = np.zeros_like(right), 0.0
    rows = max(1, _CHUNK_BYTES // (8 * right.shape[1]))
    for begin in range(0, len(features), rows):
        chunk, points = features[begin : begin + rows], counts[begin : begin + rows]
        kernel = chunk @ right
        largest = np.maximum(kernel.max(axis=1), log_outliers)
        kernel -= largest[:, None]
        np.maximum(kernel, -NEGLIGIBLE_EXPONENT, out=kernel)
        np.exp(kernel, out=kernel)
        denominator = kernel.sum(axis=1) + np.exp(log_outliers - largest)
        sums += ((points / denominator)[:, None] * chunk).T @ kernel
        log_denominators += float(points @ (np.log(denominator) + largest))
    return sums, log_denominators


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
