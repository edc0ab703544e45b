"""Edges of a design: where two faces meet at an angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.averages import TUKEY_LIMIT
from mdf_core.geometry import Array, Design, members_of
from mdf_core.welded_mesh import WeldedMesh

BY_EDGE = 2.0 * TUKEY_LIMIT
"""Standard deviations of the noise: a point so near to an edge may be of either face."""

_SHARP = np.radians(60.0)  # between the normals; below, a scan point fits either face


@dataclass(frozen=True, eq=False)
class Edges:
    """The sharp edges of a design, as e segments.

    Attributes
    ----------
    begins : (e, 3) float64, mm
    vectors : (e, 3) float64, mm
        To their ends.
    """

    begins: Array
    vectors: Array
    _tree: KDTree  # of samples along them
    _segments: NDArray[np.intp]  # that each sample lies on
    _spacing: float

    @classmethod
    def of(cls, design: Design, spacing: float) -> Edges:
        """The edges of a design, looked up by samples of them that are `spacing` mm apart."""
        # Of a soup of triangles no two share a vertex.
        mesh = trimesh.Trimesh(design.vertices, WeldedMesh(design).faces, process=False)
        ends = mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP]]
        begins, vectors = ends[:, 0], ends[:, 1] - ends[:, 0]
        counts = np.ceil(np.linalg.norm(vectors, axis=1) / spacing).astype(np.intp)
        segments, within = members_of(counts)
        shares = (within + 0.5) / counts[segments]
        return cls(begins, vectors, KDTree(begins[segments] + shares[:, None] * vectors[segments]), segments, spacing)

    def are_near(self, points: Array, reach: float) -> NDArray[np.bool_]:
        """Which of the points (n, 3) mm lie within `reach` mm of an edge, (n,). Cost O(n log e)."""
        if len(self._segments) == 0:
            return np.zeros(len(points), dtype=np.bool_)
        samples = np.asarray(self._tree.query(points, distance_upper_bound=reach + 0.5 * self._spacing, workers=-1)[1])
        asked = np.flatnonzero(samples < len(self._segments))
        segments = self._segments[samples[asked]]
        away, vectors = points[asked] - self.begins[segments], self.vectors[segments]
        shares = np.einsum("ij,ij->i", away, vectors) / np.einsum("ij,ij->i", vectors, vectors)
        away -= np.clip(shares, 0.0, 1.0)[:, None] * vectors
        are_near = np.zeros(len(points), dtype=np.bool_)
        are_near[asked] = np.einsum("ij,ij->i", away, away) < reach**2
        return are_near
