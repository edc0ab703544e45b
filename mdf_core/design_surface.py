"""Closest points on the design's triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from mdf_core.geometry import Array, Design

_CANDIDATES = 4
_REACH = 0.5  # of the scale: how far, in position and normal, a surface is looked for on the point's own side
_FEW_POINTS = 5_000  # not worth starting threads
_NORMAL_WEIGHT = 0.15  # of the scale: half the distance that opposite faces are set apart by


@dataclass(frozen=True, eq=False)
class Closest:
    """Feet of perpendiculars on the design surface.

    Attributes
    ----------
    points : (n, 3) float64, mm
    normals : (n, 3) float64
        Of the triangles hit.
    distances : (n,) float64, mm
        Along the normal, positive outside the material.
    """

    points: Array
    normals: Array
    distances: Array


class DesignSurface:
    """The design as a surface that can be asked for its closest point.

    A k-d tree of evenly spread surface samples proposes triangles, the exact distance to those decides. Asked with
    normals, the tree spans position and normal together, so that both faces of a thin wall are told apart.

    Parameters
    ----------
    design : Design
    samples : int
        About as many; the more, the surer the triangle found is the closest.

    Notes
    -----
    Building costs O(m log m) for m samples, a query O(n log m).
    """

    def __init__(self, design: Design, samples: int = 150_000) -> None:
        self.design = design
        self._samples, self._faces = spread_samples(design, samples)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self._samples, balanced_tree=False)

    @cached_property
    def _sided_tree(self) -> KDTree:
        return KDTree(self._sided(self._samples, self.design.face_normals[self._faces]), balanced_tree=False)

    def _sided(self, points: Array, normals: Array) -> Array:
        return np.hstack([points, _NORMAL_WEIGHT * self.design.scale * normals])

    def closest(self, points: Array, normals: Array | None = None) -> Closest:
        """Closest surface points to `points` (n, 3) mm; with `normals` (n, 3) on surfaces that face along them."""
        workers = -1 if len(points) > _FEW_POINTS else 1
        if normals is None:
            index = np.asarray(self._tree.query(points, k=_CANDIDATES, workers=workers)[1])
        else:
            reach = _REACH * self.design.scale
            keys = self._sided(points, normals)
            query = self._sided_tree.query(keys, k=_CANDIDATES, distance_upper_bound=reach, workers=workers)
            index = np.asarray(query[1])
            # Far from every surface its side does not matter, and looking for it would cost most of the time.
            far = index[:, 0] == len(self._faces)
            index[far] = np.asarray(self._tree.query(points[far], workers=workers)[1])[:, None]
            index = np.where(index == len(self._faces), index[:, :1], index)
        candidates = self._faces[index]
        feet = np.empty((len(points), 3))
        best = np.full(len(points), np.inf)
        faces = candidates[:, 0].copy()
        for column in range(_CANDIDATES):
            trial = candidates[:, column]
            # Neighbouring samples mostly lie on the same triangle: ask each triangle once.
            new = np.flatnonzero((trial[:, None] != candidates[:, :column]).all(axis=1))
            foot = closest_point(self.design.triangles[trial[new]], points[new])
            squares = ((points[new] - foot) ** 2).sum(axis=1)
            better = squares < best[new]
            chosen = new[better]
            best[chosen], feet[chosen], faces[chosen] = squares[better], foot[better], trial[chosen]
        face_normals = self.design.face_normals[faces]
        return Closest(feet, face_normals, ((points - feet) * face_normals).sum(axis=1))


def spread_samples(design: Design, count: int) -> tuple[Array, NDArray[np.int64]]:
    """About `count` points spread evenly over the design's surface, the same at every call.

    Returns
    -------
    points : (m, 3) float64, mm
    faces : (m,) int64
        The triangle each lies on; every triangle with an area has at least one.
    """
    areas = design.face_areas
    wanted = areas / areas.sum() * count
    counts = np.where(areas > 0, np.maximum(np.round(wanted), 1), 0).astype(np.int64)
    faces = np.repeat(np.arange(len(areas)), counts)
    # Within each triangle the points follow the additive recurrence of the plastic number, a low-discrepancy sequence.
    within = np.arange(len(faces)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = (0.5 + 0.7548776662466927 * within) % 1.0
    second = (0.5 + 0.5698402909980532 * within) % 1.0
    root = np.sqrt(first)
    # A triangle with a single sample gets it at its centroid.
    single = counts[faces] == 1
    root[single], second[single] = 2.0 / 3.0, 0.5
    corners = design.triangles[faces]
    weights = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    return np.einsum("ni,nij->nj", weights, corners), faces
