"""How far prints are off their design where the truth is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import rms_length
from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Array, Design
from mdf_core.rigid import best_rigid_fit, transform

_NO_DISTORTION = 1e-9  # of the design's scale: what rounding leaves of a rigid motion


def fraction_unrecovered(
    design: Design,
    true_displacement: Array,
    estimated_displacement: Array,
    mask: NDArray[np.bool_] | None = None,
) -> float:
    """Share of the distortion that an estimate misses: 0 is perfect, 1 as bad as estimating no distortion.

    Area-weighted RMS of the error over that of the true displacement, each after the best rigid fit, because where the
    part lay on the scanner is no distortion.

    Parameters
    ----------
    design : Design
    true_displacement, estimated_displacement : (n, 3) float64, mm
        At the design's vertices.
    mask : (n,) bool, optional
        Vertices to judge by.

    Raises
    ------
    InvalidSettingError
        There is no true distortion to recover, or the mask leaves no area.
    """
    weights = design.vertex_areas if mask is None else np.where(mask, design.vertex_areas, 0.0)
    if not weights.sum() > 0:
        raise InvalidSettingError("leaves nothing to judge by", "mask", "choose some of the surface")
    true_points = design.vertices + true_displacement
    whole = rms_length(_misfit(design.vertices, true_points, weights), weights)
    if not whole > _NO_DISTORTION * design.scale:
        raise InvalidSettingError("is no distortion", "true_displacement", "give one that bends the part")
    return rms_length(_misfit(design.vertices + estimated_displacement, true_points, weights), weights) / whole


def distortion_left(design: Design, printed_vertices: Array) -> tuple[float, float]:
    """Area-weighted RMS and largest distance (mm) of printed vertices (n, 3) to the design after the best rigid fit."""
    misfit = _misfit(printed_vertices, design.vertices, design.vertex_areas)
    return rms_length(misfit, design.vertex_areas), float(np.linalg.norm(misfit, axis=1).max())


def _misfit(source: Array, target: Array, weights: Array) -> Array:
    return transform(best_rigid_fit(source, target, weights), source) - target
