"""Whether the scan lies off by more than noise that every point has of its own, and how smooth the motion then is.

The distances of a scan are wrong in patches: calibration, speckle, a spray of uneven thickness. Both faces of a wall
lie off at once, which a smooth motion does not do; a rough one does, and slides along the faces by many times as much.
An offset along the normals that varies over the part explains such errors for less, and leaves the motion as smooth as
it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from mdf_core.design_motion import DesignMotion, Prior, Solved
from mdf_core.geometry import Design
from mdf_core.motion_basis import motion_basis, negligible_remainder
from mdf_core.settings import SurfaceSettings

_FEW = 5_000  # rows, enough to choose
_WIDTHS = (1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18)  # of the offset's kernel, in units of the scale
_MIDDLE = 0.7
_STIFFER = 1.9  # times the width: the motion may have followed the offset
_REMAINDER = 1e-2  # of the offset's variance, which is about the noise's
_STEPS = 12
_KNOWN = 0.1  # of the logarithms of the stiffnesses
_NONE = 1.0  # determined coefficients: with fewer the offset is all prior
_CLEAR = 3.0  # of the logarithm of the evidence: twenty to one


def with_uneven_offset(
    found: DesignMotion, beta: float, design: Design, settings: SurfaceSettings, points: int, told: Callable[[], None]
) -> DesignMotion:
    """The motion beside an offset that varies over the part, if that is clearly more evident; else what was `found`.

    Parameters
    ----------
    found : DesignMotion
    beta : float
        Its kernel width in units of the scale.
    design : Design
    settings : SurfaceSettings
    points : int
        Of the scan, which bound the rank.
    told : callable
        Called now and then.

    Notes
    -----
    Tried on some of the rows; cost O(rank³) for each pair of widths. Source: MacKay 1992, Bayesian interpolation.
    """
    trials = _Trials(found, design, settings, points, told)
    plain = trials.plain()
    narrow = min(_WIDTHS, key=lambda width: abs(np.log(width / min(beta, _MIDDLE))))
    stiff = min((width for width in settings.beta if width > _STIFFER * beta), default=beta)
    for start in dict.fromkeys([(stiff, narrow), (beta, _MIDDLE)]):
        best = trials.at(*start, trials.noise())
        if best.offset_determined >= _NONE and best.evidence > plain.evidence + _CLEAR:
            break
    else:
        return found
    width, offset_width = start
    stiffer = sorted(other for other in settings.beta if other > width)
    best = trials.best_of(best, ((other, offset_width) for other in stiffer))
    width = best.prior.basis.width / design.scale
    for others in (_WIDTHS[_WIDTHS.index(offset_width) + 1 :], _WIDTHS[: _WIDTHS.index(offset_width)][::-1]):
        best = trials.best_of(best, ((width, other) for other in others))
    offset_width = best.prior.offset_basis.width / design.scale
    # Of what is seen from one side only, a motion of two widths does as well: then it is one.
    motion = trials.at(width, offset_width, replace(best.prior, offset_as_motion=True))
    if best.evidence < motion.evidence + _CLEAR:
        return found
    return found.equations.solve(best.prior, found.sigma, settings.alpha > 0, told)


class _Trials:
    """Solutions of some of the rows beside an offset."""

    def __init__(
        self, found: DesignMotion, design: Design, settings: SurfaceSettings, points: int, told: Callable[[], None]
    ) -> None:
        self._found, self._design, self._settings, self._points, self._told = found, design, settings, points, told
        every = max(len(found.equations.distances) // _FEW, 1)
        self._equations = found.equations.take(slice(None, None, every))

    def plain(self) -> Solved:
        """Without any offset but the common one."""
        return self._equations.summed(self._found.prior, self._told).solve(self._found.prior, self._found.sigma)

    def noise(self) -> Prior:
        """Where to begin: with an offset as large as the noise."""
        return replace(self._found.prior, offset_alpha=(self._design.scale / self._found.sigma) ** 2)

    def at(self, width: float, offset_width: float, start: Prior) -> Solved:
        """With these kernel widths in units of the scale, the stiffnesses being the most evident ones."""
        design, rank, points, sigma = self._design, self._settings.rank, self._points, self._found.sigma
        remainder = negligible_remainder(start.alpha, sigma / design.scale)
        basis = motion_basis(design, width * design.scale, rank, points, remainder)
        offset_basis = motion_basis(design, offset_width * design.scale, rank, points, _REMAINDER)
        prior = replace(start, basis=basis, offset_basis=offset_basis)
        sums = self._equations.summed(prior, self._told)
        for _ in range(_STEPS):
            solved = sums.solve(prior, sigma)
            before, prior = prior, solved.more_evident(self._settings.alpha > 0)
            if solved.offset_determined < _NONE or _is_close(prior, before):
                break
        return solved

    def best_of(self, best: Solved, widths: Iterable[tuple[float, float]]) -> Solved:
        """The best so far, or one with these widths as long as the evidence grows."""
        for pair in widths:
            other = self.at(*pair, best.prior)
            if not other.evidence > best.evidence:
                break
            best = other
        return best


def _is_close(one: Prior, other: Prior) -> bool:
    change = np.log([one.alpha / other.alpha, one.offset_alpha / other.offset_alpha])
    return bool((np.abs(change) < _KNOWN).all())
