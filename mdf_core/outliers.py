"""Which scan points are no part of the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.averages import robust_sigma
from mdf_core.geometry import Array
from mdf_core.settings import OutlierSettings

_NEIGHBOURS = 8  # that a displacement is compared with
_EPSILON_MM = 0.01  # the displacement's noise, below which differences mean nothing


def surface_distance_test(distance: Array, settings: OutlierSettings) -> NDArray[np.bool_]:
    """Points whose registered position is far from the design surface.

    Parameters
    ----------
    distance : (n,) float64, mm
        Distance of T(y) to the surface, signed or not; NaN is an outlier.
    settings : OutlierSettings
        `threshold` in robust standard deviations and `floor_mm`.

    Returns
    -------
    (n,) bool
        True where |distance| > max(threshold · 1.4826 · median |distance|, floor_mm).
    """
    lengths = np.abs(distance)
    finite = lengths[np.isfinite(lengths)]
    sigma = robust_sigma(finite) if len(finite) else 0.0
    limit = max(settings.threshold * sigma, settings.floor_mm)
    is_outlier: NDArray[np.bool_] = ~(lengths <= limit)
    return is_outlier


def normalized_median_test(points: Array, displacement: Array, threshold: float) -> NDArray[np.bool_]:
    """Points whose displacement differs from that of their neighbours.

    Finds rough displacements only: the displacement that a registration yields is smooth by construction, also at
    points that are no part of the surface. `surface_distance_test` finds those.

    Parameters
    ----------
    points : (n, D) float64, mm
    displacement : (n, D) float64, mm
    threshold : float
        Limit of the normalised residual r*; 2 in the paper.

    Returns
    -------
    (n,) bool

    Notes
    -----
    ``r* = |U_0 / (d~ + ε) - med(U_i / (d_i + ε))| / (med |U_i / (d_i + ε) - med(U_i / (d_i + ε))| + ε / (d~ + ε))``
    with d_i the distance to neighbour i of the nearest 8, d~ their median and ε = 0.01 mm; medians of vectors are taken
    per component. The paper adds a bare ε, a length, to the denominator, which has none.

    Cost O(n) memory and O(n log n) time. Source: paper section 4.2; Westerweel & Scarano 2005;
    Duncan et al. 2010.
    """
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    if neighbours < 1:
        return np.zeros(len(points), dtype=np.bool_)
    found = KDTree(points).query(points, k=neighbours + 1)
    distances, index = _without_self(np.asarray(found[0]), np.asarray(found[1]))
    typical = np.median(distances, axis=1) + _EPSILON_MM
    rates = displacement[index] / (distances + _EPSILON_MM)[:, :, None]
    median = np.median(rates, axis=1)
    fluctuation = np.median(np.linalg.norm(rates - median[:, None], axis=2), axis=1)
    residual = np.linalg.norm(displacement / typical[:, None] - median, axis=1)
    is_outlier: NDArray[np.bool_] = residual > threshold * (fluctuation + _EPSILON_MM / typical)
    return is_outlier


def _without_self(distances: Array, index: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """Neighbours (n, k+1) without the point itself, which duplicates may push off the first place, (n, k)."""
    count, columns = index.shape
    own = index == np.arange(count)[:, None]
    own[~own.any(axis=1), -1] = True  # more duplicates than neighbours: drop one of them instead
    return distances[~own].reshape(count, columns - 1), index[~own].reshape(count, columns - 1)
