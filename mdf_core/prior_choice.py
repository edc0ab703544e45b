"""What is assumed of a motion: whether an uneven offset beside it, or a second width of its own, is more evident.

A print may be bent as a whole and swell or shrink here and there. A motion of one width follows the one or the other
well, and slides along the faces where it is too rough for the bend.

The distances of a scan are wrong in patches: calibration, speckle, a spray of uneven thickness. Both faces of a wall
lie off at once, which a smooth motion does not do; a rough one does, and slides along the faces by many times as much.
An offset along the normals that varies over the part explains such errors for less, and leaves the motion as smooth as
it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from mdf_core.design_motion import DesignMotion, Prior, Solved
from mdf_core.geometry import Design
from mdf_core.kernel import KernelBasis
from mdf_core.motion_basis import motion_basis, negligible_remainder
from mdf_core.settings import SurfaceSettings

_FEW = 5_000  # rows, enough to choose
_NARROW = (1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18)  # widths of a second motion or an offset, in units of the scale
_MIDDLE = 0.7
_STIFFER = 1.9  # times the width: the motion may have followed what is not its own
_REMAINDER = 1e-3  # of the variance of a second motion or an offset, which is some times the noise's
_STEPS = 12
_KNOWN = 0.1  # of the logarithms of the stiffnesses
_NONE = 1.0  # determined coefficients: with fewer it is all prior
_CLEAR = 3.0  # of the logarithm of the evidence: twenty to one

_Kind = Callable[[KernelBasis, KernelBasis, float, float], Prior]


def with_evident_prior(
    found: DesignMotion, beta: float, design: Design, settings: SurfaceSettings, points: int, told: Callable[[], None]
) -> DesignMotion:
    """The motion beside an uneven offset, or of two widths, if that is clearly more evident; else what was `found`.

    Parameters
    ----------
    found : DesignMotion
    beta : float
        Its kernel width in units of the scale.
    design : Design
    settings : SurfaceSettings
        A stiffness or a single width that they give is kept: no second one is tried.
    points : int
        Of the scan, which bound the rank.
    told : callable
        Called now and then.

    Notes
    -----
    Tried on some of the rows; cost O(rank³) for each pair of widths. Source: MacKay 1992, Bayesian interpolation.
    """
    trials, is_fixed = _Trials(found, design, settings, points, told), settings.alpha > 0
    narrow = min(_NARROW, key=lambda width: abs(np.log(width / min(beta, _MIDDLE))))
    wide = min((width for width in settings.beta if width > _STIFFER * beta), default=beta)
    best = trials.climbed(_beside_offset, [(wide, narrow), (beta, _MIDDLE)])
    # Of what is seen from one side only, a motion of the same two widths does as well: then it is one.
    if best and best.evidence < trials.at(_of_two_widths, best.wide, best.narrow, best.prior).evidence + _CLEAR:
        best = None
    if best is None and not is_fixed and len(settings.beta) > 1:
        best = trials.climbed(_of_two_widths, [(wide, narrow)])
    if best is None:
        return found
    return found.equations.solve(best.prior, found.sigma, is_fixed, told)


def _beside_offset(wide: KernelBasis, narrow: KernelBasis, alpha: float, second_alpha: float) -> Prior:
    return Prior([wide], np.array([alpha]), narrow, second_alpha)


def _of_two_widths(wide: KernelBasis, narrow: KernelBasis, alpha: float, second_alpha: float) -> Prior:
    return Prior([wide, narrow], np.array([alpha, second_alpha]))


@dataclass(frozen=True, eq=False)
class _Trial:
    """A solution with a wide motion and something narrow, widths in units of the scale."""

    wide: float
    narrow: float
    solved: Solved

    @property
    def prior(self) -> Prior:
        return self.solved.prior

    @property
    def evidence(self) -> float:
        return self.solved.evidence


class _Trials:
    """Solutions of some of the rows."""

    def __init__(
        self, found: DesignMotion, design: Design, settings: SurfaceSettings, points: int, told: Callable[[], None]
    ) -> None:
        self._design, self._settings, self._points, self._told = design, settings, points, told
        every = -(-len(found.equations.distances) // _FEW)
        self._equations, self._sigma = found.equations.take(slice(None, None, every)), found.sigma
        self._plain = self._most_evident(found.prior)

    def climbed(self, kind: _Kind, starts: Iterable[tuple[float, float]]) -> _Trial | None:
        """The most evident one of its kind, from the first of the `starts` clearly better than one motion alone."""
        as_noise = (self._design.scale / self._sigma) ** 2
        for wide, narrow in dict.fromkeys(starts):
            best = self.at(kind, wide, narrow, replace(self._plain.prior, offset_alpha=as_noise))
            if self._is_clear(best, self._plain):
                break
        else:
            return None
        wider = sorted(other for other in self._settings.beta if other > best.wide)
        best = self._best(kind, best, [(other, narrow) for other in wider])
        place = _NARROW.index(narrow)
        for others in (_NARROW[place + 1 :], _NARROW[:place][::-1]):
            best = self._best(kind, best, [(best.wide, other) for other in others])
        # A motion as wide may have been missed, being tried on fewer points.
        alone = self._most_evident(Prior(best.prior.bases[:1], best.prior.alphas[:1]))
        return best if self._is_clear(best, alone) else None

    def at(self, kind: _Kind, wide: float, narrow: float, start: Prior) -> _Trial:
        """With these widths and the most evident stiffnesses."""
        alpha, second_alpha = (*start.alphas, start.offset_alpha)[:2]
        remainder = negligible_remainder(alpha, self._sigma / self._design.scale)
        prior = kind(self._basis(wide, remainder), self._basis(narrow, _REMAINDER), alpha, second_alpha)
        return _Trial(wide, narrow, self._most_evident(prior))

    @staticmethod
    def _is_clear(trial: _Trial, other: Solved) -> bool:
        """Whether the narrow one is told by the data, and the evidence clearly larger than without it."""
        return trial.solved.least_determined >= _NONE and trial.evidence > other.evidence + _CLEAR

    def _most_evident(self, prior: Prior) -> Solved:
        """The solution with such stiffnesses that the next step would hardly change them."""
        sums = self._equations.summed(prior, self._told)
        for _ in range(_STEPS):
            solved = sums.solve(prior, self._sigma)
            before, prior = prior, solved.more_evident(self._settings.alpha > 0)
            if solved.least_determined < _NONE or _is_close(prior, before):
                break
        return solved

    def _best(self, kind: _Kind, best: _Trial, widths: Iterable[tuple[float, float]]) -> _Trial:
        """The best so far, or one with these widths as long as the evidence grows."""
        for wide, narrow in widths:
            other = self.at(kind, wide, narrow, best.prior)
            if not other.evidence > best.evidence:
                break
            best = other
        return best

    def _basis(self, width: float, remainder: float) -> KernelBasis:
        design = self._design
        return motion_basis(design, width * design.scale, self._settings.rank, self._points, remainder)


def _is_close(one: Prior, other: Prior) -> bool:
    change = np.log(np.append(one.alphas, one.offset_alpha) / np.append(other.alphas, other.offset_alpha))
    return bool((np.abs(change) < _KNOWN).all())
