"""Averages with weights, and such that outliers hardly move them."""

import numpy as np
import pytest

from mdf_core.averages import robust_sigma, weighted_median, weighted_rms


def test_a_tenth_of_outliers_hardly_moves_the_standard_deviation(rng):
    values = 0.02 * rng.normal(size=20_000)
    assert robust_sigma(values) == pytest.approx(0.02, rel=0.02)
    values[:2_000] = 1e6
    assert robust_sigma(values) == pytest.approx(0.02, rel=0.2)
    assert robust_sigma(np.array([-3.0])) == 3.0 * 1.4826


@pytest.mark.parametrize("seed", range(5))
def test_a_weight_counts_as_so_many_copies(seed):
    rng = np.random.default_rng(seed)
    values, weights = rng.normal(size=21), rng.integers(0, 6, 21)
    copies = np.repeat(values, weights)
    assert weighted_median(values, weights) == np.sort(copies)[(len(copies) - 1) // 2]
    assert weighted_rms(values**2, weights) == pytest.approx(np.sqrt((copies**2).mean()), rel=1e-14)


def test_what_has_no_weight_does_not_count_even_if_it_is_unknown():
    assert weighted_rms(np.array([9.0, np.nan, 25.0]), np.array([1.0, 0.0, 1.0])) == np.sqrt(17.0)
    assert np.isnan(weighted_rms(np.array([1.0, np.nan]), np.zeros(2)))
