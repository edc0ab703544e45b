"""Expectation-maximisation of the coherent mixture: exact steps, coarse while σ is wide, leaping once σ rests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from mdf_core.data_cells import DataCells, gather
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array
from mdf_core.mixture import Expectation, expect, initial_variance

LEAST_SIGMA = 1e-4
"""Of the scale; exact data would drive σ to 0."""

_MOST_EXACT_PAIRS = 5_000_000  # of centroid and data point; with fewer, cells would save next to nothing
_CELL = 0.5  # width of new cells over σ
_COARSEST = 0.7  # the same where they are too coarse
_COARSE_TOLERANCE = 1e-3  # change in a step; cells are no use for less
_WORTH_CELLS = 0.7  # cells per data point; with more, every point may as well be its own
_RESTING = 0.01  # change of log σ in a step; before, the path counts that EM takes and not only its end
_LONGEST_LEAP = 100.0  # steps


@dataclass(frozen=True, eq=False)
class Model:
    """What is registered, centred and in units of the scale.

    Attributes
    ----------
    start : (m, D) float64
        Scan points y.
    data : (N, D) float64
        Design points X.
    weights : (m,) float64
        Relative areas, positive, mean 1.
    values : (m, r) float64
        Φ at the scan points; G if `dense`.
    dense : bool
    alpha : float
        Weight of the motion prior.
    outlier_share, outlier_density : float
    """

    start: Array
    data: Array
    weights: Array
    values: Array
    dense: bool
    alpha: float
    outlier_share: float
    outlier_density: float


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns, in units of the scale: C (V if dense), (r, D), and σ."""

    coefficients: Array
    sigma: float


@dataclass(frozen=True, eq=False)
class Step:
    """One iteration of EM.

    Attributes
    ----------
    before, after : State
    objective : float
        Negative logarithm of likelihood times prior at `before`.
    gain : float
        What the step takes off the upper bound of the objective that EM minimises.
    motion : float
        Of the point that moved most.
    mass : (m,) float64
        P~1.
    is_exact : bool
        No data points shared their responsibilities.
    """

    before: State
    after: State
    objective: float
    gain: float
    motion: float
    mass: Array
    is_exact: bool

    @property
    def change(self) -> float:
        """The larger of the motion and the change of σ."""
        return max(self.motion, abs(self.after.sigma - self.before.sigma))


def em_steps(model: Model) -> Iterator[Step]:
    """The steps of EM from no motion on, without end; `after` of each is the best state so far.

    Notes
    -----
    Three things make it fast:

    - Each block of data looks only at the centroids within its reach, see `expect`.
    - In large problems, data points in one grid cell of about half of σ share their responsibilities. EM then
      improves a lower bound of the likelihood. Cells are made anew as σ falls; once most hold one point, or little
      changes any more, every point counts for itself and the steps are exact.
    - Where σ rests, every second step starts not where EM got to but where its last two steps point. A start that is
      no better than where EM got to is taken back, so that the objective never rises (but where cells are made anew).

    Source: Verbeek, Nunnink & Vlassis 2006 for the cells; Varadhan & Roland 2008, SQUAREM, third scheme.
    """
    sigma = max(float(np.sqrt(initial_variance(model.start, model.data))), LEAST_SIGMA)
    cells = _cells(model, sigma)
    step = _em_step(model, cells, State(np.zeros((model.values.shape[1], model.start.shape[1])), sigma))
    path: list[State] = []  # of EM alone, through the same cells
    while True:
        yield step
        state, rests = step.after, step.change <= _COARSE_TOLERANCE
        path = [*path, step.before] if abs(np.log(state.sigma / step.before.sigma)) <= _RESTING else []
        if not step.is_exact and (rests or cells.width > _COARSEST * state.sigma):
            cells = gather(model.data, 0.0) if rests else _cells(model, state.sigma)
            path = []
        elif len(path) == 2:
            trial = _leap(model, cells, path[0], path[1], state)
            path = []
            if trial is not None:
                # Where the objective is convex, EM alone gains at most twice what its bound promises.
                if trial.objective <= step.objective - 2.0 * step.gain:
                    step = trial
                    continue
                yield step  # the attempt took the time of a step
        step = _em_step(model, cells, state)


def covariance(model: Model, step: Step) -> Array | None:
    """Posterior covariance σ² [Φᵀ d(P~1) Φ + ασ² I]⁻¹ of C, (r, r), of each axis; None for a dense kernel.

    Source: the normal equations of the M-step.
    """
    if model.dense:
        return None
    rank = len(step.after.coefficients)
    gram = (model.values * step.mass[:, None]).T @ model.values
    variance = step.before.sigma**2
    inverse: Array = _solve_symmetric(gram, model.alpha * variance, np.eye(rank))
    inverse *= variance
    return inverse


def _cells(model: Model, sigma: float) -> DataCells:
    """The data in cells for that σ, or point by point where cells would save little."""
    if len(model.start) * len(model.data) > _MOST_EXACT_PAIRS:
        cells = gather(model.data, _CELL * sigma)
        if len(cells.counts) < _WORTH_CELLS * len(model.data):
            return cells
    return gather(model.data, 0.0)


def _em_step(model: Model, cells: DataCells, state: State) -> Step:
    motion = model.values @ state.coefficients
    moved = model.start + motion
    expectation = expect(moved, cells, model.weights, state.sigma**2, model.outlier_share, model.outlier_density)
    coefficients = _solve(model, expectation, model.alpha * state.sigma**2)
    new_motion = model.values @ coefficients
    variance = expectation.variance(model.start + new_motion)
    after = State(coefficients, max(float(np.sqrt(variance)), LEAST_SIGMA))
    degrees: float = model.start.shape[1] * expectation.explained

    def prior(coefficients: Array, motion: Array) -> float:
        return 0.5 * model.alpha * float((coefficients * (motion if model.dense else coefficients)).sum())

    def bound(variance: float, sigma: float) -> float:
        return 0.5 * degrees * (variance / sigma**2 + 2.0 * math.log(sigma))

    prior_before = prior(state.coefficients, motion)
    return Step(
        before=state,
        after=after,
        objective=prior_before - expectation.log_likelihood,
        gain=prior_before
        - prior(coefficients, new_motion)
        + bound(expectation.variance(moved), state.sigma)
        - bound(variance, after.sigma),
        motion=float(np.sqrt(((new_motion - motion) ** 2).sum(axis=1).max())),
        mass=expectation.mass,
        is_exact=cells.width == 0,
    )


def _leap(model: Model, cells: DataCells, first: State, second: State, third: State) -> Step | None:
    """The step from where three successive states point to; None where that is not ahead or not explained at all.

    Source: Varadhan & Roland 2008, SQUAREM with step length |r| / |v| in points and log σ.
    """
    coefficients = np.stack([state.coefficients for state in (first, second, third)])
    log_sigmas = np.log([state.sigma for state in (first, second, third)])

    def length(weights: Array) -> float:
        motion = model.values @ np.tensordot(weights, coefficients, 1)
        return math.hypot(float(np.linalg.norm(motion)), float(weights @ log_sigmas))

    speed, turn = length(np.array([-1.0, 1.0, 0.0])), length(np.array([1.0, -2.0, 1.0]))
    if speed <= turn:
        return None
    ahead = min(speed / turn, _LONGEST_LEAP) if turn > 0 else _LONGEST_LEAP
    weights = np.array([(1.0 - ahead) ** 2, 2.0 * ahead * (1.0 - ahead), ahead**2])
    sigma = max(float(np.exp(weights @ log_sigmas)), LEAST_SIGMA)
    try:
        return _em_step(model, cells, State(np.tensordot(weights, coefficients, 1), sigma))
    except RegistrationFailedError:
        return None


def _solve(model: Model, expectation: Expectation, penalty: float) -> Array:
    """The M-step: C (r, D) of the motion Φ C that minimises Σ_j d_j |mean_j - y_j - (Φ C)_j|² + ασ² |motion|²_G.

    Source: low rank ``[Φᵀ d(P~1) Φ + ασ² I] C = Φᵀ (P~X - d(P~1) y)``, dense ``[d(P~1) G + ασ² I] V = P~X - d(P~1) y``.
    """
    pull = expectation.mean - model.start
    if not model.dense:
        weighted = model.values * expectation.mass[:, None]
        return _solve_symmetric(weighted.T @ model.values, penalty, weighted.T @ pull)
    # With S = d(P~1)^½ and V = S Z the system is symmetric: [S G S + ασ² I] Z = S (mean - y).
    root = np.sqrt(expectation.mass)[:, None]
    return root * _solve_symmetric(root * model.values * root.T, penalty, root * pull)


def _solve_symmetric(matrix: Array, penalty: float, right: Array) -> Array:
    """Solve (matrix + penalty I) X = right for a positive semidefinite matrix, which is overwritten."""
    matrix[np.diag_indices_from(matrix)] += penalty
    try:
        solution: Array = cho_solve(cho_factor(matrix, lower=True, overwrite_a=True), right)
    except LinAlgError:
        raise RegistrationFailedError(
            "the motion is not determined", "mixture", "raise mixture.alpha, the weight of the motion prior"
        ) from None
    return solution
