"""The linear equations of the last step, against the plain solution of all unknowns at once."""

from dataclasses import replace

import numpy as np
import pytest

from mdf_core.design_motion import EVEN, Equations, Prior
from mdf_core.facets import BentFacets
from mdf_core.kernel import low_rank_basis

SCALE, SIGMA, ALPHAS, OFFSET_ALPHA = 40.0, 0.03, np.array([900.0, 4e4]), 5e5
VARIANCE = (SIGMA / SCALE) ** 2
RIDGES = np.array([1e-3, 1e-3, 1e-3, 1e-6])  # of strains and shifts
COMMON = 1e-3  # of the scale, prior standard deviation of the offset of all points


@pytest.fixture
def equations(rng):
    feet, normals = rng.uniform(-50.0, 50.0, (400, 3)), rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances, weights = rng.normal(scale=0.3, size=400), rng.uniform(0.2, 3.0, 400)
    return Equations(BentFacets(feet), normals, distances, weights, np.array([1.0, 2.0, 3.0]), SCALE)


def prior_of(equations, offset_rank, widths=1):
    feet = equations.facets.feet
    offset_basis = low_rank_basis(feet, 25.0, offset_rank) if offset_rank else EVEN
    bases = [low_rank_basis(feet, 40.0, 12), low_rank_basis(feet, 30.0, 8)][:widths]
    return Prior(bases, ALPHAS[:widths], offset_basis, OFFSET_ALPHA)


def joint(equations, prior):
    """Rows, prior precisions over that of the noise, in units of the scale, and which unknowns have a stiffness."""
    feet, rank = equations.facets.feet, sum(prior.ranks)
    features = [basis(feet) for basis in prior.bases]
    features = np.hstack([*features, (feet - equations.origin) / SCALE, np.ones((400, 1))])
    motion = np.hstack([axis[:, None] * features for axis in equations.normals.T])
    offset = np.hstack([prior.offset_basis(feet), np.ones((400, 1))])
    precisions = np.concatenate([np.repeat(prior.alphas, prior.ranks) * VARIANCE, RIDGES])
    varying = np.full(offset.shape[1] - 1, prior.offset_alpha * VARIANCE)
    has_stiffness = np.concatenate([np.tile(np.arange(rank + 4) < rank, 3), np.ones(len(varying)), [0]]).astype(bool)
    precisions = np.concatenate([precisions, precisions, precisions, varying, [VARIANCE / COMMON**2]])
    return np.hstack([motion, offset]), precisions, has_stiffness


@pytest.mark.parametrize(("offset_rank", "widths"), [(0, 1), (15, 1), (0, 2), (15, 2)])
def test_the_motion_beside_an_offset_is_that_of_all_unknowns_solved_at_once(equations, offset_rank, widths):
    prior = prior_of(equations, offset_rank, widths)
    solved = equations.summed(prior, lambda: None).solve(prior, SIGMA)
    rows, precisions, has_stiffness = joint(equations, prior)
    matrix, size = rows.T @ (equations.weights[:, None] * rows) + np.diag(precisions), solved.solution.size
    expected = np.linalg.solve(matrix, rows.T @ (equations.weights * equations.distances / SCALE))
    np.testing.assert_allclose(solved.solution.T.ravel(), expected[:size], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(solved.offsets, expected[size:], rtol=1e-7, atol=1e-12)
    covariance = np.linalg.inv(matrix)
    found = np.linalg.inv(solved.factor @ solved.factor.T)
    np.testing.assert_allclose(found, covariance[:size, :size], rtol=1e-6, atol=1e-9)
    told = 1.0 - np.diag(covariance) * precisions
    assert solved.determined.sum() == pytest.approx(told[:size][has_stiffness[:size]].sum())
    assert solved.offset_determined == pytest.approx(told[size:][has_stiffness[size:]].sum(), abs=1e-6)


def test_the_residuals_are_what_motion_and_offset_leave(equations):
    prior = prior_of(equations, 15, 2)
    motion = equations.solve(prior, SIGMA, True, lambda: None)
    rows, *_ = joint(equations, prior)
    unknowns = np.concatenate([motion.solved.solution.T.ravel(), motion.solved.offsets])
    np.testing.assert_allclose(motion.residuals(), equations.distances - SCALE * rows @ unknowns, atol=1e-10)


def test_the_evidence_ranks_stiffnesses_as_the_density_of_the_data_does(equations):
    def density(prior):
        rows, precisions, _ = joint(equations, prior)
        covariance = rows @ (rows / (precisions / VARIANCE)).T + np.diag(VARIANCE / equations.weights)
        distances = equations.distances / SCALE
        return -0.5 * (distances @ np.linalg.solve(covariance, distances) + np.linalg.slogdet(covariance)[1])

    base = prior_of(equations, 15, 2)
    sums = equations.summed(base, lambda: None)
    others = [
        replace(base, alphas=np.array([alpha, second]), offset_alpha=offset)
        for alpha in (50.0, 9e4)
        for second in (300.0, 1e6)
        for offset in (1e3, 1e7)
    ]
    evidences = np.array([sums.solve(prior, SIGMA).evidence for prior in others])
    np.testing.assert_allclose(np.diff(evidences), np.diff([density(prior) for prior in others]), atol=2e-3)


def test_the_most_evident_stiffnesses_are_where_the_evidence_is_largest(equations):
    prior = prior_of(equations, 15, 2)
    sums = equations.summed(prior, lambda: None)
    for _ in range(300):
        solved = sums.solve(prior, SIGMA)
        prior = solved.more_evident(False)
    others = [replace(prior, alphas=prior.alphas * each) for each in ((0.7, 1.0), (1.4, 1.0), (1.0, 0.7), (1.0, 1.4))]
    others.append(replace(prior, offset_alpha=1.4 * prior.offset_alpha))
    assert all(sums.solve(other, SIGMA).evidence < solved.evidence for other in others)
    assert SCALE / np.sqrt(prior.offset_alpha) == pytest.approx(2e-3 * SCALE)  # as large as an offset may be
