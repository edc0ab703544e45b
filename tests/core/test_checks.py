"""What a redesign is checked for before it is released: every fault is found and placed, nothing else is refused."""

import igl.predicates
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mdf_core.check_result import Check, describe_failures
from mdf_core.checks import check_redesign
from mdf_core.errors import DesignMismatchError
from mdf_core.geometry import Design
from mdf_core.settings import ReleaseSettings
from mdf_core.virtual_cell import PARTS, Warp

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


# Nothing wrong


@pytest.mark.parametrize("name", PARTS)
def test_a_redesign_that_changes_nothing_passes(build, name):
    design = build(name)
    settings = ReleaseSettings(max_move_mm=1e-6, max_stretch=1e-6, max_thickness_change=1e-6)
    found = checks(design, design.vertices, settings, fixed=range(len(design.vertices)))
    assert failed(found) == []
    assert "+0.000 %" in found["volume"].finding


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("seed", [0, 8])
def test_a_smooth_warp_of_ordinary_size_passes(build, name, seed):
    design = build(name)
    vertices = design.vertices + Warp(design, 2.5, seed=seed)(design.vertices)
    found = checks(design, vertices, ReleaseSettings(max_move_mm=2.5))
    assert describe_failures(list(found.values())) == ""


def test_vertices_that_are_not_shared_between_faces_make_no_difference(build):
    design = unmerged(build("clip"))
    found = checks(design, design.vertices + Warp(design, 2.5)(design.vertices), ReleaseSettings())
    assert failed(found) == []
    assert "encloses no volume" not in found["volume"].finding


def test_the_same_input_gives_the_same_answer(build):
    design = build("pair")
    vertices = design.vertices + [16.5, 0.0, 0.0] * (design.vertices[:, :1] < 45.0)
    first, *others = (checks(design, vertices) for _ in range(5))
    assert not first["self_intersections"].passed
    assert all(other == first for other in others)


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


def inner_vertex(design, near):
    """The vertex nearest to `near` and the faces around it."""
    vertex = int(np.linalg.norm(design.vertices - near, axis=1).argmin())
    return vertex, np.flatnonzero((design.faces == vertex).any(axis=1))


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


# Self-intersections


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


# Vertices that are nowhere


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_vertices_that_are_no_place_fail_what_cannot_be_checked(build, value):
    design = build("clip")
    vertices = design.vertices.copy()
    vertices[[300, 400], 1] = value
    found = checks(design, vertices, ReleaseSettings(), fixed=[5, 6])
    assert failed(found) == NAMES[:7]
    for name in NAMES[:7]:
        assert "2 of" in found[name].finding and "NaN or infinite" in found[name].finding
        assert distance(found[name], design.vertices[300]) == 0.0
    assert "not known" in found["volume"].finding
    moved_away = checks(design, vertices, fixed=[5, 400])
    assert failed(moved_away) == NAMES[:8]
    assert "not checked" in moved_away["fixed_regions"].finding
    vertices[5] += 1.0
    assert distance(checks(design, vertices, fixed=[5, 6])["fixed_regions"], design.vertices[5]) == 0.0


@pytest.mark.parametrize("everywhere", [False, True])
def test_vertices_far_away_or_all_on_one_spot_fail_without_an_error(build, everywhere):
    design = build("clip")
    vertices = design.vertices.copy()
    vertices[:] = vertices[0] if everywhere else vertices
    vertices[7] = vertices[0] if everywhere else 3e38
    found = checks(design, vertices, ReleaseSettings(max_move_mm=5.0))
    assert {"stretch", "largest_move"} <= set(failed(found))
    assert found["watertight"].passed is not everywhere


@pytest.mark.parametrize("change", ["vertices", "fixed"])
def test_the_redesign_of_another_design_is_refused(build, change):
    design = build("clip")
    vertices, fixed = design.vertices, np.zeros(len(design.vertices), dtype=bool)
    vertices, fixed = (vertices[1:], fixed) if change == "vertices" else (vertices, fixed[1:])
    with pytest.raises(DesignMismatchError, match=change):
        check_redesign(design, vertices, fixed, NO_LIMITS)


# In one line


def test_what_failed_is_told_in_one_line():
    found = [
        Check("watertight", True, "every edge joins exactly two faces", None),
        Check("self_intersections", False, "12 new pairs of faces cut each other", (12.08, 3.0, 44.84)),
        Check("stretch", False, "edges change their length by up to 30 %", (1.0, 2.0, -3.0)),
    ]
    assert describe_failures(found) == (
        "self_intersections: 12 new pairs of faces cut each other, near (12.1, 3.0, 44.8) mm; "
        "stretch: edges change their length by up to 30 %, near (1.0, 2.0, -3.0) mm"
    )
    assert describe_failures(found[:1]) == ""
