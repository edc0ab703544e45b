"""Several prints of one part: what they have in common, and what varies from print to print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import weighted_rms
from mdf_core.errors import DesignMismatchError, NoInspectionError
from mdf_core.geometry import Array, Design
from mdf_core.rigid import best_rigid_fit, transform

_ALIGNMENTS = 3  # each leaves a small share of the misfit before it
FEWEST_COMMON = 3
"""Vertices that two measurements must share for one to be aligned with the other."""


class MeasuredField(Protocol):
    """What is used of an inspection; see `Inspection`. All in mm, one entry per design vertex."""

    @property
    def displacement(self) -> Array: ...  # noqa: D102
    @property
    def inverse_displacement(self) -> Array: ...  # noqa: D102
    @property
    def std(self) -> Array: ...  # noqa: D102
    @property
    def supported(self) -> NDArray[np.bool_]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class Prints:
    """Displacement of the prints of one design, one entry per design vertex.

    Attributes
    ----------
    displacement : (n, 3) float64, mm
        The systematic part: weighted mean over the prints that support the vertex, or over all where none does.
    inverse_displacement : (n, 3) float64, mm
        The same of where the material at the vertex's nominal position belongs, minus that position.
    standard_error : (n,) float64, mm
        Of the mean (RMS length of the error vector); NaN: nothing is known, as of one print without a std.
    random : (n,) float64, mm
        Spread of the prints about their mean, measuring errors included; NaN where fewer than two support the vertex.
    variation : float, mm
        RMS variation from print to print over the part, measuring errors taken out; NaN of a single print.
    counts : (n,) int64
        How many prints support the vertex.
    count : int
        Of the prints.
    rms_displacement, rms_standard_error, rms_random : float, mm
        Over the supported surface where they are known, area-weighted; NaN: nowhere.
    """

    displacement: Array
    inverse_displacement: Array
    standard_error: Array
    random: Array
    variation: float
    counts: NDArray[np.int64]
    count: int
    rms_displacement: float
    rms_standard_error: float
    rms_random: float

    @property
    def supported(self) -> NDArray[np.bool_]:
        """By one print at least, (n,)."""
        return self.counts > 0


def combine_prints(design: Design, measured: Sequence[MeasuredField]) -> Prints:
    """Split what several prints of a design show into their systematic and their random part.

    Parameters
    ----------
    design : Design
    measured : sequence
        Inspections of prints of one and the same mesh.

    Returns
    -------
    Prints

    Raises
    ------
    NoInspectionError
        `measured` is empty.
    DesignMismatchError
        A field has another number of vertices than the design.

    Notes
    -----
    Every inspection has a datum of its own, fitted to what its scan saw: the prints are first aligned with each other.
    A print weighs 1 / (std² + variation²), and the variation comes from the moments: Source: DerSimonian & Laird 1986,
    random effects. The standard error is not below what the spread at the vertex itself says, so that a corner that
    varies more than the rest of the part is known to.
    """
    if not measured:
        raise NoInspectionError("nothing to compensate", "compensation", "inspect a scan first")
    for field in measured:
        if field.displacement.shape != design.vertices.shape:
            raise DesignMismatchError(
                f"a displacement of {len(field.displacement)} vertices for a design of {len(design.vertices)}",
                design.path or "design",
                "inspect a scan of this design",
            )
    supports = np.stack([field.supported for field in measured])
    displacements, inverses = _aligned(design, measured, supports)
    variances = np.stack([field.std for field in measured]) ** 2
    # Where no print reaches, the mean of the extrapolations is there for whoever blends into it.
    counted = supports | ~supports.any(axis=0)
    spread = _spread(displacements, supports)
    variation = _variation(design, spread, variances, supports)
    inner = np.nan_to_num(variances) + (variation**2 if np.isfinite(variation) else 0.0)
    least = np.finfo(np.float64).tiny
    weights = np.where(counted, 1.0 / np.maximum(inner, least), 0.0)
    if np.isnan(variances).any() or not inner.any():
        weights = counted.astype(np.float64)
    weights /= weights.sum(axis=0)
    random = np.sqrt(spread)
    displacement = np.einsum("kn,kni->ni", weights, displacements)
    standard_error = _standard_error(weights, variances, variation, random, supports)
    areas = design.vertex_areas * supports.any(axis=0)
    return Prints(
        displacement=displacement,
        inverse_displacement=np.einsum("kn,kni->ni", weights, inverses),
        standard_error=standard_error,
        random=random,
        variation=variation,
        counts=np.asarray(supports.sum(axis=0)),
        count=len(measured),
        rms_displacement=_rms(np.linalg.norm(displacement, axis=1), areas),
        rms_standard_error=_rms(standard_error, areas),
        rms_random=_rms(random, areas),
    )


def _rms(values: Array, areas: Array) -> float:
    return weighted_rms(values**2, areas * np.isfinite(values))


def _aligned(design: Design, measured: Sequence[MeasuredField], supports: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Displacements and inverse displacements with a common datum, (k, n, 3) each."""
    displacements = np.stack([field.displacement for field in measured])
    inverses = np.stack([field.inverse_displacement for field in measured])
    for _ in range(_ALIGNMENTS if len(measured) > 1 else 0):
        weights = np.where(supports, 1.0, 0.0) / np.maximum(supports.sum(axis=0), 1)
        mean = np.einsum("kn,kni->ni", weights, displacements)
        for number in range(len(measured)):
            common = supports[number] & (supports.sum(axis=0) > 1)
            if common.sum() < FEWEST_COMMON:
                continue
            printed = design.vertices + displacements[number]
            motion = best_rigid_fit(printed, design.vertices + mean, design.vertex_areas * common)
            displacements[number] = transform(motion, printed) - design.vertices
            inverses[number] -= transform(motion, design.vertices) - design.vertices
    return displacements, inverses


def _spread(displacements: Array, supports: NDArray[np.bool_]) -> Array:
    """Sample variance of the vectors at each vertex, (n,) mm²; NaN below two."""
    counts = supports.sum(axis=0)
    shares = supports / np.maximum(counts, 1)
    centred = displacements - np.einsum("kn,kni->ni", shares, displacements)
    squares = ((centred**2).sum(axis=2) * supports).sum(axis=0)
    variance: Array = np.divide(squares, counts - 1, out=np.full(len(squares), np.nan), where=counts > 1)
    return variance


def _variation(design: Design, spread: Array, variances: Array, supports: NDArray[np.bool_]) -> float:
    repeated = np.isfinite(spread) & (design.vertex_areas > 0)
    if not repeated.any():
        return float("nan")
    measuring = (np.nan_to_num(variances) * supports).sum(axis=0) / np.maximum(supports.sum(axis=0), 1)
    excess = np.average((spread - measuring)[repeated], weights=design.vertex_areas[repeated])
    return float(np.sqrt(max(excess, 0.0)))


def _standard_error(
    weights: Array, variances: Array, variation: float, random: Array, supports: NDArray[np.bool_]
) -> Array:
    total = variances if np.isnan(variation) else np.nan_to_num(variances) + variation**2
    expected = np.sqrt((weights**2 * np.where(weights > 0, total, 0.0)).sum(axis=0))
    seen = random / np.sqrt(np.maximum(supports.sum(axis=0), 1))
    larger: Array = np.fmax(expected, seen)
    return larger
