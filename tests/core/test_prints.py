"""Several prints: what they have in common, what varies, and how well that is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mdf_core.errors import DesignMismatchError, NoInspectionError
from mdf_core.prints import combine_prints
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.virtual_cell import Printer, Warp, build_part


@dataclass
class Measured:
    displacement: np.ndarray
    inverse_displacement: np.ndarray
    std: np.ndarray
    supported: np.ndarray


@pytest.fixture(scope="module")
def design():
    return build_part("bracket")


@pytest.fixture(scope="module")
def printer(design):
    return Printer(Warp(design, 1.5, 50.0, 3), variation=0.1)


def printed(design, printer, seed=None, std=0.0, supported=None):
    """What a perfect inspection of a print would say."""
    displacement = printer.print_part(design.vertices, seed) - design.vertices
    count = len(displacement)
    supported = np.ones(count, dtype=bool) if supported is None else supported
    return Measured(displacement, -displacement, np.full(count, std), supported)


def rms(design, vectors):
    return np.sqrt(np.average((vectors**2).reshape(len(design.vertices), -1).sum(axis=1), weights=design.vertex_areas))


def test_one_print_is_its_own_mean_and_its_variation_is_not_known(design, printer):
    one = printed(design, printer, std=0.02)
    prints = combine_prints(design, [one])
    np.testing.assert_allclose(prints.displacement, one.displacement, atol=1e-12)
    np.testing.assert_allclose(prints.inverse_displacement, one.inverse_displacement, atol=1e-12)
    np.testing.assert_allclose(prints.standard_error, 0.02)
    assert np.isnan(prints.variation) and np.isnan(prints.random).all() and prints.count == 1


@pytest.mark.parametrize("count", [3, 8])
def test_the_mean_comes_closer_to_the_printer_and_says_how_close(design, printer, count):
    truth = printer.print_part(design.vertices) - design.vertices
    errors, said = [], []
    for trial in range(12):
        prints = combine_prints(design, [printed(design, printer, 100 * trial + k) for k in range(count)])
        errors.append(rms(design, prints.displacement - truth))
        said.append(rms(design, prints.standard_error))
    error, expected = np.sqrt(np.mean(np.square(errors))), 0.1 * printer.warp.rms_mm / np.sqrt(count)
    assert error == pytest.approx(expected, rel=0.2)
    assert np.mean(said) == pytest.approx(error, rel=0.3)


def test_the_variation_is_found_with_the_measuring_error_taken_out(design, printer, rng):
    prints = [printed(design, printer, seed, std=0.1) for seed in range(10)]
    for one in prints:
        one.displacement = one.displacement + rng.normal(scale=0.1 / np.sqrt(3), size=one.displacement.shape)
    found = combine_prints(design, prints)
    assert found.variation == pytest.approx(0.1 * printer.warp.rms_mm, rel=0.15)
    assert rms(design, found.random) == pytest.approx(np.hypot(0.1 * printer.warp.rms_mm, 0.1), rel=0.15)


def test_a_print_that_is_known_better_weighs_more(design, printer):
    good, poor = printed(design, printer, std=0.01), printed(design, printer, std=0.1)
    off = np.sin(design.vertices / 2.0)  # nothing that an alignment could take for a motion
    poor = replace(poor, displacement=poor.displacement + 0.01 * off, inverse_displacement=poor.inverse_displacement)
    found = combine_prints(design, [good, poor]).displacement - good.displacement
    assert rms(design, found) < 0.1 * rms(design, 0.01 * off)


def test_a_corner_that_varies_more_is_known_less(design, printer, rng):
    corner = np.linalg.norm(design.vertices - [100.0, 50.0, 0.0], axis=1) < 30.0
    prints = []
    for _ in range(6):
        one = printed(design, printer)
        one.displacement[corner] += 0.5 * rng.normal(size=3)
        prints.append(one)
    found = combine_prints(design, prints)
    # What a corner does moves the alignment of the rest a little.
    assert np.median(found.standard_error[corner]) > 0.15
    assert np.median(found.random[corner]) > 4.0 * np.median(found.random[~corner])


def test_prints_seen_from_different_sides_fit_together(design, printer):
    """Each inspection's datum is that of what it saw; at the seam there is no step."""
    middle = np.median(design.vertices[:, 0])
    truth = printer.print_part(design.vertices) - design.vertices
    seen = [design.vertices[:, 0] < middle + 25.0, design.vertices[:, 0] > middle - 25.0]
    prints = []
    for supported in seen:
        there = design.vertices + truth
        datum = best_rigid_fit(there, design.vertices, design.vertex_areas * supported)
        displacement = transform(datum, there) - design.vertices
        prints.append(Measured(displacement, -displacement, np.full(len(there), 0.01), supported))
    apart = rms(design, prints[0].displacement - prints[1].displacement)
    found = combine_prints(design, prints)
    both = seen[0] & seen[1]
    assert apart > 0.1
    assert np.nanmax(found.random[both]) < 0.01 * apart
    error = design.vertices + found.displacement
    left = transform(best_rigid_fit(error, design.vertices + truth), error) - design.vertices - truth
    assert rms(design, left) < 0.01 * apart


def test_what_no_print_supports_is_the_mean_of_the_extrapolations(design, printer):
    nowhere = np.zeros(len(design.vertices), dtype=bool)
    nowhere[:1000] = True
    prints = [printed(design, printer, seed, 0.02, ~nowhere) for seed in range(2)]
    found = combine_prints(design, prints)
    np.testing.assert_array_equal(found.supported, ~nowhere)
    assert np.isfinite(found.displacement).all() and np.isnan(found.random[nowhere]).all()


def test_without_std_the_spread_alone_says_how_well_the_mean_is_known(design, printer):
    unknown = [printed(design, printer, seed, np.nan) for seed in range(3)]
    assert np.isnan(combine_prints(design, unknown[:1]).standard_error).all()
    found = combine_prints(design, unknown)
    np.testing.assert_allclose(
        found.displacement, np.mean([one.displacement for one in unknown], axis=0), atol=0.02 * printer.warp.rms_mm
    )
    assert np.isfinite(found.standard_error).all()


def test_the_order_of_the_prints_does_not_matter(design, printer):
    prints = [printed(design, printer, seed, 0.01 * (seed + 1)) for seed in range(4)]
    one, other = combine_prints(design, prints), combine_prints(design, prints[::-1])
    np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-12)
    np.testing.assert_allclose(one.standard_error, other.standard_error, atol=1e-12)


def test_nothing_and_another_design_are_refused(design, printer):
    with pytest.raises(NoInspectionError):
        combine_prints(design, [])
    with pytest.raises(DesignMismatchError):
        combine_prints(build_part("clip"), [printed(design, printer)])
