"""Plain and area-weighted coherent point drift."""

import numpy as np
import pytest
from scipy.spatial import Delaunay
from threadpoolctl import threadpool_limits

from mdf_core.errors import CancelledError, RegistrationFailedError
from mdf_core.geometry import PointSet
from mdf_core.kernel import gaussian_kernel
from mdf_core.progress import silent
from mdf_core.registration import register_mixture
from mdf_core.settings import MixtureSettings

UNIT_SQUARE_SCALE = np.sqrt(1.0 / 6.0)  # RMS radius of its area
PAPER_2D = MixtureSettings(beta=3.0, alpha=2.0, outlier_share=0.0, max_iterations=500)


@pytest.fixture(autouse=True, scope="module")
def one_blas_thread():
    """As in the pipeline: on a busy machine the threads of many small matrix products wait for each other."""
    with threadpool_limits(1):
        yield


def grid(*axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


DESIGN_NODES = grid(np.linspace(0.0, 1.0, 21), np.linspace(0.0, 1.0, 21))


def nodal_areas(points, triangles):
    """A third of the area of the triangles around every node."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    areas = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return np.bincount(triangles.ravel(), np.repeat(areas / 3.0, 3), minlength=len(points))


def refined_square(finest, coarsest, growth):
    """Nodes of a mesh of the unit square, refined towards its middle; the first four are the corners.

    Darts thrown in a fixed order and kept where the size function leaves room, then smoothed along the Delaunay edges.
    """
    generator = np.random.default_rng(0)

    def size(points):
        return np.minimum(finest + growth * np.linalg.norm(points - 0.5, axis=-1), coarsest)

    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    nodes = list(corners)
    fine = np.linspace(0.0, 1.0, 401)
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        middles = begin + (end - begin) * (0.5 * (fine[1:] + fine[:-1]))[:, None]
        lengths = np.concatenate([[0.0], np.cumsum(1.0 / size(middles) / 400.0)])
        count = round(lengths[-1])
        nodes += [begin + (end - begin) * np.interp(k / count * lengths[-1], lengths, fine) for k in range(1, count)]
    fixed = len(nodes)
    for dart in generator.random((20_000, 2)):
        if ((np.array(nodes) - dart) ** 2).sum(axis=1).min() > (0.8 * size(dart)) ** 2:
            nodes.append(dart)
    points = np.array(nodes)
    for _ in range(20):
        triangles = Delaunay(points).simplices
        edges = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        edges = np.vstack([edges, edges[:, ::-1]])
        sums = np.zeros_like(points)
        np.add.at(sums, edges[:, 0], points[edges[:, 1]])
        points[fixed:] = (sums / np.bincount(edges[:, 0])[:, None])[fixed:]
    return points


def deformed(points, seed, level):
    """A polynomial with random coefficients around the shear that makes the square a rhombus, as in the paper."""
    coefficients = 0.8 * np.random.default_rng(seed).uniform(-1.0, 1.0, (5, 2))
    coefficients[:2] = [[0.0, 1.0], [1.0, 0.0]]
    x, y = (points - 0.5).T
    return points + level * np.stack([x, y, x * y, x**2, y**2], axis=1) @ coefficients


@pytest.fixture(scope="module")
def refined():
    return refined_square(0.0135, 0.066, 0.14)


@pytest.fixture(scope="module")
def strongly_refined():
    return refined_square(0.006, 0.09, 0.15)


def corner_errors(nodes, seed, level):
    """Mean distance of the four registered corners from their true places (CPD, MDF), and the area contrast."""
    scan = deformed(nodes, seed, level)
    areas = nodal_areas(scan, Delaunay(nodes).simplices)
    errors = []
    for area_weighted in (False, True):
        result = register_mixture(
            PointSet(scan, areas=areas), DESIGN_NODES, PAPER_2D, area_weighted, UNIT_SQUARE_SCALE, silent
        )
        assert result.converged
        errors.append(np.linalg.norm(result.deformation.apply(scan[:4]) - nodes[:4], axis=1).mean())
    return errors, np.percentile(areas, 95) / np.percentile(areas, 5)


@pytest.mark.parametrize("level", [0.05, 0.10, 0.15])
def test_area_weights_beat_plain_drift_at_the_corners_of_the_papers_square(refined, level):
    errors, contrasts = zip(*(corner_errors(refined, seed, level) for seed in (0, 1)), strict=True)
    assert all(11.0 < contrast < 15.0 for contrast in contrasts)
    cpd, mdf = np.mean(errors, axis=0)
    assert cpd / mdf >= 2.5
    assert mdf < 0.005


@pytest.mark.parametrize("level", [0.05, 0.10, 0.15])
def test_area_weights_matter_more_the_stronger_the_refinement(strongly_refined, level):
    (cpd, mdf), contrast = corner_errors(strongly_refined, 0, level)
    assert contrast > 30.0
    assert cpd / mdf >= 10.0


def test_refining_half_of_the_scan_does_not_pull_the_area_weighted_fit():
    axis = np.concatenate([np.linspace(0.0, 0.5, 6), np.linspace(0.5, 1.0, 19)[1:]])
    nodes = grid(axis, np.linspace(0.0, 1.0, 15))
    areas = nodal_areas(nodes, Delaunay(nodes).simplices)
    shift = {}
    for area_weighted in (False, True):
        result = register_mixture(
            PointSet(nodes, areas=areas), DESIGN_NODES, PAPER_2D, area_weighted, UNIT_SQUARE_SCALE, silent
        )
        moved = result.deformation.apply(nodes) - nodes
        shift[area_weighted] = abs(np.average(moved[:, 0], weights=areas))
    bound = 0.015
    assert shift[True] < bound
    assert shift[False] > 5.0 * bound


# --- a small problem of either dimension ---


def problem(dimension, count=120):
    """Scan with areas, target and scale: a bent sheet (3D) or filled patch (2D), in mm."""
    generator = np.random.default_rng(dimension)
    points = generator.uniform(-25.0, 25.0, (2, count + 40, dimension))
    if dimension == 3:
        points[..., 2] = 8.0 * np.sin(points[..., 0] / 10.0) + 0.01 * points[..., 1] ** 2
    scan, target = points[0, :count], points[1]
    scan = scan + 0.8 * np.sin(scan[:, ::-1] / 15.0)
    return PointSet(scan, areas=generator.uniform(0.3, 3.0, count)), target, 20.0


def register(dimension, settings=None, area_weighted=True, progress=silent, count=120):
    scan, target, scale = problem(dimension, count)
    return register_mixture(scan, target, settings or MixtureSettings(), area_weighted, scale, progress)


both_dimensions = pytest.mark.parametrize("dimension", [2, 3])
both_methods = pytest.mark.parametrize("area_weighted", [False, True], ids=["cpd", "mdf"])


@both_dimensions
@both_methods
def test_low_rank_agrees_with_dense(dimension, area_weighted):
    """A kernel so narrow that it takes all points as centres."""
    scan, _, scale = problem(dimension, count=170)
    narrow = {"beta": 0.3, "max_iterations": 60}
    dense = register(dimension, MixtureSettings(**narrow), area_weighted, count=170)
    low = register(dimension, MixtureSettings(**narrow, rank=170), area_weighted, count=170)
    assert dense.deformation.basis.transform is None
    assert low.deformation.basis.transform is not None
    np.testing.assert_allclose(
        low.deformation.apply(scan.points), dense.deformation.apply(scan.points), rtol=0.0, atol=1e-5 * scale
    )
    assert low.sigma == pytest.approx(dense.sigma, rel=1e-5)


@both_dimensions
def test_without_a_rank_the_kernel_is_not_approximated(dimension):
    scan, _, scale = problem(dimension)
    basis = register(dimension, MixtureSettings(max_iterations=1)).deformation.basis
    values = basis(scan.points)
    kernel = gaussian_kernel(scan.points, scan.points, MixtureSettings().beta * scale)
    assert len(basis.centres) < len(scan.points)
    np.testing.assert_allclose(values @ values.T, kernel, rtol=0.0, atol=1e-11)


def test_large_scans_are_solved_at_low_rank_without_being_told():
    generator = np.random.default_rng(0)
    scan = PointSet(generator.uniform(0.0, 10.0, (2001, 2)))
    result = register_mixture(scan, scan.points[:50], MixtureSettings(max_iterations=1), False, 5.0, silent)
    assert len(result.deformation.coefficients) <= 150


@both_dimensions
@pytest.mark.parametrize("rank", [0, 60])
def test_order_of_the_points_does_not_matter(dimension, rank):
    scan, target, scale = problem(dimension)
    order = np.random.default_rng(9).permutation(len(scan))
    settings = MixtureSettings(max_iterations=40, rank=rank)
    first = register_mixture(scan, target, settings, True, scale, silent)
    second = register_mixture(scan.take(order), target[::-1], settings, True, scale, silent)
    np.testing.assert_allclose(
        second.deformation.apply(scan.points), first.deformation.apply(scan.points), atol=1e-6 * scale
    )


@both_dimensions
@both_methods
def test_result_follows_a_change_of_frame_and_unit(dimension, area_weighted):
    """Outlier share 0: the outliers' bounding box is the one thing tied to the axes."""
    scan, target, scale = problem(dimension)
    settings = MixtureSettings(max_iterations=40, outlier_share=0.0)
    generator = np.random.default_rng(4)
    turn, _ = np.linalg.qr(generator.normal(size=(dimension, dimension)))
    offset, unit = generator.uniform(-1e4, 1e4, dimension), 25.4

    def changed(points):
        return unit * points @ turn.T + offset

    plain = register_mixture(scan, target, settings, area_weighted, scale, silent)
    other = register_mixture(
        PointSet(changed(scan.points), areas=unit**2 * scan.areas),
        changed(target),
        settings,
        area_weighted,
        unit * scale,
        silent,
    )
    np.testing.assert_allclose(
        other.deformation.apply(changed(scan.points)),
        changed(plain.deformation.apply(scan.points)),
        rtol=0.0,
        atol=1e-6 * unit * scale,
    )
    assert other.sigma == pytest.approx(unit * plain.sigma, rel=1e-6)


@both_methods
def test_outliers_among_the_design_points_barely_move_the_fit(area_weighted):
    _, target, scale = problem(3, count=300)
    scan = PointSet(target + 0.8 * np.sin(target[:, ::-1] / 15.0), areas=np.ones(len(target)))
    outliers = np.random.default_rng(8).uniform(-40.0, 40.0, (len(target) // 5, 3))
    error = {}
    for share in (0.0, 0.1):
        settings = MixtureSettings(outlier_share=share, alpha=0.1, max_iterations=500)
        result = register_mixture(scan, np.vstack([target, outliers]), settings, area_weighted, scale, silent)
        error[share] = np.sqrt(((result.deformation.apply(scan.points) - target) ** 2).sum(axis=1).mean())
    displacement = np.sqrt(((scan.points - target) ** 2).sum(axis=1).mean())
    assert error[0.1] < 0.02 * displacement
    assert error[0.0] > 0.2 * displacement


@both_dimensions
@pytest.mark.parametrize("changes", [{}, {"beta": 0.3}, {"rank": 60}], ids=["spanned", "dense", "low rank"])
def test_equal_inputs_give_equal_bytes_on_any_number_of_threads(dimension, changes):
    settings = MixtureSettings(max_iterations=60, **changes)
    results = []
    for threads in (1, 2, 2):
        with threadpool_limits(threads):
            results.append(register(dimension, settings, count=400))
    assert len({result.deformation.coefficients.tobytes() for result in results}) == 1
    assert len({result.sigma for result in results}) == 1


# --- how it ends and what it tells on the way ---


def test_progress_is_told_after_every_iteration():
    told = []
    result = register(2, MixtureSettings(max_iterations=25, tolerance=0.0), progress=told.append)
    assert [step.iteration for step in told] == list(range(1, 26))
    assert [step.fraction for step in told] == [k / 25 for k in range(1, 26)]
    assert {step.stage for step in told} == {"mixture"}
    assert all(step.sigma_mm > 0 for step in told)
    assert told[-1].sigma_mm == result.sigma


def test_cancelling_stops_at_once():
    told = []

    def cancel_at_three(step):
        told.append(step)
        if step.iteration == 3:
            raise CancelledError("enough")

    with pytest.raises(CancelledError, match="enough"):
        register(3, progress=cancel_at_three)
    assert len(told) == 3


@both_dimensions
def test_converged_means_that_nothing_moves_any_more(dimension):
    settings = MixtureSettings(max_iterations=2000, tolerance=1e-5)
    scan, _, scale = problem(dimension)
    result = register(dimension, settings)
    assert (result.converged, result.stop_reason) == (True, "converged")
    assert result.motion <= 1e-5 * scale
    more = register(dimension, MixtureSettings(max_iterations=result.iterations + 300, tolerance=0.0))
    moves = more.deformation.apply(scan.points) - result.deformation.apply(scan.points)
    assert np.abs(moves).max() < 0.01 * scale


def test_running_out_of_iterations_is_told():
    result = register(2, MixtureSettings(max_iterations=2))
    assert (result.converged, result.stop_reason, result.iterations) == (False, "max_iterations", 2)
    assert result.motion > 1e-4 * 20.0


def test_exact_data_end_at_the_least_sigma():
    points = grid(np.arange(6.0), np.arange(6.0))
    result = register_mixture(PointSet(points), points, MixtureSettings(max_iterations=500), False, 2.0, silent)
    assert (result.converged, result.stop_reason) == (True, "sigma_floor")
    assert result.sigma == pytest.approx(2e-4, rel=1e-9)
    np.testing.assert_allclose(result.deformation.apply(points), points, atol=1e-6)


# --- deformation ---


def test_a_known_bend_is_recovered_between_the_scan_points_too():
    nodes = grid(np.linspace(0.0, 1.0, 17), np.linspace(0.0, 1.0, 17))
    scan = deformed(nodes, 0, 0.05)
    areas = nodal_areas(scan, Delaunay(nodes).simplices)
    settings = MixtureSettings(beta=2.0, alpha=0.1, outlier_share=0.0, max_iterations=500)
    result = register_mixture(PointSet(scan, areas=areas), nodes, settings, True, UNIT_SQUARE_SCALE, silent)
    fresh = np.random.default_rng(1).uniform(0.05, 0.95, (200, 2))
    displacement = deformed(fresh, 0, 0.05) - fresh
    error = result.deformation.displacement_at(fresh) - displacement
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.02 * np.sqrt((displacement**2).sum(axis=1).mean())


@both_dimensions
def test_low_rank_knows_how_sure_it_is_and_dense_does_not(dimension):
    scan, target, _ = problem(dimension, count=170)
    low = register(dimension, MixtureSettings(rank=60))
    inside = low.deformation.std(target.mean(axis=0, keepdims=True))
    far = low.deformation.std(target.mean(axis=0, keepdims=True) + 60.0)
    assert 0.0 < inside[0] < low.sigma
    assert far[0] > 3.0 * inside[0]
    dense = register(dimension, MixtureSettings(beta=0.3), count=170)
    assert np.isnan(dense.deformation.std(scan.points)).all()


# --- degenerate inputs ---


@both_methods
@pytest.mark.parametrize(
    "points",
    [
        pytest.param(np.zeros((1, 3)), id="single point"),
        pytest.param(np.zeros((20, 3)), id="one spot"),
        pytest.param(np.linspace(0.0, 5.0, 20)[:, None] * [1.0, 2.0, 0.0], id="collinear"),
        pytest.param(grid(np.arange(5.0), np.arange(5.0), [0.0]), id="planar"),
        pytest.param(np.repeat(np.eye(3), 10, axis=0), id="duplicates"),
        pytest.param(np.random.default_rng(0).normal(size=(40, 3)) + 1e6, id="far from the origin"),
    ],
)
@pytest.mark.parametrize("rank", [0, 10])
def test_degenerate_clouds_never_give_nan_or_a_sigma_of_zero(points, rank, area_weighted):
    told = []
    areas = np.linspace(0.0, 1.0, len(points)) + (len(points) == 1)
    settings = MixtureSettings(rank=rank, outlier_share=0.0, max_iterations=60)
    result = register_mixture(PointSet(points, areas=areas), points + 0.01, settings, area_weighted, 1.0, told.append)
    assert np.isfinite(result.deformation.apply(points)).all()
    assert all(step.sigma_mm >= 1e-4 for step in told)


def test_one_far_design_point_without_an_outlier_share_is_an_error_that_says_so():
    scan, target, scale = problem(3)
    target = np.vstack([target, [[1e5, 0.0, 0.0]]])
    with pytest.raises(RegistrationFailedError, match="outlier_share above 0"):
        register_mixture(scan, target, MixtureSettings(outlier_share=0.0), True, scale, silent)
    assert register_mixture(scan, target, MixtureSettings(), True, scale, silent).sigma < 0.2 * scale


def test_micrometres_taken_for_millimetres_are_no_match():
    scan, target, scale = problem(3)
    with pytest.raises(RegistrationFailedError, match="units"):
        register_mixture(PointSet(1e3 * scan.points, areas=scan.areas), target, MixtureSettings(), True, scale, silent)


@pytest.mark.parametrize("outlier_share", [0.0, 0.1])
def test_clouds_far_apart_are_no_match(outlier_share):
    scan, target, scale = problem(3)
    settings = MixtureSettings(outlier_share=outlier_share)
    with pytest.raises(RegistrationFailedError, match="pose"):
        register_mixture(scan, target + 1e4 * scale, settings, True, scale, silent)


def test_coordinates_beyond_all_measure_are_refused_before_they_overflow():
    scan, target, scale = problem(3)
    with pytest.raises(RegistrationFailedError, match="mm from the middle"):
        register_mixture(scan, 1e200 * target, MixtureSettings(), True, scale, silent)


def test_area_weights_need_areas():
    with pytest.raises(RegistrationFailedError, match="no areas"):
        register_mixture(PointSet(np.eye(3)), np.eye(3), MixtureSettings(), True, 1.0, silent)


@pytest.mark.parametrize("areas", [[0.0, 0.0, 0.0], [1.0, -1.0, 1.0]])
def test_useless_areas_are_refused(areas):
    with pytest.raises(RegistrationFailedError, match="areas"):
        register_mixture(PointSet(np.eye(3), areas=np.array(areas)), np.eye(3), MixtureSettings(), True, 1.0, silent)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, 1e300])
def test_useless_scale_is_refused(scale):
    with pytest.raises(RegistrationFailedError, match="scale"):
        register_mixture(PointSet(np.eye(3)), np.eye(3), MixtureSettings(), False, scale, silent)


@pytest.mark.parametrize("target", [np.empty((0, 3)), np.eye(2), np.full((4, 3), np.nan)])
def test_useless_target_is_refused(target):
    with pytest.raises(RegistrationFailedError, match="target"):
        register_mixture(PointSet(np.eye(3)), target, MixtureSettings(), False, 1.0, silent)


def test_too_weak_a_prior_for_so_few_design_points_is_told_rather_than_solved_badly():
    scan = PointSet(grid(*[np.arange(4.0)] * 3))
    settings = MixtureSettings(alpha=1e-9, beta=0.1, outlier_share=0.0)
    with pytest.raises(RegistrationFailedError, match="alpha"):
        register_mixture(scan, np.eye(3), settings, False, 10.0, silent)
