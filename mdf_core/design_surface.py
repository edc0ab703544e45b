"""Closest points on the design's triangles."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from mdf_core.edges import Edges
from mdf_core.geometry import Array, Design, members_of

_CANDIDATES, _MANY_CANDIDATES = 4, 24
_REACH = 0.5  # of the scale: how far, in position and normal, a surface is looked for on the point's own side
# Of the samples' spacing: from farther away, one of so many samples tells well enough what is nearest.
_FAR, _STRIDE = 8.0, 8
_NEAR_SLACK, _FAR_SLACK = 0.5, 0.1  # of the samples' spacing and of the distance to the surface
# Of the samples' spacing: farther beside its triangle than the one a point may lie on the next triangle, and farther
# away than the other it does not matter.
_BESIDE, _CLOSE = 0.01, 4.0
_FEW_POINTS = 5_000  # not worth starting threads
_NORMAL_WEIGHT = 0.15  # of the scale: half the distance that opposite faces are set apart by


class Closest(NamedTuple):
    """Feet of perpendiculars on the design surface.

    Attributes
    ----------
    points : (n, 3) float64, mm
    normals : (n, 3) float64
        Of the triangles hit.
    distances : (n,) float64, mm
        Along the normal, positive outside the material.
    faces : (n,) int64
        The triangles hit.
    """

    points: Array
    normals: Array
    distances: Array
    faces: NDArray[np.int64]


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

    def __init__(self, design: Design, samples: int = 60_000) -> None:
        self.design = design
        self._samples, self._faces = spread_samples(design, samples, least=1)
        self.spacing = float(np.sqrt(design.face_areas.sum() / len(self._samples)))
        # Of the samples on large triangles; where triangles are small there is one on each, and they are closer.
        self.pitch = float(np.sqrt(design.face_areas.sum() / samples))
        self._tree = KDTree(self._samples, balanced_tree=False)
        sided = self._sided(self._samples, design.face_normals[self._faces])
        self._sided_tree = KDTree(sided, balanced_tree=False)
        self._coarse_sided_tree = KDTree(sided[::_STRIDE], balanced_tree=False)
        self._corners = np.ascontiguousarray(design.triangles[:, 0])
        self._duals = _duals(design.triangles)

    def _sided(self, points: Array, normals: Array) -> Array:
        return np.hstack([points, _NORMAL_WEIGHT * self.design.scale * normals])

    def closest(self, points: Array, normals: Array | None = None) -> Closest:
        """Closest surface points to `points` (n, 3) mm; with `normals` (n, 3) on surfaces that face along them."""
        return self.checked(self.closest_of(points, self._candidates(points, normals, _CANDIDATES)), points, normals)

    @cached_property
    def edges(self) -> Edges:
        """Where faces meet at an angle."""
        return Edges.of(self.design, self.spacing)

    def closest_within(self, points: Array, reach: float) -> Closest:
        """Closest surface points to `points` (n, 3) mm; any, of points from which no sample is within `reach` mm.

        Looking for those would cost most.
        """
        return self.checked(self.closest_of(points, self._nearest(points, _CANDIDATES, reach)), points, None)

    def sided_candidates(self, points: Array, normals: Array, count: int = _CANDIDATES) -> NDArray[np.int64]:
        """Faces of the `count` samples nearest to each point among those that face along its normal, (n, count)."""
        keys, workers, none = self._sided(points, normals), _workers(points), len(self._faces)
        near, reach = _FAR * self.spacing, _REACH * self.design.scale
        index = np.asarray(self._sided_tree.query(keys, count, distance_upper_bound=near, workers=workers)[1])
        # Looking for what is far would cost most of the time.
        far = np.flatnonzero(index[:, 0] == none)
        coarse = self._coarse_sided_tree.query(keys[far], count, distance_upper_bound=reach, workers=workers)[1]
        index[far] = np.minimum(_STRIDE * np.asarray(coarse), none)
        # Farther still its side does not matter.
        far = far[index[far, 0] == none]
        index[far] = np.asarray(self._tree.query(points[far], workers=workers)[1])[:, None]
        index = np.where(index == none, index[:, :1], index)
        found: NDArray[np.int64] = self._faces[index]
        return found

    def _nearest(self, points: Array, count: int, reach: float = np.inf) -> NDArray[np.int64]:
        """Faces of the `count` samples nearest to each point, (n, count); any where none is within `reach` mm."""
        query = self._tree.query(points, k=count, distance_upper_bound=reach, workers=_workers(points))
        found: NDArray[np.int64] = self._faces[np.asarray(query[1]) % len(self._faces)]
        return found

    def _candidates(self, points: Array, normals: Array | None, count: int) -> NDArray[np.int64]:
        return self._nearest(points, count) if normals is None else self.sided_candidates(points, normals, count)

    def closest_of(self, points: Array, candidates: NDArray[np.int64]) -> Closest:
        """Closest points to `points` (n, 3) mm on the faces `candidates` (n, k)."""
        nowhere = np.full(len(points), -1)
        start = np.empty((len(points), 3)), np.full(len(points), np.inf), nowhere
        # The first is mostly the closest, which rules out most others.
        first = self._closer(points, candidates[:, :1], *start)
        feet, _, faces = self._closer(points, candidates[:, 1:], *first)
        return self._on_faces(points, feet, faces)

    def _closer(
        self, points: Array, candidates: NDArray[np.int64], feet: Array, squares: Array, faces: NDArray[np.int64]
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """`feet`, their squared distances and their `faces`; changed where one of the `candidates` is closer."""
        # Neighbouring samples mostly lie on the same triangle: ask each triangle once.
        is_new = candidates != faces[:, None]
        for column in range(1, candidates.shape[1]):
            is_new[:, column] &= (candidates[:, :column] != candidates[:, column, None]).all(axis=1)
        rows, columns = np.nonzero(is_new)
        asked = candidates[rows, columns]
        heights = np.einsum("ij,ij->i", points[rows] - self._corners[asked], self.design.face_normals[asked])
        # No point of a triangle is closer than its plane.
        is_near = heights**2 < squares[rows]
        rows, columns, asked, heights = rows[is_near], columns[is_near], asked[is_near], heights[is_near]
        found = self._feet(points[rows], asked, heights)
        trials = np.full(candidates.shape, np.inf)
        trials[rows, columns] = ((points[rows] - found) ** 2).sum(axis=1)
        number = np.empty(candidates.shape, dtype=np.intp)
        number[rows, columns] = np.arange(len(rows))
        best = trials.argmin(axis=1)[:, None]
        least = np.take_along_axis(trials, best, axis=1)[:, 0]
        better = np.flatnonzero(least < squares)
        chosen = np.take_along_axis(number, best, axis=1)[better, 0]
        feet[better], squares[better], faces[better] = found[chosen], least[better], asked[chosen]
        return feet, squares, faces

    def _on_faces(self, points: Array, feet: Array, faces: NDArray[np.int64]) -> Closest:
        normals = self.design.face_normals[faces]
        return Closest(feet, normals, ((points - feet) * normals).sum(axis=1), faces)

    def _feet(self, points: Array, faces: NDArray[np.int64], heights: Array) -> Array:
        """Closest point to each of `points` (n, 3), `heights` (n,) above its face's plane, on that face, (n, 3)."""
        feet: Array = points - heights[:, None] * self.design.face_normals[faces]
        shares = np.einsum("ij,ikj->ik", feet - self._corners[faces], self._duals[faces])
        beside = np.flatnonzero(~((shares.min(axis=1) >= 0.0) & (shares.sum(axis=1) <= 1.0)))
        feet[beside] = closest_point(self.design.triangles[faces[beside]], points[beside])
        return feet

    def checked(self, closest: Closest, points: Array, normals: Array | None) -> Closest:
        """`closest`, but looked for among many more faces where the points lie beside the face that was found.

        Over the middle of a face there is none closer; beside it the next one may be, without a sample close by.
        """
        offsets = points - closest.points
        squares = np.einsum("ij,ij->i", offsets, offsets)
        is_beside = squares - closest.distances**2 > (_BESIDE * self.spacing) ** 2
        which = np.flatnonzero(is_beside & (squares < (_CLOSE * self.spacing) ** 2))
        normals = None if normals is None else normals[which]
        more = self._candidates(points[which], normals, _MANY_CANDIDATES)
        feet, _, faces = self._closer(points[which], more, closest.points[which], squares[which], closest.faces[which])
        for kept, new in zip(closest, self._on_faces(points[which], feet, faces), strict=True):
            kept[which] = new
        return closest


def _workers(points: Array) -> int:
    return -1 if len(points) > _FEW_POINTS else 1


def _duals(triangles: Array) -> Array:
    """Vectors whose products with a place in the triangle, seen from its corner, are its shares, (f, 2, 3)."""
    edges = triangles[:, 1:] - triangles[:, :1]
    gram = np.einsum("fij,fkj->fik", edges, edges)
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    crossed = np.stack(
        [
            gram[:, 1, 1, None] * edges[:, 0] - gram[:, 0, 1, None] * edges[:, 1],
            gram[:, 0, 0, None] * edges[:, 1] - gram[:, 0, 1, None] * edges[:, 0],
        ],
        axis=1,
    )
    flat = determinant <= 0.0  # no share of such a triangle is known: every point lies beside it
    return np.where(flat[:, None, None], np.nan, crossed / np.where(flat, 1.0, determinant)[:, None, None])


class SurfaceTracker:
    """Closest surface points of a cloud that is asked for again and again while it moves.

    The k-d tree is asked only for points that have left the place where it was last asked for them by half the
    distance between its samples or, far from the surface, by a tenth of their distance.

    Parameters
    ----------
    surface : DesignSurface
    normals : (n, 3) float64
        Of the cloud, outward.
    """

    def __init__(self, surface: DesignSurface, normals: Array) -> None:
        self.surface = surface
        self.normals = normals
        self._anchors = np.full_like(normals, np.nan)
        self._slack = np.zeros(len(normals))
        self._candidates = np.zeros((len(normals), _CANDIDATES), dtype=np.int64)

    def closest(self, points: Array) -> Closest:
        """Closest surface points to the cloud, now at `points` (n, 3) mm."""
        away = np.einsum("ij,ij->i", points - self._anchors, points - self._anchors)
        asked = np.flatnonzero(~(away <= self._slack**2))  # NaN: never asked before
        self._candidates[asked] = self.surface.sided_candidates(points[asked], self.normals[asked])
        self._anchors[asked] = points[asked]
        found = self.surface.closest_of(points, self._candidates)
        closest = self.surface.checked(found, points, self.normals)
        self._candidates[:, -1] = closest.faces
        distances = np.abs(closest.distances[asked])
        self._slack[asked] = np.maximum(_NEAR_SLACK * self.surface.spacing, _FAR_SLACK * distances)
        return closest


def spread_samples(design: Design, count: int, least: int = 0) -> tuple[Array, NDArray[np.int64]]:
    """`count` points spread evenly over the design's surface, the same at every call.

    Parameters
    ----------
    design : Design
    count : int
    least : int
        Fewest points of any triangle with an area; they come on top of `count`.

    Returns
    -------
    points : (m, 3) float64, mm
    faces : (m,) int64
        The triangle each lies on.
    """
    areas = design.face_areas
    shares = np.round(np.cumsum(areas) / areas.sum() * count)
    counts = np.maximum(np.diff(shares, prepend=0.0), np.where(areas > 0, least, 0)).astype(np.int64)
    faces, within = members_of(counts)
    # Within each triangle the points follow the additive recurrence of the plastic number, a low-discrepancy sequence.
    first = (0.5 + 0.7548776662466927 * within) % 1.0
    second = (0.5 + 0.5698402909980532 * within) % 1.0
    root = np.sqrt(first)
    # A triangle with a single sample gets it at its centroid.
    single = counts[faces] == 1
    root[single], second[single] = 2.0 / 3.0, 0.5
    corners = design.triangles[faces]
    weights = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    return np.einsum("ni,nij->nj", weights, corners), faces
