import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mdf_core.rigid import best_rigid_fit, homogeneous, inverse, rotate, transform


def some_motion(dimension: int) -> np.ndarray:
    rotation = Rotation.from_euler("zyx", (50, -20, 170), degrees=True).as_matrix()
    if dimension == 2:
        rotation = np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    return homogeneous(rotation, np.arange(1.0, dimension + 1) * 40)


@pytest.mark.parametrize("dimension", [2, 3])
def test_inverse_undoes_a_motion_and_rotate_leaves_out_its_translation(dimension):
    motion, points = some_motion(dimension), np.random.default_rng(0).normal(size=(20, dimension))
    np.testing.assert_allclose(transform(inverse(motion), transform(motion, points)), points, atol=1e-12)
    np.testing.assert_allclose(
        rotate(motion, points), transform(motion, points) - transform(motion, 0 * points), atol=1e-12
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("weighted", [False, True])
def test_a_rigid_motion_is_found_exactly(dimension, weighted):
    rng = np.random.default_rng(1)
    points = 30 * rng.normal(size=(50, dimension))
    motion = some_motion(dimension)
    weights = rng.uniform(0, 2, size=50) if weighted else None
    np.testing.assert_allclose(best_rigid_fit(points, transform(motion, points), weights), motion, atol=1e-10)


def test_points_of_weight_zero_have_no_say():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(50, 3))
    target = transform(some_motion(3), points)
    target[:20] += 5
    weights = np.where(np.arange(50) < 20, 0.0, 1.0)
    np.testing.assert_allclose(best_rigid_fit(points, target, weights), some_motion(3), atol=1e-10)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_mirrored_target_never_yields_a_reflection(dimension):
    points = np.random.default_rng(3).normal(size=(50, dimension))
    mirror = np.diag([-1.0] + [1.0] * (dimension - 1))
    fit = best_rigid_fit(points, points @ mirror)
    assert np.linalg.det(fit[:dimension, :dimension]) == pytest.approx(1.0)


def test_points_in_a_plane_are_fitted_by_a_rotation():
    points = np.random.default_rng(4).normal(size=(50, 3)) * (1, 1, 0)
    np.testing.assert_allclose(best_rigid_fit(points, transform(some_motion(3), points)), some_motion(3), atol=1e-10)


def test_no_small_motion_fits_better():
    rng = np.random.default_rng(5)
    source = rng.normal(size=(50, 3))
    target = transform(some_motion(3), source) + 0.3 * rng.normal(size=(50, 3))
    weights = rng.uniform(0.1, 2, size=50)

    def cost(motion):
        return (weights[:, None] * (transform(motion, source) - target) ** 2).sum()

    best = best_rigid_fit(source, target, weights)
    for _ in range(50):
        nudge = homogeneous(Rotation.from_rotvec(1e-3 * rng.normal(size=3)).as_matrix(), 1e-3 * rng.normal(size=3))
        assert cost(nudge @ best) > cost(best)
