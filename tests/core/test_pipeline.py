"""`inspect` from end to end: what it refuses, what it tells on its way, what its answer does not hang on."""

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from poses import pose_numbers
from scipy.spatial.transform import Rotation

import mdf_core as mdf
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import (
    CancelledError,
    DegenerateScanError,
    RegistrationFailedError,
    TooFewPointsError,
    UnitMismatchError,
)
from mdf_core.rigid import homogeneous, inverse, rotate, transform
from mdf_core.virtual_cell import ScannerSettings, Warp, scan_part

POINTS = 3_000
QUICK = {"surface.rank": 80}


@pytest.fixture(scope="module")
def bracket(print_and_scan):
    return print_and_scan("bracket", points=POINTS, scan_seed=1)


@pytest.fixture(scope="module")
def plate(print_and_scan):
    return print_and_scan("plate", points=2_000, scan_seed=1)


def inspect_as_is(one, scan, progress=None, **changes):
    """Inspect another scan of the print, from the print's true pose."""
    settings = mdf.Settings().replace({"pose.initial": one.pose_numbers} | QUICK | changes)
    return mdf.inspect(one.design, scan, settings, progress)


def rms(vectors):
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


# Refusals


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000.0, r"larger.*1000: metres against millimetres"),
        (1e-3, r"smaller.*1000: metres against millimetres"),
        (25.4, r"larger.*25\.4: inches against millimetres"),
        (1 / 25.4, r"smaller.*25\.4: inches against millimetres"),
        (10.0, r"larger.*10: centimetres"),
        (0.1, r"smaller.*10: centimetres"),
        (3.0, r"(2\.[5-9]|3)\d* times larger"),
    ],
)
def test_a_scan_in_the_wrong_unit_is_refused_and_the_factor_named(factor, words, bracket):
    scan = mdf.PointSet(factor * bracket.scan.points, bracket.scan.normals)
    with pytest.raises(UnitMismatchError, match=words + r".*declare the unit"):
        mdf.inspect(bracket.design, scan)


def test_the_scan_of_another_part_is_refused(plate, bracket):
    with pytest.raises((RegistrationFailedError, UnitMismatchError), match="shows this part"):
        mdf.inspect(plate.design, bracket.scan.take(np.arange(2_000)))


def test_the_scan_of_another_part_is_refused_before_it_is_registered(build, print_and_scan):
    clip, stages = print_and_scan("clip", points=4_000).scan, []
    with pytest.raises(RegistrationFailedError, match="shows this part"):
        mdf.inspect(build("bracket"), clip, progress=lambda step: stages.append(step.stage))
    assert "surface" not in stages


def test_a_mirrored_part_never_passes(print_and_scan):
    # Holes and ribs come to lie in the wrong places: a quarter of the scan is far from the design.
    bracket, mirror = print_and_scan("bracket", points=4_000, scan_seed=1), np.diag([1.0, 1.0, -1.0])
    scan = mdf.PointSet(bracket.scan.points @ mirror, bracket.scan.normals @ mirror)
    try:
        inspection = mdf.inspect(bracket.design, scan, mdf.Settings().replace({"verdict.tolerance_mm": 5.0}))
    except RegistrationFailedError:
        return
    assert inspection.verdict[0] is not mdf.Verdict.PASS


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((10, 3)), TooFewPointsError),
        (np.zeros((100, 3)), DegenerateScanError),
        (np.arange(100.0)[:, None] * [1.0, 2.0, 3.0], DegenerateScanError),
        (np.random.default_rng(0).uniform(size=(100, 3)) * [80.0, 50.0, 0.0], DegenerateScanError),
    ],
    ids=["few", "spot", "line", "plane"],
)
def test_scans_that_determine_nothing_are_refused(points, error, bracket):
    with pytest.raises(error):
        mdf.inspect(bracket.design, mdf.PointSet(points))


# Progress and cancellation


@pytest.mark.parametrize("method", ["surface", "mdf"])
def test_progress_runs_from_0_to_1_through_all_stages(method, bracket, plate):
    steps = []
    one = plate if method == "surface" else bracket
    changes = QUICK | {"method": method, "mixture.points": 800, "mixture.max_iterations": 40}
    if method != "surface":
        changes["pose.initial"] = one.pose_numbers
    inspection = mdf.inspect(one.design, one.scan, mdf.Settings().replace(changes), steps.append)
    fractions = [step.fraction for step in steps]
    assert fractions[0] == 0.0 and fractions[-1] <= 1.0
    assert fractions == sorted(fractions)
    stage = "surface" if method == "surface" else "mixture"
    assert list(dict.fromkeys(step.stage for step in steps)) == ["prepare", "pose", stage, "interpolation"]
    assert list(inspection.stage_seconds) == ["prepare", "pose", stage, "interpolation"]
    assert all(seconds >= 0 for seconds in inspection.stage_seconds.values())
    told = [step for step in steps if step.stage == stage and step.iteration > 0]
    assert len(told) == inspection.iterations > 1
    assert all(step.sigma_mm > 0 for step in told)


@pytest.mark.parametrize(
    ("stage", "iteration"),
    [("prepare", 0), ("pose", 0), ("pose", 2), ("surface", 0), ("surface", 2), ("mixture", 2), ("interpolation", 0)],
)
def test_an_exception_of_the_callback_stops_the_work_at_once(stage, iteration, plate):
    raised = CancelledError("stopped by the user")
    called_after = []

    def cancel(step):
        called_after.append(step.stage)
        if step.stage == stage and step.iteration == iteration:
            called_after.clear()
            raise raised

    changes = {"method": "mdf", "mixture.points": 300} if stage == "mixture" else {}
    if stage != "pose":
        changes["pose.initial"] = plate.pose_numbers
    with pytest.raises(CancelledError) as caught:
        mdf.inspect(plate.design, plate.scan, mdf.Settings().replace(changes), cancel)
    assert caught.value is raised
    assert called_after == []


# What the answer does not hang on


def test_what_the_scanner_says_about_normals_matters_little(print_and_scan, rng):
    # Normals that are estimated need points nearer to each other than the walls are thick (5 mm).
    one = print_and_scan("bracket", points=6_000, scan_seed=1)
    scan = one.scan
    either_way = scan.normals * rng.choice([-1.0, 1.0], size=(len(scan), 1))
    fractions = {
        name: one.fraction_unrecovered(inspect_as_is(one, mdf.PointSet(scan.points, normals)))
        for name, normals in {
            "outward": scan.normals,
            "either way": either_way,
            "none": None,
        }.items()
    }
    assert fractions["outward"] < 0.025
    assert fractions["either way"] < 1.25 * fractions["outward"]
    assert fractions["none"] < 2.0 * fractions["outward"]  # planes through 16 neighbours round the edges off


def test_the_order_of_the_points_matters_less_than_their_noise(bracket, rng):
    order = rng.permutation(POINTS)
    plain, permuted = bracket.inspect(QUICK), inspect_as_is(bracket, bracket.scan.take(order))
    assert rms(permuted.displacement - plain.displacement) < 0.01  # noise 0.02, distortion 1.3 mm
    np.testing.assert_allclose(permuted.residual_scale, plain.residual_scale, rtol=0.05)


def test_the_frame_of_the_scanner_does_not_matter(bracket):
    motion = homogeneous(Rotation.from_rotvec([0.4, 2.0, -1.1]).as_matrix(), np.array([500.0, -300.0, 80.0]))
    scan = mdf.PointSet(transform(motion, bracket.scan.points), rotate(motion, bracket.scan.normals))
    pose = bracket.pose @ inverse(motion)
    plain, moved = bracket.inspect(QUICK), inspect_as_is(bracket, scan, **{"pose.initial": pose_numbers(pose)})
    np.testing.assert_allclose(moved.displacement, plain.displacement, atol=1e-3)
    np.testing.assert_allclose(moved.pose @ motion, plain.pose, atol=1e-3)


def test_the_search_and_the_true_pose_lead_to_the_same_answer(plate):
    given, searched = plate.inspect(QUICK), plate.inspect(QUICK, search_pose=True)
    assert rms(searched.displacement - given.displacement) < 0.02


CODE = """
import hashlib
import mdf_core as mdf
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part
design = build_part("plate")
printed = design.vertices + Warp(design, 2.0, 50.0)(design.vertices)
scan = scan_part(printed, design.faces, ScannerSettings(points=2_000, pose="random"), seed=1).scan
inspection = mdf.inspect(design, scan)
digest = hashlib.sha256()
for values in (inspection.displacement, inspection.inverse_displacement, inspection.std, inspection.pose):
    digest.update(values.tobytes())
print(digest.hexdigest(), hashlib.sha256(mdf.compensate(design, [inspection]).stl()).hexdigest())
"""


def test_the_same_scan_gives_the_same_bytes_whatever_the_number_of_threads():
    answers = set()
    for threads in ("1", "2"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True, timeout=200
        )
        answers.add(done.stdout)
    assert len(answers) == 1 and answers.pop().strip()


def test_the_same_call_with_inward_normals_gives_the_same_bytes_and_leaves_its_input_alone(bracket):
    before = (bracket.scan.sha256(), hashlib.sha256(bracket.design.vertices.tobytes()).hexdigest())
    first = bracket.inspect(QUICK)
    again = inspect_as_is(bracket, mdf.PointSet(bracket.scan.points, -bracket.scan.normals))
    assert before == (bracket.scan.sha256(), hashlib.sha256(bracket.design.vertices.tobytes()).hexdigest())
    for name in ("displacement", "inverse_displacement", "std", "supported", "pose"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes(), name


def test_an_inspection_names_what_it_was_made_from(bracket):
    inspection = bracket.inspect(QUICK)
    assert inspection.scan_sha256 == bracket.scan.sha256()
    assert inspection.settings.pose.initial == bracket.pose_numbers
    assert inspection.design is bracket.design


# Poses


@dataclass
class Slab:
    design: mdf.Design
    truth: np.ndarray
    virtual: object


@pytest.fixture(scope="module")
def slab():
    """Symmetric to half turns about all three axes, and little warped."""
    mesh = trimesh.creation.box((80.0, 50.0, 6.0)).subdivide_to_size(4.0)
    design = mdf.Design(mesh.vertices, mesh.faces)
    truth = Warp(design, 0.1, 50.0)(design.vertices)
    scanner = ScannerSettings(points=2_000, pose="random")
    return Slab(design, truth, scan_part(design.vertices + truth, design.faces, scanner, 1))


def test_a_symmetric_part_gets_no_verdict_and_the_reason(slab):
    settings = mdf.Settings().replace({"verdict.tolerance_mm": 5.0})
    inspection = mdf.inspect(slab.design, slab.virtual.scan, settings)
    assert inspection.pose_ambiguous
    assert len(inspection.alternative_poses) == 3
    verdict, reasons = inspection.verdict
    assert verdict is mdf.Verdict.NO_DECISION
    assert any("more than one pose" in reason and "pose.initial" in reason for reason in reasons)


def test_a_symmetric_part_that_is_much_distorted_is_told_so():
    mesh = trimesh.creation.box((100.0, 60.0, 30.0)).subdivide_to_size(4.0)
    design = mdf.Design(mesh.vertices, mesh.faces)
    printed = design.vertices + Warp(design, 2.5, 50.0, 9)(design.vertices)
    scan = scan_part(printed, design.faces, ScannerSettings(points=3_000, pose="random"), 9).scan
    inspection = mdf.inspect(design, scan)
    assert inspection.pose_ambiguous and inspection.verdict[0] is mdf.Verdict.NO_DECISION
    assert np.isfinite(inspection.displacement).all()


def test_a_given_pose_settles_which_of_the_symmetric_ones_is_meant(slab):
    pose = inverse(slab.virtual.pose)
    for turn in (np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])):
        wanted = turn @ pose
        settings = mdf.Settings().replace({"pose.initial": pose_numbers(wanted), "verdict.tolerance_mm": 5.0})
        inspection = mdf.inspect(slab.design, slab.virtual.scan, settings)
        assert not inspection.pose_ambiguous
        assert inspection.verdict[0] is mdf.Verdict.PASS
        np.testing.assert_allclose(inspection.pose[:3, :3], wanted[:3, :3], atol=0.02)
        np.testing.assert_allclose(inspection.pose[:3, 3], wanted[:3, 3], atol=1.0)
        if turn[0, 0] > 0:
            assert fraction_unrecovered(slab.design, slab.truth, inspection.displacement) < 0.5


# What comes out


def test_the_displacement_has_no_rigid_part(bracket):
    inspection = bracket.inspect(QUICK)
    weights = bracket.design.vertex_areas * inspection.supported
    mean = np.average(inspection.displacement, axis=0, weights=weights)
    arms = bracket.design.vertices - bracket.design.centre
    moment = np.average(np.cross(arms, inspection.displacement), axis=0, weights=weights)
    np.testing.assert_allclose(mean, 0.0, atol=1e-3)
    np.testing.assert_allclose(moment / bracket.design.scale, 0.0, atol=1e-3)


def test_deformation_and_fields_agree(bracket):
    inspection, vertices = bracket.inspect(QUICK), bracket.design.vertices
    in_scanner = transform(inverse(inspection.pose), vertices + inspection.displacement)
    np.testing.assert_allclose(inspection.deformation.apply(in_scanner), vertices, atol=1e-6)
    belongs = inspection.deformation.apply(transform(inverse(inspection.pose), vertices))
    np.testing.assert_allclose(belongs, vertices + inspection.inverse_displacement, atol=1e-6)


def test_the_deviation_is_the_rigidly_placed_scan_against_the_design(bracket):
    inspection = bracket.inspect(QUICK)
    deviation = inspection.deviation
    assert len(deviation.points) == len(deviation.signed_distance) == len(deviation.is_outlier) == POINTS
    np.testing.assert_allclose(deviation.points, transform(inspection.pose, bracket.scan.points), atol=1e-9)
    # The true displacement along the normal, at the points' own places.
    good = ~bracket.virtual.is_outlier
    faces = bracket.virtual.source_faces[good]
    corners = bracket.displacement[bracket.design.faces[faces]]
    moved = np.einsum("nc,ncd->nd", bracket.virtual.barycentric[good], corners)
    expected = (moved * bracket.design.face_normals[faces]).sum(axis=1)
    assert np.median(np.abs(deviation.signed_distance[good] - expected)) < 0.05


def test_planted_outliers_are_found_and_few_others(bracket):
    judged, planted = bracket.inspect(QUICK).deviation.is_outlier, bracket.virtual.is_outlier
    far = np.abs(bracket.inspect(QUICK).deviation.signed_distance) > 4.0  # some fall onto the part by chance
    assert judged[planted & far].all()
    assert judged[~planted].mean() < 0.01


@pytest.mark.parametrize("method", ["knn", "inverse_distance", "linear"])
def test_the_papers_interpolations_are_near_the_deformation(method, bracket):
    plain, interpolated = bracket.inspect(QUICK), bracket.inspect(QUICK | {"interpolation.method": method})
    assert np.isfinite(interpolated.displacement).all()
    assert bracket.fraction_unrecovered(interpolated) < 0.1
    assert not np.array_equal(interpolated.displacement, plain.displacement)
    # The inverse is looked up off the printed surface, where linear interpolates across the hollows of the part.
    apart = rms(interpolated.inverse_displacement - plain.inverse_displacement)
    assert apart < (0.5 if method == "linear" else 0.1) * rms(plain.inverse_displacement)


def test_the_papers_outlier_test_can_be_chosen(bracket):
    inspection = bracket.inspect(QUICK | {"outliers.method": "normalized_median"})
    assert inspection.deviation.is_outlier.shape == (POINTS,)
    assert bracket.fraction_unrecovered(inspection) < 0.05


def test_a_scan_above_the_target_is_thinned(bracket):
    inspection = bracket.inspect(QUICK | {"thinning.target_points": 2_000})
    assert 1_700 <= len(inspection.deviation.points) <= 2_000
    assert bracket.fraction_unrecovered(inspection) < 0.06
    assert inspection.scan_sha256 == bracket.scan.sha256()  # of the scan as it came
