from __future__ import annotations

import numpy as np
import pytest

from mdf_core.errors import InvalidSettingError
from mdf_core.units import UNITS, metres_to_millimetres, millimetres_per, millimetres_to_metres, to_millimetres


@pytest.mark.parametrize(("unit", "millimetres"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0), ("inch", 25.4)])
def test_every_unit_has_its_length(unit: str, millimetres: float) -> None:
    assert millimetres_per(unit) == millimetres
    np.testing.assert_array_equal(to_millimetres(np.array([[1.0, -2.0]]), unit), [[millimetres, -2.0 * millimetres]])


def test_these_are_all_units() -> None:
    assert UNITS == ("mm", "cm", "m", "inch")


def test_an_unknown_unit_is_refused_with_the_list_of_known_ones() -> None:
    with pytest.raises(InvalidSettingError, match=r"unit: unknown unit 'furlong'; use one of mm, cm, m, inch"):
        millimetres_per("furlong")


def test_millimetres_are_float64_whatever_comes_in() -> None:
    assert to_millimetres(np.float32([1.5]), "mm").dtype == np.float64
    assert metres_to_millimetres(np.float32([1.5])).dtype == np.float64


@pytest.mark.parametrize(("power", "factor"), [(1, 1e3), (2, 1e6)])
def test_metres_and_millimetres_convert_both_ways(power: int, factor: float) -> None:
    values = np.array([0.0, 0.25, -3.0])
    np.testing.assert_array_equal(metres_to_millimetres(values, power), values * factor)
    np.testing.assert_array_equal(millimetres_to_metres(metres_to_millimetres(values, power), power), values)
