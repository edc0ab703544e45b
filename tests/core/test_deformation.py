"""The map from scan to design, its inverse, and what both say about the part."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mdf_core.deformation import Deformation, affine_features, motion_features, tangential_stretches, without_rigid_part
from mdf_core.kernel import KernelBasis
from mdf_core.rigid import homogeneous, inverse, transform

SCALE = 40.0


def motion(rng, amplitude=2.0, covariance=None):
    """A smooth motion of about `amplitude` mm, with poses before and after it."""
    start = homogeneous(Rotation.random(random_state=1).as_matrix(), np.array([120.0, -40.0, 15.0]))
    datum = homogeneous(Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), np.array([0.3, -0.2, 0.1]))
    centres = rng.uniform(-50.0, 50.0, size=(30, 3))
    coefficients = amplitude / 3.0 * rng.normal(size=(30, 3))
    affine = 0.2 * amplitude * rng.normal(size=(4, 3))
    basis = KernelBasis(centres, SCALE, None)
    return Deformation(start, datum, basis, coefficients, affine, np.zeros(3), SCALE, covariance)


def alike(covariance):
    """The same for every axis."""
    return np.kron(np.eye(3), covariance)


@pytest.fixture(params=[False, True], ids=["maps the scan", "maps the design"])
def smooth(request, rng):
    return replace(motion(rng), maps_design=request.param)


def in_scanner(deformation, points_in_design_frame):
    """Where the scanner sees what lies there in the design's frame."""
    return transform(inverse(deformation.pose), points_in_design_frame)


def test_material_of_a_design_point_is_mapped_onto_it(smooth, rng):
    deformation = smooth
    design_points = rng.uniform(-50.0, 50.0, size=(500, 3))
    found = deformation.displacement_at(design_points)
    assert np.linalg.norm(found, axis=1).max() > 1.0
    returned = deformation.apply(in_scanner(deformation, design_points + found))
    np.testing.assert_allclose(returned, design_points, rtol=0, atol=1e-6)


def test_the_inverse_displacement_undoes_the_displacement(smooth, rng):
    deformation = smooth
    design_points = rng.uniform(-50.0, 50.0, size=(500, 3))
    displacement = deformation.displacement_at(design_points)
    back = deformation.inverse_displacement_at(design_points + displacement)
    np.testing.assert_allclose(back, -displacement, rtol=0, atol=1e-6)


def test_the_inverse_displacement_leads_to_where_the_map_leads(smooth, rng):
    deformation = smooth
    design_points = rng.uniform(-50.0, 50.0, size=(500, 3))
    belongs = design_points + deformation.inverse_displacement_at(design_points)
    np.testing.assert_allclose(deformation.apply(in_scanner(deformation, design_points)), belongs, rtol=0, atol=1e-9)


def test_the_jacobian_of_a_motion_of_two_widths_is_its_derivative(rng):
    deformation, step = motion(rng), 1e-4
    widths = np.where(np.arange(30) < 12, SCALE, 0.4 * SCALE)
    deformation = replace(deformation, basis=replace(deformation.basis, width=widths), maps_design=True)
    places = rng.uniform(-50.0, 50.0, size=(40, 3))

    def moved(points):
        return transform(inverse(deformation.datum), points + deformation.displacement_at(points))

    steps = step * np.eye(3)
    expected = np.stack([(moved(places + each) - moved(places - each)) / (2.0 * step) for each in steps], axis=2)
    np.testing.assert_allclose(deformation.jacobian(places), expected, atol=1e-7)


def test_without_motion_only_the_poses_remain(rng):
    deformation = motion(rng, amplitude=0.0)
    points = rng.uniform(-50.0, 50.0, size=(50, 3))
    np.testing.assert_allclose(deformation.apply(points), transform(deformation.start, points), atol=1e-12)
    unmoved = replace(deformation, datum=np.eye(4))
    np.testing.assert_allclose(unmoved.displacement_at(points), 0.0, atol=1e-12)
    np.testing.assert_allclose(unmoved.inverse_displacement_at(points), 0.0, atol=1e-12)
    np.testing.assert_allclose(deformation.pose, deformation.datum @ deformation.start)


def test_the_affine_part_shrinks_about_the_origin(rng):
    shrunk = replace(
        motion(rng, 0.0),
        start=np.eye(4),
        datum=np.eye(4),
        affine=np.vstack([0.01 * SCALE * np.eye(3), [[0.5, 0.0, 0.0]]]),
    )
    points = rng.uniform(-50.0, 50.0, size=(50, 3))
    np.testing.assert_allclose(shrunk.apply(points), 1.01 * points + [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shrunk.displacement_at(points), (points - [0.5, 0.0, 0.0]) / 1.01 - points, atol=1e-7)


def test_it_works_in_the_plane(rng):
    plane = Deformation(
        start=homogeneous(np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([3.0, 4.0])),
        datum=np.eye(3),
        basis=KernelBasis(rng.uniform(-10.0, 10.0, size=(8, 2)), 8.0, None),
        coefficients=0.2 * rng.normal(size=(8, 2)),
        affine=np.zeros((3, 2)),
        origin=np.zeros(2),
        scale=8.0,
    )
    design_points = rng.uniform(-10.0, 10.0, size=(50, 2))
    displaced = design_points + plane.displacement_at(design_points)
    np.testing.assert_allclose(plane.apply(in_scanner(plane, displaced)), design_points, atol=1e-6)


def test_where_a_motion_folds_space_there_is_no_displacement(rng):
    deformation, points = motion(rng, amplitude=400.0), rng.uniform(-50.0, 50.0, size=(200, 3))
    displacement = deformation.displacement_at(points)
    has_none = np.isnan(displacement).any(axis=1)
    assert 0 < has_none.sum() < 200
    kept = points[~has_none]
    found = deformation.apply(in_scanner(deformation, kept + displacement[~has_none]))
    np.testing.assert_allclose(found, kept, atol=1e-6)


def test_where_a_motion_of_the_design_folds_it_there_is_no_displacement(rng):
    deformation = replace(motion(rng, amplitude=400.0), maps_design=True)
    points, step = rng.uniform(-50.0, 50.0, size=(200, 3)), 1e-3
    ends = [points + step * sign * axis for axis in np.eye(3) for sign in (0.5, -0.5)]
    inside_out = []
    for corner in zip(*ends, strict=True):
        moved = np.array(corner) + deformation._motion(np.array(corner))
        inside_out.append(np.linalg.det((moved[::2] - moved[1::2]) / step) < 0)
    displacement = deformation.displacement_at(points)
    assert 0 < sum(inside_out) < 200
    np.testing.assert_array_equal(np.isnan(displacement).any(axis=1), inside_out)


def test_the_standard_deviation_of_a_motion_of_the_design_is_taken_where_it_is_asked_for(rng):
    root = 0.05 * rng.normal(size=(34, 34))
    deformation = replace(motion(rng, amplitude=0.5, covariance=alike(root @ root.T)), maps_design=True)
    points = rng.uniform(-50.0, 50.0, size=(20, 3))
    features = np.hstack([deformation.basis(points), affine_features(points, deformation.origin, SCALE)])
    expected = np.sqrt(3.0 * ((features @ root) ** 2).sum(axis=1))
    np.testing.assert_allclose(deformation.std(points), expected, rtol=1e-9)


def test_stretches_are_those_of_tangents_on_their_way_through_the_motion(rng):
    deformation, placed = motion(rng, amplitude=5.0), rng.uniform(-50.0, 50.0, size=(30, 3))
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    least, most = tangential_stretches(deformation.jacobian(placed), normals).T
    assert (least < most).all()
    start, step = inverse(deformation.start), 1e-4
    for direction in rng.normal(size=(20, 3)):
        tangents = direction - (normals @ direction)[:, None] * normals
        tangents *= step / np.linalg.norm(tangents, axis=1, keepdims=True)
        ends = [deformation.apply(transform(start, placed + sign * tangents)) for sign in (0.5, -0.5)]
        growth = np.linalg.norm(ends[0] - ends[1], axis=1) / step
        assert ((growth > least - 1e-5) & (growth < most + 1e-5)).all()


def test_the_standard_deviation_is_that_of_the_motion_under_its_posterior(rng):
    root = 0.05 * rng.normal(size=(34, 34))
    deformation = motion(rng, amplitude=0.5, covariance=alike(root @ root.T))
    design_points = rng.uniform(-50.0, 50.0, size=(20, 3))
    placed = transform(inverse(deformation.datum), design_points + deformation.displacement_at(design_points))
    features = np.hstack([deformation.basis(placed), affine_features(placed, deformation.origin, SCALE)])
    # Coefficients drawn from it, one axis after the other, and the motion they make.
    drawn = features @ root @ rng.normal(size=(3, 34, 40_000))
    rms = np.sqrt((drawn**2).sum(axis=0).mean(axis=1))
    np.testing.assert_allclose(deformation.std(design_points), rms, rtol=0.02)


def errors(deformation, root, points, seed=0, count=4_000):
    """Displacement errors at `points` for unknowns drawn with covariance root rootᵀ, (count, n, 3)."""
    drawn = root @ np.random.default_rng(seed).normal(size=(len(root), count))
    features = motion_features(deformation.basis, points, deformation.origin, SCALE)
    return np.einsum("nm,amk->kna", features, drawn.reshape(3, -1, count))


def less_rigid(errors, points, weights):
    """What a rigid fit of small motions leaves of each of the `errors`."""
    turns = [np.cross(axis, points) for axis in np.eye(3)]
    shifts = [np.tile(axis, (len(points), 1)) for axis in np.eye(3)]
    rigid = np.stack([*turns, *shifts], axis=-1).reshape(-1, 6)
    root = np.repeat(np.sqrt(weights), 3)[:, None]
    flat = errors.reshape(len(errors), -1).T
    fitted = np.linalg.lstsq(root * rigid, root * flat, rcond=None)[0]
    return (flat - rigid @ fitted).T.reshape(errors.shape)


def test_what_is_left_after_a_rigid_fit_is_as_well_known_as_draws_from_the_posterior_say(rng):
    root = 0.05 * rng.normal(size=(102, 102))
    root[90:] *= 20.0  # where the part lies is hardly known
    deformation = replace(motion(rng, amplitude=0.5, covariance=root @ root.T), maps_design=True)
    points, weights = rng.uniform(-50.0, 50.0, size=(60, 3)), rng.uniform(size=60)
    weights[:20] = 0.0  # not seen: the fit goes without them
    left = less_rigid(errors(deformation, root, points), points, weights)
    rms = np.sqrt((left**2).sum(axis=2).mean(axis=0))
    known = deformation.without_rigid_part(points, weights)
    np.testing.assert_allclose(known.std(points), rms, rtol=0.05)
    assert np.median(known.std(points) / deformation.std(points)) < 0.8
    np.testing.assert_array_equal(known.apply(points), deformation.apply(points))


def test_how_two_pieces_lie_to_each_other_is_no_rigid_part(rng):
    root = 0.05 * rng.normal(size=(102, 102))
    motions = [replace(motion(rng, amplitude=0.5, covariance=root @ root.T), maps_design=True) for _ in range(2)]
    points = [rng.uniform(-50.0, 50.0, size=(30, 3)) + shift for shift in (-60.0, 60.0)]
    drawn = [errors(one, root, where, seed) for seed, (one, where) in enumerate(zip(motions, points, strict=True))]
    left = less_rigid(np.concatenate(drawn, axis=1), np.concatenate(points), np.ones(60))
    rms = np.sqrt((left**2).sum(axis=2).mean(axis=0))
    known = without_rigid_part(motions, points, [np.ones(30)] * 2)
    found = np.concatenate([one.std(where) for one, where in zip(known, points, strict=True)])
    np.testing.assert_allclose(found, rms, rtol=0.05)


def test_a_rigid_motion_that_is_not_known_leaves_the_displacement_certain(rng):
    covariance = np.zeros((102, 102))
    shift = np.arange(3) * 34 + 33
    covariance[np.ix_(shift, shift)] = np.diag([1.0, 4.0, 9.0])
    deformation = replace(motion(rng, amplitude=0.5, covariance=covariance), maps_design=True)
    points = rng.uniform(-50.0, 50.0, size=(20, 3))
    np.testing.assert_allclose(deformation.std(points), np.sqrt(14.0))
    assert deformation.without_rigid_part(points, np.ones(20)).std(points).max() < 1e-6


def test_without_a_posterior_the_standard_deviation_is_unknown(rng):
    assert np.isnan(motion(rng).std(np.zeros((3, 3)))).all()


def test_many_points_are_no_different_from_few(rng):
    deformation = motion(rng, covariance=np.eye(102))
    points = rng.uniform(-50.0, 50.0, size=(70_000, 3))
    some = slice(69_900, 69_950)
    np.testing.assert_allclose(deformation.apply(points)[some], deformation.apply(points[some]), atol=1e-10)
    np.testing.assert_allclose(deformation.std(points)[some], deformation.std(points[some]), rtol=1e-6)
