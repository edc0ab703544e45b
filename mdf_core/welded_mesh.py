"""The design as the checks of a redesign look at it: its faces joined, its bodies found, its slivers known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mdf_core.check_result import Place, place_of
from mdf_core.connectivity import connected_groups
from mdf_core.geometry import Array, Design, crosses_of, volumes_of

Index = NDArray[np.int64]

_ROUNDING = 4.0  # float32 spacings at the design's largest coordinate: more than rounding changes any length by
_SLIVER_HEIGHT, _SLIVER_SHAPE = 1e-3, 0.1  # of the design's scale and of the face's longest edge


@dataclass(frozen=True, eq=False)
class WeldedMesh:
    """The faces of a design joined where their corners lie on the same spot.

    Attributes
    ----------
    design : Design
    """

    design: Design

    @cached_property
    def used(self) -> Index:
        """The vertices that faces use, in order."""
        return np.unique(self.design.faces)

    @cached_property
    def spots(self) -> Index:
        """See `spots_of`; in the design."""
        return self.spots_of(self.design.vertices)

    @cached_property
    def faces(self) -> Index:
        """The design's faces, the corners on one spot named by the same vertex, (f, 3)."""
        return self.spots[self.design.faces]

    def spots_of(self, vertices: Array) -> Index:
        """For each of `vertices` (n, 3) the first one on the same spot, (n,); those that no face uses are left out."""
        spots = np.arange(len(vertices))
        _, first, inverse = np.unique(vertices[self.used], axis=0, return_index=True, return_inverse=True)
        spots[self.used] = self.used[first[inverse.reshape(-1)]]
        return spots

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge joins exactly two faces."""
        return is_closed(self.faces)

    @cached_property
    def bodies(self) -> Index:
        """The connected body that each face belongs to, (f,), numbered from 0."""
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]]])
        groups = connected_groups(edges, len(self.design.vertices))
        return np.unique(groups[self.faces[:, 0]], return_inverse=True)[1].reshape(-1)

    @cached_property
    def first_faces(self) -> Index:
        """The first face of each body, (b,)."""
        return np.unique(self.bodies, return_index=True)[1]

    @cached_property
    def rounding(self) -> float:
        """Changes of a length below this many mm are rounding."""
        return _ROUNDING * float(np.spacing(np.float32(np.abs(self.design.vertices[self.used]).max())))

    @cached_property
    def heights(self) -> Array:
        """Smallest height of every face, (f,) mm."""
        return heights_of(self.design.triangles)

    @cached_property
    def sliver_height(self) -> float:
        """Slivers are thinner than this, mm."""
        return _SLIVER_HEIGHT * self.design.scale

    @cached_property
    def is_sliver(self) -> NDArray[np.bool_]:
        """Faces whose shape and direction mean nothing, (f,): thin and long, or no thicker than rounding may be."""
        longest = edge_lengths(self.design.triangles).max(axis=1)
        is_thin = (self.heights <= self.sliver_height) & (self.heights <= _SLIVER_SHAPE * longest)
        sliver: NDArray[np.bool_] = is_thin | (self.heights <= 4.0 * self.rounding)
        return sliver

    def centroid(self, face: int) -> Place:
        """Centroid of a face in the design."""
        return place_of(self.design.triangles[face].mean(axis=0))

    def slivers_left(self, moved: Array) -> NDArray[np.bool_]:
        """Slivers of the design that are no thicker with the vertices `moved` (n, 3) mm either, (f,)."""
        left: NDArray[np.bool_] = self.is_sliver & (heights_of(moved[self.design.faces]) <= self.sliver_height)
        return left

    def turns(self, moved: Array) -> Array:
        """Angle between every face's normals in the design and with the vertices `moved` (n, 3) mm, (f,) degrees.

        90 where the face had no area, 0 where it has none left.
        """
        crosses = crosses_of(moved[self.design.faces])
        lengths = np.linalg.norm(crosses, axis=1)
        cosines = np.ones(len(crosses))
        np.divide(np.einsum("fi,fi->f", crosses, self.design.face_normals), lengths, out=cosines, where=lengths > 0)
        turns: Array = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
        return turns

    def body_volumes(self, triangles: Array) -> Array:
        """Volume of each body, (b,) mm³, from all `triangles` (f, 3, 3) mm; means something for closed bodies only."""
        return np.bincount(self.bodies, volumes_of(triangles - self.design.centre)) / 6.0


def is_closed(faces: Index) -> bool:
    """Whether every edge joins exactly two of `faces` (f, 3); those that name a vertex twice have no say."""
    has_three_corners = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    ends = np.sort(faces[has_three_corners][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(ends[:, 0] * (faces.max() + 1) + ends[:, 1], return_counts=True)
    return bool((counts == 2).all())


def edge_lengths(triangles: Array) -> Array:
    """Of the edges from each corner of `triangles` (f, 3, 3) to the next, (f, 3)."""
    lengths: Array = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    return lengths


def heights_of(triangles: Array) -> Array:
    """Smallest height of `triangles` (f, 3, 3), (f,); zero where there is no area."""
    double_areas = np.linalg.norm(crosses_of(triangles), axis=1)
    longest = edge_lengths(triangles).max(axis=1)
    heights: Array = np.divide(double_areas, longest, out=np.zeros_like(longest), where=longest > 0)
    return heights
