"""Designs of several pieces: which face belongs to which, and a motion for each.

What moves one piece tells nothing about another that does not touch it: each is registered on its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.connectivity import connected_groups
from mdf_core.deformation import Deformation, without_rigid_part
from mdf_core.design_surface import spread_samples
from mdf_core.geometry import Array, Design
from mdf_core.rigid import transform

_SAMPLES = 20_000
_SAME_VERTEX = 1e-6  # of the scale: corners this close are one
_TOUCH = 0.01  # of the scale: bodies this close are taken for one piece


def split_design(design: Design) -> list[Design]:
    """The pieces of a design, largest first; the design itself where there is only one.

    A piece is a closed body, with everything that touches it, and with the cavities and open patches nearest to it:
    a mesh whose patches are not stitched together remains one piece.

    Notes
    -----
    Cost O(f log f) for f faces.
    """
    body_of_face, count = _bodies(design)
    if count < 2:
        return [design]
    samples, faces = spread_samples(design, _SAMPLES)
    body = body_of_face[faces]
    reach = _TOUCH * design.scale + np.sqrt(design.face_areas.sum() / len(samples))
    pairs = KDTree(samples).query_pairs(reach, output_type="ndarray")
    touching = body[pairs][(body[pairs[:, 0]] != body[pairs[:, 1]]) & (body[pairs] >= 0).all(axis=1)]
    piece_of_body = connected_groups(touching, count)
    if piece_of_body.max() == 0:
        return [design]
    # Cavities and open patches belong to the nearest body.
    inside = body >= 0
    homeless = body_of_face < 0
    nearest = KDTree(samples[inside]).query(design.triangles[homeless].mean(axis=1))[1]
    body_of_face[homeless] = body[inside][nearest]
    piece_of_face = piece_of_body[body_of_face]
    areas = np.bincount(piece_of_face, design.face_areas)
    return [_part(design, piece_of_face == piece) for piece in np.argsort(-areas, kind="stable")]


def _bodies(design: Design) -> tuple[NDArray[np.intp], int]:
    """Number of the closed body that each face bounds from outside, -1 for other faces, (f,); and how many bodies."""
    rounded = np.round(design.vertices / (_SAME_VERTEX * design.scale)).astype(np.int64)
    corner = np.zeros(len(rounded), dtype=np.int64)
    for coordinate in rounded.T:  # three sorts of numbers cost a tenth of one of rows
        number = np.unique(coordinate, return_inverse=True)[1]
        corner = np.unique(corner * len(rounded) + number, return_inverse=True)[1]
    faces = corner[design.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    size = int(corner.max()) + 1
    shell_of_corner = connected_groups(edges, size)
    shell_of_face = shell_of_corner[faces[:, 0]]
    _, edge_number, uses = np.unique(edges[:, 0] * size + edges[:, 1], return_inverse=True, return_counts=True)
    shells = int(shell_of_corner.max()) + 1
    torn = np.bincount(shell_of_corner[edges[:, 0]], uses[edge_number] % 2, minlength=shells)
    volume = np.bincount(shell_of_face, design.face_volumes, minlength=shells)
    is_body = (torn == 0) & (volume > 0)
    number = np.where(is_body, np.cumsum(is_body) - 1, -1)
    return number[shell_of_face], int(is_body.sum())


def _part(design: Design, chosen: NDArray[np.bool_]) -> Design:
    used, faces = np.unique(design.faces[chosen], return_inverse=True)
    return Design(design.vertices[used], faces.reshape(-1, 3), design.path, design.file_sha256)


@dataclass(frozen=True, eq=False)
class PiecewiseDeformation:
    """A deformation for each piece of a design; points belong to the piece whose surface is nearest.

    Attributes
    ----------
    pieces : tuple of Design
    deformations : tuple of Deformation
        One per piece, all with the same `start` and `datum`.
    """

    pieces: tuple[Design, ...]
    deformations: tuple[Deformation, ...]

    @property
    def pose(self) -> Array:
        """T_design_scan, the rigid part of the registration, (4, 4)."""
        return self.deformations[0].pose

    def framed(self, start: Array, datum: Array) -> PiecewiseDeformation:
        """The same motions with other frames, see `Deformation.framed`."""
        return replace(self, deformations=tuple(one.framed(start, datum) for one in self.deformations))

    def without_rigid_part(self, design_points: Array, weights: Array) -> PiecewiseDeformation:
        """See `Deformation.without_rigid_part`: how the pieces lie to each other is no rigid part."""
        piece = self.piece_of(design_points)
        owns = [piece == number for number in range(len(self.pieces))]
        points, shares = [design_points[own] for own in owns], [weights[own] for own in owns]
        return replace(self, deformations=without_rigid_part(self.deformations, points, shares))

    def apply(self, points: Array) -> Array:
        """See `Deformation.apply`."""
        piece = self.piece_of(transform(self.deformations[0].start, points))
        return self._by_piece(points, piece, Deformation.apply)

    def displacement_at(self, design_points: Array) -> Array:
        """See `Deformation.displacement_at`."""
        return self._by_piece(design_points, self.piece_of(design_points), Deformation.displacement_at)

    def inverse_displacement_at(self, design_points: Array) -> Array:
        """See `Deformation.inverse_displacement_at`."""
        return self._by_piece(design_points, self.piece_of(design_points), Deformation.inverse_displacement_at)

    def std(self, design_points: Array) -> Array:
        """See `Deformation.std`."""
        return self._by_piece(design_points, self.piece_of(design_points), Deformation.std)

    def piece_of(self, points: Array) -> NDArray[np.int64]:
        """Number of the piece nearest to each of `points` (n, 3) mm in the design frame, (n,)."""
        tree, piece = self._samples
        numbers: NDArray[np.int64] = piece[np.asarray(tree.query(points, workers=-1)[1])]
        return numbers

    @cached_property
    def _samples(self) -> tuple[KDTree, NDArray[np.int64]]:
        clouds = [spread_samples(piece, _SAMPLES)[0] for piece in self.pieces]
        numbers = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        return KDTree(np.concatenate(clouds), balanced_tree=False), numbers

    def _by_piece(
        self, points: Array, piece: NDArray[np.int64], evaluate: Callable[[Deformation, Array], Array]
    ) -> Array:
        values = [evaluate(one, points[piece == number]) for number, one in enumerate(self.deformations)]
        result = np.empty((len(points), *values[0].shape[1:]))
        for number, value in enumerate(values):
            result[piece == number] = value
        return result
