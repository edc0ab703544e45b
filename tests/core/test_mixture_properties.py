"""What holds for the mixture and its kernel, whatever the points: tried on many, the same ones every time."""

from unittest.mock import patch

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from property_samples import clouds, seeds, tried

from mdf_core import mixture
from mdf_core.data_cells import gather
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import PointSet
from mdf_core.kernel import gaussian_kernel, low_rank_basis
from mdf_core.mixture import area_weights, box_density, expect
from mdf_core.progress import silent
from mdf_core.registration import register_mixture
from mdf_core.settings import MixtureSettings

# --- point sets of every kind ----------------------------------------------------------------------------------------


@st.composite
def mixtures(draw, least=1, most=40, offset=0.3):
    """A scan with areas, a target near to it, and their scale."""
    points = draw(clouds(least=least, most=most))
    rng = np.random.default_rng(draw(seeds))
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    scale = spread if spread > 1e-9 * np.abs(points).max() else 1.0
    target = points[rng.integers(0, len(points), draw(st.integers(1, most)))]
    target = target + draw(st.sampled_from([0.0, offset])) * scale * rng.normal(size=target.shape)
    areas = rng.uniform(0.0, 1.0, len(points)) ** draw(st.sampled_from([0.0, 1.0, 20.0]))
    return PointSet(points, areas=areas), target, scale


def log_responsibilities(moved, target, weights, variance):
    """log of p_jn without its denominator, (m, N), pair by pair."""
    squared = ((target[None] - moved[:, None]) ** 2).sum(axis=2)
    return (1.0 - 0.5 * moved.shape[1]) * np.log(weights)[:, None] - squared / (2.0 * weights[:, None] * variance)


@tried(60)
@given(
    problem=mixtures(),
    sigma=st.sampled_from([1e-4, 1e-2, 1.0, 30.0]),
    share=st.sampled_from([0.0, 1e-3, 0.3]),
    chunk=st.integers(1, 2_000),
)
def test_every_design_point_is_shared_out_whole_and_pulls_towards_itself(problem, sigma, share, chunk):
    scan, target, scale = problem
    weights, density = area_weights(scan.areas), box_density(target / scale)
    moved, data = (cloud / scale for cloud in (scan.points, target))
    try:
        result = expect(moved, gather(data, 0.0), weights, sigma**2, share, density)
    except RegistrationFailedError as refused:
        assert share > 0 and "mixture.outlier_share" in refused.remedy
        return
    # Of every design point, the share that is no outlier.
    logs = log_responsibilities(moved, data, weights, sigma**2)
    largest = logs.max(axis=0)
    constant = share / (1.0 - share) * (2.0 * np.pi * sigma**2) ** (0.5 * moved.shape[1]) * len(moved) * density
    shares = np.exp(logs - largest).sum(axis=0)
    with np.errstate(over="ignore"):
        shares /= shares + (constant * np.exp(-largest) if share else 0.0)
    np.testing.assert_allclose(result.explained, shares.sum(), rtol=1e-6)
    np.testing.assert_allclose((weights * result.mass).sum(), result.explained, rtol=1e-9)
    if share == 0.0:
        np.testing.assert_allclose(result.explained, len(data), rtol=1e-9)
    drawn = result.mass > 1e-9
    slack = 1e-9 * max(1.0, np.abs(data).max())
    assert (result.mean[drawn] >= data.min(axis=0) - slack).all()
    assert (result.mean[drawn] <= data.max(axis=0) + slack).all()
    assert 0.0 <= result.variance(moved) < np.inf
    with patch.object(mixture, "_CHUNK_BYTES", chunk):
        blocks = expect(moved, gather(data, 0.0), weights, sigma**2, share, density)
    for name in ("mass", "mean", "explained"):
        np.testing.assert_allclose(getattr(blocks, name), getattr(result, name), rtol=1e-7, atol=slack)


@tried(40)
@given(
    problem=mixtures(),
    share=st.sampled_from([0.0, 0.1]),
    rank=st.sampled_from([0, 5]),
    beta=st.sampled_from([0.1, 3.0]),
    alpha=st.sampled_from([0.01, 2.0]),
    area_weighted=st.booleans(),
)
def test_sigma_stays_positive_and_every_point_finite(problem, share, rank, beta, alpha, area_weighted):
    scan, target, scale = problem
    told = []
    settings = MixtureSettings(
        beta=beta, alpha=alpha, outlier_share=share, rank=rank, max_iterations=40, tolerance=1e-6
    )
    try:
        result = register_mixture(scan, target, settings, area_weighted, scale, told.append)
    except RegistrationFailedError as refused:
        assert "mixture." in refused.remedy
        return
    assert all(step.sigma_mm >= 0.999e-4 * scale for step in told)
    assert np.isfinite([step.sigma_mm for step in told]).all()
    assert np.isfinite(result.deformation.apply(scan.points)).all()


@tried(20)
@given(
    problem=mixtures(least=3),
    share=st.sampled_from([0.0, 0.1]),
    beta=st.sampled_from([0.5, 3.0]),
    area_weighted=st.booleans(),
)
def test_all_centres_of_the_low_rank_are_as_good_as_the_dense_solve(problem, share, beta, area_weighted):
    scan, target, scale = problem
    registered = [
        register_mixture(
            scan,
            target,
            MixtureSettings(beta=beta, outlier_share=share, rank=rank, max_iterations=15),
            area_weighted,
            scale,
            silent,
        )
        for rank in (0, len(scan))
    ]
    dense, low = (one.deformation.apply(scan.points) for one in registered)
    np.testing.assert_allclose(low, dense, rtol=0.0, atol=1e-5 * scale)


# --- the kernel ------------------------------------------------------------------------------------------------------


@tried(40)
@given(points=clouds(), width=st.sampled_from([0.3, 1.0, 5.0]), rank=st.integers(1, 50))
def test_the_low_rank_misses_only_what_is_left_on_the_diagonal(points, width, rank):
    width *= np.ptp(points) or 1.0
    tolerance = 1e-6
    basis = low_rank_basis(points, width, rank, tolerance)
    kernel, values = gaussian_kernel(points, points, width), basis(points)
    remainder = kernel - values @ values.T
    # What is left is a covariance too: no entry exceeds the diagonal, and none of it is negative.
    assert remainder.diagonal().min() > -1e-9
    assert np.linalg.eigvalsh(remainder).min() > -1e-8
    assert np.abs(remainder).max() <= remainder.diagonal().max() + 1e-9
    assert len(basis.centres) <= min(rank, len(points))
    if len(basis.centres) < min(rank, len(points)):
        assert remainder.diagonal().max() <= tolerance + 1e-9
    at_centres = basis(basis.centres)
    np.testing.assert_allclose(at_centres @ values.T, gaussian_kernel(basis.centres, points, width), atol=1e-6)
    # Distinct points that were there before.
    assert len(np.unique(basis.centres, axis=0)) == len(basis.centres)
    assert {*map(tuple, basis.centres)} <= {*map(tuple, points)}
