"""Errors that neighbouring points share are told from the distortion, and bumps from a bend; others lose nothing."""

import numpy as np
import pytest
from poses import IN_PLACE

import mdf_core as mdf
from mdf_core import last_step
from mdf_core.averages import rms_length
from mdf_core.distortion import fraction_unrecovered
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.virtual_cell import ScannerSettings, Warp, scan_part


@pytest.fixture(scope="module")
def never():
    """Function: an inspection with one motion of one width, whatever is evident; made once for equal arguments."""
    made = {}

    def inspect(one, **changes):
        key = one, tuple(sorted(changes.items()))
        if key not in made:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(last_step, "with_evident_prior", lambda found, *_: found)
                settings = mdf.Settings().replace({"pose.initial": one.pose_numbers} | changes)
                made[key] = mdf.inspect(one.design, one.scan, settings)
        return made[key]

    return inspect


def std_over_error(one, found):
    weights = one.design.vertex_areas * found.supported
    true, moved = one.design.vertices + one.displacement, one.design.vertices + found.displacement
    errors = transform(best_rigid_fit(moved, true, weights), moved) - true
    return np.sqrt(np.average(found.std**2, weights=weights)) / rms_length(errors, weights)


@pytest.mark.parametrize(("name", "length_mm"), [("bracket", 12.0), ("bracket", 40.0), ("hub", 20.0)])
def test_a_ripple_of_the_scanner_does_not_pass_for_a_rough_motion(name, length_mm, print_and_scan, never, measured):
    one = print_and_scan(name, warp_mm=1.0, points=10_000, ripple_mm=0.03, ripple_length_mm=length_mm)
    found, without = one.inspect(), never(one)
    measured("missed", one.fraction_unrecovered(found))
    measured("missed_without", one.fraction_unrecovered(without))
    measured("std_over_error", std_over_error(one, found))
    assert one.fraction_unrecovered(found) < 0.08
    assert one.fraction_unrecovered(found) < 0.5 * one.fraction_unrecovered(without)
    assert 0.5 < std_over_error(one, found) < 2.0


@pytest.mark.parametrize(
    ("name", "length_mm", "points"),
    [("bracket", 50.0, 10_000), ("bracket", 50.0, 60_000), ("hub", 35.0, 60_000), ("clip", 20.0, 10_000)],
)
def test_a_scan_without_such_errors_is_measured_to_the_bit_as_before(name, length_mm, points, print_and_scan, never):
    one = print_and_scan(name, length_mm=length_mm, points=points)
    found, without = one.inspect(), never(one)
    np.testing.assert_array_equal(found.displacement, without.displacement)
    np.testing.assert_array_equal(found.std, without.std)


@pytest.mark.parametrize(("name", "bump_mm", "length_mm"), [("hub", 0.5, 20.0), ("housing", 0.4, 15.0)])
def test_a_bend_with_bumps_is_no_motion_of_one_width(name, bump_mm, length_mm, build, measured, monkeypatch):
    design, scanner = build(name), ScannerSettings(points=20_000)
    displacement = sum(Warp(design, *each)(design.vertices) for each in ((2.0, 60.0, 3), (bump_mm, length_mm, 53)))
    scan = scan_part(design.vertices + displacement, design.faces, scanner).scan
    settings = mdf.Settings().replace({"pose.initial": IN_PLACE})
    found = mdf.inspect(design, scan, settings)
    monkeypatch.setattr(last_step, "with_evident_prior", lambda found, *_: found)
    missed, without = (
        fraction_unrecovered(design, displacement, each.displacement)
        for each in (found, mdf.inspect(design, scan, settings))
    )
    measured("missed", missed)
    measured("missed_without", without)
    assert np.unique(found.deformation.basis.width).size == 2
    assert missed < 0.8 * without


def test_all_points_of_a_large_scan_have_their_say_beside_the_offset(print_and_scan, measured):
    few, many = (print_and_scan(warp_mm=1.0, points=points, ripple_mm=0.03) for points in (5_000, 50_000))
    missed = [one.fraction_unrecovered(one.inspect({"thinning.target_points": 5_000})) for one in (few, many)]
    measured("of_5000", missed[0])
    measured("of_50000", missed[1])
    assert missed[1] < 0.8 * missed[0]


def test_what_the_scan_lies_off_by_is_told_and_no_motion_hides_it(print_and_scan, never):
    one = print_and_scan("bracket", warp_mm=1.0, points=10_000, ripple_mm=0.03, ripple_length_mm=12.0)
    found, without = one.inspect(), never(one)
    assert found.residual_scale == pytest.approx(0.02, rel=0.1)
    assert 0.04 < found.unexplained.max() < 0.2
    assert (found.unexplained > 0).mean() > 2.0 * (without.unexplained > 0).mean()


def test_an_error_of_a_sheet_that_is_seen_from_one_side_stays_a_bend_of_the_sheet(sheet):
    warp = Warp(sheet, 2.0, 50.0, 1)
    scanner = ScannerSettings(points=6_000, ripple_mm=0.03)
    printed = sheet.vertices + warp(sheet.vertices)
    scan = scan_part(printed, sheet.faces, scanner).scan
    found = mdf.inspect(sheet, scan, mdf.Settings().replace({"pose.initial": IN_PLACE}))
    bend = (transform(best_rigid_fit(printed, sheet.vertices), printed) - sheet.vertices)[:, 2]
    assert np.std(found.displacement[:, 2] - bend) < 0.2 * np.std(bend)


def test_a_stiffness_that_the_user_gives_is_kept(print_and_scan, never, measured):
    one = print_and_scan(warp_mm=1.0, points=10_000, ripple_mm=0.03)
    given = {"surface.alpha": 3_000.0, "surface.beta": (1.4,)}
    found, without = one.inspect(given), never(one, **given)
    measured("missed", one.fraction_unrecovered(found))
    measured("missed_without", one.fraction_unrecovered(without))
    assert found.deformation.basis.width == pytest.approx(1.4 * one.design.scale)
    assert one.fraction_unrecovered(found) < one.fraction_unrecovered(without)
