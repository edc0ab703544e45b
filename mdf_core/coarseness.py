"""Designs whose triangles are too large for the distortion: how much that costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import points_to_barycentric

from mdf_core.averages import weighted_rms
from mdf_core.deformation import Deformation
from mdf_core.design_surface import spread_samples
from mdf_core.geometry import Array, Design
from mdf_core.inspection import Inspection
from mdf_core.pieces import PiecewiseDeformation

_TOO_COARSE = 0.05  # of the distortion
_PLACES = 10_000  # spread over the surface, and one on each triangle


@dataclass(frozen=True, eq=False)
class Between:
    """What the displacement of the vertices does not show.

    Attributes
    ----------
    mesh_error : float, mm
        What is lost where the triangles move with their corners, RMS; NaN: not known.
    displacement : (f,) float64, mm
        Largest displacement found within each triangle, 0 in those without an area; NaN: not known.
    """

    mesh_error: float
    displacement: Array


def between_vertices(
    design: Design,
    deformation: Deformation | PiecewiseDeformation,
    displacement: Array,
    supported: NDArray[np.bool_],
) -> Between:
    """How the triangles are displaced between their corners, from places spread over them.

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
    places, face_of = spread_samples(design, _PLACES, least=1)
    found = deformation.displacement_at(places)
    shares = points_to_barycentric(design.triangles[face_of], places)
    flat = np.einsum("nc,nci->ni", shares, displacement[design.faces[face_of]])
    missed = ((found - flat) ** 2).sum(axis=1)
    counts = supported[design.faces[face_of]].all(axis=1) & np.isfinite(missed)
    areas = design.face_areas[face_of] / np.bincount(face_of)[face_of]
    largest = np.zeros(len(design.faces))
    np.maximum.at(largest, face_of, np.linalg.norm(found, axis=1))
    return Between(weighted_rms(missed, areas * counts), largest)


def coarseness(inspection: Inspection) -> str:
    """A warning where the triangles are too large for the distortion; else empty."""
    error, rms = inspection.mesh_error, inspection.rms_displacement
    if not error > _TOO_COARSE * rms:  # so that NaN is none
        return ""
    return (
        f"the design's triangles are too large for its distortion: between the vertices {error:.3f} mm RMS are missed, "
        f"of {rms:.3f} mm; refine them by design.longest_edge_mm"
    )
