"""Checks of a redesign's surface: whether it is closed as the design is, and every face looks as it did."""

from __future__ import annotations

import numpy as np

from mdf_core.check_result import Check, place_of
from mdf_core.geometry import Array
from mdf_core.welded_mesh import WeldedMesh, heights_of, is_closed

_LEAST_HEIGHT = 0.1  # of what it was: a face that keeps less has collapsed


def watertight(mesh: WeldedMesh, moved: Array) -> Check:
    """Whether a closed design is still closed with its vertices `moved` (n, 3) mm, no two of them on one spot."""
    if not mesh.is_closed:
        return Check("watertight", True, "the design is open itself: not every edge joins exactly two faces", None)
    spots = mesh.spots_of(moved)
    changed = np.flatnonzero(spots != mesh.spots)
    # Rounding may well join what it alone keeps apart.
    distances = np.linalg.norm(mesh.design.vertices[changed] - mesh.design.vertices[spots[changed]], axis=1)
    joined = changed[distances > mesh.rounding]
    if len(joined):
        finding = f"{len(joined)} of {len(mesh.used)} vertices came to lie on the spot of another one (limit 0)"
        return Check("watertight", False, finding, place_of(mesh.design.vertices[joined[0]]))
    if len(changed) and not is_closed(spots[mesh.design.faces]):
        finding = (
            f"the surface is torn open: {len(changed)} vertices left the spot they shared with another one (limit 0)"
        )
        return Check("watertight", False, finding, place_of(mesh.design.vertices[changed[0]]))
    return Check("watertight", True, "every edge joins exactly two faces, as in the design", None)


def orientation(mesh: WeldedMesh, moved: Array) -> Check:
    """Whether every face and every closed body still looks outward with the vertices `moved` (n, 3) mm."""
    turns = np.where((mesh.heights > 0) & ~mesh.slivers_left(moved), mesh.turns(moved), 0.0)
    worst = int(turns.argmax())
    flipped = int((turns >= 90.0).sum())
    if flipped:
        finding = f"{flipped} of {len(turns)} faces are flipped, turned by up to {turns[worst]:.0f}° (limit 90°)"
        return Check("orientation", False, finding, mesh.centroid(worst))
    before, after = mesh.body_volumes(mesh.design.triangles), mesh.body_volumes(moved[mesh.design.faces])
    has_volume = np.abs(before) > mesh.rounding * np.bincount(mesh.bodies, mesh.design.face_areas)
    inside_out = np.flatnonzero(mesh.is_closed & has_volume & (before * after <= 0.0))
    if len(inside_out):
        finding = f"{len(inside_out)} of {len(before)} bodies are inside out"
        return Check("orientation", False, finding, mesh.centroid(mesh.first_faces[inside_out[0]]))
    return Check("orientation", True, f"no face is turned by more than {turns[worst]:.1f}° (limit 90°)", None)


def degenerate_faces(mesh: WeldedMesh, moved: Array) -> Check:
    """Whether every face keeps enough of its smallest height with the vertices `moved` (n, 3) mm."""
    heights = heights_of(moved[mesh.design.faces])
    kept = np.ones(len(heights))
    np.divide(heights, mesh.heights, out=kept, where=~mesh.is_sliver)
    worst = int(kept.argmin())
    limit = f"(limit {100 * _LEAST_HEIGHT:.0f} %)"
    collapsed = int((kept < _LEAST_HEIGHT).sum())
    if not collapsed:
        finding = f"every face keeps {100 * kept[worst]:.0f} % or more of its smallest height {limit}"
        return Check("degenerate_faces", True, finding, None)
    change = f"from {mesh.heights[worst]:.3g} mm to {heights[worst]:.3g} mm"
    finding = f"{collapsed} of {len(kept)} faces have collapsed, the smallest height of one {change} {limit}"
    return Check("degenerate_faces", False, finding, mesh.centroid(worst))
