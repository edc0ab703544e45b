"""What the prints of all cycles together say of the mesh that prints right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import rms_length, weighted_rms
from mdf_core.geometry import Array, Design
from mdf_core.prints import FEWEST_COMMON, Prints
from mdf_core.rigid import best_rigid_fit, transform

_SAME_WAY = 0.5  # cosine between two shifts; that of two that chance makes is rarely above
_TOO_FAR = 1.7  # times the RMS length that is expected of chance


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the prints so far say of the mesh that prints right, one entry per vertex.

    Attributes
    ----------
    wanted : (n, 3) float64, mm
        Where its vertices are.
    error : (n,) float64, mm
        RMS length by which that may be off, the variation from print to print aside; inf: not known.
    prints : (n,) float64
        How many prints' mean it is; less than their number where some weighed more; 0: none.
    variation : float, mm
        RMS variation from print to print; NaN: not known.
    """

    wanted: Array
    error: Array
    prints: Array
    variation: float

    @property
    def most_prints(self) -> float:
        """`prints` where most of them show the part."""
        return float(self.prints.max())

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Where it is known how far it may be off, (n,)."""
        return np.isfinite(self.error)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A mesh that is printed, and what the prints before it say.

    Attributes
    ----------
    vertices : (n, 3) float64, mm
    before : (n, 3) float64, mm
        Of the mesh that was printed before it.
    evidence : Evidence
    """

    vertices: Array
    before: Array
    evidence: Evidence

    @classmethod
    def unknown(cls, vertices: Array) -> Estimate:
        """A mesh of which no more than its `vertices` (n, 3), mm, is known."""
        count = len(vertices)
        return cls(vertices, vertices, Evidence(vertices, np.full(count, np.inf), np.zeros(count), float("nan")))


@dataclass(frozen=True, eq=False)
class Update:
    """What new prints change about the evidence.

    Attributes
    ----------
    evidence : Evidence
        With them.
    standard_error : (n,) float64, mm
        Of its `wanted` (RMS length of the error vector), the variation included; NaN: not known.
    lasting : float, mm
        RMS length of what the new prints show that chance does not explain: the last move fell short, or the printer
        has changed; 0: nothing.
    """

    evidence: Evidence
    standard_error: Array
    lasting: float


def update(printed: Estimate, prints: Prints, asked: Array, design: Design) -> Update:
    """Weigh what new prints show against what was known before them.

    Parameters
    ----------
    printed : Estimate
        The mesh that was printed.
    prints : Prints
        What its prints show against the design.
    asked : (n, 3) float64, mm
        Where these prints alone want the vertices.
    design : Design

    Returns
    -------
    Update

    Notes
    -----
    Source: Kalman 1960, one step for each vertex. Without it every cycle would follow the chance of its own prints, and
    that is worse than leaving the mesh alone (Deming 1986, funnel experiment, rule 2). A single print does not show the
    variation, but its distance from what the prints before foretold does, as far as that is chance; what lasts makes
    the new prints count more. Cost O(n).
    """
    before, seen, known = printed.evidence, prints.supported, printed.evidence.is_known
    error, count = np.where(known, before.error, 0.0), np.where(known, before.prints, 1.0)
    areas = design.vertex_areas * (seen & known)
    news = _aligned(asked, before.wanted, areas) - before.wanted
    lasting = _lasting(printed, prints, news, areas)
    variation = _variation(before, prints, news, lasting, areas)
    chance = 0.0 if np.isnan(variation) else variation**2
    counts = np.maximum(prints.counts, 1)
    new = prints.standard_error**2 + (chance if np.isnan(prints.variation) else 0.0)
    old = error**2 + chance / count + lasting**2
    weight = np.divide(old, old + new, out=np.ones(len(new)), where=known & (old + new > 0))
    kept = np.where(known, 1.0 - weight, 0.0)
    measuring = np.nan_to_num(np.maximum(new - chance / counts, 0.0), nan=np.inf)
    evidence = Evidence(
        wanted=np.where((seen | ~known)[:, None], before.wanted + weight[:, None] * news, before.wanted),
        error=np.where(seen, np.sqrt((kept * error) ** 2 + weight**2 * measuring), before.error),
        prints=np.where(seen, 1.0 / (kept**2 / count + weight**2 / counts), before.prints),
        variation=variation,
    )
    return Update(evidence, np.sqrt(weight * new), lasting)


def largest_residual(printed: Estimate, prints: Prints, design: Design) -> float:
    """RMS displacement of prints that what was known before them still explains, mm; NaN: not known. As `update`."""
    evidence = printed.evidence
    areas = design.vertex_areas * (prints.supported & evidence.is_known)
    left = rms_length(evidence.wanted - printed.vertices, areas)
    return float(np.hypot(left, _TOO_FAR * _chance(evidence, prints, areas)))


def _aligned(asked: Array, wanted: Array, areas: Array) -> Array:
    """The `asked` vertices (n, 3) with the datum of the `wanted` ones, fitted over the `areas` (n,).

    Every inspection has a datum of its own, fitted to what its scan saw.
    """
    if (areas > 0).sum() < FEWEST_COMMON:
        return asked
    return transform(best_rigid_fit(asked, wanted, areas), asked)


def _lasting(printed: Estimate, prints: Prints, news: Array, areas: Array) -> float:
    """RMS length of that part of the `news` (n, 3) which is no chance, over the `areas` (n,)."""
    if not areas.any():
        return 0.0
    move = printed.vertices - printed.before
    size, last = (rms_length(shift, areas) for shift in (news, move))
    along = float(np.average((news * move).sum(axis=1), weights=areas))
    if along > _SAME_WAY * size * last:
        return along / last
    chance = _chance(printed.evidence, prints, areas)
    return float(np.sqrt(size**2 - chance**2)) if size > _TOO_FAR * chance else 0.0


def _chance(before: Evidence, prints: Prints, areas: Array) -> float:
    """RMS length that news may have by chance, as far as that was known before; NaN: not known."""
    at = areas > 0
    expected = before.error[at] ** 2 + prints.standard_error[at] ** 2
    # A variation that few differences tell may well be larger.
    variation = before.variation**2 * (1.0 + 1.0 / max(_differences(before), 1.0))
    expected += variation * (1.0 / before.prints[at] + np.isnan(prints.variation))
    return weighted_rms(expected, areas[at])


def _variation(before: Evidence, prints: Prints, news: Array, lasting: float, areas: Array) -> float:
    """From print to print, of all cycles: that between the new prints, or what a single one shows beside those before.

    Every cycle counts by how many differences between prints it knows.
    """
    at = areas > 0
    differences, more = _differences(before), max(prints.count - 1.0, 1.0)
    if np.isfinite(prints.variation):
        found = prints.variation**2
    elif at.any():
        excess = ((news**2).sum(axis=1) - before.error**2 - prints.standard_error**2)[at]
        lift = 1.0 + np.average(1.0 / before.prints[at], weights=areas[at])
        found = max(float(np.average(excess, weights=areas[at])) - lasting**2, 0.0) / lift
    else:
        found = float("nan")
    if np.isnan(found) or np.isnan(before.variation):
        return before.variation if np.isnan(found) else float(np.sqrt(found))
    return float(np.sqrt((differences * before.variation**2 + more * found) / (differences + more)))


def _differences(before: Evidence) -> float:
    """How many independent differences between prints the variation is known from."""
    return max(before.most_prints - 1.0, 0.0)
