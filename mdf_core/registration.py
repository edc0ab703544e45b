"""Coherent point drift, plain (CPD) and area-weighted (MDF): the paper's registration of a scan to design points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from mdf_core.data_cells import gather
from mdf_core.deformation import Deformation
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.kernel import KernelBasis, low_rank_basis
from mdf_core.mixture import Expectation, area_weights, box_density, expect, initial_variance
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.settings import MixtureSettings

_LARGEST_DENSE = 2000  # points; beyond it the O(m³) solve outlasts the E-step
_AUTOMATIC_RANK = 150
_LEAST_SIGMA = 1e-4  # of the scale; exact data would drive σ to 0


@dataclass(frozen=True, eq=False)
class MixtureRegistration:
    """Result of `register_mixture`.

    Attributes
    ----------
    deformation : Deformation
        Scan to design; `start` and `datum` are the identity.
    sigma : float, mm
        Standard deviation σ of the mixture (of a component of mean area).
    iterations : int
    converged : bool
        The last iteration moved no point farther, and changed σ by no more, than the tolerance.
    stop_reason : str
        converged | sigma_floor (converged, with σ held at its least value: the data match exactly) | max_iterations
    motion : float, mm
        How far the last iteration moved the point that moved most.
    """

    deformation: Deformation
    sigma: float
    iterations: int
    converged: bool
    stop_reason: str
    motion: float


def register_mixture(
    scan: PointSet,
    target: Array,
    settings: MixtureSettings,
    area_weighted: bool,
    scale: float,
    progress: ProgressCallback,
) -> MixtureRegistration:
    """Move the scan points coherently until their mixture explains the design points.

    Parameters
    ----------
    scan : PointSet
        Posed, (m, D) with D = 2 or 3; `areas` are needed when `area_weighted`.
    target : (N, D) float64, mm
        Design points.
    settings : MixtureSettings
    area_weighted : bool
        True: MDF, every point counts by its area. False: CPD, all points count alike.
    scale : float, mm
        s, the length unit of β, α and the tolerance; one for both clouds, because separate ones would hide shrinkage.
    progress : callable
        Called after every iteration, with the share of `max_iterations` done.

    Raises
    ------
    RegistrationFailedError
        Missing or useless areas, unusable target or scale, no design point explained, or a prior too weak to solve.

    Notes
    -----
    Stops on the motion of the point that moves most: on |Δσ²| alone, the usual test of CPD programs, runs end long
    before the points rest. σ must rest as well, because the motion passes through small values while σ still anneals.

    Cost per iteration O(m · N) for the E-step plus O(m³) dense or O(m · rank²) low rank; memory O(m²) or O(m · rank).
    Source: paper section 3.3 and table 2, as corrected in the documentation.
    """
    _check(scan, target, area_weighted, scale)
    points = scan.points
    origin = target.mean(axis=0)
    # Everything below is centred and in units of the scale.
    start, data = (points - origin) / scale, (target - origin) / scale
    weights = area_weights(scan.areas) if area_weighted and scan.areas is not None else np.ones(len(points))
    rank = settings.rank or (0 if len(points) <= _LARGEST_DENSE else _AUTOMATIC_RANK)
    width = settings.beta * scale
    basis = low_rank_basis(points, width, rank) if rank else KernelBasis(points, width, None)
    values = basis(points)  # Φ; dense: G
    density = box_density(data)

    cells = gather(data, 0.0)
    moved = start
    sigma = max(float(np.sqrt(initial_variance(start, data))), _LEAST_SIGMA)
    iteration, converged = 0, False
    while iteration < settings.max_iterations and not converged:
        iteration += 1
        expectation = expect(moved, cells, weights, sigma**2, settings.outlier_share, density)
        penalty = settings.alpha * sigma**2
        coefficients = _solve(values, expectation, start, penalty, dense=not rank)
        last_sigma, last_moved = sigma, moved
        moved = start + values @ coefficients
        sigma = max(float(np.sqrt(expectation.variance(moved))), _LEAST_SIGMA)
        motion = float(np.sqrt(((moved - last_moved) ** 2).sum(axis=1).max()))
        converged = max(motion, abs(sigma - last_sigma)) <= settings.tolerance
        progress(Progress("mixture", iteration / settings.max_iterations, iteration, sigma * scale))

    dimension = points.shape[1]
    deformation = Deformation(
        start=np.eye(dimension + 1),
        datum=np.eye(dimension + 1),
        basis=basis,
        coefficients=scale * coefficients,
        affine=np.zeros((dimension + 1, dimension)),
        origin=origin,
        scale=scale,
        covariance=_covariance(values, expectation.mass, penalty, last_sigma * scale, dimension) if rank else None,
    )
    stop_reason = "max_iterations"
    if converged:
        stop_reason = "sigma_floor" if sigma <= _LEAST_SIGMA else "converged"
    return MixtureRegistration(deformation, sigma * scale, iteration, converged, stop_reason, motion * scale)


def _check(scan: PointSet, target: Array, area_weighted: bool, scale: float) -> None:
    if area_weighted and scan.areas is None:
        raise RegistrationFailedError(
            "the points have no areas", "scan", "give every point the area it stands for, or use method cpd"
        )
    if not (scale > 0 and np.isfinite(scale)):
        raise RegistrationFailedError(f"a scale of {scale:g} mm", "design", "give a design that has an extent")
    if len(target) == 0 or target.shape[1] != scan.points.shape[1] or not np.isfinite(target).all():
        raise RegistrationFailedError(
            f"target points of shape {target.shape} cannot attract scan points of shape {scan.points.shape}",
            "design",
            "give finite target points, at least one, of the scan's dimension",
        )


def _solve(values: Array, expectation: Expectation, start: Array, penalty: float, dense: bool) -> Array:
    """The M-step: C (r, D) of the motion Φ C that minimises Σ_j d_j |mean_j - y_j - (Φ C)_j|² + ασ² |motion|²_G.

    Source: low rank ``[Φᵀ d(P~1) Φ + ασ² I] C = Φᵀ (P~X - d(P~1) y)``, dense ``[d(P~1) G + ασ² I] V = P~X - d(P~1) y``.
    """
    pull = expectation.mean - start
    if not dense:
        weighted = values * expectation.mass[:, None]
        return _solve_symmetric(weighted.T @ values, penalty, weighted.T @ pull)
    # With S = d(P~1)^½ and V = S Z the system is symmetric: [S G S + ασ² I] Z = S (mean - y).
    root = np.sqrt(expectation.mass)[:, None]
    return root * _solve_symmetric(root * values * root.T, penalty, root * pull)


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


def _covariance(values: Array, mass: Array, penalty: float, sigma: float, dimension: int) -> Array:
    """Posterior covariance σ² [Φᵀ d(P~1) Φ + ασ² I]⁻¹ of (C, A), summed over the axes; A is fixed at zero."""
    rank = values.shape[1]
    covariance = np.zeros((rank + dimension + 1, rank + dimension + 1))
    gram = (values * mass[:, None]).T @ values
    covariance[:rank, :rank] = dimension * sigma**2 * _solve_symmetric(gram, penalty, np.eye(rank))
    return covariance
