"""The one place where lengths change their unit.

The core computes in millimetres, ROS messages carry metres, files carry whatever unit is declared for them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdf_core.errors import InvalidSettingError

MILLIMETRES_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
"""Millimetres per declared unit."""

UNITS = tuple(MILLIMETRES_PER)
"""The units a file may be declared in."""


def millimetres_per(unit: str) -> float:
    """Length of one `unit` in mm.

    Raises
    ------
    InvalidSettingError
        The unit is not one of `UNITS`.
    """
    try:
        return MILLIMETRES_PER[unit]
    except KeyError:
        raise InvalidSettingError(f"unknown unit {unit!r}", "unit", f"use one of {', '.join(UNITS)}") from None


def to_millimetres(lengths: NDArray[np.floating], unit: str) -> NDArray[np.float64]:
    """Lengths of any shape, given in `unit`, as float64 mm."""
    return np.asarray(lengths, dtype=np.float64) * millimetres_per(unit)


def metres_to_millimetres(lengths: NDArray[np.floating], power: int = 1) -> NDArray[np.float64]:
    """Lengths (power 1) or areas (power 2) of any shape from metres to mm."""
    return np.asarray(lengths, dtype=np.float64) * 1000.0**power


def millimetres_to_metres(lengths: NDArray[np.floating], power: int = 1) -> NDArray[np.float64]:
    """Lengths (power 1) or areas (power 2) of any shape from mm to metres."""
    return np.asarray(lengths, dtype=np.float64) / 1000.0**power
