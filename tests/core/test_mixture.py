"""The mixture and its E-step, held against the formulas written out in full."""

import tracemalloc

import numpy as np
import pytest

from mdf_core import mixture
from mdf_core.data_cells import gather
from mdf_core.errors import RegistrationFailedError
from mdf_core.mixture import area_weights, box_density, expect, initial_variance


def responsibilities(moved, target, weights, variance, outlier_share, density):
    """P (m, N) of the corrected paper, term by term."""
    count, dimension = moved.shape
    squared = ((target[None] - moved[:, None]) ** 2).sum(axis=2)
    terms = weights[:, None] ** (1 - dimension / 2) * np.exp(-squared / (2 * weights[:, None] * variance))
    constant = outlier_share / (1 - outlier_share) * (2 * np.pi * variance) ** (dimension / 2) * count * density
    return terms / (terms.sum(axis=0) + constant)


@pytest.fixture(params=[2, 3])
def clouds(request):
    generator = np.random.default_rng(7)
    moved = generator.normal(size=(60, request.param))
    target = generator.normal(size=(80, request.param)) + 0.1
    return moved, target, area_weights(generator.uniform(0.2, 3.0, 60))


@pytest.mark.parametrize("outlier_share", [0.0, 0.1])
def test_expectation_is_the_formula(clouds, outlier_share):
    moved, target, weights = clouds
    density, variance = box_density(target), 0.05
    result = expect(moved, gather(target, 0.0), weights, variance, outlier_share, density)

    probability = responsibilities(moved, target, weights, variance, outlier_share, density)
    tilde = probability / weights[:, None]
    np.testing.assert_allclose(result.explained, probability.sum(), rtol=1e-12)
    np.testing.assert_allclose(result.mass, tilde.sum(axis=1), rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(result.mass[:, None] * result.mean, tilde @ target, rtol=1e-9, atol=1e-12)

    fresh = moved + 0.01
    squared = ((target[None] - fresh[:, None]) ** 2).sum(axis=2)
    expected = (tilde * squared).sum() / (target.shape[1] * probability.sum())
    np.testing.assert_allclose(result.variance(fresh), expected, rtol=1e-10)


def test_log_likelihood_is_the_formula(clouds):
    moved, target, weights = clouds
    count, dimension = moved.shape
    density, variance, share = box_density(target), 0.05, 0.1
    squared = ((target[None] - moved[:, None]) ** 2).sum(axis=2)
    normal = (2 * np.pi * weights * variance)[:, None] ** (-dimension / 2)
    components = weights[:, None] / count * normal * np.exp(-squared / (2 * weights[:, None] * variance))
    expected = np.log(share * density + (1 - share) * components.sum(axis=0)).sum()
    result = expect(moved, gather(target, 0.0), weights, variance, share, density)
    assert result.log_likelihood == pytest.approx(expected, rel=1e-12)


# --- out of reach, and in cells ---


@pytest.fixture
def surface(rng):
    """A wavy sheet: many blocks, of which a narrow mixture reaches a few."""
    moved, target = rng.uniform(-1.0, 1.0, (700, 3)), rng.uniform(-1.0, 1.0, (3000, 3))
    for points in (moved, target):
        points[:, 2] = 0.2 * np.sin(3.0 * points[:, 0])
    return moved, target, area_weights(rng.uniform(0.2, 3.0, 700))


@pytest.mark.parametrize("outlier_share", [0.0, 0.1])
@pytest.mark.parametrize("sigma", [0.5, 0.1, 0.03, 1e-3])
def test_centroids_out_of_reach_make_no_difference(surface, sigma, outlier_share, monkeypatch):
    moved, target, weights = surface
    cells = gather(target, 0.0)
    reached = expect(moved, cells, weights, sigma**2, outlier_share, 0.1)
    monkeypatch.setattr(mixture, "_OUT_OF_REACH", np.inf)
    dense = expect(moved, cells, weights, sigma**2, outlier_share, 0.1)
    drawn = dense.mass > 1e-9
    np.testing.assert_allclose(reached.mass, dense.mass, rtol=0.0, atol=1e-12 * len(target))
    np.testing.assert_allclose(reached.mean[drawn], dense.mean[drawn], rtol=0.0, atol=1e-10)
    assert reached.log_likelihood == pytest.approx(dense.log_likelihood, rel=1e-13)
    assert reached.variance(moved) == pytest.approx(dense.variance(moved), rel=1e-10)


def test_a_narrow_mixture_looks_at_few_pairs(surface, monkeypatch):
    moved, target, weights = surface
    pairs = []

    def counted(features, counts, right, log_outliers):
        pairs.append(len(features) * right.shape[1])
        return shared_out(features, counts, right, log_outliers)

    shared_out = mixture._shared_out
    monkeypatch.setattr(mixture, "_shared_out", counted)
    expect(moved, gather(target, 0.0), weights, 0.02**2, 0.1, 0.1)
    assert sum(pairs) < 0.3 * len(moved) * len(target)


def test_points_that_share_responsibilities_make_a_lower_bound_that_closes_as_the_cells_shrink(surface):
    moved, target, weights = surface
    exact = expect(moved, gather(target, 0.0), weights, 0.3**2, 0.1, 0.1)
    previous = None
    for width in (0.3, 0.15, 0.075):
        shared = expect(moved, gather(target, width), weights, 0.3**2, 0.1, 0.1)
        loss = exact.log_likelihood - shared.log_likelihood
        error = np.abs(shared.mass - exact.mass).max() / exact.mass.max()
        assert loss > 0
        if previous:
            assert loss < 0.5 * previous[0] and error < 0.5 * previous[1]
        previous = loss, error


def test_every_design_point_is_shared_out_completely_without_outliers(clouds):
    moved, target, weights = clouds
    assert expect(moved, gather(target, 0.0), weights, 0.01, 0.0, 1.0).explained == pytest.approx(
        len(target), rel=1e-12
    )


@pytest.mark.parametrize("chunk_bytes", [1, 8 * 60 * 7, 8 * 60 * 79])
def test_block_size_does_not_change_the_result(clouds, monkeypatch, chunk_bytes):
    moved, target, weights = clouds
    whole = expect(moved, gather(target, 0.0), weights, 0.02, 0.1, 0.3)
    monkeypatch.setattr(mixture, "_CHUNK_BYTES", chunk_bytes)
    blocks = expect(moved, gather(target, 0.0), weights, 0.02, 0.1, 0.3)
    for name in ("mass", "mean", "spread", "explained"):
        np.testing.assert_allclose(getattr(blocks, name), getattr(whole, name), rtol=1e-9, atol=1e-14)


def test_memory_stays_far_below_the_matrix_of_responsibilities():
    generator = np.random.default_rng(0)
    moved, target = generator.normal(size=(3000, 3)), generator.normal(size=(3000, 3))
    tracemalloc.start()
    expect(moved, gather(target, 0.0), np.ones(3000), 0.01, 0.1, 0.1)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.1 * 3000 * 3000 * 8


def test_a_point_far_from_everything_goes_to_its_nearest_centroid_even_without_an_outlier_share():
    moved = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    target = np.vstack([moved, [[1e4, 0.0]]])
    result = expect(moved, gather(target, 0.0), np.ones(3), 1e-4, 0.0, 1.0)
    np.testing.assert_allclose(result.mass, [1.0, 2.0, 1.0], rtol=1e-9)
    np.testing.assert_allclose(result.mean[1], [5000.5, 0.0], rtol=1e-9)
    assert result.variance(moved) > 0


def test_with_an_outlier_share_that_point_is_dropped():
    moved = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    target = np.vstack([moved, [[1e4, 0.0]]])
    result = expect(moved, gather(target, 0.0), np.ones(3), 1e-4, 0.1, box_density(target))
    np.testing.assert_allclose(result.mean, moved, atol=1e-9)
    assert result.explained == pytest.approx(3.0, rel=1e-3)


def test_a_centroid_that_nothing_draws_stays_where_it_is():
    moved = np.array([[0.0, 0.0], [50.0, 0.0]])
    result = expect(moved, gather(np.zeros((5, 2)), 0.0), np.ones(2), 1e-6, 0.0, 1.0)
    assert result.mass[1] < 1e-20
    assert np.isfinite(result.mean).all()


def test_no_explained_point_is_an_error_and_not_a_nan():
    with pytest.raises(RegistrationFailedError, match="outlier"):
        expect(np.full((4, 3), 1e6), gather(np.zeros((4, 3)), 0.0), np.ones(4), 1e-8, 0.5, 1.0)


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("name", ["duplicates", "planar", "collinear"])
def test_variance_is_never_negative(name, offset):
    points = np.random.default_rng(3).normal(size=(50, 3))
    if name == "duplicates":
        points = np.repeat(points[:5], 10, axis=0)
    points[:, {"duplicates": 3, "planar": 2, "collinear": 1}[name] :] = 0.0
    points += offset
    for variance in (1.0, 1e-4, 1e-8):
        result = expect(points, gather(points, 0.0), np.ones(50), variance, 0.0, 1.0)
        assert 0.0 <= result.variance(points) <= 1.1 * variance
    assert initial_variance(points, points) > 0
    assert np.isfinite(box_density(points)) and box_density(points) > 0


def test_initial_variance_is_the_mean_over_all_pairs(clouds):
    moved, target, _ = clouds
    squared = ((target[None] - moved[:, None]) ** 2).sum(axis=2)
    assert initial_variance(moved, target) == pytest.approx(squared.mean() / moved.shape[1], rel=1e-12)


def test_area_weights_are_relative_areas():
    np.testing.assert_allclose(area_weights(np.array([1.0, 2.0, 3.0])), [0.5, 1.0, 1.5], rtol=1e-15)


def test_area_weights_have_a_floor_and_mean_one():
    weights = area_weights(np.array([0.0, 1e-12, 1.0, 1.0]))
    assert weights.min() > 0.04
    assert weights.mean() == pytest.approx(1.0, rel=1e-15)


@pytest.mark.parametrize("areas", [[0.0, 0.0], [1.0, -1.0], [np.nan, 1.0]])
def test_useless_areas_are_refused(areas):
    with pytest.raises(RegistrationFailedError, match="cpd"):
        area_weights(np.array(areas))


def test_box_density_is_one_over_the_padded_volume():
    corners = np.array([[0.0, 0.0], [3.0, 4.0]])
    assert box_density(corners) == pytest.approx(1.0 / (3.5 * 4.5), rel=1e-12)
