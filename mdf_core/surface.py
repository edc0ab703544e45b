"""The surface stage: registration of the posed scan to the design's triangles, point to plane.

A point-to-point mixture has nothing that holds points in place along a smooth face; measuring along the normal only
and letting the motion prior carry the rest does. How stiff that prior is, the data say: among the kernel widths the one
with the largest evidence (marginal likelihood) wins, and its variance is the one that maximises the evidence.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dtrtri

from mdf_core.averages import robust_sigma
from mdf_core.deformation import Deformation, motion_features, tangential_stretches
from mdf_core.design_surface import Closest, DesignSurface, SurfaceTracker, spread_samples
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.kernel import KernelBasis, low_rank_basis
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.settings import SurfaceSettings
from mdf_core.threads import in_threads

_TUKEY = 4.685  # 95 % efficiency for Gaussian noise
_WIDE_STEPS, _WIDE = 2, 3.0  # the first correspondences are poor: let more points in
_FIRST_ALPHA = 100.0  # stiffness before the data have said theirs
# Strains cost a little: next to nothing where the scan shows them, much where it does not, as the thickness of a part
# that is seen from one side. Shifts are free.
_STRAIN_RIDGE, _SHIFT_RIDGE = 1e-3, 1e-6
_NORMAL_GATE = 0.5  # cos 60°
_SIGMA_FLOOR = 1e-5  # of the part's extent; a noise-free scan has no spread to divide by
_CENTRE_POOL = 5_000  # design points among which the centres of the kernel are chosen
_POINTS_PER_CENTRE = 12  # four for each unknown
_TRIAL_POINTS = 5_000  # enough to choose the kernel width
_TRIAL_STEPS = 8
_TRIAL_TOLERANCE = 1e-4  # in units of the scale
_ALPHA_RANGE = (10.0, 1e9)  # down to a prior sd of a third of the scale; less would let the motion run away
_NEGLIGIBLE = 0.01  # of the noise's variance: what the low-rank basis may leave out
_REMAINDER_RANGE = (1e-10, 1e-4)
_ROUGH = 0.7  # kernel width; of softer motions the stiff ones that lead there are no approximation
_CALM = 0.005  # of the scale: points that are no farther off, or move no farther, are in place but for their noise
_CALMER = 0.5  # the noise is taken out again once it has turned out to be this much smaller
_SETTLED = 1e-3  # of the scale: such a step hardly turns the normals; and if it is within the noise, no weight changes
_STILL = 0.1  # of the noise: shorter steps change nothing that the data could tell
_STALLED = 0.7  # of the motion two steps before
_ANYWHERE = 0.1  # of the scale: the range of an outlier
_MOST_STRETCH, _MOST_TORN = 1.5, 0.1  # no part is printed half as long again; but at a few points, noise
_CHUNK = 2_500  # rows of the normal equations at a time
_WORTH_THREADS = 200_000_000  # products; of less, starting the threads would take longer


@dataclass(frozen=True, eq=False)
class SurfaceRegistration:
    """Result of the surface stage.

    Attributes
    ----------
    fit : SurfaceFit
        Of all points, at the kernel width and stiffness chosen.
    iterations : int
        Steps of all fits.
    """

    fit: SurfaceFit
    iterations: int

    @property
    def deformation(self) -> Deformation:
        """The motion; `start` and `datum` are the identity: it is that of the posed scan."""
        return self.fit.deformation()


def register_surface(
    scan: PointSet,
    surface: DesignSurface,
    settings: SurfaceSettings,
    start: Deformation,
    progress: ProgressCallback,
    whole: int = 0,
) -> SurfaceRegistration:
    """Register a posed scan to the design's surface.

    Parameters
    ----------
    scan : PointSet
        Posed in the design frame, with outward normals; n points in mm.
    surface : DesignSurface
    settings : SurfaceSettings
    start : Deformation
        The motion of the posed scan so far, such as the one that judged its pose.
    progress : callable
        Called at every step; an exception it raises stops the work.
    whole : int
        Points of the scan before it was thinned, if all of them are to have a say in the end: the more, the finer the
        basis has to be.

    Raises
    ------
    RegistrationFailedError
        Fewer points lie near the surface than the motion has unknowns, or the motion diverges.

    Notes
    -----
    Kernel widths are tried from stiff to soft on a part of the points, until the evidence falls; where it is largest
    between them is then fitted to all points. Cost O(n · rank²) and one query of the surface per step.
    Source: MacKay 1992, Bayesian interpolation.
    """
    steps = 0

    def counted(step: Progress) -> None:
        nonlocal steps
        steps += 1
        most = settings.max_steps * (len(settings.beta) + 1)
        progress(replace(step, iteration=steps, fraction=min(steps / most, 1.0)))

    trial = scan.take(np.linspace(0, len(scan) - 1, min(len(scan), _TRIAL_POINTS)).astype(np.intp))
    tracker = tracked(trial, surface)
    moved = start.apply(trial.points)
    tolerance = max(_TRIAL_TOLERANCE, settings.tolerance)
    trial_settings = replace(settings, max_steps=min(settings.max_steps, _TRIAL_STEPS))

    def narrowing(widths: tuple[float, ...]) -> list[SurfaceFit]:
        """Fits from stiff to soft, each from where the last one ended, until the evidence falls."""
        fits: list[SurfaceFit] = []
        for beta in widths:
            fit = fit_surface(
                trial,
                tracker,
                trial_settings,
                beta,
                remainder=fits[-1].negligible_remainder if fits else _REMAINDER_RANGE[1],
                moved=fits[-1].moved if fits else moved,
                tolerance=tolerance,
                progress=counted,
            )
            fits.append(fit)
            if len(fits) > 1 and _evidences(fits)[-1] < _evidences(fits)[-2]:
                break
        return fits

    fits = narrowing(settings.beta)
    widest = int(_evidences(fits).argmax()) - 1
    if widest >= 0 and fits[widest + 1].beta <= _ROUGH:
        # What is rough bends a stiff motion along the surface, out of reach of the right one: begin anew without it.
        with suppress(RegistrationFailedError):  # then the first way stands
            others = narrowing(settings.beta[widest:])
            if _evidences([*fits, *others]).argmax() >= len(fits):
                fits = others
    best = fits[int(_evidences(fits).argmax())]
    beta, alpha = _most_evident(fits)
    final = fit_surface(
        scan,
        tracked(scan, surface),
        replace(settings, alpha=alpha),
        beta,
        remainder=best.negligible_remainder * len(scan) / max(whole, len(scan)),
        moved=best.motion().apply(scan.points),
        tolerance=settings.tolerance,
        progress=counted,
    )
    return SurfaceRegistration(final, steps)


def _evidences(fits: list[SurfaceFit]) -> Array:
    sigma = min(fit.sigma for fit in fits)
    return np.array([fit.evidence(sigma) for fit in fits])


def _most_evident(fits: list[SurfaceFit]) -> tuple[float, float]:
    """Kernel width and stiffness where the parabola through the largest evidence and its neighbours has its top."""
    evidences = _evidences(fits)
    middle = int(evidences.argmax())
    chosen = slice(max(middle - 1, 0), middle + 2)
    widths = np.log([fit.beta for fit in fits[chosen]])
    if len(widths) < 3:
        return fits[middle].beta, fits[middle].alpha
    curvature, slope, _ = np.polyfit(widths, evidences[chosen], 2)
    if not curvature < 0:
        return fits[middle].beta, fits[middle].alpha
    top = -0.5 * slope / curvature
    order = np.argsort(widths)
    stiffness = np.interp(top, widths[order], np.log([fit.alpha for fit in fits[chosen]])[order])
    return float(np.exp(top)), float(np.exp(stiffness))


def tracked(scan: PointSet, surface: DesignSurface) -> SurfaceTracker:
    """Tracker of the closest surface points of a scan that has normals."""
    assert scan.normals is not None, "the scan is prepared: it has normals"
    return SurfaceTracker(surface, scan.normals)


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A scan fitted to the surface at one kernel width."""

    basis: KernelBasis
    origin: Array
    scale: float
    beta: float
    alpha: float
    solution: Array  # (r + 4, 3): C and A
    factor: Array  # lower Cholesky factor of the normal equations, (3 (r + 4))²
    moved: Array
    closest: Closest  # of the moved points
    facing: NDArray[np.bool_]
    sigma: float
    stop_reason: str

    def motion(self) -> Deformation:
        """The motion, without its posterior."""
        rank, identity = len(self.basis.centres), np.eye(4)
        coefficients, affine = self.solution[:rank], self.solution[rank:]
        return Deformation(identity, identity, self.basis, coefficients, affine, self.origin, self.scale)

    def deformation(self) -> Deformation:
        """The motion with its posterior covariance."""
        return replace(self.motion(), covariance=posterior_covariance(self.factor, self.sigma))

    @property
    def negligible_remainder(self) -> float:
        """Share of the prior's variance that a low-rank basis may leave out: well below the noise."""
        return negligible_remainder(self.alpha, self.sigma / self.scale)

    def evidence(self, sigma: float) -> float:
        """Log marginal likelihood up to a constant, for residuals of standard deviation `sigma` in mm.

        No point costs more than an outlier would by Tukey's loss; comparable between fits of the same points.
        """
        loss = _TUKEY**2 / 6.0 * self._strangeness(sigma).sum()
        rank = len(self.basis.centres)
        prior = 0.5 * self.alpha * (self.solution[:rank] ** 2).sum() / self.scale**2
        log_determinant = 2.0 * np.log(np.diag(self.factor)).sum()
        log_prior = 3 * rank * np.log(self.alpha * (self.sigma / self.scale) ** 2)
        return -float(loss + prior + 0.5 * (log_determinant - log_prior))

    def plausibility(self) -> float:
        """Log marginal likelihood up to a constant with the noise that the fit itself found.

        Comparable between fits of scans in different poses: small residuals of some points, as a part that is squashed
        onto a wrong place has, do not make up for other points that lie nowhere. What is no part of the surface could
        be anywhere within a tenth of the scale.
        """
        strange = self._strangeness(self.sigma)
        spread = (1.0 - strange).sum() * np.log(self.sigma) + strange.sum() * np.log(_ANYWHERE * self.scale)
        return self.evidence(self.sigma) - float(spread)

    def squashes(self, placed: PointSet) -> bool:
        """Whether the motion stretches or shrinks the posed scan as no printed part would come out."""
        assert placed.normals is not None, "the scan is prepared: it has normals"
        jacobian = self.motion().jacobian(placed.points[self.facing])
        stretches = tangential_stretches(jacobian, placed.normals[self.facing])
        is_torn = (stretches[:, 0] < 1.0 / _MOST_STRETCH) | (stretches[:, 1] > _MOST_STRETCH)
        return float(is_torn.mean()) > _MOST_TORN

    def _strangeness(self, sigma: float) -> Array:
        """0 for points on the surface to 1 for those that are no part of it, by Tukey's loss, (n,)."""
        strange: Array = 1.0 - tukey_weights(self.closest.distances, sigma) ** 1.5
        strange[~self.facing] = 1.0
        return strange


def fit_surface(
    scan: PointSet,
    tracker: SurfaceTracker,
    settings: SurfaceSettings,
    beta: float,
    *,
    moved: Array,
    tolerance: float,
    progress: ProgressCallback,
    remainder: float = _REMAINDER_RANGE[1],
    wide: bool = False,
) -> SurfaceFit:
    """Gauss-Newton at one kernel width, with the prior's variance from the data unless it is set.

    Parameters
    ----------
    scan, settings, progress
        See `register_surface`.
    tracker : SurfaceTracker
        Of this scan.
    beta : float
        Kernel width in units of the scale.
    moved : (n, 3) float64, mm
        Where the scan points are taken to be on the design to begin with.
    tolerance : float
        RMS motion in one step below which the fit has converged, in units of the scale.
    remainder : float
        Largest share of the prior's variance that the low-rank basis may leave out.
    wide : bool
        The start is rough: the first steps let in points from farther away.
    """
    design, normals = tracker.surface.design, tracker.normals
    origin, scale = design.centre, design.scale
    alpha = settings.alpha or _FIRST_ALPHA
    basis = motion_basis(design, beta * scale, settings.rank, len(scan), remainder)
    features = motion_features(basis, scan.points, origin, scale)
    solution = np.zeros((features.shape[1], 3))  # in units of the scale: its prior variance is 1 / alpha
    denoised_at, determined, motion, stop_reason = np.inf, 0.0, np.inf, "max_steps"
    earlier = np.inf  # the motion one step ago
    is_settled = False  # the normal equations hardly change any more, and making them costs most
    for step in range(1, settings.max_steps + 1):
        closest = tracker.closest(moved)
        facing, sigma = _residuals(closest, normals, 3 * features.shape[1], determined)
        tolerant = _WIDE if wide and step <= _WIDE_STEPS else 1.0
        weights = facing * tukey_weights(closest.distances, tolerant * sigma)
        is_calm = tolerant == 1.0 and min(sigma, motion) < _CALM * scale
        if is_calm and sigma < _CALMER * denoised_at:
            # The motion is looked up where the point would be without its noise. Looked up at the noisy place, a motion
            # that shrinks along the normal would shrink the noise as well, and the evidence would fall for it: until
            # then the stiffness is not the data's to choose. Before the points are nearly there, what they are off by
            # is no noise.
            quiet = scan.points - np.where(weights > 0, closest.distances, 0.0)[:, None] * closest.normals
            features, denoised_at, is_settled = motion_features(basis, quiet, origin, scale), sigma, False
        if not is_settled:
            matrix = normal_matrix(features, closest.normals, weights)
        offsets = np.einsum("ij,ij->i", closest.normals, closest.points - scan.points) / scale
        offsets -= np.einsum("ij,ij->i", closest.normals, features @ solution)
        pull = features.T @ ((weights * offsets)[:, None] * closest.normals)
        variance, rank = (sigma / scale) ** 2, len(basis.centres)
        stepped, factor = newton_step(matrix, pull, solution, rank, alpha * variance)
        determined = well_determined(factor, rank, alpha * variance)
        if settings.alpha == 0 and denoised_at < np.inf:
            alpha = _evident_alpha(determined, stepped[:rank])
            stepped, factor = newton_step(matrix, pull, solution, rank, alpha * variance)
        solution = stepped
        previous, moved = moved, scan.points + scale * (features @ solution)
        before_last, earlier, motion = earlier, motion, float(np.sqrt(((moved - previous) ** 2).sum(axis=1).mean()))
        is_settled = denoised_at < np.inf and motion < min(_SETTLED * scale, sigma)
        progress(Progress("surface", 0.0, step, sigma))
        if not motion < 10.0 * scale:
            raise RegistrationFailedError(
                "the motion diverges", "surface stage", "check the pose, or register with a larger surface.alpha"
            )
        # Where the motion is soft, single points go to and fro between faces for ever, by less than their noise.
        is_restless = is_settled and motion > _STALLED * before_last
        is_still = motion < scale * max(tolerance, min(_STILL * sigma / scale, _TRIAL_TOLERANCE))
        if denoised_at < np.inf and (is_still or is_restless):
            stop_reason = "converged"
            break
    closest = tracker.closest(moved)
    facing, sigma = _residuals(closest, normals, 3 * features.shape[1], determined)
    return SurfaceFit(
        basis, origin, scale, beta, alpha, scale * solution, factor, moved, closest, facing, sigma, stop_reason
    )


def motion_basis(design: Design, width: float, rank: int, points: int, remainder: float) -> KernelBasis:
    """The basis of a motion of the design, for a scan of so many points.

    `width` in mm; at most `rank` functions, and fewer once they leave out no more than the share `remainder` of the
    prior's variance.
    """
    # Centres on the design, not on the scan: an outlier with a centre of its own could be moved anywhere for nothing.
    centres, _ = spread_samples(design, _CENTRE_POOL)
    return low_rank_basis(centres, width, most_centres(rank, points), tolerance=remainder)


def most_centres(rank: int, points: int) -> int:
    """How many functions a basis of at most `rank` may have for a scan of so many points."""
    return min(rank, points // _POINTS_PER_CENTRE)


def negligible_remainder(alpha: float, noise: float) -> float:
    """Share of the prior's variance a basis may leave out: well below that of the `noise`, in units of the scale."""
    return float(np.clip(_NEGLIGIBLE * alpha * noise**2, *_REMAINDER_RANGE))


def _residuals(closest: Closest, normals: Array, unknowns: int, determined: float) -> tuple[NDArray[np.bool_], float]:
    """Which points face the surface they are nearest to, and the robust standard deviation of those in mm.

    As many degrees of freedom as the data have `determined` are missing from the residuals.
    """
    facing = np.einsum("ij,ij->i", closest.normals, normals) > _NORMAL_GATE
    count = int(facing.sum())
    if count < unknowns:
        raise RegistrationFailedError(
            f"only {count} of {len(facing)} points face the surface nearest to them",
            "surface stage",
            "check the pose, the scan's normals, and that the scan shows this part",
        )
    sigma = noise_sigma(closest.distances[facing], determined)
    return facing, max(sigma, _SIGMA_FLOOR * float(np.ptp(closest.points)))


def noise_sigma(distances: Array, determined: float) -> float:
    """`robust_sigma` of the `distances` (n,) that a motion leaves which has spent `determined` degrees of freedom."""
    count = len(distances)
    return robust_sigma(distances) * float(np.sqrt(count / max(count - determined, 0.5 * count)))


def tukey_weights(distances: Array, sigma: float) -> Array:
    """Tukey's biweight of `distances` (n,) with standard deviation `sigma`: 1 at zero, 0 from 4.685 sigma on."""
    relative = np.minimum(np.abs(distances) / (_TUKEY * sigma), 1.0)
    weights: Array = (1.0 - relative**2) ** 2
    return weights


def normal_matrix(features: Array, normals: Array, weights: Array) -> Array:
    """Σ w (n ⊗ φ)(n ⊗ φ)ᵀ, the matrix (3m, 3m) of the distances to the tangent planes; unknowns axis by axis."""
    size = 3 * features.shape[1]
    used = np.flatnonzero(weights)

    def share(chunk: NDArray[np.intp]) -> Array:
        directions = np.sqrt(weights[chunk])[:, None] * normals[chunk]
        rows = (directions[:, :, None] * features[chunk, None, :]).reshape(len(chunk), size)
        product: Array = rows.T @ rows
        return product

    chunks = np.array_split(used, max(-(-len(used) // _CHUNK), 1))
    is_much = len(used) * size**2 > _WORTH_THREADS
    matrix = np.zeros((size, size))
    for product in in_threads(share, chunks) if is_much else map(share, chunks):
        matrix += product
    return matrix


def newton_step(matrix: Array, pull: Array, solution: Array, rank: int, stiffness: float) -> tuple[Array, Array]:
    """Newton step from `solution` (m, 3) by the residuals' `pull` (m, 3) and the prior; and the Cholesky factor."""
    size = len(solution)
    prior = np.full(size, stiffness)
    prior[rank:] = _STRAIN_RIDGE
    prior[-1] = _SHIFT_RIDGE
    prior = np.tile(prior, 3)
    posterior = matrix.copy()
    posterior[np.diag_indices(len(matrix))] += prior
    factor: Array = cholesky(posterior, lower=True, overwrite_a=True, check_finite=False)
    start = solution.T.ravel()
    stepped = start + cho_solve((factor, True), pull.T.ravel() - prior * start)
    return stepped.reshape(3, size).T, factor


def posterior_covariance(factor: Array, sigma: float) -> Array:
    """Covariance of the unknowns, axis by axis, (3m, 3m) mm², from the lower Cholesky factor (3m, 3m)."""
    covariance: Array = cho_solve((factor, True), np.eye(len(factor)))
    covariance *= sigma**2
    return covariance


def evident_alpha(factor: Array, solution: Array, rank: int, stiffness: float) -> float:
    """The stiffness that the data speak for, from a `solution` (m, 3) and its `factor` with another one."""
    return _evident_alpha(well_determined(factor, rank, stiffness), solution[:rank])


def _evident_alpha(determined: float, coefficients: Array) -> float:
    # Source: MacKay 1992, equation 4.9: alpha |C|² = number of well-determined parameters.
    return float(np.clip(determined / (coefficients**2).sum(), *_ALPHA_RANGE))


def well_determined(factor: Array, rank: int, stiffness: float) -> float:
    """How many of the basis's coefficients the data determine rather than the prior."""
    is_basis = _is_basis(len(factor) // 3, rank)
    inverse, _ = dtrtri(factor, lower=1)
    return float(is_basis.sum() - stiffness * (inverse[:, is_basis] ** 2).sum())


def _is_basis(size: int, rank: int) -> NDArray[np.bool_]:
    return np.tile(np.arange(size) < rank, 3)
