"""Where two faces of a design meet at an angle."""

import numpy as np
import pytest
import trimesh

import mdf_core as mdf
from mdf_core.edges import Edges


def design_of(mesh):
    return mdf.Design(np.array(mesh.vertices), np.array(mesh.faces))


@pytest.fixture(params=["shared vertices", "triangle soup"])
def box(request):
    mesh = trimesh.creation.box(extents=(20.0, 10.0, 4.0))
    if request.param == "triangle soup":
        mesh = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(12, 3), process=False)
    return design_of(mesh)


@pytest.mark.parametrize("spacing", [0.1, 3.0])
def test_points_near_an_edge_are_told_to_the_reach_whatever_the_samples(box, spacing, rng):
    points = rng.uniform([-12.0, -7.0, -4.0], [12.0, 7.0, 4.0], size=(2_000, 3))
    beyond = np.abs(np.abs(points) - [10.0, 5.0, 2.0])  # from the planes of the faces
    outside = np.maximum(np.abs(points) - [10.0, 5.0, 2.0], 0.0)  # beyond the ends of the edges along each axis
    distances = [
        np.sqrt((np.delete(beyond, axis, axis=1) ** 2).sum(axis=1) + outside[:, axis] ** 2) for axis in range(3)
    ]
    np.testing.assert_array_equal(Edges.of(box, spacing).are_near(points, 0.7), np.min(distances, axis=0) < 0.7)


def test_a_smooth_part_has_no_edges():
    sphere = design_of(trimesh.creation.icosphere(subdivisions=3, radius=10.0))
    assert not Edges.of(sphere, 0.5).are_near(sphere.vertices, 5.0).any()


def test_of_a_cylinder_the_rims_are_edges():
    cylinder = design_of(trimesh.creation.cylinder(radius=5.0, height=20.0, sections=64))
    places = [[5.0, 0.0, 9.9], [5.0, 0.0, 0.0], [0.0, 0.0, 10.0]]
    assert Edges.of(cylinder, 0.5).are_near(np.array(places), 0.5).tolist() == [True, False, False]
