"""Which vertices the scan tells about."""

import numpy as np
import pytest
import trimesh

from mdf_core.geometry import Design
from mdf_core.support import reached_vertices

SIZE = np.array([80.0, 50.0, 4.0])


@pytest.fixture(scope="module")
def wall():
    """A thin wall, 4 mm, between z = -2 and 2."""
    mesh = trimesh.creation.box(SIZE).subdivide_to_size(4.0)
    return Design(mesh.vertices, mesh.faces)


def on_top(count, rng):
    points = rng.uniform(-0.5, 0.5, (count, 3)) * SIZE
    points[:, 2] = 0.5 * SIZE[2]
    return points, np.tile([0.0, 0.0, 1.0], (count, 1))


def test_points_on_one_face_of_a_thin_wall_do_not_reach_the_other(wall, rng):
    reached = reached_vertices(wall, *on_top(500, rng), spacings=3.0)
    top = wall.vertices[:, 2] == 0.5 * SIZE[2]
    assert reached[top].all()
    assert not reached[wall.vertices[:, 2] == -0.5 * SIZE[2]].any()


def test_a_hole_in_the_scan_is_not_reached_but_for_its_rim(wall, rng):
    points, normals = on_top(4_000, rng)
    radius = np.linalg.norm(wall.vertices[:, :2], axis=1)
    outside = np.linalg.norm(points[:, :2], axis=1) > 15.0
    reached = reached_vertices(wall, points[outside], normals[outside], spacings=3.0)
    top = wall.vertices[:, 2] == 0.5 * SIZE[2]
    reach = 3.0 * np.sqrt(wall.face_areas.sum() / outside.sum())
    assert reach < 7.0
    assert not reached[top & (radius < 15.0 - 2.0 * reach)].any()
    assert reached[top & (radius > 15.0)].all()


def test_a_single_corner_in_a_gap_is_reached(wall, rng):
    points, normals = on_top(6_000, rng)
    top = wall.vertices[:, 2] == 0.5 * SIZE[2]
    corner = int(np.flatnonzero(top & (np.abs(wall.vertices[:, :2]) < 20.0).all(axis=1))[0])
    away = np.linalg.norm(points - wall.vertices[corner], axis=1)
    points, normals = points[away > 4.0], normals[away > 4.0]
    nearest = np.linalg.norm(points - wall.vertices[corner], axis=1).min()
    spacing = np.sqrt(wall.face_areas.sum() / len(points))
    for share, expected in ((0.9, True), (0.4, False)):  # of the gap; up to twice the reach
        reached = reached_vertices(wall, points, normals, spacings=share * nearest / spacing)
        assert reached[corner] == expected
    assert not reached_vertices(wall, points[:0], normals[:0], spacings=3.0).any()
