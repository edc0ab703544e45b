"""The surface stage: a posed scan registered to the design's triangles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mdf_core.deformation import Deformation
from mdf_core.design_surface import DesignSurface
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import CancelledError, RegistrationFailedError
from mdf_core.geometry import Design, PointSet
from mdf_core.kernel import KernelBasis
from mdf_core.progress import silent
from mdf_core.rigid import homogeneous, rotate, transform
from mdf_core.settings import SurfaceSettings
from mdf_core.surface import register_surface

QUICK = SurfaceSettings(rank=80)  # less time where short waves are tried; enough for the long ones here
NOWHERE = KernelBasis(np.empty((0, 3)), 1.0, None)
AT_REST = Deformation(np.eye(4), np.eye(4), NOWHERE, np.empty((0, 3)), np.zeros((4, 3)), np.zeros(3), 1.0)
CLEAN = {"noise_mm": 0.0, "outlier_share": 0.0, "normal_noise": 0.0}


@pytest.fixture(scope="module")
def bracket(print_and_scan):
    return print_and_scan("bracket", points=3_000, scan_seed=1, pose="identity")


@pytest.fixture(scope="module")
def surface(build):
    return DesignSurface(build("bracket"))


def register(scan, surface, settings=None, start=AT_REST, progress=silent):
    return register_surface(scan, surface, settings or QUICK, start, progress)


def unrecovered(one, result):
    displacement = result.fit.deformation().displacement_at(one.design.vertices)
    return fraction_unrecovered(one.design, one.displacement, displacement)


def moved(scan, degrees, millimetres, about, seed):
    """The scan turned about a random axis through `about` and shifted."""
    axis, shift = (vector / np.linalg.norm(vector) for vector in np.random.default_rng(seed).normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    motion = homogeneous(turn, about - turn @ about + millimetres * shift)
    return PointSet(transform(motion, scan.points), rotate(motion, scan.normals), scan.areas)


def test_points_come_to_lie_on_the_surface_at_their_own_places(bracket, surface):
    result = register(bracket.scan, surface)
    assert result.fit.stop_reason == "converged"
    good = ~bracket.virtual.is_outlier
    corners = bracket.design.triangles[bracket.virtual.source_faces[good]]
    sources = np.einsum("nc,ncd->nd", bracket.virtual.barycentric[good], corners)
    errors = np.linalg.norm(result.fit.deformation().apply(bracket.scan.points[good]) - sources, axis=1)
    assert np.sqrt((errors**2).mean()) < 0.06  # 20 µm noise along three axes is 35 µm
    assert result.fit.sigma == pytest.approx(0.02, rel=0.2)  # the scan's noise
    assert unrecovered(bracket, result) < 0.025


@pytest.mark.parametrize("seed", range(2))
def test_it_converges_from_15_degrees_and_5_mm_off(seed, bracket, surface):
    off = moved(bracket.scan, 15.0, 5.0, bracket.design.centre, seed)
    here = register(bracket.scan, surface)
    there = register(off, surface)
    assert unrecovered(bracket, there) < 0.04
    np.testing.assert_allclose(there.fit.sigma, here.fit.sigma, rtol=0.2)


def test_both_faces_of_a_thin_wall_are_told_apart(print_and_scan):
    # The plate is 3 mm thick and moves by up to 4 mm: most points start nearer to the wrong face.
    one = print_and_scan("plate", warp_mm=4.0, points=3_000, scan_seed=1, pose="identity")
    result = register(one.scan, DesignSurface(one.design))
    good = ~one.virtual.is_outlier
    found = DesignSurface(one.design).closest(
        result.fit.deformation().apply(one.scan.points[good]), one.scan.normals[good]
    )
    assert (np.abs(found.distances) < 0.15).mean() > 0.99
    assert unrecovered(one, result) < 0.06


def test_without_noise_nearly_nothing_is_missed(print_and_scan, surface):
    one = print_and_scan("bracket", points=3_000, scan_seed=1, pose="identity", **CLEAN)
    result = register(one.scan, surface)
    assert unrecovered(one, result) < 0.01
    assert result.fit.sigma < 0.002


def test_a_part_without_distortion_shows_none(print_and_scan, build, surface):
    one = print_and_scan("bracket", warp_mm=0.0, points=3_000, scan_seed=1, pose="identity")
    displacement = register(one.scan, surface).fit.deformation().displacement_at(one.design.vertices)
    assert np.sqrt((displacement**2).sum(axis=1).mean()) < 0.015
    assert np.linalg.norm(displacement, axis=1).max() < 0.06


def test_uniform_shrinkage_is_distortion(build, surface):
    design = build("bracket")
    points = surface.closest(design.vertices).points
    scan = PointSet(0.99 * points, surface.closest(points).normals)
    displacement = register(scan, surface).fit.deformation().displacement_at(design.vertices)
    expected = -0.01 * design.vertices
    assert fraction_unrecovered(design, expected, displacement) < 0.05


def test_outliers_do_not_pull(print_and_scan, surface):
    one = print_and_scan("bracket", points=1_500, scan_seed=1, pose="identity", outlier_share=0.1)
    assert unrecovered(one, register(one.scan, surface)) < 0.04


def test_the_stiffness_is_the_users_where_it_is_set(bracket, surface):
    settings = SurfaceSettings(alpha=321.0, beta=(1.3,), rank=80)
    result = register(bracket.scan, surface, settings)
    assert (result.fit.alpha, result.fit.beta) == (321.0, 1.3)


def test_short_waves_choose_a_softer_motion_than_long_ones(print_and_scan, surface):
    betas = []
    for length in (80.0, 20.0):
        one = print_and_scan("bracket", length_mm=length, points=3_000, scan_seed=1, pose="identity")
        betas.append(register(one.scan, surface).fit.beta)
    assert betas[0] > betas[1]
    assert all(min(SurfaceSettings().beta) <= beta <= max(SurfaceSettings().beta) for beta in betas)


def test_a_start_is_where_the_motion_starts(bracket, surface):
    first = register(bracket.scan, surface)
    again = register(bracket.scan, surface, start=first.fit.deformation())
    assert again.iterations <= first.iterations
    vertices = bracket.design.vertices
    np.testing.assert_allclose(
        again.fit.deformation().displacement_at(vertices), first.fit.deformation().displacement_at(vertices), atol=0.02
    )


def test_it_says_how_sure_it_is_and_knows_more_from_more_points(print_and_scan, surface, bracket):
    few = print_and_scan("bracket", points=1_000, scan_seed=1, pose="identity")
    vertices = bracket.design.vertices
    stds = [register(one.scan, surface).fit.deformation().std(vertices) for one in (few, bracket)]
    assert (stds[0] > 0).all() and (stds[1] > 0).all()
    assert np.median(stds[1]) < np.median(stds[0])


def test_every_step_is_told_and_can_be_the_last(bracket, surface):
    steps = []
    result = register(bracket.scan, surface, progress=steps.append)
    assert [step.iteration for step in steps] == list(range(1, result.iterations + 1))
    assert {step.stage for step in steps} == {"surface"}
    assert all(0.0 < step.fraction <= 1.0 and step.sigma_mm > 0 for step in steps)

    def cancel(step):
        if step.iteration == 3:
            raise CancelledError("stopped")

    with pytest.raises(CancelledError, match="stopped"):
        register(bracket.scan, surface, progress=cancel)


def test_too_few_steps_are_told(bracket, surface):
    assert register(bracket.scan, surface, SurfaceSettings(max_steps=1)).fit.stop_reason == "max_steps"


@pytest.mark.parametrize("facing", [0, 10])
def test_a_scan_that_hardly_faces_the_design_is_refused_with_the_count(facing, rng):
    corners = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [50.0, 40.0, 0.0], [0.0, 40.0, 0.0]])
    sheet = DesignSurface(Design(corners, np.array([[0, 1, 2], [0, 2, 3]])), 1_000)
    points = rng.uniform([0.0, 0.0, -0.1], [50.0, 40.0, 0.1], size=(60, 3))
    normals = np.where(np.arange(60)[:, None] < facing, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    with pytest.raises(RegistrationFailedError) as caught:
        register(PointSet(points, normals), sheet)
    assert str(caught.value) == (
        f"surface stage: only {facing} of 60 points face the surface nearest to them; "
        "check the pose, the scan's normals, and that the scan shows this part"
    )


def test_the_same_scan_gives_the_same_bytes(bracket, surface):
    first, again = register(bracket.scan, surface), register(bracket.scan, surface)
    assert first.fit.deformation().coefficients.tobytes() == again.fit.deformation().coefficients.tobytes()
    assert isinstance(first.fit.deformation(), Deformation)
    np.testing.assert_array_equal(first.fit.deformation().start, np.eye(4))
    np.testing.assert_array_equal(first.fit.deformation().datum, np.eye(4))
