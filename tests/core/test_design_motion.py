"""The linear equations of the last step, against the plain solution of all unknowns at once."""

import numpy as np
import pytest

from mdf_core.design_motion import EVEN, Equations, Prior
from mdf_core.facets import BentFacets
from mdf_core.kernel import low_rank_basis

SCALE, SIGMA, ALPHA, OFFSET_ALPHA = 40.0, 0.03, 900.0, 5e5
RIDGES = np.array([1e-3, 1e-3, 1e-3, 1e-6])  # of strains and shifts
COMMON = 1e-3  # of the scale, prior standard deviation of the offset of all points


@pytest.fixture
def equations(rng):
    feet, normals = rng.uniform(-50.0, 50.0, (400, 3)), rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances, weights = rng.normal(scale=0.3, size=400), rng.uniform(0.2, 3.0, 400)
    return Equations(BentFacets(feet), normals, distances, weights, np.array([1.0, 2.0, 3.0]), SCALE)


def prior_of(equations, offset_rank, as_motion=False):
    feet = equations.facets.feet
    offset_basis = low_rank_basis(feet, 25.0, offset_rank) if offset_rank else EVEN
    return Prior(low_rank_basis(feet, 40.0, 20), ALPHA, offset_basis, OFFSET_ALPHA, as_motion)


def joint(equations, prior):
    """Rows, prior precisions over that of the noise, in units of the scale; the motion's unknowns first."""
    feet = equations.facets.feet
    features = np.hstack([prior.basis(feet), (feet - equations.origin) / SCALE, np.ones((400, 1))])
    motion = np.hstack([axis[:, None] * features for axis in equations.normals.T])
    varying = prior.offset_basis(feet)
    if prior.offset_as_motion:
        varying = np.hstack([axis[:, None] * varying for axis in equations.normals.T])
    offset = np.hstack([varying, np.ones((400, 1))])
    variance = (SIGMA / SCALE) ** 2
    ridges = np.concatenate([np.full(20, ALPHA * variance), RIDGES])
    softer = np.full(varying.shape[1], OFFSET_ALPHA * variance)
    return np.hstack([motion, offset]), np.concatenate([ridges, ridges, ridges, softer, [variance / COMMON**2]])


@pytest.mark.parametrize(("offset_rank", "as_motion"), [(0, False), (15, False), (15, True)])
def test_the_motion_beside_an_offset_is_that_of_all_unknowns_solved_at_once(equations, offset_rank, as_motion):
    prior = prior_of(equations, offset_rank, as_motion)
    solved = equations.summed(prior, lambda: None).solve(prior, SIGMA)
    rows, precisions = joint(equations, prior)
    matrix = rows.T @ (equations.weights[:, None] * rows) + np.diag(precisions)
    expected = np.linalg.solve(matrix, rows.T @ (equations.weights * equations.distances / SCALE))
    np.testing.assert_allclose(solved.solution.T.ravel(), expected[:72], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(solved.offsets, expected[72:], rtol=1e-7, atol=1e-12)
    covariance = np.linalg.inv(matrix)
    np.testing.assert_allclose(
        np.linalg.inv(solved.factor @ solved.factor.T), covariance[:72, :72], rtol=1e-6, atol=1e-9
    )
    kept = np.diag(covariance) * precisions
    basis = np.tile(np.arange(24) < 20, 3)
    assert solved.determined == pytest.approx((1.0 - kept[:72])[basis].sum())
    assert solved.offset_determined == pytest.approx(prior.offset_rank - kept[72:-1].sum(), abs=1e-6)


def test_the_residuals_are_what_motion_and_offset_leave(equations):
    prior = prior_of(equations, 15)
    motion = equations.solve(prior, SIGMA, True, lambda: None)
    rows, _ = joint(equations, prior)
    unknowns = np.concatenate([motion.solved.solution.T.ravel(), motion.solved.offsets])
    np.testing.assert_allclose(motion.residuals(), equations.distances - SCALE * rows @ unknowns, atol=1e-10)


def test_the_evidence_ranks_stiffnesses_as_the_density_of_the_data_does(equations):
    def density(prior):
        rows, precisions = joint(equations, prior)
        precisions = precisions * (SCALE / SIGMA) ** 2
        precisions[:20] = precisions[24:44] = precisions[48:68] = prior.alpha
        precisions[72:-1] = prior.offset_alpha
        covariance = rows @ (rows / precisions).T + np.diag((SIGMA / SCALE) ** 2 / equations.weights)
        distances = equations.distances / SCALE
        return -0.5 * (distances @ np.linalg.solve(covariance, distances) + np.linalg.slogdet(covariance)[1])

    base = prior_of(equations, 15)
    others = [Prior(base.basis, alpha, base.offset_basis, offset) for alpha in (50.0, 9e4) for offset in (1e3, 1e7)]
    sums = equations.summed(base, lambda: None)
    evidences = np.array([sums.solve(prior, SIGMA).evidence for prior in others])
    np.testing.assert_allclose(np.diff(evidences), np.diff([density(prior) for prior in others]), rtol=1e-6, atol=1e-3)
