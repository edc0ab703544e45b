"""Checks of a redesign's dimensions: its walls, edges, moves and volume beside those of the design."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray

from mdf_core.check_result import Check, limited, place_of
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import stl_coordinates
from mdf_core.welded_mesh import Index, WeldedMesh, edge_lengths

_THICKEST_WALL = 0.25  # of the design's scale


def wall_thickness(mesh: WeldedMesh, moved: Array, limit: float) -> Check:
    """Whether no wall changes its thickness by more than the share `limit`, the vertices being `moved` (n, 3) mm."""
    thickest = _THICKEST_WALL * mesh.design.scale
    faces, opposite, shares = _walls(mesh, thickest)
    if len(faces) == 0:
        return Check("wall_thickness", True, f"the design has no wall of up to {thickest:.1f} mm", None)
    before, after = (
        np.linalg.norm(np.einsum("wc,wci->wi", shares, corners[opposite]) - corners[faces].mean(axis=1), axis=1)
        for corners in (mesh.design.triangles, moved[mesh.design.faces])
    )
    changes = _relative_changes(before, after, mesh.rounding)
    worst = int(changes.argmax())
    what = f"walls of up to {thickest:.1f} mm change their thickness"
    finding = _change_text(what, float(changes[worst]), float(before[worst]), float(after[worst]), limit)
    return limited("wall_thickness", float(changes[worst]), limit, finding, mesh.centroid(int(faces[worst])))


def _walls(mesh: WeldedMesh, thickest: float) -> tuple[Index, Index, Array]:
    """Faces with material behind them, (w,), the face on its other side, (w,), and where on that: shares, (w, 3)."""
    design = mesh.design
    asked = np.flatnonzero(~mesh.is_sliver)
    inward = -design.face_normals[asked]
    # Off the face by what rounding may do, lest the ray end where it starts.
    starts = design.triangles[asked].mean(axis=1) + mesh.rounding * inward
    tree = igl.AABB()
    tree.init(design.vertices, design.faces)
    hit, _, shares = tree.intersect_ray_first(design.vertices, design.faces, starts, inward, thickest)
    # Where bodies overlap, or in an open design, the ray may enter material instead of leaving it.
    leaves = (hit >= 0) & (np.einsum("ri,ri->r", design.face_normals[hit], inward) > 0)
    u, v = shares[leaves].T
    return asked[leaves], hit[leaves], np.column_stack([1.0 - u - v, u, v])


def stretch(mesh: WeldedMesh, moved: Array, limit: float) -> Check:
    """Whether no edge changes its length by more than the share `limit`, the vertices being `moved` (n, 3) mm."""
    before, after = edge_lengths(mesh.design.triangles), edge_lengths(moved[mesh.design.faces])
    changes = _relative_changes(before, after, mesh.rounding)
    face, edge = divmod(int(changes.argmax()), 3)
    largest, old, new = (float(values[face, edge]) for values in (changes, before, after))
    ends = mesh.design.triangles[face][[edge, (edge + 1) % 3]]
    finding = _change_text("edges change their length", largest, old, new, limit)
    return limited("stretch", largest, limit, finding, place_of(ends.mean(axis=0)))


def _relative_changes(before: Array, after: Array, rounding: float) -> Array:
    """Of lengths, relative to what they were; what rounding may have done is taken off."""
    changes = np.maximum(np.abs(after - before) - rounding, 0.0)
    relative: Array = np.divide(changes, before, out=np.zeros_like(changes), where=before > 0)
    return relative


def _change_text(what: str, largest: float, before: float, after: float, limit: float) -> str:
    limit_text = f"limit {100 * limit:g} %" if limit else "no limit is set"
    return f"{what} by up to {100 * largest:.1f} % ({limit_text}), from {before:.3g} mm to {after:.3g} mm"


def largest_move(mesh: WeldedMesh, vertices: Array, limit: float) -> Check:
    """Whether none of `vertices` (n, 3) mm lies farther than `limit` mm from where it is in the design."""
    moves = np.linalg.norm(vertices - mesh.design.vertices, axis=1)
    worst = int(moves.argmax())
    limit_text = f"limit {limit:g} mm" if limit else "no limit is set"
    finding = f"vertices move by up to {moves[worst]:.3f} mm ({limit_text})"
    largest = max(float(moves[worst]) - mesh.rounding, 0.0)
    return limited("largest_move", largest, limit, finding, place_of(mesh.design.vertices[worst]))


def fixed_regions(design: Design, moved: Array, fixed: NDArray[np.bool_]) -> Check:
    """Whether the `fixed` (n,) of the vertices `moved` (n, 3) mm lie where they do in the design."""
    vertices = np.flatnonzero(fixed)
    if len(vertices) == 0:
        return Check("fixed_regions", True, "no vertex is fixed", None)
    moves = np.linalg.norm(moved[vertices] - stl_coordinates(design.vertices[vertices]), axis=1)
    worst = int(moves.argmax())
    if moves[worst] == 0.0:
        return Check("fixed_regions", True, f"none of {len(vertices)} fixed vertices moved (limit 0 mm)", None)
    what = f"{np.count_nonzero(moves)} of {len(vertices)} fixed vertices moved"
    finding = f"{what}, by up to {moves[worst]:.3g} mm (limit 0 mm)"
    return Check("fixed_regions", False, finding, place_of(design.vertices[vertices[worst]]))


def volume(mesh: WeldedMesh, moved: Array) -> Check:
    """How the enclosed volume changes with the vertices `moved` (n, 3) mm; always passes."""
    before = float(mesh.body_volumes(mesh.design.triangles).sum())
    if not mesh.is_closed or abs(before) <= mesh.rounding * mesh.design.face_areas.sum():
        return Check("volume", True, "the design encloses no volume", None)
    after = float(mesh.body_volumes(moved[mesh.design.faces]).sum())
    change = f"{100 * (after / before - 1):+.3f} %"
    return Check("volume", True, f"the enclosed volume changes by {change}, from {before:.6g} to {after:.6g} mm³", None)
