"""The rigid pose: candidates, the choice between them, and which way the normals face."""

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Manifold
from scipy.spatial.transform import Rotation

from mdf_core.design_surface import DesignSurface
from mdf_core.errors import CancelledError, InvalidSettingError
from mdf_core.geometry import Design, PointSet
from mdf_core.outward import outward
from mdf_core.pose import candidate_poses, refine_pose
from mdf_core.pose_choice import choose_pose, place
from mdf_core.progress import silent
from mdf_core.rigid import best_rigid_fit, homogeneous, inverse, transform
from mdf_core.sampling import prepare
from mdf_core.settings import PoseSettings, Settings
from mdf_core.virtual_cell import ScannerSettings, Warp, scan_part

POINTS = 3_000


def prepared(one):
    return prepare(one.scan, Settings())


def misplacement(pose, one):
    """RMS distance (mm) of the design's vertices to their places, had the scan been put by `pose`."""
    moved = transform(pose @ one.virtual.pose, one.design.vertices)
    return float(np.sqrt(((moved - one.design.vertices) ** 2).sum(axis=1).mean()))


def perturbed(pose, degrees, millimetres, about, rng):
    """`pose`, then a turn about a random axis through `about`, then a shift."""
    axis, shift = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    return homogeneous(turn, about - turn @ about + millimetres * shift) @ pose


def is_rigid(pose):
    rotation = pose[:3, :3]
    return np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0


def slab():
    """Symmetric to half turns about all three axes; refined, because density is decided face by face."""
    mesh = trimesh.creation.box((80.0, 50.0, 6.0)).subdivide_to_size(4.0)
    return Design(mesh.vertices, mesh.faces)


def scan_of_slab(seed=0):
    design = slab()
    printed = design.vertices + Warp(design, 0.1, 50.0)(design.vertices)
    return design, scan_part(printed, design.faces, ScannerSettings(points=POINTS, pose="random"), seed)


# Candidates


def notched_beam():
    """300 mm long, 10 mm thick; what tells its four sides and two ends apart is small."""
    beam = Manifold.cube((300.0, 10.0, 10.0)) - Manifold.cube((30.0, 4.0, 4.0)).translate((60.0, 3.0, 6.0))
    for x in (20.0, 110.0, 190.0, 270.0):
        beam -= Manifold.cylinder(10.0, 2.0, circular_segments=24).translate((x, 4.0, 0.0))
    mesh = beam.refine_to_length(4.0).to_mesh64()
    return Design(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


@pytest.mark.parametrize("seed", range(4))
def test_a_beam_is_found_the_right_way_round_and_at_its_place(seed):
    # Turned about its axis, or shifted along it by its thickness, a beam hardly moves against its length.
    design = notched_beam()
    warp = Warp(design, 0.4, 150.0, seed)
    scanner = ScannerSettings(points=20_000, noise_mm=0.03, pose="random")
    virtual = scan_part(design.vertices + warp(design.vertices), design.faces, scanner, seed)
    choice = choose_pose(prepare(virtual.scan, Settings()), DesignSurface(design), PoseSettings(), 0, silent)
    moved = transform(choice.pose @ virtual.pose, design.vertices)
    assert np.sqrt(((moved - design.vertices) ** 2).sum(axis=1).mean()) < 1.5
    assert not choice.alternatives


def cap_with_tab():
    """Round but for one tab at its rim, a hundredth of its surface."""
    outline = [[(0.0, 0.0), (35.0, 0.0), (35.0, 11.0), (33.0, 11.0), (33.0, 2.0), (0.0, 2.0)]]
    cap = Manifold.revolve(CrossSection(outline), 96) + Manifold.cube((7.0, 12.0, 2.5)).translate((33.5, -6.0, 8.5))
    mesh = cap.refine_to_length(3.0).to_mesh64()
    return Design(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


@pytest.mark.parametrize("seed", [1, 3])
def test_a_round_cap_is_found_turned_as_its_tab_tells(seed):
    design = cap_with_tab()
    printed = design.vertices + Warp(design, 1.0, 35.0, seed)(design.vertices)
    scanner = ScannerSettings(points=6_000, pose="random", density_contrast=3.0)
    virtual = scan_part(printed, design.faces, scanner, seed)
    choice = choose_pose(prepare(virtual.scan, Settings()), DesignSurface(design), PoseSettings(), 0, silent)
    assert np.degrees(Rotation.from_matrix(choice.pose[:3, :3] @ virtual.pose[:3, :3]).magnitude()) < 2.0


@pytest.mark.parametrize("degrees", [-6.0, 6.0])
def test_a_given_pose_of_a_round_cap_is_turned_as_its_tab_tells(degrees):
    design = cap_with_tab()
    turn = homogeneous(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))
    virtual = scan_part(design.vertices, design.faces, ScannerSettings(points=6_000))
    refined = refine_pose(turn, virtual.scan.points, design, seed=0)
    assert np.degrees(Rotation.from_matrix(refined[:3, :3]).magnitude()) < 1.0


@pytest.mark.parametrize("name", ["bracket", "plate"])
def test_the_true_pose_is_among_few_distinct_candidates(name, print_and_scan):
    one = print_and_scan(name, points=POINTS, scan_seed=1)
    poses = candidate_poses(one.scan.points, one.design, 10, seed=0)
    assert 1 <= len(poses) <= 10
    assert all(is_rigid(pose) for pose in poses)
    assert min(misplacement(pose, one) for pose in poses) < 2.5  # the warp's own size
    places = [transform(pose, one.scan.points) for pose in poses]
    apart = [
        np.sqrt(((a - b) ** 2).sum(axis=1).mean()) for number, a in enumerate(places) for b in places[number + 1 :]
    ]
    assert min(apart, default=np.inf) > 0.1 * one.design.scale


def test_candidates_are_the_same_at_every_call(print_and_scan):
    one = print_and_scan("plate", points=POINTS, scan_seed=1)
    first, again = (candidate_poses(one.scan.points, one.design, 4, seed=0) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    other = candidate_poses(one.scan.points, one.design, 4, seed=1)
    assert other.tobytes() != first.tobytes(), "the seed draws the points"


@pytest.mark.parametrize("seed", range(4))
def test_a_rough_pose_is_refined(seed, print_and_scan):
    one = print_and_scan("bracket", points=POINTS, scan_seed=1)
    rough = perturbed(one.pose, 10.0, 5.0, one.design.centre, np.random.default_rng(seed))
    assert misplacement(rough, one) > 5.0
    refined = refine_pose(rough, one.scan.points, one.design, seed=0)
    assert is_rigid(refined)
    assert misplacement(refined, one) < 2.5  # the warp itself


# The choice


@pytest.mark.parametrize(("name", "seed"), [("bracket", 1), ("clip", 2)])
def test_an_asymmetric_part_is_found_in_any_pose_without_doubt(name, seed, print_and_scan):
    one = print_and_scan(name, points=POINTS, warp_seed=seed, scan_seed=seed)
    choice = choose_pose(prepared(one), DesignSurface(one.design), PoseSettings(), 0, silent)
    assert is_rigid(choice.pose)
    assert misplacement(choice.pose, one) < 2.5
    assert choice.alternatives == ()


def test_a_hidden_side_does_not_mislead_the_search(print_and_scan):
    one = print_and_scan("bracket", points=POINTS, scan_seed=4, hidden_share=0.2)
    choice = choose_pose(prepared(one), DesignSurface(one.design), PoseSettings(), 0, silent)
    assert misplacement(choice.pose, one) < 2.5


def test_a_symmetric_part_has_all_its_poses_named():
    design, virtual = scan_of_slab()
    choice = choose_pose(prepare(virtual.scan, Settings()), DesignSurface(design), PoseSettings(), 0, silent)
    half_turns = [
        np.diag([1.0, 1.0, 1.0, 1.0]),
        *(np.diag([*signs, 1.0]) for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))),
    ]
    found = [choice.pose, *choice.alternatives]
    assert len(found) == 4
    for turn in half_turns:
        expected = transform(turn @ inverse(virtual.pose), virtual.scan.points)
        distances = [
            np.sqrt(((transform(pose, virtual.scan.points) - expected) ** 2).sum(axis=1).mean()) for pose in found
        ]
        assert min(distances) < 1.0


def test_a_given_pose_is_refined_and_not_searched(print_and_scan, rng):
    design, virtual = scan_of_slab()
    scan = prepare(virtual.scan, Settings())
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    for wanted in (inverse(virtual.pose), half_turn @ inverse(virtual.pose)):
        given = perturbed(wanted, 5.0, 2.0, design.centre, rng)
        quaternion = 3.0 * Rotation.from_matrix(given[:3, :3]).as_quat()  # of any length
        numbers = tuple(float(number) for number in (*given[:3, 3], *quaternion))
        choice = choose_pose(scan, DesignSurface(design), PoseSettings(numbers), 0, silent)
        assert choice.alternatives == ()
        np.testing.assert_allclose(transform(choice.pose, scan.points), transform(wanted, scan.points), atol=2.0)


def test_datum_points_give_the_pose():
    design, virtual = scan_of_slab()
    scan = prepare(virtual.scan, Settings())
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    corners = design.vertices[[0, len(design.vertices) // 3, -1]]
    for wanted in (inverse(virtual.pose), half_turn @ inverse(virtual.pose)):
        touched = transform(inverse(wanted), corners) + 0.3
        settings = PoseSettings(datum_design=tuple(corners.ravel()), datum_scan=tuple(touched.ravel()))
        choice = choose_pose(scan, DesignSurface(design), settings, 0, silent)
        assert choice.alternatives == ()
        np.testing.assert_allclose(transform(choice.pose, scan.points), transform(wanted, scan.points), atol=2.0)


CORNERS = np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 50.0, 6.0], [30.0, 40.0, 0.0]])


def datum(in_scan):
    return PoseSettings(datum_design=tuple(CORNERS.ravel()), datum_scan=tuple(in_scan.ravel()))


@pytest.mark.parametrize("factor", [1e-3, 0.1, 1.0 / 25.4, 25.4, 1e3])
def test_datum_points_in_another_unit_are_refused(factor, print_and_scan):
    one = print_and_scan("plate", points=POINTS, scan_seed=1)
    there = transform(inverse(homogeneous(np.eye(3), np.array([10.0, 20.0, 30.0]))), CORNERS)
    with pytest.raises(InvalidSettingError, match=r"no rigid motion .*; give both in mm and in the same order"):
        choose_pose(prepared(one), DesignSurface(one.design), datum(factor * there), 0, silent)


def test_the_datum_point_that_does_not_fit_is_named(print_and_scan):
    one = print_and_scan("plate", points=POINTS, scan_seed=1)
    there = CORNERS + np.array([300.0, 0.0, 0.0])
    there[2, 2] += 60.0
    with pytest.raises(InvalidSettingError) as caught:
        choose_pose(prepared(one), DesignSurface(one.design), datum(there), 0, silent)
    fit = best_rigid_fit(there, CORNERS)
    missed = np.linalg.norm(transform(fit, there) - CORNERS, axis=1)
    assert missed.argmax() == 2
    told = f"number 3 ends {missed.max():.4g} mm off, from 300 50 66 in the scan to 0 50 6 in the design"
    assert told in caught.value.what
    assert caught.value.where == "settings pose.datum_design and pose.datum_scan"


def test_datum_points_of_a_distorted_print_are_taken(print_and_scan, rng):
    one = print_and_scan("plate", points=POINTS, scan_seed=1)
    touched = transform(inverse(one.pose), 0.9 * CORNERS + rng.uniform(-2.0, 2.0, CORNERS.shape))
    choice = choose_pose(prepared(one), DesignSurface(one.design), datum(touched), 0, silent)
    assert is_rigid(choice.pose)


def test_the_search_can_be_cancelled(print_and_scan):
    one = print_and_scan("plate", points=POINTS, scan_seed=1)

    def cancel(_):
        raise CancelledError("stopped")

    with pytest.raises(CancelledError, match="stopped"):
        choose_pose(prepared(one), DesignSurface(one.design), PoseSettings(), 0, cancel)


# Normals


def outward_share(one, scan):
    surface = DesignSurface(one.design, 50_000)
    placed = place(scan, one.pose)
    normals = outward(placed, placed.points, surface).normals
    good = ~one.virtual.is_outlier
    true_normals = one.design.face_normals[one.virtual.source_faces[good]]
    return float(((normals[good] * true_normals).sum(axis=1) > 0).mean())


def test_normals_are_turned_outward_whichever_way_they_face(print_and_scan, rng):
    one = print_and_scan("bracket", points=POINTS, scan_seed=1)
    scan = one.scan
    assert outward_share(one, scan) == 1.0
    assert outward_share(one, PointSet(scan.points, -scan.normals)) == 1.0
    either_way = scan.normals * rng.choice([-1.0, 1.0], size=(len(scan), 1))
    # In a 5 mm wall that is warped by half as much some points are nearer to the other face.
    assert outward_share(one, PointSet(scan.points, either_way)) > 0.93


def test_a_scan_is_placed_rigidly(print_and_scan):
    one = print_and_scan("bracket", points=POINTS, scan_seed=1)
    placed = place(one.scan, one.pose)
    np.testing.assert_array_equal(placed.points, transform(one.pose, one.scan.points))
    np.testing.assert_allclose(np.linalg.norm(placed.normals, axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("seed", [3, 5])
def test_a_symmetric_design_is_ambiguous_however_the_print_is_distorted(seed):
    mesh = trimesh.creation.box((100.0, 60.0, 30.0)).subdivide_to_size(4.0)
    design = Design(mesh.vertices, mesh.faces)
    printed = design.vertices + Warp(design, 2.5, 50.0, seed)(design.vertices)
    scan = scan_part(printed, design.faces, ScannerSettings(points=POINTS, pose="random"), seed).scan
    choice = choose_pose(prepare(scan, Settings()), DesignSurface(design), PoseSettings(), 0, silent)
    assert choice.alternatives
    for pose in choice.alternatives:
        motion = pose @ inverse(choice.pose)
        turned = transform(motion, design.vertices)
        assert np.linalg.norm(turned - design.vertices, axis=1).mean() > 0.1 * design.scale
