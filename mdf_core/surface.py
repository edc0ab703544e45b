"""The surface stage: registration of the posed scan to the design's triangles, point to plane.

A point-to-point mixture has nothing that holds points in place along a smooth face; measuring along the normal only
and letting the motion prior carry the rest does. How stiff that prior is, the data say: among the kernel widths the one
with the largest evidence (marginal likelihood) wins, and its variance is the one that maximises the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dtrtri

from mdf_core.deformation import Deformation, affine_features
from mdf_core.design_surface import Closest, DesignSurface, spread_samples
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.kernel import KernelBasis, low_rank_basis
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.settings import SurfaceSettings

_TUKEY = 4.685  # 95 % efficiency for Gaussian noise
_WIDE_STEPS, _WIDE = 2, 3.0  # the first correspondences are poor: let more points in
_FIRST_ALPHA = 100.0  # stiffness before the data have said theirs
_AFFINE_RIDGE = 1e-6
_NORMAL_GATE = 0.5  # cos 60°
_SIGMA_FLOOR = 1e-7  # in units of the scale; a noise-free scan has no spread to divide by
_CENTRE_POOL = 5_000  # design points among which the centres of the kernel are chosen
_TRIAL_POINTS = 6_000  # enough to choose the kernel width
_TRIAL_TOLERANCE = 1e-4  # in units of the scale
_ALPHA_RANGE = (10.0, 1e9)  # down to a prior sd of a third of the scale; less would let the motion run away
_CHUNK = 4_096  # rows of the normal equations at a time


@dataclass(frozen=True, eq=False)
class SurfaceRegistration:
    """Result of the surface stage.

    Attributes
    ----------
    deformation : Deformation
        `start` and `datum` are the identity: the motion is that of the posed scan.
    residual_scale : float, mm
        1.4826 times the median absolute distance of the moved points to the surface.
    iterations : int
    stop_reason : str
        converged | max_steps
    beta : float
        The kernel width chosen, in units of the scale.
    alpha : float
        The stiffness chosen.
    """

    deformation: Deformation
    residual_scale: float
    iterations: int
    stop_reason: str
    beta: float
    alpha: float


def register_surface(
    scan: PointSet,
    surface: DesignSurface,
    settings: SurfaceSettings,
    start: Deformation | None,
    progress: ProgressCallback,
) -> SurfaceRegistration:
    """Register a posed scan to the design's surface.

    Parameters
    ----------
    scan : PointSet
        Posed in the design frame, with outward normals; n points in mm.
    surface : DesignSurface
    settings : SurfaceSettings
    start : Deformation or None
        Where the motion starts, such as the result of a mixture registration; None: at rest.
    progress : callable
        Called at every step; an exception it raises stops the work.

    Raises
    ------
    RegistrationFailedError
        Fewer points lie near the surface than the motion has unknowns, or the motion diverges.

    Notes
    -----
    Kernel widths are tried from stiff to soft on a part of the points, until the evidence falls; the best one is then
    fitted to all points. Cost O(n · rank²) and one query of the surface per step.
    Source: MacKay 1992, Bayesian interpolation.
    """
    steps = 0

    def counted(step: Progress) -> None:
        nonlocal steps
        steps += 1
        most = settings.max_steps * (len(settings.beta) + 1)
        progress(replace(step, iteration=steps, fraction=min(steps / most, 1.0)))

    trial = scan.take(np.arange(0, len(scan), max(1, len(scan) // _TRIAL_POINTS)))
    moved = trial.points if start is None else start.apply(trial.points)
    tolerance = max(_TRIAL_TOLERANCE, settings.tolerance)
    fits: list[SurfaceFit] = []
    for beta in settings.beta:
        wide = start is None and not fits
        fit = fit_surface(trial, surface, settings, beta, moved=moved, tolerance=tolerance, wide=wide, progress=counted)
        fits.append(fit)
        moved = fit.moved
        sigma = min(fit.sigma for fit in fits)
        if len(fits) > 1 and fits[-1].evidence(sigma) < fits[-2].evidence(sigma):
            break
    best = max(fits, key=lambda fit: fit.evidence(sigma))
    final = fit_surface(
        scan,
        surface,
        settings,
        best.beta,
        alpha=best.alpha,
        moved=best.deformation().apply(scan.points),
        tolerance=settings.tolerance,
        progress=counted,
    )
    return SurfaceRegistration(final.deformation(), final.sigma, steps, final.stop_reason, final.beta, final.alpha)


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A scan fitted to the surface at one kernel width."""

    basis: KernelBasis
    origin: Array
    scale: float
    beta: float
    alpha: float
    solution: Array  # (r + 4, 3): C and A
    factor: tuple[Array, bool]  # Cholesky factor of the normal equations, (3 (r + 4))²
    moved: Array
    closest: Closest  # of the moved points
    facing: NDArray[np.bool_]
    sigma: float
    stop_reason: str

    def deformation(self) -> Deformation:
        """The motion with its posterior covariance."""
        size, rank, identity = len(self.solution), len(self.basis.centres), np.eye(4)
        posterior = self.sigma**2 * cho_solve(self.factor, np.eye(3 * size)).reshape(3, size, 3, size)
        coefficients, affine = self.solution[:rank], self.solution[rank:]
        covariance = np.einsum("iaib->ab", posterior)
        return Deformation(identity, identity, self.basis, coefficients, affine, self.origin, self.scale, covariance)

    def evidence(self, sigma: float) -> float:
        """Log marginal likelihood up to a constant, for residuals of standard deviation `sigma` in mm.

        No point costs more than an outlier would by Tukey's loss; comparable between fits of the same points.
        """
        relative = np.minimum(np.abs(self.closest.distances) / (_TUKEY * sigma), 1.0)
        relative[~self.facing] = 1.0
        loss = _TUKEY**2 / 6.0 * (1.0 - (1.0 - relative**2) ** 3).sum()
        rank = len(self.basis.centres)
        prior = 0.5 * self.alpha * (self.solution[:rank] ** 2).sum() / self.scale**2
        log_determinant = 2.0 * np.log(np.diag(self.factor[0])).sum()
        log_prior = 3 * rank * np.log(self.alpha * (self.sigma / self.scale) ** 2)
        return -float(loss + prior + 0.5 * (log_determinant - log_prior))


def fit_surface(
    scan: PointSet,
    surface: DesignSurface,
    settings: SurfaceSettings,
    beta: float,
    *,
    moved: Array,
    tolerance: float,
    progress: ProgressCallback,
    alpha: float = _FIRST_ALPHA,
    wide: bool = False,
) -> SurfaceFit:
    """Gauss-Newton at one kernel width, with the prior's variance from the data unless it is set.

    Parameters
    ----------
    scan, surface, settings, progress
        See `register_surface`.
    beta : float
        Kernel width in units of the scale.
    moved : (n, 3) float64, mm
        Where the scan points are taken to be on the design to begin with.
    tolerance : float
        RMS motion in one step below which the fit has converged, in units of the scale.
    alpha : float
        Stiffness to begin with.
    wide : bool
        The start is rough: the first steps let in points from farther away.
    """
    assert scan.normals is not None, "the scan is prepared: it has normals"
    origin, scale = surface.design.centre, surface.design.scale
    alpha = settings.alpha or alpha
    # Centres on the design, not on the scan: an outlier with a centre of its own could be moved anywhere for nothing.
    centres, _ = spread_samples(surface.design, _CENTRE_POOL)
    basis = low_rank_basis(centres, beta * scale, min(settings.rank, len(scan) // 4), tolerance=1e-7)
    features = _features(basis, scan.points, origin, scale)
    denoised = False
    stop_reason = "max_steps"
    for step in range(1, settings.max_steps + 1):
        closest = surface.closest(moved, scan.normals)
        facing, sigma = _residuals(closest, scan.normals, features.shape[1])
        tolerant = _WIDE if wide and step <= _WIDE_STEPS else 1.0
        relative = np.abs(closest.distances) / (tolerant * _TUKEY * sigma)
        weights = np.where(facing & (relative < 1.0), (1.0 - relative**2) ** 2, 0.0)
        if tolerant == 1.0 and not denoised:
            # The motion is looked up where the point would be without its noise. Looked up at the noisy place, a motion
            # that shrinks along the normal would shrink the noise as well, and the evidence would fall for it: until
            # then the stiffness is not the data's to choose.
            quiet = scan.points - np.where(weights > 0, closest.distances, 0.0)[:, None] * closest.normals
            features, denoised = _features(basis, quiet, origin, scale), True
        # In units of the scale the solution's prior variance is 1 / alpha.
        matrix, right = _normal_equations(features, closest, scan.points, weights)
        solution, factor, alpha = _solve(
            matrix, right / scale, len(basis.centres), sigma / scale, alpha, fixed=settings.alpha > 0 or not denoised
        )
        solution *= scale
        previous, moved = moved, scan.points + features @ solution
        motion = float(np.sqrt(((moved - previous) ** 2).sum(axis=1).mean()))
        progress(Progress("surface", 0.0, step, sigma))
        if not motion < 10.0 * scale:
            raise RegistrationFailedError(
                "the motion diverges", "surface stage", "check the pose, or register with a larger surface.alpha"
            )
        if tolerant == 1.0 and motion < tolerance * scale:
            stop_reason = "converged"
            break
    closest = surface.closest(moved, scan.normals)
    facing, sigma = _residuals(closest, scan.normals, features.shape[1])
    return SurfaceFit(basis, origin, scale, beta, alpha, solution, factor, moved, closest, facing, sigma, stop_reason)


def _features(basis: KernelBasis, points: Array, origin: Array, scale: float) -> Array:
    return np.hstack([basis(points), affine_features(points, origin, scale)])


def _residuals(closest: Closest, normals: Array, unknowns: int) -> tuple[NDArray[np.bool_], float]:
    """Which points face the surface they are nearest to, and the robust standard deviation of those in mm."""
    facing = np.einsum("ij,ij->i", closest.normals, normals) > _NORMAL_GATE
    if facing.sum() < unknowns:
        raise RegistrationFailedError(
            f"only {int(facing.sum())} of {len(facing)} points face the surface nearest to them",
            "surface stage",
            "check the pose, the scan's normals, and that the scan shows this part",
        )
    sigma = 1.4826 * float(np.median(np.abs(closest.distances[facing])))
    return facing, max(sigma, _SIGMA_FLOOR * float(np.ptp(closest.points)))


def _normal_equations(features: Array, closest: Closest, points: Array, weights: Array) -> tuple[Array, Array]:
    """Matrix (3m, 3m) and right side (3m,) of the weighted distances to the tangent planes; unknowns axis by axis."""
    size = 3 * features.shape[1]
    matrix, right = np.zeros((size, size)), np.zeros(size)
    offsets = np.einsum("ij,ij->i", closest.normals, closest.points - points)
    used = np.flatnonzero(weights)
    for begin in range(0, len(used), _CHUNK):
        chunk = used[begin : begin + _CHUNK]
        roots = np.sqrt(weights[chunk])
        rows = roots[:, None, None] * closest.normals[chunk, :, None] * features[chunk, None, :]
        rows = rows.reshape(len(chunk), size)
        matrix += rows.T @ rows
        right += rows.T @ (roots * offsets[chunk])
    return matrix, right


def _solve(
    matrix: Array, right: Array, rank: int, relative_sigma: float, alpha: float, fixed: bool
) -> tuple[Array, tuple[Array, bool], float]:
    """(C, A) as (m, 3), the Cholesky factor, and alpha: moved one step towards the largest evidence unless `fixed`.

    Source: MacKay 1992, equation 4.9: alpha |C|² = number of well-determined parameters.
    """
    size = len(matrix) // 3
    is_basis = np.tile(np.arange(size) < rank, 3)

    def factorised(stiffness: float) -> Array:
        posterior = matrix.copy()
        posterior[np.diag_indices(len(matrix))] += np.where(is_basis, stiffness, _AFFINE_RIDGE)
        return cholesky(posterior, lower=True, overwrite_a=True, check_finite=False)

    factor = factorised(alpha * relative_sigma**2)
    solution = cho_solve((factor, True), right)
    if not fixed:
        inverse, _ = dtrtri(factor, lower=1)
        variances = (inverse[:, is_basis] ** 2).sum()
        determined = is_basis.sum() - alpha * relative_sigma**2 * variances
        alpha = float(np.clip(determined / (solution[is_basis] ** 2).sum(), *_ALPHA_RANGE))
        factor = factorised(alpha * relative_sigma**2)
        solution = cho_solve((factor, True), right)
    return solution.reshape(3, size).T, (factor, True), alpha
