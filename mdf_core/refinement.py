"""Designs whose triangles are too large for the distortion: how much that costs, and finer ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from trimesh.remesh import subdivide_to_size

from mdf_core.averages import weighted_rms
from mdf_core.deformation import Deformation
from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Array, Design
from mdf_core.inspection import Inspection
from mdf_core.pieces import PiecewiseDeformation

_MOST_FACES = 4_000_000
_MOST_HALVINGS = 20
_TOO_COARSE = 0.05  # of the distortion


def refined(design: Design, longest_edge: float) -> Design:
    """The design with its triangles split until no edge is longer than `longest_edge` mm; 0: as it is.

    The surface stays the same; the vertices of the design come first, in their order.

    Raises
    ------
    InvalidSettingError
        There would be more than 4 million triangles.
    """
    if longest_edge == 0:
        return design
    edges = design.triangles - np.roll(design.triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # An edge that is too long is halved until it fits, and its triangle is split in four each time.
    faces = float((4.0 ** np.ceil(np.log2(np.maximum(longest / longest_edge, 1.0)))).sum())
    if faces > _MOST_FACES:
        raise InvalidSettingError(
            f"about {faces:.3g} triangles", "setting design.longest_edge_mm", "choose a longer edge, or 0"
        )
    vertices, split = subdivide_to_size(design.vertices, design.faces, longest_edge, max_iter=_MOST_HALVINGS)
    return Design(vertices, split, design.path, design.file_sha256)


def mesh_error(
    design: Design,
    deformation: Deformation | PiecewiseDeformation,
    displacement: Array,
    supported: NDArray[np.bool_],
) -> float:
    """What is lost where the triangles move with their corners, mm: RMS over their centroids; NaN: not known.

    Parameters
    ----------
    design : Design
    deformation : Deformation or PiecewiseDeformation
    displacement : (n, 3) float64, mm
        Of the vertices, by that deformation.
    supported : (n,) bool

    Notes
    -----
    A triangle stays flat, the distortion does not: a redesign of a mesh with large triangles cannot follow it, and the
    largest displacement may lie between the vertices.
    """
    found = deformation.displacement_at(design.triangles.mean(axis=1))
    missed: Array = ((found - displacement[design.faces].mean(axis=1)) ** 2).sum(axis=1)
    seen = supported[design.faces].all(axis=1) & np.isfinite(missed)
    return weighted_rms(missed, design.face_areas * seen)


def coarseness(inspection: Inspection) -> str:
    """A warning where the triangles are too large for the distortion; else empty."""
    error, rms = inspection.mesh_error, inspection.rms_displacement
    if not error > _TOO_COARSE * rms:  # so that NaN is none
        return ""
    return (
        f"the design's triangles are too large for its distortion: between the vertices {error:.3f} mm RMS are missed, "
        f"of {rms:.3f} mm; refine them by design.longest_edge_mm"
    )
