"""Designs that are checked against redesigns with faults, and what the checks say of them by name."""

import numpy as np
import trimesh

from mdf_core.check_result import describe_failures
from mdf_core.checks import check_redesign
from mdf_core.geometry import Design
from mdf_core.settings import ReleaseSettings

NAMES = [
    "watertight",
    "orientation",
    "degenerate_faces",
    "self_intersections",
    "wall_thickness",
    "stretch",
    "largest_move",
    "fixed_regions",
    "volume",
]
NO_LIMITS = ReleaseSettings(max_move_mm=0.0, max_stretch=0.0, max_thickness_change=0.0)
NEAR_MM = 4.0  # the longest edge of the parts


def checks(design, vertices, settings=NO_LIMITS, fixed=()):
    """By name; `fixed` are indices of vertices."""
    is_fixed = np.zeros(len(design.vertices), dtype=bool)
    is_fixed[list(fixed)] = True
    found = check_redesign(design, vertices, is_fixed, settings)
    assert [check.name for check in found] == NAMES
    assert all((check.place is None) == check.passed and check.finding for check in found)
    return {check.name: check for check in found}


def failed(found):
    return [name for name, check in found.items() if not check.passed]


def only_failure(found, name):
    assert failed(found) == [name], describe_failures(list(found.values()))
    return found[name]


def mesh_design(*meshes):
    joined = trimesh.util.concatenate(list(meshes))
    return Design(joined.vertices, joined.faces)


def box(size, centre=(0.0, 0.0, 0.0), edge_mm=None):
    mesh = trimesh.creation.box(size)
    mesh = mesh.subdivide_to_size(edge_mm) if edge_mm else mesh
    return mesh.apply_translation(centre)


def unmerged(design):
    """The same triangles, none sharing a vertex."""
    return Design(design.triangles.reshape(-1, 3), np.arange(3 * len(design.faces)).reshape(-1, 3))


def bump(design, centre, radius, depth):
    """`design` with its upper side pressed down smoothly around `centre` (x, y)."""
    vertices = design.vertices.copy()
    is_upper = vertices[:, 2] >= vertices[:, 2].max() - 1e-6
    away = np.linalg.norm(vertices[:, :2] - centre, axis=1) / radius
    vertices[:, 2] -= np.where(is_upper & (away < 1.0), depth * (1.0 - away**2) ** 2, 0.0)
    return vertices


def distance(check, point):
    return np.linalg.norm(np.subtract(check.place, point))


def inner_vertex(design, near):
    """The vertex nearest to `near` and the faces around it."""
    vertex = int(np.linalg.norm(design.vertices - near, axis=1).argmin())
    return vertex, np.flatnonzero((design.faces == vertex).any(axis=1))
