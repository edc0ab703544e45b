"""The posed scan fitted to the design's triangles, point to plane, at one kernel width."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import TUKEY_LIMIT, noise_sigma, tukey_weights
from mdf_core.deformation import Deformation, motion_features, tangential_stretches
from mdf_core.design_surface import Closest, DesignSurface, SurfaceTracker
from mdf_core.errors import LOOK_AT_THE_SCAN, RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.kernel import KernelBasis
from mdf_core.lone_points import ShownPlaces
from mdf_core.motion_basis import MOST_REMAINDER, motion_basis, negligible_remainder
from mdf_core.normal_equations import (
    OffsetSums,
    evident_alpha,
    newton_step,
    normal_matrix,
    normal_sum,
    posterior_covariance,
    well_determined,
)
from mdf_core.outward import outward
from mdf_core.progress import Progress, ProgressCallback

_WIDE_STEPS, _WIDE = 2, 3.0  # the first correspondences are poor: let more points in
_REACHES = (0.1, 0.033, 0.01)  # of the scale, in the first steps; below, points are as good as in place
_FIRST_ALPHA = 100.0  # stiffness before the data have said theirs
_NORMAL_GATE = 0.5  # cos 60°
_SIGMA_FLOOR = 1e-5  # of the part's extent; a noise-free scan has no spread to divide by
_CALM = 0.005  # of the scale: points that are no farther off, or move no farther, are in place but for their noise
_SETTLED = 1e-3  # of the scale: such a step hardly turns the normals; and if it is within the noise, no weight changes
_STILL, _STILL_AT_MOST = 0.1, 1e-4  # of the noise, of the scale: shorter steps change nothing that the data could tell
_STALLED = 0.7  # of the motion two steps before
_KNOWN = 0.2  # of the logarithm of the stiffness, which may still change so much
_FARTHEST = 10.0  # of the scale, in one step
_ANYWHERE = 0.1  # of the scale: the range of an outlier
_MOST_STRETCH, _MOST_TORN = 1.5, 0.1  # no part is printed half as long again; but at a few points, noise


@dataclass(frozen=True)
class FitSettings:
    """How a scan is fitted at one kernel width.

    Attributes
    ----------
    beta : float
        Kernel width in units of the scale.
    alpha : float
        Stiffness; 0: from the data.
    rank : int
        Most functions of the basis.
    max_steps : int
    tolerance : float
        RMS motion in one step below which the fit has converged, in units of the scale.
    remainder : float
        Largest share of the prior's variance that the low-rank basis may leave out.
    wide : bool
        The start is rough: the first steps let in points from farther away.
    far : bool
        The first steps let in what is off by a tenth of the scale, whatever the noise.
    """

    beta: float
    alpha: float
    rank: int
    max_steps: int
    tolerance: float
    remainder: float = MOST_REMAINDER
    wide: bool = False
    far: bool = False


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A scan of n points fitted to the surface at one kernel width.

    Attributes
    ----------
    basis : KernelBasis
    origin : (3,) float64, mm
    scale : float, mm
    beta : float
        Kernel width in units of the scale.
    alpha : float
        Stiffness, as it was set or as the data had it.
    solution : (r + 4, 3) float64, mm
        C and A of the motion of the design.
    factor : (3 (r + 4), 3 (r + 4)) float64
        Lower Cholesky factor of the normal equations.
    moved : (n, 3) float64, mm
        The points on the design.
    closest : Closest
        Of those.
    facing : (n,) bool
        Whether the design faces there as the scan point does.
    counts : (n,) bool
        Which points have a say: those that are of the face they lie on, and not alone there.
    offset : float, mm
        Of all points along their normals: a coating, or lines that were printed too wide.
    sigma : float, mm
        The noise.
    stop_reason : str
        converged | max_steps
    """

    basis: KernelBasis
    origin: Array
    scale: float
    beta: float
    alpha: float
    solution: Array
    factor: Array
    moved: Array
    closest: Closest
    facing: NDArray[np.bool_]
    counts: NDArray[np.bool_]
    offset: float
    sigma: float
    stop_reason: str

    def motion(self) -> Deformation:
        """The motion of the design onto the posed scan, without its posterior."""
        rank, still = len(self.basis.centres), np.eye(4)
        coefficients, affine = self.solution[:rank], self.solution[rank:]
        return Deformation(still, still, self.basis, coefficients, affine, self.origin, self.scale, maps_design=True)

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
        loss = TUKEY_LIMIT**2 / 6.0 * self._strangeness(sigma).sum()
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

    def squashes(self) -> bool:
        """Whether the motion stretches or shrinks what the scan shows as no printed part would come out."""
        jacobian = self.motion().jacobian(self.closest.points[self.facing])
        stretches = tangential_stretches(jacobian, self.closest.normals[self.facing])
        is_torn = (stretches[:, 0] < 1.0 / _MOST_STRETCH) | (stretches[:, 1] > _MOST_STRETCH)
        return float(is_torn.mean()) > _MOST_TORN

    def require_unsquashed(self, where: str) -> None:
        """Refuse a fit that squashes the part.

        Raises
        ------
        RegistrationFailedError
        """
        if self.squashes():
            raise RegistrationFailedError(
                "the motion that brings the scan onto the design would squash it", where, LOOK_AT_THE_SCAN
            )

    def _strangeness(self, sigma: float) -> Array:
        """0 for points on the surface to 1 for those that are no part of it, by Tukey's loss, (n,)."""
        strange: Array = 1.0 - tukey_weights(self.closest.distances - self.offset, sigma) ** 1.5
        strange[~self.facing] = 1.0
        return strange


def fit_surface(
    scan: PointSet, surface: DesignSurface, settings: FitSettings, moved: Array, progress: ProgressCallback
) -> SurfaceFit:
    """Gauss-Newton at one kernel width, with the prior's variance from the data unless it is set.

    The motion is that of the design, looked up where each scan point is closest to it. A motion of the scan, looked up
    at its points, could shrink along the normals of a part that is seen from one side, and its distortion and noise
    with it.

    Parameters
    ----------
    scan : PointSet
        Posed in the design frame, n points in mm.
    surface : DesignSurface
    settings : FitSettings
    moved : (n, 3) float64, mm
        Where the scan points are taken to be on the design to begin with.
    progress : callable
        Called at every step; an exception it raises stops the work.

    Raises
    ------
    RegistrationFailedError
        Fewer points face the surface than the motion has unknowns, or the motion diverges.
    """
    fitting, stop_reason = _Fitting(scan, surface, settings, moved), "max_steps"
    for step in range(1, settings.max_steps + 1):
        fitting.step(step)
        progress(Progress("surface", 0.0, step, fitting.sigma))
        if not fitting.motions[-1] < _FARTHEST * fitting.scale:
            raise RegistrationFailedError(
                "the motion diverges",
                "surface stage",
                "check the pose and that the scan shows this part, or register with a larger surface.alpha",
            )
        if fitting.is_at_rest():
            stop_reason = "converged"
            break
    return fitting.result(stop_reason)


class _Fitting:
    """The fit on its way; the solution is in units of the scale, in which its prior variance is 1 / alpha."""

    def __init__(self, scan: PointSet, surface: DesignSurface, settings: FitSettings, moved: Array) -> None:
        design, turned = surface.design, outward(scan, moved, surface)
        self._points, self._settings = scan.points, settings
        self._tracker, self._is_of_face = SurfaceTracker(surface, turned.normals), turned.is_of_face
        self._origin, self.scale = design.centre, design.scale
        self._basis = motion_basis(design, settings.beta * self.scale, settings.rank, len(scan), settings.remainder)
        self._solution = np.zeros((len(self._basis.centres) + 4, 3))
        self._alpha = self._former_alpha = settings.alpha or _FIRST_ALPHA
        self._determined = 0.0
        self._features: Array
        self._matrix: Array
        self._common: OffsetSums  # of one offset of all points
        self._factor: Array
        self._is_calm = False  # before, what the points are off by says nothing of the stiffness
        self._is_settled = False  # the normal equations hardly change any more, and making them costs most
        self._is_lone: NDArray[np.bool_]
        self._moved = moved
        self.motions = (np.inf, np.inf, np.inf)  # mm RMS, in the last three steps
        self.offset, self.sigma = 0.0, np.inf

    def step(self, number: int) -> None:
        """One Gauss-Newton step, the first of which is number 1."""
        closest, facing = self._measured()
        assumed = self._assumed_noise(number)
        weights = self._weights(closest, facing, assumed)
        if not self._is_settled:
            self._is_lone = _lone(closest, weights)
        weights[self._is_lone] = 0.0
        self._is_calm |= assumed == self.sigma and min(self.sigma, self.motions[-1]) < _CALM * self.scale
        if not self._is_settled:
            self._features = motion_features(self._basis, closest.points, self._origin, self.scale)
            self._matrix = normal_matrix(self._features, closest.normals, weights)
            self._common = OffsetSums.of(np.ones((len(weights), 1)), self._features, closest.normals, weights)
        self._solve(closest, weights)
        previous, self._moved = self._moved, self._points - self.scale * (self._features @ self._solution)
        # Outliers go to and fro between the feet of several faces.
        motion = float(np.sqrt(((self._moved - previous)[weights > 0] ** 2).sum(axis=1).mean()))
        self.motions = (*self.motions[1:], motion)
        self._is_settled = self._is_calm and motion < min(_SETTLED * self.scale, self.sigma)

    def is_at_rest(self) -> bool:
        """Whether further steps would tell nothing."""
        before_last, _, motion = self.motions
        # Where the motion is soft, single points go to and fro between faces for ever, by less than their noise.
        is_restless = self._is_settled and motion > _STALLED * before_last
        still = max(self._settings.tolerance, min(_STILL * self.sigma / self.scale, _STILL_AT_MOST))
        is_known = abs(np.log(self._alpha / self._former_alpha)) < _KNOWN
        return self._is_calm and is_known and (motion < self.scale * still or is_restless)

    def result(self, stop_reason: str) -> SurfaceFit:
        """The fit as it now is."""
        closest, facing = self._measured()
        return SurfaceFit(
            basis=self._basis,
            origin=self._origin,
            scale=self.scale,
            beta=self._settings.beta,
            alpha=self._alpha,
            solution=self.scale * self._solution,
            factor=self._factor,
            moved=self._moved,
            closest=closest,
            facing=facing,
            counts=(self._weights(closest, facing, self.sigma) > 0) & ~self._is_lone,
            offset=self.offset,
            sigma=self.sigma,
            stop_reason=stop_reason,
        )

    def _measured(self) -> tuple[Closest, NDArray[np.bool_]]:
        """Closest surface points and which of them face their scan points; and their `offset` and noise `sigma`."""
        closest = self._tracker.closest(self._moved)
        facing = np.einsum("ij,ij->i", closest.normals, self._tracker.normals) > _NORMAL_GATE
        counts = facing & self._is_of_face
        self.offset, self.sigma = _residuals(closest, counts, self._solution.size, self._determined)
        return closest, facing

    def _weights(self, closest: Closest, facing: NDArray[np.bool_], sigma: float) -> Array:
        return (facing & self._is_of_face) * tukey_weights(closest.distances - self.offset, sigma)

    def _assumed_noise(self, number: int) -> float:
        """What points are judged by in a step, mm; more than the noise while the start is rough."""
        if self._settings.far and number <= len(_REACHES):
            return max(self.sigma, _REACHES[number - 1] * self.scale / TUKEY_LIMIT)
        return self.sigma * (_WIDE if self._settings.wide and number <= _WIDE_STEPS else 1.0)

    def _solve(self, closest: Closest, weights: Array) -> None:
        noise, rank = self.sigma / self.scale, len(self._basis.centres)
        stiffness = np.full(rank, self._alpha * noise**2)
        left = np.einsum("ij,ij->i", closest.normals, self._points - closest.points) / self.scale
        left -= np.einsum("ij,ij->i", closest.normals, self._features @ self._solution)
        pull, own_pull = normal_sum(self._features, closest.normals, weights * left), np.array([weights @ left])
        matrix, pull = self._common.eliminated(0.0, noise).without(self._matrix, pull, own_pull)
        solution, self._factor = newton_step(matrix, pull, self._solution, stiffness)
        self._determined = float(well_determined(self._factor, stiffness).sum())
        if self._settings.alpha == 0 and self._is_calm:
            self._former_alpha, self._alpha = self._alpha, evident_alpha(self._determined, solution[:rank])
            stiffness = np.full(rank, self._alpha * noise**2)
            solution, self._factor = newton_step(matrix, pull, self._solution, stiffness)
        self._solution = solution


def _lone(closest: Closest, weights: Array) -> NDArray[np.bool_]:
    """Which of the points with a weight have no others with one around them, (n,)."""
    weighty, is_lone = np.flatnonzero(weights), np.zeros(len(weights), dtype=np.bool_)
    is_lone[weighty] = ShownPlaces(closest.points[weighty], closest.normals[weighty]).lone()
    return is_lone


def _residuals(closest: Closest, counts: NDArray[np.bool_], unknowns: int, determined: float) -> tuple[float, float]:
    """The offset and robust standard deviation in mm of the points that count, (n,).

    As many degrees of freedom as the data have `determined` are missing from the residuals.
    """
    distances = closest.distances[counts]
    if len(distances) < unknowns:
        raise RegistrationFailedError(
            f"only {len(distances)} of {len(counts)} points face the surface nearest to them",
            "surface stage",
            "check the pose, the scan's normals, and that the scan shows this part",
        )
    offset = float(np.median(distances))
    sigma = noise_sigma(distances - offset, determined)
    return offset, max(sigma, _SIGMA_FLOOR * float(np.ptp(closest.points, axis=0).max()))
