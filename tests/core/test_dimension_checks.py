"""Walls, edges, moves, fixed regions and volume of redesigns: the largest change is found and placed."""

import numpy as np
import pytest
import trimesh
from check_samples import (
    NEAR_MM,
    box,
    bump,
    checks,
    distance,
    failed,
    inner_vertex,
    mesh_design,
    only_failure,
)
from scipy.spatial.transform import Rotation

from mdf_core.geometry import Design
from mdf_core.settings import ReleaseSettings

# Wall thickness


def test_a_wall_that_became_thinner_is_found_with_its_thicknesses(build):
    design = build("plate")
    found = checks(design, bump(design, (40.0, 40.0), 12.0, 1.0), ReleaseSettings(max_stretch=0.0))
    check = only_failure(found, "wall_thickness")
    assert "from 3 mm to 2.0" in check.finding and "limit 20 %" in check.finding
    assert np.linalg.norm(np.subtract(check.place[:2], [40.0, 40.0])) < NEAR_MM
    thicker = checks(design, bump(design, (40.0, 40.0), 12.0, -1.0), ReleaseSettings(max_stretch=0.0))
    assert "to 3.9" in only_failure(thicker, "wall_thickness").finding
    slight = checks(design, bump(design, (40.0, 40.0), 12.0, 0.5), ReleaseSettings(max_stretch=0.0))
    assert failed(slight) == []


def test_the_thickness_is_that_of_the_material_between_two_surfaces():
    """A hollow cube whose walls of 3 mm are pushed in from inside to 2 mm."""
    hollow = trimesh.creation.box((54.0, 54.0, 54.0)).subdivide_to_size(9.0)
    hollow.invert()
    design = mesh_design(box((60.0, 60.0, 60.0), edge_mm=9.0), hollow)
    vertices = design.vertices.copy()
    is_inner = np.abs(vertices).max(axis=1) < 28.0
    vertices[is_inner] *= 56.0 / 54.0
    check = only_failure(checks(design, vertices, ReleaseSettings(max_stretch=0.0)), "wall_thickness")
    assert "by up to 33." in check.finding and "from 3 mm to 2 mm" in check.finding


def test_the_length_of_a_rod_is_no_wall():
    design = mesh_design(box((100.0, 6.0, 6.0), edge_mm=3.0))
    longer = design.vertices * [1.3, 1.0, 1.0]
    found = checks(design, longer, ReleaseSettings(max_thickness_change=0.01, max_stretch=0.0))
    assert failed(found) == []
    assert "up to 0.0 %" in found["wall_thickness"].finding
    thicker = checks(design, design.vertices * [1.0, 1.02, 1.0], ReleaseSettings(max_thickness_change=0.01))
    assert "from 6 mm to 6.12 mm" in only_failure(thicker, "wall_thickness").finding


def test_material_between_a_body_and_another_inside_it_is_no_wall():
    design = mesh_design(box((40.0, 40.0, 4.0), edge_mm=3.0), box((8.0, 8.0, 1.0)))
    vertices = design.vertices.copy()
    vertices[-8:] += [0.0, 0.0, 0.5]
    found = checks(design, vertices, ReleaseSettings())
    assert failed(found) == []
    assert "up to 0.0 %" in found["wall_thickness"].finding


@pytest.mark.parametrize("depths_mm, has_wall", [((3.0, 3.0, 3.0), True), ((2.0, 50.0, 50.0), False)])
def test_walls_are_measured_up_to_a_quarter_of_the_radius(depths_mm, has_wall):
    upper = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0]])
    design = Design(np.vstack([upper, upper - np.outer(depths_mm, [0.0, 0.0, 1.0])]), [[0, 1, 2], [3, 5, 4]])
    finding = checks(design, design.vertices)["wall_thickness"].finding
    assert ("has no wall of up to" in finding) is not has_wall


@pytest.mark.parametrize("seed", range(10))
def test_the_thickness_is_found_however_the_part_lies(seed):
    upper = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0]])
    turn = Rotation.random(rng=seed).as_matrix()
    upright = np.vstack([upper, upper - [0.0, 0.0, 3.0]]) + 0.1
    design = Design(upright @ turn.T, [[0, 1, 2], [3, 5, 4]])
    thinner = (upright - np.outer([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0])) @ turn.T
    check = only_failure(checks(design, thinner, ReleaseSettings()), "wall_thickness")
    assert "by up to 33.3 % (limit 20 %), from 3 mm to 2 mm" in check.finding


# Stretch, moves, fixed regions, volume


def test_the_largest_stretch_is_found(build):
    design = build("plate")
    vertices = design.vertices.copy()
    beyond = np.maximum(vertices[:, 0] - 70.0, 0.0)
    vertices[:, 0] += 0.01 * beyond**2
    check = only_failure(checks(design, vertices, ReleaseSettings()), "stretch")
    assert "limit 20 %" in check.finding
    # The stretch grows along x; edges end at x = 100 mm.
    assert check.place[0] > 100.0 - NEAR_MM
    share = float(check.finding.split("up to ")[1].split(" %")[0]) / 100
    assert 0.52 < share < 0.60


def test_the_stretch_is_placed_at_the_middle_of_the_edge():
    design = Design([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]], [[0, 1, 2]])
    check = only_failure(checks(design, design.vertices * [1.0, 1.5, 1.0], ReleaseSettings()), "stretch")
    assert "by up to 50.0 % (limit 20 %), from 10 mm to 15 mm" in check.finding
    assert check.place == (0.0, 5.0, 0.0)


def test_rounding_of_short_edges_is_no_stretch():
    """A ball of 2 µm, 100 mm from the origin, moved as a whole."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1e-3)
    design = mesh_design(box((100.0, 100.0, 100.0)), ball.apply_translation((100.0, 100.0, 100.0)))
    vertices = design.vertices + 0.1234567
    edges = design.vertices[ball.edges_unique + 8], vertices.astype(np.float32)[ball.edges_unique + 8]
    before, after = (np.linalg.norm(np.diff(ends, axis=1), axis=2) for ends in edges)
    assert np.abs(after / before - 1.0).max() > 0.01
    assert failed(checks(design, vertices, ReleaseSettings(max_stretch=0.001, max_thickness_change=0.001))) == []


def test_the_largest_move_is_found(build):
    design = build("plate")
    vertex, _ = inner_vertex(design, [45.0, 50.0, 3.0])
    vertices = design.vertices + np.array([0.3, 0.0, 0.0])
    vertices[vertex] += [0.1, 0.0, 0.0]
    check = only_failure(checks(design, vertices, ReleaseSettings(max_move_mm=0.35)), "largest_move")
    assert "0.400 mm" in check.finding and "limit 0.35 mm" in check.finding
    assert distance(check, design.vertices[vertex]) == 0.0
    assert failed(checks(design, vertices, ReleaseSettings(max_move_mm=0.4))) == []


def test_a_fixed_vertex_must_not_move_at_all(build):
    design = build("plate")
    vertices = design.vertices.copy()
    vertices[100, 2] = np.nextafter(np.float32(vertices[100, 2]), np.float32(np.inf))
    vertices[200, 2] += 0.25
    check = only_failure(checks(design, vertices, fixed=[50, 100, 150]), "fixed_regions")
    assert "1 of 3 fixed vertices moved" in check.finding
    assert distance(check, design.vertices[100]) == 0.0
    assert failed(checks(design, vertices, fixed=[50, 150])) == []


def test_a_fixed_vertex_has_not_moved_where_its_coordinates_in_the_file_are_the_same(build):
    design = build("plate")
    vertex, _ = inner_vertex(design, [45.0, 50.0, 3.0])
    vertices = design.vertices.copy()
    vertices[vertex] += 1e-9
    assert failed(checks(design, vertices, fixed=[vertex])) == []
    finer = Design(design.vertices / 3.0, design.faces)
    assert failed(checks(finer, finer.vertices.astype(np.float32), fixed=range(len(finer.vertices)))) == []


def test_the_change_of_the_volume_is_told_and_never_fails(build):
    design = build("hub")
    found = checks(design, design.vertices * 1.01, ReleaseSettings())
    assert failed(found) == []
    assert "+3.030 %" in found["volume"].finding
    tiny = checks(design, design.vertices * 0.1)["volume"]
    assert tiny.passed and "-99.900 %" in tiny.finding


@pytest.mark.parametrize("name", ["wall_thickness", "stretch", "largest_move"])
def test_a_limit_of_nothing_is_none(build, name):
    design = build("plate")
    check = checks(design, design.vertices * [1.0, 1.0, 3.0])[name]
    assert check.passed and "no limit is set" in check.finding
