"""Coherent point drift, plain (CPD) and area-weighted (MDF): the paper's registration of a scan to design points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from mdf_core.deformation import Deformation
from mdf_core.em import LEAST_SIGMA, Model, covariance, em_steps
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.kernel import KernelBasis, low_rank_basis
from mdf_core.mixture import area_weights, box_density
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.settings import MixtureSettings

AUTOMATIC_RANK = 150
"""Of the kernel where none is set and it is not dense."""

LARGEST_DENSE = 2_000
"""Points; beyond it the O(m³) solve would take nearly all of the time."""

_WIDEST_SIGMA = 1.0  # of the scale; clouds of one size that lie on each other begin with less
_FARTHEST = 1e9  # of the scale; beyond it rounding reaches the least σ


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
        Missing or useless areas, unusable target or scale, clouds too far apart, no design point explained, no match
        found, or a prior too weak to solve.

    Notes
    -----
    Stops on the motion of the point that moves most: on |Δσ²| alone, the usual test of CPD programs, runs end long
    before the points rest. σ must rest as well, because the motion passes through small values while σ still anneals.

    The kernel has the rank that is set. Where none is set, 150 functions mostly span it to rounding; where they do
    not, it is dense up to 2000 points and of rank 150 beyond.

    The linear algebra runs on one thread, so that the result does not depend on their number. Cost per iteration that
    of `expect` and O(m · rank²), dense O(m³); memory O(N + m · rank), dense O(m²). What saves time: see `em_steps`.

    Source: paper section 3.3 and table 2, as corrected in the documentation.
    """
    _check(scan, target, area_weighted, scale)
    with threadpool_limits(limits=1, user_api="blas"):
        return _register(scan, target, settings, area_weighted, scale, progress)


def _register(
    scan: PointSet,
    target: Array,
    settings: MixtureSettings,
    area_weighted: bool,
    scale: float,
    progress: ProgressCallback,
) -> MixtureRegistration:
    points, origin = scan.points, target.mean(axis=0)
    data = (target - origin) / scale
    basis = _basis(points, settings.beta * scale, settings.rank)
    model = Model(
        start=(points - origin) / scale,
        data=data,
        weights=area_weights(scan.areas) if area_weighted and scan.areas is not None else np.ones(len(points)),
        values=basis(points),
        dense=basis.transform is None,
        alpha=settings.alpha,
        outlier_share=settings.outlier_share,
        outlier_density=box_density(data),
    )
    for iteration, step in enumerate(em_steps(model), 1):
        progress(Progress("mixture", iteration / settings.max_iterations, iteration, step.after.sigma * scale))
        converged = step.is_exact and step.change <= settings.tolerance
        if converged or iteration == settings.max_iterations:
            break

    if converged and step.after.sigma > _WIDEST_SIGMA:
        raise RegistrationFailedError(
            f"the mixture has settled on no match: its σ is {step.after.sigma:.3g} times the RMS radius of the design",
            "mixture",
            "check the units and the pose of the scan, and keep mixture.outlier_share above 0",
        )
    stop_reason = "max_iterations"
    if converged:
        stop_reason = "sigma_floor" if step.after.sigma <= LEAST_SIGMA else "converged"
    deformation = _deformation(basis, step.after.coefficients, covariance(model, step), origin, scale)
    return MixtureRegistration(
        deformation, step.after.sigma * scale, iteration, converged, stop_reason, step.motion * scale
    )


def _basis(points: Array, width: float, rank: int) -> KernelBasis:
    basis = low_rank_basis(points, width, rank or AUTOMATIC_RANK)
    spans_kernel = len(basis.centres) < AUTOMATIC_RANK
    if rank or spans_kernel or len(points) > LARGEST_DENSE:
        return basis
    return KernelBasis(points, width, None)


def _deformation(
    basis: KernelBasis, coefficients: Array, of_axis: Array | None, origin: Array, scale: float
) -> Deformation:
    """The motion in mm, without an affine part; coefficients, and their covariance per axis, in units of the scale."""
    dimension = coefficients.shape[1]
    covariance: Array | None = None
    if of_axis is not None:  # the affine part is certain
        covariance = np.asarray(np.kron(np.eye(dimension), np.pad(scale**2 * of_axis, (0, dimension + 1))))
    return Deformation(
        start=np.eye(dimension + 1),
        datum=np.eye(dimension + 1),
        basis=basis,
        coefficients=scale * coefficients,
        affine=np.zeros((dimension + 1, dimension)),
        origin=origin,
        scale=scale,
        covariance=covariance,
    )


def _check(scan: PointSet, target: Array, area_weighted: bool, scale: float) -> None:
    if area_weighted and scan.areas is None:
        raise RegistrationFailedError(
            "the points have no areas", "scan", "give every point the area it stands for, or use method cpd"
        )
    if not 1e-100 < scale < 1e100:  # so that squares are finite
        raise RegistrationFailedError(f"a scale of {scale:g} mm", "design", "give a design that has an extent")
    if len(target) == 0 or target.shape[1] != scan.points.shape[1] or not np.isfinite(target).all():
        raise RegistrationFailedError(
            f"target points of shape {target.shape} cannot attract scan points of shape {scan.points.shape}",
            "design",
            "give finite target points, at least one, of the scan's dimension",
        )
    origin = target.mean(axis=0)
    farthest = max(np.abs(target - origin).max(), np.abs(scan.points - origin).max())
    if not farthest <= _FARTHEST * scale:
        raise RegistrationFailedError(
            f"points {farthest:.3g} mm from the middle of a design with an RMS radius of {scale:.3g} mm",
            "scan",
            "check the units and the pose of the scan, and remove stray points",
        )
