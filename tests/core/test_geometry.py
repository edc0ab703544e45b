from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mdf_core.errors import DegenerateDesignError, EmptyScanError, NonFiniteScanError
from mdf_core.geometry import Design, PointSet

POINTS = np.arange(12.0).reshape(4, 3)


def test_points_become_float64_in_one_block() -> None:
    scan = PointSet(np.asfortranarray(POINTS.astype(np.float32)), areas=np.ones(4, np.int64))
    assert scan.points.dtype == np.float64
    assert scan.points.flags.c_contiguous
    assert scan.areas is not None
    assert scan.areas.dtype == np.float64
    assert len(scan) == 4


def test_normals_of_vertices_count_the_faces_around_them_by_area() -> None:
    # A corner of a box whose faces are split into triangles unevenly, and a vertex that nothing refers to.
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5], [9, 9, 9]], np.float64)
    design = Design(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2]]))
    corner = -np.array([15.0, 10.0, 6.0])
    np.testing.assert_allclose(design.vertex_normals[0], corner / np.linalg.norm(corner), rtol=1e-15)
    np.testing.assert_array_equal(design.vertex_normals[4], 0.0)
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = Design(ball.vertices, ball.faces).vertex_normals
    assert ((normals * ball.vertices).sum(axis=1) > np.cos(np.radians(1.0))).all()


def test_taking_points_takes_their_normals_and_areas() -> None:
    scan = PointSet(POINTS, POINTS + 100.0, np.arange(4.0))
    for index in (np.array([3, 1]), np.array([False, True, False, True])):
        part = scan.take(index)
        np.testing.assert_array_equal(part.points, POINTS[index])
        np.testing.assert_array_equal(part.normals, POINTS[index] + 100.0)
        np.testing.assert_array_equal(part.areas, np.arange(4.0)[index])
    bare = PointSet(POINTS).take(np.array([0]))
    assert bare.normals is None
    assert bare.areas is None


def test_the_hash_sees_points_normals_and_areas() -> None:
    scan = PointSet(POINTS, POINTS, np.ones(4))
    assert scan.sha256() == PointSet(POINTS.copy(), POINTS.copy(), np.ones(4)).sha256()
    others = [PointSet(POINTS + 1e-9, POINTS, np.ones(4)), PointSet(POINTS, None, np.ones(4)), PointSet(POINTS, POINTS)]
    assert len({scan.sha256(), *(other.sha256() for other in others)}) == 4


def test_no_points_are_no_scan() -> None:
    with pytest.raises(EmptyScanError):
        PointSet(np.empty((0, 3)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["points", "normals", "areas"])
def test_values_that_are_not_finite_are_counted_and_located(name: str, bad: float) -> None:
    parts = {"points": POINTS.copy(), "normals": POINTS.copy(), "areas": np.ones(4)}
    parts[name][2:] = bad
    with pytest.raises(NonFiniteScanError, match=f"2 of 4 {name} are NaN or infinite, the first at index 2"):
        PointSet(**parts)


def test_a_box_has_the_areas_normals_centre_and_scale_of_a_box() -> None:
    box = trimesh.creation.box((2.0, 4.0, 6.0))
    design = Design(box.vertices + np.array([10.0, 0.0, 0.0]), box.faces)
    assert design.face_areas.sum() == pytest.approx(2 * (8 + 12 + 24))
    assert design.vertex_areas.sum() == pytest.approx(2 * (8 + 12 + 24))
    np.testing.assert_allclose(design.face_normals, box.face_normals, atol=1e-12)
    np.testing.assert_allclose(design.centre, [10.0, 0.0, 0.0], atol=1e-12)
    # The mean of x² over a face pair is extent² / 4 on the faces across x and extent² / 12 on the others.
    areas, squares = np.array([24.0, 12.0, 8.0]), np.array([4.0, 16.0, 36.0])
    mean_squares = (areas @ squares / 4 + (areas.sum() * squares.sum() - areas @ squares) / 12) / areas.sum()
    assert design.scale == pytest.approx(np.sqrt(mean_squares))


def test_scale_and_centre_do_not_depend_on_how_the_surface_is_meshed() -> None:
    coarse = trimesh.creation.box((2.0, 4.0, 6.0))
    fine = coarse.subdivide().subdivide()
    one, other = Design(coarse.vertices, coarse.faces), Design(fine.vertices, fine.faces)
    assert one.scale == pytest.approx(other.scale, rel=1e-12)
    np.testing.assert_allclose(one.centre, other.centre, atol=1e-12)


def test_degenerate_faces_and_unreferenced_vertices_stay_and_weigh_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]])
    design = Design(vertices, np.array([[0, 1, 2], [0, 0, 1]]))
    assert design.faces.tolist() == [[0, 1, 2], [0, 0, 1]]
    np.testing.assert_allclose(design.vertex_areas, [1 / 6, 1 / 6, 1 / 6, 0.0])
    np.testing.assert_array_equal(design.face_normals, [[0, 0, 1], [0, 0, 0]])


@pytest.mark.parametrize(
    ("vertices", "faces", "what"),
    [
        (np.empty((0, 3)), np.empty((0, 3), int), "no triangles"),
        (np.eye(3), np.empty((0, 3), int), "no triangles"),
        (np.eye(3), [[0, 1, 3]], "names a vertex that does not exist"),
        (np.eye(3), [[0, 1, -1]], "names a vertex that does not exist"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "NaN or infinite"),
        (np.ones((3, 3)), [[0, 1, 2]], "no triangle has an area"),
    ],
)
def test_a_design_that_is_none_is_refused(vertices: np.ndarray, faces: np.ndarray, what: str) -> None:
    with pytest.raises(DegenerateDesignError, match=what):
        Design(vertices, np.asarray(faces), path="part.stl")
