"""Closest points on the design's triangles."""

import numpy as np
import pytest
import trimesh
from trimesh.triangles import closest_point

from mdf_core.design_surface import DesignSurface, spread_samples
from mdf_core.geometry import Design


def as_design(mesh):
    return Design(mesh.vertices, mesh.faces)


def sphere(radius=20.0):
    return as_design(trimesh.creation.icosphere(subdivisions=3, radius=radius))


def box(*size):
    return as_design(trimesh.creation.box(size))


def by_brute_force(design, points):
    """Distance to every triangle."""
    distances = np.empty(len(points))
    for number, point in enumerate(points):
        feet = closest_point(design.triangles, np.broadcast_to(point, (len(design.faces), 3)))
        distances[number] = np.sqrt(((feet - point) ** 2).sum(axis=1)).min()
    return distances


def around(design, rng, count, reach):
    """Points up to `reach` (mm) off the surface."""
    samples, _ = spread_samples(design, count)
    picked = samples[rng.permutation(len(samples))[:count]]
    return picked + reach * rng.uniform(-1.0, 1.0, size=picked.shape)


@pytest.mark.parametrize("reach", [0.5, 60.0])
@pytest.mark.parametrize("shape", ["clip", "bracket", "sphere", "box"])
def test_the_point_found_is_the_closest_of_all_triangles(shape, reach, build, rng):
    # The box has twelve large triangles, the sphere 1280 small ones, the parts sharp edges, thin walls and slivers.
    makers = {"sphere": sphere, "box": lambda: box(40.0, 30.0, 4.0)}
    design = makers[shape]() if shape in makers else build(shape)
    points = around(design, rng, 200, reach)
    found = DesignSurface(design, 150_000).closest(points)
    distances = np.linalg.norm(points - found.points, axis=1)
    excess = distances - by_brute_force(design, points)
    assert excess.min() > -1e-9
    # Where another triangle is nearer, it is by less than the spacing of the samples, and seldom.
    spacing = np.sqrt(design.face_areas.sum() / 150_000)
    assert (excess < 1e-9).mean() >= 0.9
    assert excess.max() < 0.5 * spacing
    assert excess.mean() < 0.01 * spacing


def test_feet_lie_on_the_surface_and_come_with_the_normal_of_their_triangle(build, rng):
    design = build("bracket")
    surface = DesignSurface(design, 30_000)
    found = surface.closest(around(design, rng, 500, 3.0))
    np.testing.assert_allclose(by_brute_force(design, found.points[:100]), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, rtol=1e-12)


def test_distances_are_positive_outside_the_material():
    surface = DesignSurface(box(40.0, 30.0, 4.0))
    points = np.array([[1.0, 2.0, 3.5], [1.0, 2.0, 0.5], [-3.0, 4.0, -2.25], [22.5, 3.0, 0.1]])
    found = surface.closest(points)
    np.testing.assert_allclose(found.distances, [1.5, -1.5, 0.25, 2.5], atol=1e-9)
    np.testing.assert_allclose(found.points[0], [1.0, 2.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(found.normals, [[0, 0, 1], [0, 0, 1], [0, 0, -1], [1, 0, 0]], atol=1e-12)


def test_from_far_off_a_face_on_the_points_own_side_is_found_within_a_few_per_cent(build, rng):
    design = build("bracket")
    samples, faces = spread_samples(design, 20_000)
    picked = rng.permutation(len(samples))[:300]
    normals = design.face_normals[faces[picked]]
    points = samples[picked] + 0.2 * design.scale * normals  # off their own face; others may be nearer
    found = DesignSurface(design).closest(points, normals)
    distances = np.linalg.norm(points - found.points, axis=1)
    assert (np.einsum("ij,ij->i", found.normals, normals) > 0.0).all()
    assert (distances < 1.05 * 0.2 * design.scale).all()


def test_with_normals_both_faces_of_a_thin_wall_are_told_apart(rng):
    wall = box(60.0, 40.0, 1.0)
    surface = DesignSurface(wall)
    across = np.column_stack([rng.uniform(-25, 25, 200), rng.uniform(-15, 15, 200)])
    # 0.9 mm into a wall of 1 mm: the other face is nine times nearer.
    deep = np.column_stack([across, np.full(200, -0.4)])
    up = np.tile([0.0, 0.0, 1.0], (200, 1))
    np.testing.assert_allclose(surface.closest(deep).distances, -0.1, atol=1e-9)
    np.testing.assert_allclose(surface.closest(deep, up).distances, -0.9, atol=1e-9)
    np.testing.assert_allclose(surface.closest(deep, -up).distances, -0.1, atol=1e-9)


def test_the_same_points_find_the_same_feet_however_many_are_asked_at_once(build, rng):
    design = build("clip")
    surface = DesignSurface(design, 20_000)
    points = around(design, rng, 6_000, 2.0)
    normals = rng.normal(size=points.shape)
    whole = surface.closest(points, normals)
    pieces = [surface.closest(points[part], normals[part]) for part in np.array_split(np.arange(6_000), 3)]
    np.testing.assert_array_equal(whole.points, np.concatenate([piece.points for piece in pieces]))
    np.testing.assert_array_equal(whole.distances, np.concatenate([piece.distances for piece in pieces]))


def test_triangles_without_an_area_and_unreferenced_vertices_do_no_harm():
    clean = box(40.0, 30.0, 4.0)
    vertices = np.vstack([clean.vertices, [[500.0, 0.0, 0.0]]])
    dirty = Design(vertices, np.vstack([clean.faces, [[0, 0, 1], [2, 2, 2]]]))
    points = np.array([[1.0, 2.0, 3.5], [30.0, 0.0, 0.0], [-20.0, -15.0, -2.0]])
    for normals in (None, np.tile([0.0, 0.0, 1.0], (3, 1))):
        expected, found = (DesignSurface(design).closest(points, normals) for design in (clean, dirty))
        np.testing.assert_allclose(found.points, expected.points, atol=1e-12)
        np.testing.assert_allclose(found.distances, expected.distances, atol=1e-12)


def test_samples_lie_evenly_on_all_triangles(build):
    design = build("bracket")
    points, faces = spread_samples(design, 50_000, least=1)
    assert len(points) == len(faces) == pytest.approx(50_000, rel=0.1)
    np.testing.assert_array_equal(np.unique(faces), np.flatnonzero(design.face_areas > 0))
    feet = closest_point(design.triangles[faces], points)
    np.testing.assert_allclose(feet, points, atol=1e-9)
    np.testing.assert_allclose(points.mean(axis=0), design.centre, atol=0.02 * design.scale)
    # Within a triangle, too: the samples of a large one have its centroid.
    large = box(40.0, 30.0, 4.0)
    points, faces = spread_samples(large, 50_000)
    for face, triangle in enumerate(large.triangles):
        np.testing.assert_allclose(points[faces == face].mean(axis=0), triangle.mean(axis=0), atol=0.25)


@pytest.mark.parametrize("count", [10, 1_000, 50_000])
def test_there_are_as_many_samples_as_wanted_however_fine_the_design(count, build):
    design = build("bracket")
    points, faces = spread_samples(design, count)
    assert len(points) == len(faces) == count
    halves = design.triangles.mean(axis=1)[:, 0] > design.centre[0]
    share = design.face_areas[halves].sum() / design.face_areas.sum()
    assert halves[faces].mean() == pytest.approx(share, abs=3.0 / np.sqrt(count))


def test_samples_are_the_same_at_every_call(build):
    first, again = spread_samples(build("clip"), 5_000), spread_samples(build("clip"), 5_000)
    assert first[0].tobytes() == again[0].tobytes()
    np.testing.assert_array_equal(first[1], again[1])
