"""The basis of a motion of the design: how many functions a scan can tell, and how many its noise is worth."""

from __future__ import annotations

import numpy as np

from mdf_core.design_surface import spread_samples
from mdf_core.geometry import Design
from mdf_core.kernel import KernelBasis, low_rank_basis

MOST_REMAINDER = 1e-4
"""Largest share of the prior's variance that a basis may leave out."""

_LEAST_REMAINDER = 1e-10
_CENTRE_POOL = 5_000  # design points among which the centres of the kernel are chosen
_POINTS_PER_CENTRE = 12  # four for each unknown
_NEGLIGIBLE = 0.01  # of the noise's variance: what the low-rank basis may leave out


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
    return float(np.clip(_NEGLIGIBLE * alpha * noise**2, _LEAST_REMAINDER, MOST_REMAINDER))
