"""How long work tells where it is, and how it is told to stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Where the work is.

    Attributes
    ----------
    stage : str
        prepare | pose | mixture | surface | interpolation
    fraction : float
        Of the whole job, 0..1.
    iteration : int
        Within the stage.
    sigma_mm : float
        Robust residual now, NaN where there is none yet.
    """

    stage: str
    fraction: float
    iteration: int
    sigma_mm: float


ProgressCallback = Callable[[Progress], None]
"""Called at every iteration; an exception it raises (`CancelledError`) stops the work and reaches the caller."""


def silent(_: Progress) -> None:
    """The callback of those who do not watch."""
