"""From scan points to design vertices: each method is exact on what it can be exact on."""

import numpy as np
import pytest

from mdf_core.errors import DegenerateScanError, InvalidSettingError
from mdf_core.interpolation import interpolate

METHODS = ("knn", "inverse_distance", "linear")


@pytest.fixture(params=[2, 3])
def points(request):
    return np.random.default_rng(2).uniform(-10.0, 10.0, (300, request.param))


def inside(points):
    """Queries well inside the convex hull."""
    return 0.5 * points[:50] + 0.1


@pytest.mark.parametrize("method", METHODS)
def test_a_constant_stays_the_constant(points, method):
    values = np.tile([1.0, -2.0, 0.5], (len(points), 1))
    result = interpolate(points, values, inside(points), method, neighbours=4)
    np.testing.assert_allclose(result, values[:50], rtol=1e-12)


def test_linear_is_exact_on_a_linear_field(points):
    gradient = np.arange(1.0, 1.0 + points.shape[1] ** 2).reshape(points.shape[1], -1)
    result = interpolate(points, points @ gradient + 3.0, inside(points), "linear", neighbours=1)
    np.testing.assert_allclose(result, inside(points) @ gradient + 3.0, rtol=1e-9, atol=1e-9)


def test_linear_is_nan_outside_the_convex_hull_and_only_there(points):
    outside = np.full((1, points.shape[1]), 11.0)
    result = interpolate(points, points, np.vstack([inside(points), outside]), "linear", neighbours=1)
    np.testing.assert_array_equal(np.isnan(result).any(axis=1), [False] * 50 + [True])


@pytest.mark.parametrize("method", METHODS)
def test_values_come_back_at_their_points(points, method):
    values = np.random.default_rng(5).normal(size=points.shape)
    result = interpolate(points, values, points, method, neighbours=1 if method == "knn" else 6)
    np.testing.assert_allclose(result, values, rtol=1e-9, atol=1e-9)


def test_knn_is_the_mean_of_the_nearest():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [10.0, 0.0]])
    values = np.array([[1.0, 2.0], [3.0, 6.0], [100.0, 100.0]])
    np.testing.assert_array_equal(interpolate(points, values, np.array([[0.4, 0.0]]), "knn", 2), [[2.0, 4.0]])


def test_inverse_distance_weighs_by_one_over_the_squared_distance():
    points = np.array([[0.0, 0.0], [3.0, 0.0], [100.0, 0.0]])
    values = np.array([[0.0, 0.0], [10.0, 20.0], [7.0, 7.0]])
    result = interpolate(points, values, np.array([[1.0, 0.0]]), "inverse_distance", 2)
    np.testing.assert_allclose(result, [[2.0, 4.0]], rtol=1e-12)


def test_inverse_distance_shares_between_coincident_points():
    points = np.array([[1.0, 1.0], [1.0, 1.0], [5.0, 1.0]])
    values = np.array([[2.0, 0.0], [4.0, 0.0], [100.0, 0.0]])
    result = interpolate(points, values, np.array([[1.0, 1.0]]), "inverse_distance", 3)
    np.testing.assert_array_equal(result, [[3.0, 0.0]])


@pytest.mark.parametrize("distance", [1e-300, 1e-160, 1e100])
def test_inverse_distance_takes_any_distance(distance):
    result = interpolate(np.zeros((1, 2)), np.ones((1, 2)), np.array([[distance, 0.0]]), "inverse_distance", 1)
    np.testing.assert_array_equal(result, [[1.0, 1.0]])


@pytest.mark.parametrize("method", ["knn", "inverse_distance"])
def test_more_neighbours_than_points_means_all_points(method):
    points, values = np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[1.0, 0.0], [3.0, 0.0]])
    result = interpolate(points, values, np.array([[1.0, 0.0]]), method, neighbours=50)
    np.testing.assert_allclose(result, [[2.0, 0.0]], rtol=1e-15)


@pytest.mark.parametrize(
    "points", [np.zeros((1, 3)), np.eye(3), np.random.default_rng(0).normal(size=(50, 3)) * [1, 1, 0]]
)
def test_linear_refuses_points_that_do_not_span_space(points):
    with pytest.raises(DegenerateScanError, match="knn"):
        interpolate(points, points, points, "linear", neighbours=1)


def test_unknown_method_is_named():
    with pytest.raises(InvalidSettingError, match="'cubic'"):
        interpolate(np.eye(3), np.eye(3), np.eye(3), "cubic", 1)
