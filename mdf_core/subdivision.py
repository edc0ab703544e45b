"""Designs with their triangles split until no edge is too long."""

from __future__ import annotations

import numpy as np
from trimesh.remesh import subdivide_to_size

from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Design

_MOST_FACES = 4_000_000
_MOST_HALVINGS = 20
_SETTING = "setting design.longest_edge_mm"


def subdivided(design: Design, longest_edge: float) -> Design:
    """The design with its triangles split until no edge is longer than `longest_edge` mm; 0: as it is.

    The surface stays the same; the vertices of the design come first, in their order.

    Raises
    ------
    InvalidSettingError
        `longest_edge` is negative or NaN, or there would be more than 4 million triangles.
    """
    if not longest_edge >= 0:
        raise InvalidSettingError(f"{longest_edge:g} mm is no length", _SETTING, "choose a positive one, or 0")
    if longest_edge == 0:
        return design
    edges = design.triangles - np.roll(design.triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # An edge that is too long is halved until it fits, and its triangle is split in four each time.
    faces = float((4.0 ** np.ceil(np.log2(np.maximum(longest / longest_edge, 1.0)))).sum())
    if faces > _MOST_FACES:
        raise InvalidSettingError(f"about {faces:.3g} triangles", _SETTING, "choose a longer edge, or 0")
    vertices, split, whole = subdivide_to_size(
        design.vertices, design.faces, longest_edge, max_iter=_MOST_HALVINGS, return_index=True
    )
    file_faces = whole if design.file_faces is None else design.file_faces[whole]
    return Design(vertices, split, design.path, design.file_sha256, file_faces)
