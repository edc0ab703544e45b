"""The motion kernel and its low-rank basis."""

import numpy as np
import pytest

from mdf_core.kernel import KernelBasis, gaussian_kernel, joined, low_rank_basis

WIDTH = 40.0


@pytest.fixture(params=[2, 3])
def points(request):
    return np.random.default_rng(1).uniform(-30.0, 30.0, (400, request.param))


def test_kernel_is_the_gaussian_of_the_distance(points):
    a, b = points[:50], points[50:120]
    squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(gaussian_kernel(a, b, WIDTH), np.exp(-squared / (2.0 * WIDTH**2)), rtol=1e-12)


def test_kernel_of_far_points_is_tiny_but_never_denormal():
    values = gaussian_kernel(np.zeros((1, 3)), np.array([[1e3, 0.0, 0.0], [1e9, 0.0, 0.0]]), 1.0)
    assert ((values >= np.finfo(float).tiny) & (values < 1e-25)).all()


def test_plain_basis_is_the_kernel_itself(points):
    basis = KernelBasis(points, WIDTH, None)
    np.testing.assert_array_equal(basis(points[:7]), gaussian_kernel(points[:7], points, WIDTH))


def test_low_rank_basis_reproduces_the_kernel(points):
    values = low_rank_basis(points, WIDTH, rank=150)(points)
    np.testing.assert_allclose(values @ values.T, gaussian_kernel(points, points, WIDTH), atol=1e-9)


def test_low_rank_error_is_bounded_by_the_diagonal_and_falls_with_the_rank(points):
    kernel = gaussian_kernel(points, points, WIDTH)
    errors = []
    for rank in (5, 15, 45):
        values = low_rank_basis(points, WIDTH, rank)(points)
        remainder = kernel - values @ values.T
        assert np.abs(remainder).max() <= remainder.diagonal().max() + 1e-9
        errors.append(np.abs(remainder).max())
    assert errors[0] > 5.0 * errors[1] > 25.0 * errors[2]


def test_low_rank_basis_also_holds_between_its_points(points):
    basis, fresh = low_rank_basis(points, WIDTH, rank=150), 0.9 * points[::-1][:40] + 0.5
    np.testing.assert_allclose(basis(fresh) @ basis(points).T, gaussian_kernel(fresh, points, WIDTH), atol=1e-5)


def test_joined_bases_are_the_sum_of_their_kernels(points):
    wide, narrow = low_rank_basis(points, WIDTH, rank=150), low_rank_basis(points, 0.6 * WIDTH, rank=150)
    basis, expected = joined([wide, narrow]), np.hstack([wide(points), narrow(points)])
    np.testing.assert_allclose(basis(points), expected, atol=1e-12)
    coefficients = np.linspace(-1.0, 1.0, 3 * expected.shape[1]).reshape(-1, 3)
    moved = gaussian_kernel(points, basis.centres, basis.width) @ basis.weights(coefficients)
    np.testing.assert_allclose(moved, expected @ coefficients, atol=1e-6)
    assert joined([wide]) is wide


def test_duplicate_points_are_used_once():
    points = np.repeat(np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]), 20, axis=0)
    basis = low_rank_basis(points, 5.0, rank=50)
    assert len(basis.centres) == 3
    assert np.isfinite(basis(points)).all()


def test_equal_points_give_equal_bytes(points):
    first, second = low_rank_basis(points, WIDTH, 60), low_rank_basis(points.copy(), WIDTH, 60)
    assert first.centres.tobytes() == second.centres.tobytes()
    assert first(points).tobytes() == second(points).tobytes()
