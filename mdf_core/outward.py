"""Which way the normals of a scan face: outward, as the design's do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import TUKEY_LIMIT, robust_sigma
from mdf_core.design_surface import DesignSurface
from mdf_core.edges import BY_EDGE
from mdf_core.geometry import Array, PointSet

_JUDGES = 2_000  # points, at most
_NEAR = 0.1  # points within this share of the scale from the surface tell which way normals face
_ALIKE = 0.5  # cos 60°
_IN_PLACE = 0.005  # of the scale: so far off, the points are where they belong but for their noise
_TRUSTED = 0.58  # share of the normals that must face alike to be believed
_CLEARLY = 0.98  # cos 11°


class Outward(NamedTuple):
    """The normals of a posed scan, turned outward.

    Attributes
    ----------
    normals : (n, 3) float64
    is_of_face : (n,) bool
        False by an edge where an estimated normal does not tell of which of two faces the point is.
    """

    normals: Array
    is_of_face: NDArray[np.bool_]


def outward(placed: PointSet, moved: Array, surface: DesignSurface) -> Outward:
    """Turn the normals of a posed scan outward.

    Normals more of which face as the design does are trusted, though in a thin wall that is bent by its thickness the
    nearest surface is often the other one; those of which more face the other way are reversed. Where they face either
    way, as estimated ones do, each takes the side of the nearest surface, and its direction if it is near that: across
    an edge estimates point between the faces, and in a sparse scan anywhere. So once the points have moved to their
    places, one that lies on a face as well as the others do on theirs takes its direction, too. By an edge it may be of
    the other face: the lowest points of walls would tell where the underside is, though nobody has seen it.

    Parameters
    ----------
    placed : PointSet
        n points with normals.
    moved : (n, 3) float64, mm
        Where they are taken to be on the design so far.
    surface : DesignSurface

    Notes
    -----
    Cost O(n log f) for f faces.
    """
    normals = placed.normals
    assert normals is not None, "the scan is prepared: it has normals"
    is_of_face = np.ones(len(moved), dtype=np.bool_)
    judges = np.linspace(0, len(moved) - 1, min(len(moved), _JUDGES)).astype(np.intp)
    closest = surface.closest(moved[judges])
    agreement = np.einsum("ij,ij->i", closest.normals, normals[judges])
    telling = (np.abs(closest.distances) < _NEAR * surface.design.scale) & (np.abs(agreement) > _ALIKE)
    facing = (agreement[telling] > 0).mean() if telling.any() else 1.0
    if facing >= _TRUSTED:
        return Outward(normals, is_of_face)
    if facing < 1.0 - _TRUSTED:
        return Outward(-normals, is_of_face)
    closest = surface.closest(moved)
    agreement = np.einsum("ij,ij->i", closest.normals, normals)
    takes_direction = np.abs(agreement) > _ALIKE
    sigma = robust_sigma(closest.distances)
    if sigma < _IN_PLACE * surface.design.scale:
        takes_direction |= np.abs(closest.distances) < TUKEY_LIMIT * sigma
        doubtful = np.flatnonzero((np.abs(agreement) < _CLEARLY) & (np.abs(closest.distances) < BY_EDGE * sigma))
        is_of_face[doubtful] = ~surface.edges.are_near(moved[doubtful], BY_EDGE * sigma)
    directions = np.where(takes_direction[:, None], closest.normals, np.copysign(1.0, agreement)[:, None] * normals)
    return Outward(directions, is_of_face)
