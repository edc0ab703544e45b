"""Redesigns that cut themselves: new cuts are found and placed, those of the design are not held against them."""

import igl.predicates
import numpy as np
import pytest
import trimesh
from check_samples import (
    box,
    bump,
    checks,
    distance,
    failed,
    mesh_design,
    only_failure,
)

from mdf_core.geometry import Design
from mdf_core.settings import ReleaseSettings
from mdf_core.virtual_cell import Warp


def test_a_body_that_moved_into_another_is_found(build):
    design = build("pair")
    vertices = design.vertices.copy()
    is_block = vertices[:, 0] < 45.0
    vertices[is_block] += [16.0, 0.0, 0.0]
    check = only_failure(checks(design, vertices, ReleaseSettings()), "self_intersections")
    # The block of 40 mm now reaches 1 mm into the angle, which begins at x = 55 mm and is 5 mm high.
    x, y, z = check.place
    assert 53.0 < x < 58.0 and -2.0 < y < 32.0 and -2.0 < z < 7.0


@pytest.mark.parametrize("into", [True, False])
def test_a_body_wholly_inside_another_is_found(into):
    beside, inside = (30.0, 1.0, 2.0), (0.5, 1.0, 2.0)
    block, pin = box((20.0, 20.0, 20.0)), box((3.0, 3.0, 3.0), beside if into else inside)
    design = mesh_design(block, pin)
    vertices = design.vertices.copy()
    move = np.subtract(inside, beside) if into else np.subtract(beside, inside)
    vertices[8:] += move
    check = only_failure(checks(design, vertices), "self_intersections")
    assert "1 of 2 bodies" in check.finding
    assert distance(check, inside if into else beside) < 3.0


def test_a_body_in_an_open_cup_is_not_inside_another():
    cup = box((20.0, 20.0, 20.0))
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    design = mesh_design(cup, box((3.0, 3.0, 3.0), (30.0, 0.0, 0.0)))
    vertices = design.vertices.copy()
    vertices[-8:] -= [30.0, 0.0, 0.0]
    assert failed(checks(design, vertices)) == []


def test_a_wall_pushed_through_the_opposite_wall_is_found(build):
    design = build("plate")
    found = checks(design, bump(design, (40.0, 40.0), 12.0, 3.3))
    check = only_failure(found, "self_intersections")
    assert np.linalg.norm(np.subtract(check.place[:2], [40.0, 40.0])) < 6.0
    assert abs(check.place[2]) < 0.5
    assert failed(checks(design, bump(design, (40.0, 40.0), 12.0, 2.7))) == []


def test_faces_with_a_common_corner_that_cut_each_other_are_found():
    corners = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [3.0, 3.0, 6.0], [4.0, 3.0, 2.0]]
    design = Design(corners, [[0, 1, 2], [0, 3, 4]])
    vertices = design.vertices.copy()
    vertices[4, 2] = -2.0
    check = only_failure(checks(design, vertices), "self_intersections")
    assert distance(check, [3.5, 3.0, 0.0]) < 4.0


@pytest.mark.parametrize(("depth_mm", "is_cut"), [(1e-5, False), (1e-3, True)])
def test_a_cut_no_deeper_than_rounding_is_none(depth_mm, is_cut):
    """As of faces that lie on each other, where a rod ends in a plate, when the part bends."""
    design = Design(
        [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [3.0, 2.0, 1e-4], [5.0, 3.0, 1e-4], [2.0, 5.0, 1e-4]],
        [[0, 1, 2], [3, 5, 4]],
    )
    vertices = design.vertices.copy()
    vertices[3, 2] = -depth_mm
    cuts, _, _ = igl.predicates.find_self_intersections(vertices.astype(np.float32).astype(float), design.faces)
    assert cuts
    assert checks(design, vertices)["self_intersections"].passed != is_cut


def overlapping(offset):
    """A block and a cylinder of other triangles, the cylinder's middle `offset` from the block's."""
    cylinder = trimesh.creation.cylinder(8.0, 30.0, sections=40).subdivide_to_size(3.0)
    return mesh_design(box((40.0, 30.0, 12.0), edge_mm=4.0), cylinder.apply_translation(offset))


@pytest.mark.parametrize(
    "offset",
    [
        pytest.param((5.0, 3.0, 0.0), id="through"),
        pytest.param((1.3, 0.7, 21.0), id="standing on it"),
        pytest.param((5.0, 3.0, 9.0), id="ends in one plane"),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_where_the_design_cuts_itself_a_smooth_warp_may_too(offset, seed):
    design = overlapping(offset)
    found = checks(design, design.vertices + Warp(design, 2.5, seed=seed)(design.vertices))
    assert failed(found) == []
    own = igl.predicates.find_self_intersections(design.vertices.astype(np.float32).astype(float), design.faces)[1]
    assert f"{len(own)} pairs of the design itself do" in found["self_intersections"].finding


def test_a_cut_elsewhere_is_found_in_a_design_that_cuts_itself():
    design = overlapping((5.0, 3.0, 9.0))
    vertices = design.vertices.copy()
    vertices[vertices[:, 2] > 20.0] -= [0.0, 0.0, 35.0]
    check = checks(design, vertices)["self_intersections"]
    assert not check.passed
    # The cylinder's upper end is drawn down through the block's bottom.
    assert np.linalg.norm(np.subtract(check.place[:2], [5.0, 3.0])) < 10.0


def test_slivers_that_turned_over_cut_nothing_worth_telling(build):
    """The predicates find them: triangles 2 µm high beside a hole, which the bend of the plate folds over."""
    design = build("plate")
    vertices = design.vertices + Warp(design, 2.5, seed=8)(design.vertices)
    is_cut, _, _ = igl.predicates.find_self_intersections(vertices.astype(np.float32).astype(float), design.faces)
    assert is_cut
    assert checks(design, vertices)["self_intersections"].passed


def bar_with_sliver(height_mm):
    """A bar, one edge with a vertex in its middle that only the face on one side knows; a flat triangle fills the gap.

    Returns the design and the vertex, which lies `height_mm` inside the face.
    """
    bar = trimesh.creation.box((40.0, 10.0, 10.0))
    start, end = np.flatnonzero((bar.vertices[:, 1:] == [5.0, 5.0]).all(axis=1))
    split = np.flatnonzero(np.isin(bar.faces, [start, end]).sum(axis=1) == 2)[0]
    face = bar.faces[split]
    one, other = np.roll(face, -1 - np.flatnonzero(~np.isin(face, [start, end])).item())[:2]
    apex = face[~np.isin(face, [start, end])].item()
    middle = len(bar.vertices)
    parts = [[apex, one, middle], [apex, middle, other], [one, other, middle]]
    inward = bar.vertices[apex] - bar.vertices[[one, other]].mean(axis=0)
    inward[0] = 0.0
    point = bar.vertices[[one, other]].mean(axis=0) + height_mm * inward / np.linalg.norm(inward)
    design = Design(np.vstack([bar.vertices, point]), np.vstack([np.delete(bar.faces, split, axis=0), parts]))
    return design, middle


@pytest.mark.parametrize("bend_mm", [0.01, -0.01])
@pytest.mark.parametrize("height_mm", [0.0, 0.005])
def test_slivers_may_turn_over_to_either_side(height_mm, bend_mm):
    design, middle = bar_with_sliver(height_mm)
    assert (design.face_areas == 0).sum() == (height_mm == 0)
    vertices = design.vertices.copy()
    vertices[middle, 1:] += bend_mm
    found = checks(design, vertices)
    assert failed(found) == []
    assert "open itself" not in found["watertight"].finding


def test_a_sliver_that_turned_over_and_grew_is_found():
    design, middle = bar_with_sliver(0.005)
    inward = design.vertices[middle] - [0.0, 5.0, 5.0]
    vertices = design.vertices.copy()
    vertices[middle] -= 200.0 * inward
    assert "orientation" in failed(checks(design, vertices))


def test_a_cut_beside_a_sliver_that_did_not_turn_over_is_found():
    corners = [[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [20.0, 0.001, 0.0]]
    left = [[10.0, -5.0, 5.0], [10.0, 5.0, 5.0]]
    right = [[15.0, -1.0, 9.0], [15.0, 1.0, 9.0]]
    design = Design(corners + left + right, [[0, 1, 2], [0, 3, 4], [1, 5, 6]])
    vertices = design.vertices.copy()
    vertices[5:] -= [14.0, 0.0, 7.0]
    check = only_failure(checks(design, vertices), "self_intersections")
    assert distance(check, [4.0, 0.0, 2.0]) < 4.0
