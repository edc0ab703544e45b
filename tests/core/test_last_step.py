"""Every point of a large scan has its say in the end, though the iterations work on few."""

import numpy as np
import pytest

import mdf_core as mdf
from mdf_core import last_step
from mdf_core.errors import CancelledError
from mdf_core.virtual_cell import ScannerSettings, scan_part

POINTS = 100_000
FEW = {"thinning.target_points": 5_000}
KNOWN = {"pose.initial": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}


@pytest.fixture(scope="module")
def large(print_and_scan):
    return print_and_scan("bracket", points=POINTS, scan_seed=3, pose="identity")


@pytest.fixture(scope="module")
def whole(large):
    return large.inspect(FEW | KNOWN)


def test_all_points_tell_more_than_the_few_that_are_kept(large, whole, measured):
    few = print_of_few(large)
    alone = mdf.inspect(large.design, few, mdf.Settings().replace(KNOWN))
    measured("few_points", large.fraction_unrecovered(alone))
    measured("all_points", large.fraction_unrecovered(whole))
    assert large.fraction_unrecovered(whole) < 0.7 * large.fraction_unrecovered(alone)
    assert large.fraction_unrecovered(whole) < 0.008


def print_of_few(large):
    return large.scan.take(np.random.default_rng(0).permutation(POINTS)[:5_000])


def test_the_standard_deviation_knows_how_many_points_there_were(large, whole):
    alone = mdf.inspect(large.design, print_of_few(large), mdf.Settings().replace(KNOWN))
    assert np.median(whole.std) < 0.5 * np.median(alone.std)


def test_the_size_of_the_chunks_does_not_matter(large, whole, monkeypatch):
    monkeypatch.setattr(last_step, "_CHUNK", 7_001)
    again = large.inspect(FEW | KNOWN | {"memory_mib": 2_047})  # another setting: no result that is known already
    np.testing.assert_allclose(again.displacement, whole.displacement, atol=1e-7)


def test_outliers_of_the_whole_scan_do_not_count(print_and_scan, whole):
    clean = print_and_scan("bracket", points=POINTS, scan_seed=3, pose="identity", outlier_share=0.0)
    found = clean.inspect(FEW | KNOWN)
    apart = np.linalg.norm(found.displacement - whole.displacement, axis=1)
    assert np.sqrt((apart**2).mean()) < 0.015


def test_a_point_far_away_does_no_harm(large, whole):
    points = large.scan.points.copy()
    points[11] = (65_535.0, -1e9, 0.0)
    scan = mdf.PointSet(points, large.scan.normals)
    found = mdf.inspect(large.design, scan, mdf.Settings().replace(FEW | KNOWN))
    assert large.fraction_unrecovered(found) < 1.3 * large.fraction_unrecovered(whole)


def test_a_perfect_print_scanned_without_noise_is_found_perfect(large):
    design = large.design
    scan = scan_part(
        design.vertices, design.faces, ScannerSettings(points=30_000, noise_mm=0.0, outlier_share=0.0)
    ).scan
    found = mdf.inspect(design, scan, mdf.Settings().replace(FEW | KNOWN))
    assert np.abs(found.displacement).max() < 1e-3


def test_the_last_step_can_be_cancelled(large):
    def cancel(step):
        if step.stage == "surface" and step.iteration == 0 and step.fraction > 0.9:
            raise CancelledError("stopped")

    with pytest.raises(CancelledError, match="stopped"):
        mdf.inspect(large.design, large.scan, mdf.Settings().replace(FEW | KNOWN), cancel)
