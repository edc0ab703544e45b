"""A field known at scan points, interpolated to other points: the paper's alternatives to the deformation itself."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError, cKDTree

from mdf_core.errors import DegenerateScanError, InvalidSettingError
from mdf_core.geometry import Array


def interpolate(points: Array, values: Array, queries: Array, method: str, neighbours: int) -> Array:
    """`values` at `queries`.

    Parameters
    ----------
    points : (m, D) float64, mm
        Where the values are known, at least one.
    values : (m, K) float64
    queries : (n, D) float64, mm
    method : str
        knn: mean of the nearest points. inverse_distance: mean of the nearest points weighted by one over the squared
        distance, exact at a point. linear: barycentric in the Delaunay simplices.
    neighbours : int
        Nearest points for knn and inverse_distance; all points where there are fewer.

    Returns
    -------
    (n, K) float64
        NaN outside the convex hull of the points for linear.

    Raises
    ------
    InvalidSettingError
        An unknown method.
    DegenerateScanError
        Too few points, or points on one line or plane, for linear.

    Notes
    -----
    Source: paper section 4.2 (linear and k-nearest-neighbour regression).
    """
    if method == "linear":
        return _linear(points, values, queries)
    if method not in ("knn", "inverse_distance"):
        raise InvalidSettingError(
            f"unknown value {method!r}", "setting interpolation.method", "use one of knn, linear, inverse_distance"
        )
    nearest = np.arange(1, min(neighbours, len(points)) + 1)
    found = cKDTree(points).query(queries, k=nearest)
    distances, index = np.asarray(found[0]), np.asarray(found[1])
    if method == "knn":
        means: Array = values[index].mean(axis=1)
        return means
    # Relative to the nearest, so that no distance is too small or too large to be squared; 0/0 is a coincidence.
    with np.errstate(invalid="ignore"):
        ratios = distances[:, :1] / distances
    weights = np.where(distances == 0.0, 1.0, ratios**2)
    weights /= weights.sum(axis=1, keepdims=True)
    weighted: Array = np.einsum("nk,nkc->nc", weights, values[index])
    return weighted


def _linear(points: Array, values: Array, queries: Array) -> Array:
    try:
        result: Array = LinearNDInterpolator(points, values)(queries)
    except (QhullError, ValueError):
        raise DegenerateScanError(
            f"{len(points)} points do not span the space",
            "interpolation",
            "use knn, inverse_distance or deformation as interpolation.method",
        ) from None
    return result
