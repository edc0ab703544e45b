"""The iterations of EM: exact, never worse, and at the same end whatever saves time on the way."""

from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdf_core import em
from mdf_core.em import Model, State, em_steps
from mdf_core.errors import RegistrationFailedError
from mdf_core.kernel import KernelBasis, gaussian_kernel, low_rank_basis
from mdf_core.mixture import area_weights, box_density

WIDTH = 1.5
VARIANTS = pytest.mark.parametrize(
    ("dimension", "outlier_share", "dense"),
    [(2, 0.0, True), (2, 0.1, False), (3, 0.0, False), (3, 0.1, True)],
)


def make_model(dimension=3, outlier_share=0.1, dense=False, count=70):
    """A bent sheet (3D) or filled patch (2D) registered to another sample of it."""
    generator = np.random.default_rng(dimension)
    points = generator.uniform(-1.0, 1.0, (2, count + 30, dimension))
    if dimension == 3:
        points[..., 2] = 0.4 * np.sin(2.0 * points[..., 0])
    start, data = points[0, :count], points[1]
    start = start + 0.1 * np.sin(2.0 * start[:, ::-1])
    basis = KernelBasis(start, WIDTH, None) if dense else low_rank_basis(start, WIDTH, count)
    weights = area_weights(generator.uniform(0.3, 3.0, count))
    return Model(start, data, weights, basis(start), dense, 1.0, outlier_share, box_density(data))


def moved_by(model, state):
    return model.start + model.values @ state.coefficients


def objective(model, state):
    """Negative log-likelihood plus the motion prior, term by term."""
    moved, variance = moved_by(model, state), state.sigma**2
    count, dimension = moved.shape
    squared = ((model.data[:, None] - moved[None]) ** 2).sum(axis=2)
    normal = model.weights / count * (2 * np.pi * model.weights * variance) ** (-dimension / 2)
    components = (normal * np.exp(-squared / (2 * model.weights * variance))).sum(axis=1)
    share = model.outlier_share
    likelihood = np.log(share * model.outlier_density + (1 - share) * components).sum()
    coefficients = state.coefficients
    kernel = gaussian_kernel(model.start, model.start, WIDTH) if model.dense else np.eye(len(coefficients))
    return model.alpha / 2 * np.trace(coefficients.T @ kernel @ coefficients) - likelihood


def end_of(model, change=1e-9, most=5000):
    """The first exact step that changes no more than that, and how many it took."""
    for count, step in enumerate(islice(em_steps(model), most), 1):
        if step.is_exact and step.change <= change:
            return step, count
    raise AssertionError("no convergence")


def never_rises(values):
    return all(after <= before + 1e-9 * abs(before) for before, after in pairwise(values))


@VARIANTS
def test_no_step_makes_the_objective_worse(dimension, outlier_share, dense):
    model = make_model(dimension, outlier_share, dense)
    steps = list(islice(em_steps(model), 60))
    values = [objective(model, step.after) for step in steps]
    assert never_rises(values)
    assert values[-1] < values[0] - 10.0
    assert any(later.before is not earlier.after for earlier, later in pairwise(steps)), "no leap was tried"


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    seed=st.integers(0, 2**31 - 1),
    dimension=st.sampled_from([2, 3]),
    counts=st.tuples(st.integers(3, 40), st.integers(3, 40)),
    contrast=st.sampled_from([1.0, 10.0, 100.0]),
    alpha=st.sampled_from([1e-3, 1.0, 1e3]),
    outlier_share=st.sampled_from([0.0, 0.01, 0.5]),
    dense=st.booleans(),
)
def test_the_objective_never_rises_whatever_the_points(seed, dimension, counts, contrast, alpha, outlier_share, dense):
    generator = np.random.default_rng(seed)
    start, data = (generator.normal(size=(count, dimension)) for count in counts)
    basis = KernelBasis(start, WIDTH, None) if dense else low_rank_basis(start, WIDTH, 10)
    weights = area_weights(contrast ** generator.uniform(-0.5, 0.5, counts[0]))
    model = Model(start, data, weights, basis(start), dense, alpha, outlier_share, box_density(data))
    states = [step.after for step in islice(em_steps(model), 40)]
    assert all(np.isfinite(state.coefficients).all() and state.sigma >= em.LEAST_SIGMA for state in states)
    assert never_rises([objective(model, state) for state in states if state.sigma > 10.0 * em.LEAST_SIGMA])


@VARIANTS
def test_a_step_knows_its_objective_and_promises_no_more_than_it_gains(dimension, outlier_share, dense):
    model = make_model(dimension, outlier_share, dense)
    for step in islice(em_steps(model), 40):
        assert step.objective == pytest.approx(objective(model, step.before), rel=1e-10)
        gained = step.objective - objective(model, step.after)
        assert -1e-9 <= step.gain <= gained + 1e-9 * abs(step.objective)


@VARIANTS
def test_sigma_is_always_positive_and_change_is_what_changed(dimension, outlier_share, dense):
    model = make_model(dimension, outlier_share, dense)
    for step in islice(em_steps(model), 30):
        assert step.after.sigma > 0
        moves = np.linalg.norm(moved_by(model, step.after) - moved_by(model, step.before), axis=1)
        assert step.motion == pytest.approx(moves.max(), rel=1e-9)
        assert step.change == max(step.motion, abs(step.after.sigma - step.before.sigma))


@VARIANTS
def test_leaps_end_where_em_ends_only_sooner(dimension, outlier_share, dense, monkeypatch):
    model = make_model(dimension, outlier_share, dense)
    leaping, short = end_of(model)
    monkeypatch.setattr(em, "_leap", lambda *_: None)
    plain, long = end_of(model)
    np.testing.assert_allclose(moved_by(model, leaping.after), moved_by(model, plain.after), rtol=0.0, atol=1e-6)
    assert leaping.after.sigma == pytest.approx(plain.after.sigma, rel=1e-6)
    assert short < 0.8 * long


@pytest.mark.parametrize("length", [1e-3, 1e6], ids=["too far", "so far that nothing is explained"])
def test_a_leap_that_overshoots_is_taken_back(length, monkeypatch):
    model = make_model()
    fails = []
    leap, expect = em._leap, em.expect

    def astray(model, cells, first, second, third):
        far = [State(third.coefficients - back * length, third.sigma) for back in (2.0, 1.0)]
        return leap(model, cells, *far, third)

    def expect_and_tell(*arguments):
        try:
            return expect(*arguments)
        except RegistrationFailedError:
            fails.append(True)
            raise

    monkeypatch.setattr(em, "_leap", lambda *_: None)
    plain, count = end_of(model)
    monkeypatch.setattr(em, "_leap", astray)
    monkeypatch.setattr(em, "expect", expect_and_tell)
    steps = list(islice(em_steps(model), 2 * count))
    assert never_rises([objective(model, step.after) for step in steps])
    np.testing.assert_allclose(moved_by(model, steps[-1].after), moved_by(model, plain.after), rtol=0.0, atol=1e-6)
    assert bool(fails) == (length > 1.0)


def test_sharing_responsibilities_on_the_way_changes_nothing_about_the_end(monkeypatch):
    model = make_model(count=150)
    exact, _ = end_of(model)
    assert next(em_steps(model)).is_exact
    monkeypatch.setattr(em, "_MOST_EXACT_PAIRS", 0)
    assert not next(em_steps(model)).is_exact
    shared, _ = end_of(model)
    np.testing.assert_allclose(moved_by(model, shared.after), moved_by(model, exact.after), rtol=0.0, atol=1e-6)
    assert shared.after.sigma == pytest.approx(exact.after.sigma, rel=1e-6)


def test_shared_responsibilities_end_even_where_sigma_stays_wide(monkeypatch):
    """Two thousand design points drawn to four centroids."""
    monkeypatch.setattr(em, "_MOST_EXACT_PAIRS", 0)
    data = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 2))
    start = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    model = Model(start, data, np.ones(4), np.eye(4), False, 1.0, 0.0, box_density(data))
    step, _ = end_of(model)
    assert step.after.sigma > 0.2
    assert step.is_exact
