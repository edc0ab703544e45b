"""The surface stage: registration of the posed scan to the design's triangles, point to plane.

A point-to-point mixture has nothing that holds points in place along a smooth face; measuring along the normal only
and letting the motion prior carry the rest does. How stiff that prior is, the data say: among the kernel widths the one
with the largest evidence (marginal likelihood) wins, and its variance is the one that maximises the evidence.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from mdf_core.deformation import Deformation
from mdf_core.design_surface import DesignSurface
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.motion_basis import MOST_REMAINDER
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.settings import SurfaceSettings
from mdf_core.surface_fit import FitSettings, SurfaceFit, fit_surface

_TRIAL_POINTS = 5_000  # enough to choose the kernel width
_TRIAL_STEPS = 8
_TRIAL_TOLERANCE = 1e-4  # in units of the scale
_ROUGH = 0.7  # kernel width; of softer motions the stiff ones that lead there are no approximation


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


def register_surface(
    scan: PointSet,
    surface: DesignSurface,
    settings: SurfaceSettings,
    start: Deformation,
    progress: ProgressCallback,
    whole: int = 0,
    from_afar: bool = False,
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
    from_afar : bool
        Let in what is off by up to a tenth of the scale to begin with. Most of a part may lie where it should and say
        so by a small noise, as walls do that are bent along themselves; then the few faces that tell of the bend count
        as outliers, and go on to.

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

    fits = _trials(scan, surface, settings, start, from_afar, counted)
    best = fits[int(_evidences(fits).argmax())]
    beta, alpha = _most_evident(fits)
    remainder = best.negligible_remainder * len(scan) / max(whole, len(scan))
    final = FitSettings(beta, alpha, settings.rank, settings.max_steps, settings.tolerance, remainder)
    moved = best.motion().apply_roughly(scan.points)
    fit = fit_surface(scan, surface, final, moved, counted)
    return SurfaceRegistration(fit, steps)


def _trials(
    scan: PointSet,
    surface: DesignSurface,
    settings: SurfaceSettings,
    start: Deformation,
    from_afar: bool,
    progress: ProgressCallback,
) -> list[SurfaceFit]:
    """Fits of a part of the points at several kernel widths, from stiff to soft."""
    trial = scan.take(np.linspace(0, len(scan) - 1, min(len(scan), _TRIAL_POINTS)).astype(np.intp))
    begin = start.apply_roughly(trial.points)
    max_steps, tolerance = min(settings.max_steps, _TRIAL_STEPS), max(_TRIAL_TOLERANCE, settings.tolerance)

    def narrowing(widths: tuple[float, ...], *before: SurfaceFit) -> list[SurfaceFit]:
        """Each from where the last one ended, until the evidence falls."""
        fits = list(before)
        for beta in widths:
            remainder = fits[-1].negligible_remainder if fits else MOST_REMAINDER
            far = from_afar and not fits
            fitted = FitSettings(beta, settings.alpha, settings.rank, max_steps, tolerance, remainder, far=far)
            moved = fits[-1].moved if fits else begin
            fits.append(fit_surface(trial, surface, fitted, moved, progress))
            if len(fits) > 1 and _evidences(fits)[-1] < _evidences(fits)[-2]:
                break
        return fits

    fits = narrowing(settings.beta)
    middle = int(_evidences(fits).argmax())
    if middle == 0 or fits[middle].beta > _ROUGH:
        return fits
    # What is rough bends a stiff motion along the surface, out of reach of the right one: begin anew without it.
    softer = fits[middle + 1 :]
    with suppress(RegistrationFailedError):  # then the first way stands
        others = narrowing(settings.beta[middle - 1 : middle + 1])
        best, *next_best, other = _evidences([fits[middle], *softer, others[-1]])
        if other - best > best - max(next_best, default=other):  # so much better that a softer one may be the best
            others, softer = narrowing(settings.beta[middle + 1 :], *others), []
        if _evidences([*fits, *others]).argmax() >= len(fits):
            return [*others, *softer]
    return fits


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
