"""Designs whose triangles are too large for the distortion: how much that costs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import weighted_rms
from mdf_core.deformation import Deformation
from mdf_core.geometry import Array, Design
from mdf_core.inspection import Inspection
from mdf_core.pieces import PiecewiseDeformation

_TOO_COARSE = 0.05  # of the distortion


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
