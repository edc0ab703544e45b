"""Whether a scan can be of the declared unit: its size beside the design's."""

from __future__ import annotations

import numpy as np

from mdf_core.averages import weighted_median
from mdf_core.design_surface import spread_samples
from mdf_core.errors import UnitMismatchError
from mdf_core.geometry import Array, Design, PointSet

_LIKELY_FACTORS = {1000.0: "metres against millimetres", 25.4: "inches against millimetres", 10.0: "centimetres"}
_FACTOR_SLACK = 1.3
_RANGE = (0.5, 2.0)  # a scan with a hidden side may well seem smaller or larger
_SAMPLES = 5_000
_MOST_AREA = 5.0  # of the median: an outlier stands for much


def check_size(scan: PointSet, design: Design) -> None:
    """Refuse a scan whose unit cannot be the declared one.

    Parameters
    ----------
    scan : PointSet
        Prepared: with areas.
    design : Design

    Raises
    ------
    UnitMismatchError
        The median radius of the scan is not within 0.5 to 2 times the design's; with the factor and its likely cause.
    """
    samples, _ = spread_samples(design, _SAMPLES)
    assert scan.areas is not None, "the scan is prepared: it has areas"
    ratio = _median_radius(scan.points, scan.areas) / _median_radius(samples, np.ones(len(samples)))
    if _RANGE[0] <= ratio <= _RANGE[1]:
        return
    factor = ratio if ratio > 1 else 1.0 / ratio
    word = "larger" if ratio > 1 else "smaller"
    likely = [
        f" (about {known:g}: {name})"
        for known, name in _LIKELY_FACTORS.items()
        if known / _FACTOR_SLACK < factor < known * _FACTOR_SLACK
    ]
    raise UnitMismatchError(
        f"the scan is {factor:.4g} times {word} than the design{''.join(likely)}",
        "scan",
        "declare the unit of the scan and of the design, and check that the scan shows this part and nothing else, or "
        "crop it (crop.box_mm)",
    )


def _median_radius(points: Array, areas: Array) -> float:
    """Median distance from the median point, by area: neither outliers nor uneven density move it much."""
    weights = np.minimum(areas, _MOST_AREA * np.median(areas))
    centre = [weighted_median(coordinate, weights) for coordinate in points.T]
    return weighted_median(np.linalg.norm(points - centre, axis=1), weights)
