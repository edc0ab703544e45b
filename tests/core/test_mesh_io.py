"""What designs and scans have in common as files, STL as it is written, and what is left out of points."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import FACES, VERTICES, ply, write

from mdf_core.errors import DesignFileError, InvalidSettingError, ScanFileError
from mdf_core.geometry import Design
from mdf_core.mesh_io import has_return, load_design, load_scan, stl_bytes, unit_normals


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0), ("inch", 25.4)])
def test_the_declared_unit_becomes_millimetres(tmp_path: Path, unit: str, factor: float) -> None:
    path = write(tmp_path, "part.ply", ply(VERTICES, FACES))
    np.testing.assert_array_equal(load_design(path, unit).vertices, VERTICES * factor)
    scan = load_scan(path, unit)
    np.testing.assert_array_equal(scan.points, VERTICES * factor)
    assert scan.areas is not None
    assert scan.areas.sum() == pytest.approx(Design(VERTICES, FACES).face_areas.sum() * factor**2)


@pytest.mark.parametrize("load", [load_design, load_scan])
def test_an_unknown_unit_is_refused_before_the_file_is_touched(tmp_path: Path, load: object) -> None:
    with pytest.raises(InvalidSettingError, match="unknown unit 'feet'"):
        load(tmp_path / "missing.stl", "feet")  # type: ignore[operator]


@pytest.mark.parametrize(("load", "error"), [(load_design, DesignFileError), (load_scan, ScanFileError)])
def test_missing_files_folders_and_unknown_types_are_told_apart(tmp_path: Path, load: object, error: type) -> None:
    (tmp_path / "folder.stl").mkdir()
    (tmp_path / "part.step").write_bytes(b"ISO-10303-21;")
    (tmp_path / "part").write_bytes(b"solid")
    for name, told in {
        "missing.stl": "No such file or directory",
        "folder.stl": "Is a directory",
        "part.step": r"unknown file type '\.step'; use one of \.stl, \.ply, \.obj",
        "part": "unknown file type ''",
    }.items():
        with pytest.raises(error, match=told):
            load(str(tmp_path / name))  # type: ignore[operator]


def test_unit_normals_have_length_one_or_zero() -> None:
    np.testing.assert_array_equal(unit_normals(np.array([[3.0, 0, 0], [0, 0, 0]])), [[1, 0, 0], [0, 0, 0]])
    assert unit_normals(np.zeros((3, 3))) is None


def test_a_normal_that_is_not_finite_is_none() -> None:
    """Estimators give NaN to points with too few neighbours: no reason to refuse the others."""
    result = unit_normals(np.array([[0.0, 2.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]))
    np.testing.assert_array_equal(result, [[0, 1, 0], [0, 0, 0], [0, 0, 0]])
    assert unit_normals(np.full((3, 3), np.nan)) is None


def test_only_points_that_are_nan_throughout_have_no_return() -> None:
    points = np.array([[0.0, 0, 0], [np.nan, np.nan, np.nan], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert has_return(points).tolist() == [True, False, True, True]
    assert has_return(points[:0]).shape == (0,)


def test_the_same_mesh_gives_the_same_stl() -> None:
    content = stl_bytes(VERTICES, FACES)
    assert content == stl_bytes(VERTICES.copy(), FACES.astype(np.int32))
    assert content[:80] == b"mdf_core binary STL, millimetres".ljust(80)
    assert len(content) == 84 + 50 * len(FACES)


def test_a_written_stl_is_read_by_others_with_its_normals() -> None:
    rng = np.random.default_rng(0)
    sphere = trimesh.creation.icosphere(2, 30.0)
    vertices = sphere.vertices + rng.normal(size=sphere.vertices.shape)
    loaded = trimesh.load_mesh(io.BytesIO(stl_bytes(vertices, sphere.faces)), file_type="stl", process=False)
    np.testing.assert_array_equal(loaded.triangles, vertices.astype(np.float32)[sphere.faces])
    written = np.frombuffer(stl_bytes(vertices, sphere.faces)[84:], "u1").reshape(-1, 50)[:, :12].copy().view("<f4")
    np.testing.assert_allclose(written, Design(vertices, sphere.faces).face_normals, atol=1e-6)


def test_a_written_stl_is_read_back_with_the_same_faces(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(3, 30.0)
    vertices = np.asarray(sphere.vertices, np.float32).astype(float)
    design = load_design(write(tmp_path, "part.stl", stl_bytes(vertices, sphere.faces)))
    np.testing.assert_array_equal(design.triangles, vertices[sphere.faces])
    assert len(design.vertices) == len(vertices)
    again = load_design(write(tmp_path, "again.stl", stl_bytes(design.vertices, design.faces)))
    np.testing.assert_array_equal(again.vertices, design.vertices)
    np.testing.assert_array_equal(again.faces, design.faces)


def test_degenerate_faces_are_written_with_a_zero_normal() -> None:
    content = stl_bytes(VERTICES, np.array([[0, 0, 1]]))
    assert content[84:96] == bytes(12)


def test_a_mesh_without_faces_is_a_valid_empty_stl() -> None:
    assert len(stl_bytes(VERTICES, FACES[:0])) == 84
