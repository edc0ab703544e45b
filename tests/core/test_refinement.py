"""Designs with triangles that are too large for the distortion: told, and made finer."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import mdf_core as mdf
from mdf_core.coarseness import coarseness
from mdf_core.distortion import distortion_left
from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Design
from mdf_core.inspection import Verdict
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.subdivision import subdivided
from mdf_core.virtual_cell import PARTS, ScannerSettings, Warp, build_part, scan_part

POSED = {"pose.initial": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "verdict.tolerance_mm": 2.0}


@pytest.fixture(scope="module")
def block():
    """As CAD exports it: twelve triangles."""
    mesh = trimesh.creation.box((100.0, 60.0, 30.0))
    return Design(mesh.vertices + np.array([20.0, 10.0, 5.0]), mesh.faces, "block.stl", "hash")


@pytest.fixture(scope="module")
def warp(block):
    return Warp(subdivided(block, 4.0), 1.5, 50.0, 1)


@pytest.fixture(scope="module")
def scan(block, warp):
    fine = subdivided(block, 4.0)
    return scan_part(fine.vertices + warp(fine.vertices), fine.faces, ScannerSettings(points=8_000), 0).scan


def test_refined_it_is_the_same_surface_with_short_edges(block):
    fine = subdivided(block, 5.0)
    mesh = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    assert mesh.is_watertight and mesh.edges_unique_length.max() <= 5.0
    assert mesh.volume == pytest.approx(100.0 * 60.0 * 30.0) and mesh.area == pytest.approx(block.face_areas.sum())
    np.testing.assert_array_equal(fine.vertices[: len(block.vertices)], block.vertices)
    assert (fine.path, fine.file_sha256) == ("block.stl", "hash")
    assert subdivided(block, 0.0) is block


def test_a_file_is_loaded_as_fine_as_it_is_asked_for(block, tmp_path):
    path = tmp_path / "block.stl"
    path.write_bytes(stl_bytes(block.vertices, block.faces))
    coarse, fine = load_design(path, "cm"), load_design(path, "cm", longest_edge_mm=50.0)
    wanted = subdivided(coarse, 50.0)
    assert len(coarse.faces) == 12 < len(fine.faces)
    np.testing.assert_array_equal(fine.vertices, wanted.vertices)
    np.testing.assert_array_equal(fine.faces, wanted.faces)
    assert (fine.path, fine.file_sha256) == (coarse.path, coarse.file_sha256)
    np.testing.assert_array_equal(load_design(path, "cm", longest_edge_mm=0.0).faces, coarse.faces)


@pytest.mark.parametrize("length", [-1.0, np.nan])
def test_an_edge_of_no_length_is_refused(block, tmp_path, length):
    path = tmp_path / "block.stl"
    path.write_bytes(stl_bytes(block.vertices, block.faces))
    with pytest.raises(InvalidSettingError, match=r"design\.longest_edge_mm"):
        load_design(path, longest_edge_mm=length)


def test_a_coarse_design_is_told_and_never_passes_on_its_corners_alone(block, scan):
    inspection = mdf.inspect(block, scan, mdf.Settings().replace(POSED))
    assert "design.longest_edge_mm" in coarseness(inspection)
    corners, between = inspection.max_displacement, inspection.face_displacement.max()
    finer = mdf.inspect(subdivided(block, 6.0), scan, mdf.Settings().replace(POSED))
    assert corners < 0.9 * finer.max_displacement < between
    for tolerance, wanted in ((1.2 * corners, Verdict.NO_DECISION), (1.05 * between, Verdict.PASS)):
        judged = replace(inspection, settings=inspection.settings.replace({"verdict.tolerance_mm": tolerance}))
        assert judged.verdict[0] is wanted


def test_refined_it_is_measured_and_redesigned_as_any_other(block, warp, scan):
    fine = subdivided(block, 6.0)
    inspection = mdf.inspect(fine, scan, mdf.Settings().replace(POSED))
    assert coarseness(inspection) == "" and inspection.verdict[0] is Verdict.PASS
    vertices = mdf.compensate(fine, [inspection]).vertices
    before = distortion_left(fine, fine.vertices + warp(fine.vertices))[0]
    # How a flat face moves along itself no scan shows.
    assert distortion_left(fine, vertices + warp(vertices))[0] < 0.5 * before


@pytest.mark.parametrize("part", PARTS)
def test_ordinary_meshes_are_fine_enough(part):
    design = build_part(part)
    warp = Warp(design, 2.5, 35.0, 0)
    scan = scan_part(design.vertices + warp(design.vertices), design.faces, ScannerSettings(points=3_000), 0).scan
    inspection = mdf.inspect(design, scan, mdf.Settings().replace(POSED | {"surface.beta": (1.0,)}))
    assert inspection.mesh_error < 0.01 * inspection.rms_displacement and coarseness(inspection) == ""


def test_too_many_triangles_are_refused_before_they_are_made(block):
    with pytest.raises(InvalidSettingError, match="triangles"):
        subdivided(block, 0.01)
