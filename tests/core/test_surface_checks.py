"""Surfaces of redesigns: what tore, joined, turned over or collapsed is found and placed."""

import numpy as np
import pytest
import trimesh
from check_samples import NEAR_MM, box, checks, distance, failed, inner_vertex, mesh_design, only_failure, unmerged

from mdf_core.geometry import Design
from mdf_core.settings import ReleaseSettings
from mdf_core.virtual_cell import Warp

# Watertight


def test_vertices_on_the_same_spot_are_found():
    """The corners of two blocks, 0.2 mm apart, come to touch."""
    design = mesh_design(box((10.0, 10.0, 10.0)), box((10.0, 10.0, 10.0), (10.2, 10.0, 10.0)))
    vertices = design.vertices.copy()
    corner = np.flatnonzero((vertices == [5.0, 5.0, 5.0]).all(axis=1)).item()
    vertices[corner] = [5.2, 5.0, 5.0]
    check = only_failure(checks(design, vertices), "watertight")
    assert "1 of 16 vertices" in check.finding
    assert distance(check, [5.2, 5.0, 5.0]) <= 0.2


def test_vertices_that_no_face_uses_make_no_difference():
    block = box((10.0, 10.0, 10.0))
    design = Design(np.vstack([[5.0, 5.0, 5.0], block.vertices, [8.0, 0.0, 0.0]]), block.faces + 1)
    vertices = design.vertices.copy()
    vertices[[0, -1]] = vertices[[3, 5]]
    found = checks(design, vertices)
    assert failed(found) == []
    assert "open itself" not in found["watertight"].finding


def test_an_edge_that_lost_its_length_is_found(build):
    design = build("plate")
    vertices = design.vertices.copy()
    gone, kept, _ = design.faces[1000]
    vertices[gone] = vertices[kept]
    found = checks(design, vertices)
    assert {"watertight", "degenerate_faces"} <= set(failed(found))
    assert distance(found["watertight"], vertices[kept]) < NEAR_MM
    assert distance(found["degenerate_faces"], vertices[kept]) < NEAR_MM


def test_a_surface_torn_open_is_found():
    design = unmerged(mesh_design(box((20.0, 20.0, 20.0))))
    vertices = design.vertices.copy()
    vertices[7] *= 1.05
    check = only_failure(checks(design, vertices), "watertight")
    assert "torn open" in check.finding
    assert distance(check, design.vertices[7]) == 0.0


@pytest.mark.parametrize("gap_mm, passes", [(1e-9, True), (1e-3, False)])
def test_only_what_rounding_alone_keeps_apart_may_be_joined(gap_mm, passes):
    """A pyramid of 100 mm with two tips, joined by the redesign."""
    base = [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]]
    tips = [[30.0, 30.0, 100.0], [30.0 + gap_mm, 30.0, 100.0]]
    design = Design(base + tips, [[0, 2, 1], [0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 3, 4], [2, 0, 3]])
    vertices = design.vertices.copy()
    vertices[4] = vertices[3]
    found = checks(design, vertices)
    assert failed(found) == ([] if passes else ["watertight"])
    assert "encloses no volume" not in found["volume"].finding


def test_an_open_design_passes_as_it_is(build):
    closed = build("plate")
    design = Design(closed.vertices, closed.faces[closed.face_normals[:, 2] > -0.5])
    found = checks(design, design.vertices + Warp(design, 2.5)(design.vertices), ReleaseSettings())
    assert failed(found) == []
    assert "open itself" in found["watertight"].finding
    assert "encloses no volume" in found["volume"].finding


# Orientation


@pytest.mark.parametrize("is_open", [False, True])
def test_a_flipped_face_is_found(build, is_open):
    closed = build("plate")
    design = Design(closed.vertices, closed.faces[closed.face_normals[:, 2] > -0.5]) if is_open else closed
    vertex, around = inner_vertex(design, [45.0, 50.0, 3.0])
    vertices = design.vertices.copy()
    opposite = design.faces[around[0]][design.faces[around[0]] != vertex]
    vertices[vertex] += 1.6 * (vertices[opposite].mean(axis=0) - vertices[vertex])
    found = checks(design, vertices)
    # Where the fold lies on the surface beside it, the two cut each other.
    assert set(failed(found)) <= {"orientation", "self_intersections"}
    assert "flipped, turned by up to 180°" in found["orientation"].finding
    assert distance(found["orientation"], design.vertices[vertex]) < NEAR_MM


def test_a_body_turned_inside_out_is_found(build):
    """Mirrored at a point all faces look where they did, but the material is on their other side."""
    design = build("pair")
    vertices = design.vertices.copy()
    is_block = vertices[:, 0] < 45.0
    vertices[is_block] = [40.0, 30.0, 12.0] - vertices[is_block]
    check = only_failure(checks(design, vertices), "orientation")
    assert "1 of 2 bodies are inside out" in check.finding
    assert check.place[0] < 45.0


def test_an_open_design_has_no_inside(build):
    closed = build("plate")
    design = Design(closed.vertices, closed.faces[closed.face_normals[:, 2] > -0.5])
    assert failed(checks(design, [100.0, 60.0, 3.0] - design.vertices)) == []


def test_a_body_that_encloses_nothing_has_no_inside():
    """A sheet of two triangles, back to back, beside a block."""
    sheet = trimesh.Trimesh([[20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [20.0, 10.0, 1.0]], [[0, 1, 2], [2, 1, 0]])
    design = mesh_design(box((10.0, 10.0, 10.0)), sheet)
    found = checks(design, design.vertices + 0.1 * np.sin(design.vertices))
    assert failed(found) == []
    assert "open itself" not in found["watertight"].finding


def test_a_face_folded_back_onto_its_neighbour_is_flipped():
    design = Design([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [4.0, 8.0, 0.0], [5.0, -9.0, 0.0]], [[0, 1, 2], [1, 0, 3]])
    vertices = design.vertices.copy()
    vertices[3, 1] = 9.0
    check = only_failure(checks(design, vertices), "orientation")
    assert "1 of 2 faces are flipped, turned by up to 180°" in check.finding
    assert distance(check, [5.0, -3.0, 0.0]) < 1e-6


def test_a_fault_in_a_fine_detail_is_found():
    """A ball of 0.05 mm on a part of 100 mm; one vertex is pushed out through its other side."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05).apply_translation((60.0, 0.0, 0.0))
    design = mesh_design(box((100.0, 100.0, 100.0)), ball)
    vertices = design.vertices.copy()
    vertices[8] -= 2.5 * (vertices[8] - [60.0, 0.0, 0.0])
    found = checks(design, vertices)
    assert {"orientation", "self_intersections"} <= set(failed(found))
    assert distance(found["orientation"], [60.0, 0.0, 0.0]) < 0.1


# Degenerate faces


def test_a_collapsed_face_is_found(build):
    design = build("plate")
    vertex, around = inner_vertex(design, [45.0, 50.0, 3.0])
    vertices = design.vertices.copy()
    opposite = design.faces[around[0]][design.faces[around[0]] != vertex]
    vertices[vertex] += 0.97 * (vertices[opposite].mean(axis=0) - vertices[vertex])
    check = only_failure(checks(design, vertices), "degenerate_faces")
    assert "1 of 6874 faces have collapsed" in check.finding
    assert distance(check, design.triangles[around[0]].mean(axis=0)) < 1e-6


def test_faces_as_small_as_rounding_are_not_judged(rng):
    """A ball of 10 nm, 100 mm from the origin: rounding leaves hardly any of its faces."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=1e-5).apply_translation((100.0, 100.0, 100.0))
    design = mesh_design(box((10.0, 10.0, 10.0)), ball)
    found = checks(design, design.vertices)
    assert set(failed(found)) <= {"watertight", "self_intersections"}


def test_a_face_without_an_area_cuts_nothing():
    corners = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 10.0]]
    design = Design([*corners, [2.0, 2.0, -50.0], [20.0, 20.0, 50.0], [11.0, 13.0, 0.0]], [[0, 1, 2], [3, 4, 5]])
    vertices = design.vertices.copy()
    vertices[5] = [11.0, 11.0, 0.0]
    check = only_failure(checks(design, vertices), "degenerate_faces")
    assert "to 0 mm" in check.finding
