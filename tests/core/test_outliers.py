"""Finding the scan points that are no part of the surface."""

import numpy as np
import pytest

from mdf_core.outliers import normalized_median_test, surface_distance_test
from mdf_core.settings import OutlierSettings

THRESHOLD = OutlierSettings().median_threshold


@pytest.fixture
def generator():
    return np.random.default_rng(11)


def smooth_field(points):
    return 0.3 * np.stack([np.sin(points[:, 0] / 30.0), np.cos(points[:, 1] / 40.0), points[:, 0] / 100.0], axis=1)


def test_surface_distance_finds_every_planted_outlier_and_hardly_anything_else(generator):
    distance = generator.normal(0.0, 0.02, 4000)
    planted = generator.choice(4000, 40, replace=False)
    distance[planted] = generator.uniform(0.3, 5.0, 40) * generator.choice([-1.0, 1.0], 40)
    found = surface_distance_test(distance, OutlierSettings())
    assert found[planted].sum() == 40
    assert np.delete(found, planted).mean() <= 0.01


def test_surface_distance_limit_is_the_larger_of_floor_and_robust_spread():
    settings = OutlierSettings(threshold=4.0, floor_mm=0.1)
    quiet = np.array([0.001] * 9 + [0.0999, 0.1001])
    np.testing.assert_array_equal(np.flatnonzero(surface_distance_test(quiet, settings)), [10])
    limit = 4.0 * 1.4826
    loud = np.array([1.0] * 9 + [limit - 1e-6, -limit - 1e-6])
    np.testing.assert_array_equal(np.flatnonzero(surface_distance_test(loud, settings)), [10])


def test_a_distance_that_is_no_number_is_an_outlier():
    np.testing.assert_array_equal(
        surface_distance_test(np.array([0.0, np.nan, np.inf]), OutlierSettings()), [False, True, True]
    )
    assert surface_distance_test(np.full(3, np.nan), OutlierSettings()).all()


def test_median_test_finds_rough_displacements(generator):
    points = generator.uniform(-50.0, 50.0, (2000, 3)) * [1.0, 1.0, 0.1]
    displacement = smooth_field(points) + generator.normal(0.0, 0.002, (2000, 3))
    planted = generator.choice(2000, 40, replace=False)
    displacement[planted] += 3.0 * (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(
        generator.normal(size=(40, 3))
    )
    found = normalized_median_test(points, displacement, THRESHOLD)
    assert found[planted].sum() == 40
    assert np.delete(found, planted).mean() <= 0.01


def test_median_test_cannot_see_a_smooth_displacement_at_points_off_the_surface(generator):
    points = generator.uniform(-50.0, 50.0, (2000, 3)) * [1.0, 1.0, 0.0]
    points[:40, 2] += 5.0
    assert not normalized_median_test(points, smooth_field(points), THRESHOLD)[:40].any()


def test_median_test_is_the_formula_on_a_grid():
    """Equal distances: Westerweel & Scarano's test with the distance cancelled."""
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    points = np.vstack([[0.0, 0.0], np.column_stack([np.cos(angles), np.sin(angles)])])
    # Half of the neighbours differ from the median by 0.1, the others not at all.
    neighbours = np.column_stack([[0.9, 0.9, 1.0, 1.0, 1.0, 1.0, 1.1, 1.1], np.zeros(8)])
    spread, epsilon = 0.05, 0.01
    for distance, expected in [(1.99 * (spread + epsilon), False), (2.01 * (spread + epsilon), True)]:
        displacement = np.vstack([[1.0 + distance, 0.0], neighbours])
        assert normalized_median_test(points, displacement, 2.0)[0] == expected


def test_median_test_takes_noise_below_epsilon_for_nothing(generator):
    points = generator.uniform(0.0, 10.0, (300, 2))
    assert not normalized_median_test(points, generator.normal(0.0, 0.002, (300, 2)), THRESHOLD).any()


def test_median_test_takes_duplicates_and_few_points():
    duplicates = np.zeros((30, 3))
    displacement = np.zeros((30, 3))
    displacement[3] = 1.0
    np.testing.assert_array_equal(np.flatnonzero(normalized_median_test(duplicates, displacement, THRESHOLD)), [3])
    assert not normalized_median_test(np.zeros((1, 3)), np.ones((1, 3)), THRESHOLD).any()
    assert normalized_median_test(np.eye(3), np.zeros((3, 3)), THRESHOLD).shape == (3,)
