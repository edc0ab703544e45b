"""Between the vertices of the design a print may have bent, as all real ones do, or not, as simulated ones do not."""

import numpy as np
import pytest
import trimesh

import mdf_core as mdf
from mdf_core import last_step
from mdf_core.design_motion import DesignMotion
from mdf_core.design_surface import DesignSurface, spread_samples
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import CancelledError
from mdf_core.facets import BentFacets, FlatFacets
from mdf_core.geometry import Design
from mdf_core.kernel import low_rank_basis
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.subdivision import subdivided
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part

POSED = {"pose.initial": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
CLEAN = ScannerSettings(points=8_000, noise_mm=0.0, outlier_share=0.0)


@pytest.fixture(scope="module")
def coarse():
    """The bracket with triangles that a warp is seen to bend."""
    return build_part("bracket")


@pytest.fixture(scope="module")
def warp(coarse):
    return Warp(coarse, 2.0, 50.0, 4)


def unrecovered(coarse, warp, printed):
    """What is missed of the warp from a scan without noise of that mesh, warped vertex by vertex."""
    scan = scan_part(printed.vertices + warp(printed.vertices), printed.faces, CLEAN, 0).scan
    found = mdf.inspect(coarse, scan, mdf.Settings().replace(POSED))
    return fraction_unrecovered(coarse, warp(coarse.vertices), found.displacement, found.supported)


def test_a_print_whose_facets_stay_flat_is_measured_as_such(coarse, warp, measured, monkeypatch):
    flat = unrecovered(coarse, warp, coarse)
    monkeypatch.setattr(last_step, "_TELLING", np.inf)
    bent = unrecovered(coarse, warp, coarse)
    measured("flat", flat)
    measured("bent", bent)
    assert flat < 0.001 and flat < 0.5 * bent


def test_a_print_that_bends_between_the_vertices_is_measured_as_such(coarse, warp, measured, monkeypatch):
    fine = subdivided(coarse, 0.9)
    bent = unrecovered(coarse, warp, fine)
    monkeypatch.setattr(DesignMotion, "misfit", lambda motion: isinstance(motion.equations.facets, BentFacets))
    flat = unrecovered(coarse, warp, fine)
    measured("flat", flat)
    measured("bent", bent)
    assert bent < 0.002 and bent < 0.5 * flat


@pytest.mark.parametrize("noise_mm", [0.0, 0.002])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_creases_of_a_sheet_make_nobody_sure_of_what_happened_in_its_plane(sheet, seed, noise_mm, measured):
    warp = Warp(sheet, 2.0, 50.0, seed)
    scanner = ScannerSettings(points=6_000, noise_mm=noise_mm)
    scan = scan_part(sheet.vertices + warp(sheet.vertices), sheet.faces, scanner, 0).scan
    settings = mdf.Settings().replace(POSED | {"verdict.tolerance_mm": 1.8})
    found = mdf.inspect(sheet, scan, settings)
    printed = sheet.vertices + warp(sheet.vertices)
    moved = sheet.vertices + found.displacement
    motion = best_rigid_fit(moved, printed, sheet.vertex_areas)
    errors = np.linalg.norm(transform(motion, moved) - printed, axis=1)
    measured("std_over_error", np.sqrt((found.std**2).mean() / (errors**2).mean()))
    assert 0.8 < np.sqrt((found.std**2).mean() / (errors**2).mean()) < 8.0  # less sure than need be is no harm
    assert found.verdict[0] is not mdf.Verdict.PASS


def test_what_the_basis_cannot_follow_is_not_taken_for_a_lack_of_noise(coarse, warp):
    dent = np.exp(-0.5 * ((coarse.vertices - coarse.vertices[1_000]) ** 2).sum(axis=1) / 6.0**2)
    displacement = warp(coarse.vertices) + 0.3 * dent[:, None]
    scan = scan_part(coarse.vertices + displacement, coarse.faces, CLEAN, 0).scan
    found = mdf.inspect(coarse, scan, mdf.Settings().replace(POSED))
    assert np.median(found.std) > 5e-4  # a scan without noise of the warp alone is known to a tenth of that


def test_progress_is_told_while_facets_and_noise_are_found_out(coarse, warp):
    scan = scan_part(coarse.vertices + warp(coarse.vertices), coarse.faces, CLEAN, 0).scan

    def cancel(step):
        if step.stage == "surface" and step.iteration == 0 and step.fraction > 0.9:
            raise CancelledError("stopped")

    with pytest.raises(CancelledError, match="stopped"):
        mdf.inspect(coarse, scan, mdf.Settings().replace(POSED), cancel)


@pytest.fixture(scope="module")
def block():
    """With edges of up to 12 mm."""
    mesh = trimesh.creation.box((90.0, 60.0, 30.0))
    return subdivided(Design(mesh.vertices, mesh.faces, "block.stl", "hash"), 12.0)


def flat_facets(design, feet):
    return FlatFacets.below(DesignSurface(design).closest(feet), design, design)


def test_where_nothing_bends_both_are_the_same(block):
    feet, _ = spread_samples(block, 500)
    basis = low_rank_basis(feet, 50.0, 20)
    origin = np.zeros(3)
    flat = flat_facets(block, feet).features(basis, origin, 40.0)
    bent = BentFacets(feet).features(basis, origin, 40.0)
    np.testing.assert_allclose(flat[:, 20:], bent[:, 20:], atol=1e-12)  # what is affine
    assert 0.0 < np.abs(flat[:, :20] - bent[:, :20]).max() < 0.1


def test_the_places_are_where_they_were_asked_for(block):
    feet, _ = spread_samples(block, 500)
    flat = flat_facets(block, feet)
    np.testing.assert_allclose(flat.places(), feet, atol=1e-9)


def test_at_the_vertices_both_are_the_same(block):
    basis = low_rank_basis(block.vertices, 50.0, 20)
    origin = np.zeros(3)
    flat = flat_facets(block, block.vertices).features(basis, origin, 40.0)
    np.testing.assert_allclose(flat, BentFacets(block.vertices).features(basis, origin, 40.0), atol=1e-10)
