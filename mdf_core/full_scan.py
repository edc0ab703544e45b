"""One last step of the surface stage over all the points of a scan that was thinned for the iterations.

Millions of points tell the motion from the noise far better than the thousands that found it, and by then all of them
lie so close to the surface that one step of Gauss-Newton is enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mdf_core.deformation import motion_features
from mdf_core.design_surface import DesignSurface
from mdf_core.geometry import Array
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.rigid import transform
from mdf_core.sampling import number_boxes
from mdf_core.surface import SurfaceFit, newton_step, normal_matrix, robust_sigma, tukey_weights
from mdf_core.threads import in_threads

_CHUNK = 65_536  # points at a time; bounds the memory
_CELL = 0.1  # of the kernel width: points of a cell that face alike share their row of the normal equations
_REACH = 10.0  # standard deviations; at half of that a point has no weight
_LEAST_SIGMA = 2e-5  # of the scale; a noise-free scan has no spread to divide by
_FACINGS = 8  # steps from -1 to 0 in which each component of a normal is told apart


@dataclass(frozen=True, eq=False)
class _Rows:
    """Sums over the points of a cell that face alike."""

    weight: Array  # (g,)
    place: Array  # (g, 3) mm, mean of the posed points, less their noise
    normal: Array  # (g, 3), mean
    offset: Array  # (g,) mm, mean distance to the surface that the motion so far leaves


def fit_full_scan(
    fit: SurfaceFit, points: Array, pose: Array, surface: DesignSurface, progress: ProgressCallback
) -> SurfaceFit:
    """The fit of a thinned scan after one more step that every point of the scan takes part in.

    Parameters
    ----------
    fit : SurfaceFit
        Of the thinned scan, converged.
    points : (n, 3) float64, mm
        The whole scan, in its own frame.
    pose : (4, 4) float64
        That the thinned scan was placed with.
    surface : DesignSurface
    progress : callable
        Called after every chunk; an exception it raises stops the work.

    Returns
    -------
    SurfaceFit
        `moved`, `closest` and `facing` remain those of the thinned scan; the motion, its stiffness and posterior are
        those of all points.

    Notes
    -----
    Points are moved and measured to the surface one by one; the rows of the normal equations are shared by points of a
    cell that is small against the kernel. Cost O(n · rank) and O(g · rank²) for g cells; memory 100 bytes per point.
    """
    rows, sigma = _rows(fit, points, pose, surface, progress)
    basis = fit.basis
    features = motion_features(basis, rows.place, fit.origin, fit.scale)
    matrix = normal_matrix(features, rows.normal, rows.weight)
    pull = features.T @ ((rows.weight * rows.offset / fit.scale)[:, None] * rows.normal)
    stiffness = fit.alpha * (sigma / fit.scale) ** 2
    solution, factor = newton_step(matrix, pull, fit.solution / fit.scale, len(basis.centres), stiffness)
    return replace(fit, solution=fit.scale * solution, factor=factor, sigma=sigma)


def _rows(
    fit: SurfaceFit, points: Array, pose: Array, surface: DesignSurface, progress: ProgressCallback
) -> tuple[_Rows, float]:
    motion = fit.motion()
    placed, moved = np.empty_like(points), np.empty_like(points)

    def move(chunk: slice) -> None:
        placed[chunk] = transform(pose, points[chunk])
        moved[chunk] = motion.apply(placed[chunk])

    for share in _in_chunks(len(points), move):
        progress(Progress("surface", 0.95 + 0.03 * share, 0, fit.sigma))
    # Points in a cell no larger than the distance between the surface's samples have the same neighbours.
    _, first, cell_of = np.unique(_cells(moved, surface.spacing, surface), return_index=True, return_inverse=True)
    # What is farther off counts for nothing, and looking for it would take longest.
    reach = _REACH * fit.sigma + 2.0 * surface.pitch
    candidates = surface.candidates(moved[first], reach=reach)
    distances, normals = np.empty(len(points)), np.empty_like(points)
    is_near = np.empty(len(points), dtype=np.bool_)

    def measure(chunk: slice) -> None:
        found = surface.closest_of(moved[chunk], candidates[cell_of[chunk]])
        closest = surface.checked(found, moved[chunk], None)
        distances[chunk], normals[chunk] = closest.distances, closest.normals
        is_near[chunk] = ((moved[chunk] - closest.points) ** 2).sum(axis=1) < reach**2

    for share in _in_chunks(len(points), measure):
        progress(Progress("surface", 0.98 + 0.02 * share, 0, fit.sigma))
    sigma = robust_sigma(distances[is_near]) if is_near.any() else fit.sigma
    sigma = max(sigma, _LEAST_SIGMA * fit.scale)
    weights = np.where(is_near, tukey_weights(distances, sigma), 0.0)
    placed -= np.where(weights > 0, distances, 0.0)[:, None] * normals
    return _grouped(_cells(placed, _CELL * fit.basis.width, surface), placed, normals, distances, weights), sigma


def _in_chunks(count: int, work: Callable[[slice], None]) -> Iterator[float]:
    """Do the work on `count` points chunk by chunk; yields the share that is done."""
    chunks = [slice(begin, begin + _CHUNK) for begin in range(0, count, _CHUNK)]
    for done, _ in enumerate(in_threads(work, chunks), 1):
        yield done / len(chunks)


def _cells(points: Array, edge: float, surface: DesignSurface) -> NDArray[np.int64]:
    """Which cell of a grid each point lies in, (n,); what is far from the part counts as lying on its border."""
    corners, margin = surface.design.triangles.reshape(-1, 3), surface.design.scale
    nearby = np.clip(points, corners.min(axis=0) - margin, corners.max(axis=0) + margin)
    cells = number_boxes(nearby.T, edge, nearby.min(axis=0))
    assert cells is not None  # the part has no more cells than samples or kernel widths
    return cells


def _grouped(cells: NDArray[np.int64], places: Array, normals: Array, distances: Array, weights: Array) -> _Rows:
    facings = np.round(_FACINGS * normals).astype(np.int64) + _FACINGS
    for axis in range(3):
        cells = cells * (2 * _FACINGS + 1) + facings[:, axis]
    row_of = np.unique(cells, return_inverse=True)[1].reshape(-1)
    weight = np.bincount(row_of, weights).astype(np.float64)

    def mean(values: Array) -> Array:
        sums = np.bincount(row_of, weights * values).astype(np.float64)
        return np.divide(sums, weight, out=np.zeros_like(sums), where=weight > 0)

    place, normal = (np.stack([mean(axis) for axis in vectors.T], axis=1) for vectors in (places, normals))
    return _Rows(weight, place, normal, mean(-distances))
