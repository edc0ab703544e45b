"""From the registration to what is said of every vertex: its displacement, less the rigid part, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.coarseness import between_vertices
from mdf_core.deformation import Deformation
from mdf_core.errors import LOOK_AT_THE_SCAN, RegistrationFailedError
from mdf_core.geometry import Array, Design
from mdf_core.inspection import Deviation
from mdf_core.interpolation import interpolate
from mdf_core.methods import Registered, Task
from mdf_core.outliers import normalized_median_test, surface_distance_test
from mdf_core.outward import outward
from mdf_core.pieces import PiecewiseDeformation
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.settings import InterpolationSettings, OutlierSettings
from mdf_core.support import (
    determined_vertices,
    disputed_vertices,
    reached_vertices,
    unexplained_distances,
    unseen_vertices,
)


@dataclass(frozen=True, eq=False)
class Measurement:
    """What `Inspection` says of the design's vertices and of the scan points, by the same names."""

    deformation: Deformation | PiecewiseDeformation
    displacement: Array
    inverse_displacement: Array
    std: Array
    supported: NDArray[np.bool_]
    disputed: NDArray[np.bool_]
    unseen: NDArray[np.bool_]
    unexplained: Array
    face_displacement: Array
    deviation: Deviation
    mesh_error: float


def measure(task: Task, registered: Registered) -> Measurement:
    """The displacement of the design's vertices, and what the scan says of each.

    Raises
    ------
    RegistrationFailedError
        The motion folds the part where it was measured.
    """
    design, surface, settings = task.surface.design, task.surface, task.settings
    is_outlier = _outliers(task.placed.points, registered, settings.outliers)
    found = registered.deformation.displacement_at(design.vertices)
    disputed = disputed_vertices(design, registered.closest, is_outlier, settings.verdict.support_distances)
    reached = _reached(task, registered, ~is_outlier)
    supported = _supported(task, registered, reached, found) & ~disputed
    _refuse_fold(found, supported)

    deformed = design.vertices + _extrapolated(design, found)
    # The datum: the part's own place on the scanner is no distortion.
    weights = _datum_weights(design, supported)
    datum = best_rigid_fit(deformed, design.vertices, weights)
    motion = registered.deformation.without_rigid_part(design.vertices, weights).framed(task.choice.pose, datum)
    displacement = transform(datum, deformed) - design.vertices
    between = between_vertices(design, motion, displacement, supported)
    inverse_displacement = motion.inverse_displacement_at(design.vertices)
    inverse_displacement = np.where(np.isfinite(inverse_displacement), inverse_displacement, -displacement)

    resting = transform(datum, task.placed.points)
    if settings.interpolation.method != "deformation":
        there, here = resting[~is_outlier], registered.moved[~is_outlier]
        displacement = _interpolated(here, there - here, design, displacement, settings.interpolation)
        inverse_displacement = _interpolated(there, here - there, design, inverse_displacement, settings.interpolation)
    spacings, normals = settings.verdict.support_distances, outward(task.placed, registered.moved, surface).normals
    distances = surface.closest(resting, normals).distances
    return Measurement(
        deformation=motion,
        displacement=displacement,
        inverse_displacement=inverse_displacement,
        std=motion.std(design.vertices),
        supported=supported,
        disputed=disputed,
        unseen=unseen_vertices(design, reached, int((~is_outlier).sum())),
        unexplained=unexplained_distances(design, registered.closest, registered.offsets, spacings),
        face_displacement=between.displacement,
        deviation=Deviation(resting, distances, is_outlier),
        mesh_error=between.mesh_error,
    )


def _outliers(placed: Array, registered: Registered, settings: OutlierSettings) -> NDArray[np.bool_]:
    """Which of the placed points (m, 3) are no part of the surface, (m,)."""
    if settings.method == "surface_distance":
        return surface_distance_test(registered.distances, settings)
    return normalized_median_test(placed, registered.moved - placed, settings.median_threshold)


def _reached(task: Task, registered: Registered, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which vertices the scan points `kept` (m,) lie near, (n,)."""
    points, normals = registered.moved[kept], registered.closest.normals[kept]
    return reached_vertices(task.surface.design, points, normals, task.settings.verdict.support_distances)


def _supported(
    task: Task, registered: Registered, reached: NDArray[np.bool_], displacement: Array
) -> NDArray[np.bool_]:
    """Which of the `reached` vertices (n,) the scan tells about, (n,)."""
    supported = determined_vertices(task.surface.design, displacement, registered.deformation, reached)
    if task.choice.is_symmetric:  # no pose is believed: that the motion to this one folds is no reason to refuse
        supported = supported & np.isfinite(displacement).all(axis=1)
    return supported


def _refuse_fold(displacement: Array, supported: NDArray[np.bool_]) -> None:
    """What was measured has a displacement."""
    has_own: NDArray[np.bool_] = np.asarray(np.isfinite(displacement).all(axis=1))
    folded = int((supported & ~has_own).sum())
    if folded or not has_own.any():
        raise RegistrationFailedError(
            f"the motion folds the part onto itself at {folded or len(has_own)} of {len(has_own)} vertices",
            "registration",
            LOOK_AT_THE_SCAN,
        )


def _extrapolated(design: Design, displacement: Array) -> Array:
    """The displacement of the nearest vertex where the motion has none of its own, as may be where no scan point is."""
    has_own = np.isfinite(displacement).all(axis=1)
    if has_own.all():
        return displacement
    nearest = KDTree(design.vertices[has_own]).query(design.vertices[~has_own])[1]
    result: Array = displacement.copy()
    result[~has_own] = displacement[has_own][nearest]
    return result


def _datum_weights(design: Design, supported: NDArray[np.bool_]) -> Array:
    """The supported area of every vertex, (n,) mm²; all of it where none is supported."""
    weights: Array = design.vertex_areas * supported
    return weights if weights.sum() > 0 else design.vertex_areas


def _interpolated(
    points: Array, values: Array, design: Design, fallback: Array, settings: InterpolationSettings
) -> Array:
    """Interpolation between scan points at the vertices, and the deformation itself where that has no value."""
    found = interpolate(points, values, design.vertices, settings.method, settings.neighbours)
    return np.where(np.isfinite(found), found, fallback)
