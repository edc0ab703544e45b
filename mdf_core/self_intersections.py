"""The check of a redesign for faces that cut each other, and bodies that passed through one another."""

from __future__ import annotations

import igl
import igl.predicates
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mdf_core.check_result import Check, place_of
from mdf_core.geometry import Array, crosses_of
from mdf_core.mesh_io import stl_coordinates
from mdf_core.welded_mesh import Index, WeldedMesh

_DEPTH = 1e-5  # of the design's scale, or rounding: faces that lie on each other cut by as much when they bend


def self_intersections(mesh: WeldedMesh, moved: Array) -> Check:
    """Whether with the vertices `moved` (n, 3) mm nothing cuts or contains another that did not so in the design."""
    known, found = _cutting_pairs(mesh, stl_coordinates(mesh.design.vertices)), _cutting_pairs(mesh, moved)
    turned = np.flatnonzero(mesh.slivers_left(moved) & (mesh.turns(moved) >= 90.0))
    excused = _is_near(found, known, mesh.faces) | _is_near(found, np.column_stack([turned, turned]), mesh.faces)
    new = found[~excused]
    new = new[_cut_depths(moved[mesh.design.faces[new]]) > max(_DEPTH * mesh.design.scale, mesh.rounding)]
    if len(new):
        place = place_of(_cut_place(moved[mesh.design.faces[new[0]]]))
        return Check("self_intersections", False, f"{len(new)} new pairs of faces cut each other (limit 0)", place)
    if mesh.is_closed:
        before, after = _depths(mesh, mesh.design.vertices), _depths(mesh, moved)
        # Of a body that is cut it depends on the corner that is asked for whether it lies inside.
        is_cut = np.isin(np.arange(len(before)), mesh.bodies[np.vstack([known, found])])
        passed_through = np.flatnonzero(~is_cut & (before != after))
        if len(passed_through):
            finding = f"{len(passed_through)} of {len(before)} bodies went into another or came out of it (limit 0)"
            face = mesh.first_faces[passed_through[0]]
            return Check("self_intersections", False, finding, place_of(moved[mesh.design.faces[face]].mean(axis=0)))
    own = f"; {len(known)} pairs of the design itself do" if len(known) else ""
    return Check("self_intersections", True, f"no new pair of faces cuts each other (limit 0){own}", None)


def _cutting_pairs(mesh: WeldedMesh, vertices: Array) -> Index:
    """Faces that cut or touch each other elsewhere than at a common edge or corner, (p, 2) in ascending order."""
    faces = mesh.spots_of(vertices)[mesh.design.faces]
    # A face without an area cuts nothing that the faces beside it do not; the predicates take it for a coplanar one.
    solid = np.flatnonzero(crosses_of(vertices[faces]).any(axis=1))
    _, found, _ = igl.predicates.find_self_intersections(vertices, np.ascontiguousarray(faces[solid]))
    pairs = np.sort(solid[found.reshape(-1, 2)], axis=1)
    # Faces with a common edge are found where one folds back on the other; orientation tells that.
    common = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None, :]).sum(axis=(1, 2))
    # Threads find them in any order.
    return np.unique(pairs[common < 2], axis=0)


def _is_near(pairs: Index, known: Index, faces: Index) -> NDArray[np.bool_]:
    """Which of `pairs` (p, 2) are among `known` (k, 2) or touch such a pair, one face the one, one the other, (p,)."""
    if len(pairs) == 0 or len(known) == 0:
        return np.zeros(len(pairs), dtype=np.bool_)
    count = len(faces)
    at_corner = csr_matrix((np.ones(3 * count), (np.repeat(np.arange(count), 3), faces.ravel())))
    first, second = known.T
    cuts = csr_matrix((np.ones(2 * len(known)), (np.r_[first, second], np.r_[second, first])), shape=(count, count))
    one, other = (at_corner[side] @ at_corner.T for side in pairs.T)
    near: NDArray[np.bool_] = np.asarray((one @ cuts).multiply(other).sum(axis=1)).reshape(-1) > 0
    return near


def _cut_place(pair: Array) -> Array:
    """Middle of the box that two triangles (2, 3, 3) have in common, (3,)."""
    middle: Array = 0.5 * (pair.min(axis=1).max(axis=0) + pair.max(axis=1).min(axis=0))
    return middle


def _cut_depths(pairs: Array) -> Array:
    """By how much at most one of two triangles (p, 2, 3, 3) that cut has to move to leave the other's plane, (p,)."""
    depths = []
    for one, other in (pairs.swapaxes(0, 1), pairs.swapaxes(0, 1)[::-1]):
        crosses = crosses_of(other)
        normals = crosses / np.linalg.norm(crosses, axis=1)[:, None]
        heights = np.einsum("pci,pi->pc", one - other[:, :1], normals)
        depths.append(np.minimum(heights.max(axis=1), -heights.min(axis=1)))
    least: Array = np.minimum(*depths)
    return least


def _depths(mesh: WeldedMesh, vertices: Array) -> Index:
    """In how many other bodies the first corner of each body lies, (b,)."""
    by_body = np.argsort(mesh.bodies, kind="stable")
    starts = np.searchsorted(mesh.bodies[by_body], np.arange(len(mesh.first_faces)))
    faces = mesh.faces[by_body]
    points = vertices[faces[starts, 0]]
    corners = vertices[faces]
    lows, highs = np.minimum.reduceat(corners.min(axis=1), starts), np.maximum.reduceat(corners.max(axis=1), starts)
    depths = np.zeros(len(starts), dtype=np.int64)
    for body, body_faces in enumerate(np.split(faces, starts[1:])):
        in_box = ((points > lows[body]) & (points < highs[body])).all(axis=1)
        in_box[body] = False
        if in_box.any():
            turns = igl.winding_number(vertices, np.ascontiguousarray(body_faces), points[in_box])
            depths[in_box] += np.abs(turns) > 0.5
    return depths
