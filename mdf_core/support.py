"""Which vertices of the design the scan tells about; everything else is extrapolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.averages import robust_sigma
from mdf_core.connectivity import connected_groups
from mdf_core.deformation import Deformation
from mdf_core.design_surface import Closest
from mdf_core.geometry import Array, Design
from mdf_core.pieces import PiecewiseDeformation

_ALONG = 0.1  # of the scale: what is no farther from the surface is told of it
_SEVERAL = 6  # points, of which chance would not make all alike
_GAP = 2.0  # times the reach
_EXPECTED = 10.0  # points: a patch that should have so many and has none was not scanned, or is not there
_NEAREST = 9  # points whose median says where the scan lies
_CHANCE = 5.0  # standard deviations of such a median, which vertices by the thousand do not exceed by chance
_MEDIAN_ERROR = 1.25  # times that of a mean
_NEARBY = 24  # points looked at beside a vertex: at an edge the nearest may all lie on the other face
_SAME_SIDE = 0.1  # cosine; at right angles rounding would decide
_POORLY = 5.0  # times the usual standard deviation: the scan is near, but says little about where the vertex went
_WELL = 0.01  # of the displacement: what is known to that is measured, however well the rest is known
_BESIDE = 1.0  # of the scale: how far a hidden region has a say


def reached_vertices(design: Design, points: Array, normals: Array, spacings: float) -> NDArray[np.bool_]:
    """Vertices that have registered scan points on their own side of the wall nearby, (n,).

    Parameters
    ----------
    design : Design
    points : (m, 3) float64, mm
        Of the scan, on the design; without outliers.
    normals : (m, 3) float64
        Of the design there.
    spacings : float
        How near, in mean spacings of the points.
    """
    if len(points) == 0:
        return np.zeros(len(design.vertices), dtype=np.bool_)
    reach = _reach(design, len(points), spacings)
    distances, _ = _on_its_side(design, np.arange(len(design.vertices)), points, normals)
    away = np.where(design.vertex_areas > 0, distances.min(axis=1), np.inf)
    reached: NDArray[np.bool_] = away < reach
    # Between few points a single corner lies in a gap by chance.
    reached |= ~_hidden(design, reached) & (away < _GAP * reach)
    return reached


def unseen_vertices(design: Design, reached: NDArray[np.bool_], points: int) -> NDArray[np.bool_]:
    """Vertices in patches that are not `reached` (n,), though some of the scan's `points` should lie there, (n,).

    A feature that was not printed, or that the scanner did not see. Where few points would lie, none may by chance.
    """
    edges = np.stack([design.faces, np.roll(design.faces, 1, axis=1)], axis=2).reshape(-1, 2)
    patch_of = connected_groups(edges[~reached[edges].any(axis=1)], len(reached))
    areas = np.bincount(patch_of, design.vertex_areas * ~reached)
    unseen: NDArray[np.bool_] = (areas * points / design.face_areas.sum() >= _EXPECTED)[patch_of] & ~reached
    return unseen


def unexplained_distances(design: Design, closest: Closest, offsets: Array, spacings: float) -> Array:
    """How far the scan lies off the registered surface at each vertex, where that is more than chance; else 0, (n,) mm.

    What the motion does not follow, but too shallow for its points to be outliers: none of them says so alone. At least
    what is known of it.

    Parameters
    ----------
    design : Design
    closest : Closest
        Of the registered scan points (m,), to the design.
    offsets : (m,) float64, mm
        What is known of their distances.
    spacings : float
        How near, in mean spacings of the points.
    """
    near = np.abs(closest.distances) < _ALONG * design.scale
    if not near.any():
        return np.zeros(len(design.vertices))
    off, known = closest.distances[near], offsets[near]
    away, index = _on_its_side(design, np.arange(len(design.vertices)), closest.points[near], closest.normals[near])
    nearest = np.argsort(away, axis=1, kind="stable")[:, :_NEAREST]
    counts = np.take_along_axis(away, nearest, axis=1) < _reach(design, len(off), spacings)
    enough, nearest = counts.sum(axis=1) >= _SEVERAL, np.take_along_axis(index, nearest, axis=1)

    def medians(values: Array) -> Array:
        found = np.zeros(len(design.vertices))
        found[enough] = np.abs(np.nanmedian(np.where(counts, values[nearest], np.nan)[enough], axis=1))
        return found

    distances, left = medians(off), off - known
    noise = robust_sigma(left - np.median(left))  # what all points are off by is no noise: walls printed too thick
    chance = _CHANCE * _MEDIAN_ERROR * noise / np.sqrt(np.maximum(counts.sum(axis=1), 1))
    distances[distances <= chance] = 0.0
    return np.maximum(distances, medians(known)) if known.any() else distances


def disputed_vertices(
    design: Design, closest: Closest, is_outlier: NDArray[np.bool_], spacings: float
) -> NDArray[np.bool_]:
    """Vertices near which most of the scan points on their side of the wall are outliers, (n,).

    A few outliers anywhere are the scanner's. Where they lie side by side along the surface they are the part's: a dent
    or a burr that is too steep for the motion.

    Parameters
    ----------
    design : Design
    closest : Closest
        Of the registered scan points (m,), to the design.
    is_outlier : (m,) bool
    spacings : float
        How near, in mean spacings of the points.
    """
    disputed = np.zeros(len(design.vertices), dtype=np.bool_)
    near = np.abs(closest.distances) < _ALONG * design.scale
    if not (near & is_outlier).any():
        return disputed
    feet, normals, doubtful = closest.points[near], closest.normals[near], is_outlier[near]
    reach = _reach(design, len(feet), spacings)
    beside = np.flatnonzero(KDTree(feet[doubtful]).query(design.vertices, workers=-1)[0] < reach)
    distances, index = _on_its_side(design, beside, feet, normals)
    nearby = distances < reach
    against = (nearby & doubtful[index]).sum(axis=1)
    disputed[beside] = (against >= _SEVERAL) & (2 * against > nearby.sum(axis=1))
    return disputed


def determined_vertices(
    design: Design, displacement: Array, motion: Deformation | PiecewiseDeformation, reached: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Those of the `reached` vertices (n,) whose displacement is measured and not extrapolated, (n,).

    That is all but those beside a hidden region that are far less known than usual.

    Parameters
    ----------
    design : Design
    displacement : (n, 3) float64, mm
        Of the vertices by the motion; NaN where that folds.
    motion : Deformation or PiecewiseDeformation
    reached : (n,) bool
    """
    hidden = _hidden(design, reached)
    if not hidden.any():
        return reached
    std = motion.std(design.vertices)
    known = reached & np.isfinite(std) & np.isfinite(displacement).all(axis=1)
    if not known.any():
        return reached
    size = np.sqrt((displacement[known] ** 2).sum(axis=1).mean())
    distances, _ = KDTree(design.vertices[hidden]).query(design.vertices, workers=-1)
    poor = max(_POORLY * np.median(std[known]), _WELL * size)
    is_extrapolated: NDArray[np.bool_] = (std > poor) & (distances < _BESIDE * design.scale)
    return reached & ~is_extrapolated


def _reach(design: Design, points: int, spacings: float) -> float:
    """So many mean spacings of that many points, mm."""
    return float(spacings * np.sqrt(design.face_areas.sum() / points))


def _on_its_side(
    design: Design, vertices: NDArray[np.intp], points: Array, normals: Array
) -> tuple[Array, NDArray[np.intp]]:
    """Distances of the points nearest to each of the `vertices` (v,) and which they are, both (v, k).

    Those on the other side of the wall are infinitely far.
    """
    count = min(_NEARBY, len(points))
    distances, index = KDTree(points).query(design.vertices[vertices], k=[*range(1, count + 1)], workers=-1)
    same_side = np.einsum("vki,vi->vk", normals[index], design.vertex_normals[vertices]) > _SAME_SIDE
    return np.where(same_side, distances, np.inf), np.asarray(index, dtype=np.intp)


def _hidden(design: Design, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The corners of faces none of whose corners is reached: a single one is no hidden region."""
    hidden = np.zeros(len(reached), dtype=np.bool_)
    hidden[design.faces[~reached[design.faces].any(axis=1) & (design.face_areas > 0)]] = True
    return hidden
