"""Scan files: points, normals and areas as they are in the file, and errors that name it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import EMPTY_DESIGNS, FACES, VERTICES, obj, ply, write
from pypcd4 import Encoding, PointCloud

from mdf_core.errors import EmptyScanError, NonFiniteScanError, ScanFileError
from mdf_core.mesh_io import load_scan, stl_bytes


def test_a_scanned_mesh_gives_vertices_with_areas_and_outward_normals(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(3, 20.0)
    vertices, faces = np.asarray(sphere.vertices, np.float32).astype(float), sphere.faces
    files = {
        "a.stl": stl_bytes(vertices, faces),
        "b.ply": ply(vertices, faces, "binary_little_endian"),
        "c.obj": obj(vertices, faces).encode(),
    }
    for name, content in files.items():
        scan = load_scan(write(tmp_path, name, content))
        assert len(scan) == len(vertices)
        assert {*map(tuple, scan.points)} == {*map(tuple, vertices)}
        assert scan.areas is not None
        assert scan.normals is not None
        assert scan.areas.sum() == pytest.approx(sphere.area, rel=1e-6)
        np.testing.assert_allclose(scan.normals, scan.points / 20.0, atol=0.02)
        np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1.0)


def test_normals_of_a_scanned_mesh_are_weighted_by_area(tmp_path: Path) -> None:
    # A corner between a face of 2 mm² across z and one of 1 mm² across x.
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1]])
    scan = load_scan(write(tmp_path, "scan.ply", ply(vertices, np.array([[0, 1, 2], [0, 2, 3]]))))
    np.testing.assert_allclose(scan.normals[0], np.array([1.0, 0.0, 2.0]) / np.sqrt(5.0))
    np.testing.assert_allclose(scan.areas, [1.0, 2 / 3, 1.0, 1 / 3])


def test_vertices_that_no_face_uses_are_no_scan_points(tmp_path: Path) -> None:
    vertices = np.vstack([VERTICES, [99.0, 99.0, 99.0]])
    scan = load_scan(write(tmp_path, "scan.ply", ply(vertices, FACES)))
    np.testing.assert_array_equal(scan.points, VERTICES)


NORMALS = np.array([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
BOTH = np.hstack([VERTICES, NORMALS])


def npy(table: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, table)
    return buffer.getvalue()


def pcd(table: np.ndarray, encoding: Encoding, dtype: type = np.float32, names: str = "") -> bytes:
    fields = names.split() or ["x", "y", "z", "normal_x", "normal_y", "normal_z"][: table.shape[1]]
    buffer = io.BytesIO()
    PointCloud.from_points(table.astype(dtype), fields, [dtype] * len(fields)).save(buffer, encoding)
    return buffer.getvalue()


def text(table: np.ndarray, separator: str = " ", head: str = "") -> bytes:
    return (head + "".join(separator.join(map(repr, map(float, row))) + "\n" for row in table)).encode()


def point_files(table: np.ndarray) -> dict[str, bytes]:
    names = ["x", "y", "z", "nx", "ny", "nz"][: table.shape[1]]
    return {
        "ascii.ply": ply(table, None),
        "binary.ply": ply(table, None, "binary_little_endian"),
        "ascii.pcd": pcd(table, Encoding.ASCII),
        "binary.pcd": pcd(table, Encoding.BINARY),
        "compressed.pcd": pcd(table, Encoding.BINARY_COMPRESSED),
        "double.pcd": pcd(table, Encoding.BINARY, np.float64),
        "spaces.xyz": text(table),
        "tabs.txt": text(table, "\t", "# made by a scanner\n\n"),
        "commas.csv": text(table, ",", ",".join(names) + "\n"),
        "semicolons.csv": text(table, "; "),
        "slashes.txt": text(table, " ", "//X Y Z\n"),
        "bom.csv": text(table, ",", "\ufeffx,y,z\n"),
        "double.npy": npy(table),
        "single.npy": npy(table.astype(np.float32)),
    }


@pytest.mark.parametrize("name", point_files(VERTICES))
def test_points_are_read_from_every_format(tmp_path: Path, name: str) -> None:
    scan = load_scan(write(tmp_path, name, point_files(VERTICES)[name]))
    np.testing.assert_array_equal(scan.points, VERTICES)
    assert scan.normals is None
    assert scan.areas is None


@pytest.mark.parametrize("name", point_files(BOTH))
def test_normals_are_read_from_every_format(tmp_path: Path, name: str) -> None:
    scan = load_scan(write(tmp_path, name, point_files(BOTH)[name]), "cm")
    np.testing.assert_array_equal(scan.points, VERTICES * 10.0)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-7)


def test_points_of_an_obj_are_read(tmp_path: Path) -> None:
    scan = load_scan(write(tmp_path, "scan.obj", obj(VERTICES, FACES[:0])))
    np.testing.assert_array_equal(scan.points, VERTICES)


def test_other_fields_of_a_pcd_are_ignored(tmp_path: Path) -> None:
    content = pcd(VERTICES[:, [2, 0, 1, 0]], Encoding.BINARY, names="z x y intensity")
    np.testing.assert_array_equal(load_scan(write(tmp_path, "scan.pcd", content)).points, VERTICES)


@pytest.mark.parametrize("encoding", list(Encoding)[:3])
def test_pixels_without_return_are_left_out_of_a_pcd(tmp_path: Path, encoding: Encoding) -> None:
    table = np.vstack([BOTH[:2], np.full(6, np.nan), BOTH[2:]])
    scan = load_scan(write(tmp_path, "scan.pcd", pcd(table, encoding)))
    np.testing.assert_array_equal(scan.points, VERTICES)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-7)


def test_half_a_nan_in_a_pcd_is_an_error(tmp_path: Path) -> None:
    table = VERTICES.copy()
    table[2, 1] = np.nan
    with pytest.raises(NonFiniteScanError, match="1 of 4 points are NaN or infinite, the first at index 2"):
        load_scan(write(tmp_path, "scan.pcd", pcd(table, Encoding.BINARY)))


def test_a_pcd_without_any_return_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(NonFiniteScanError, match="all 4 points are NaN"):
        load_scan(write(tmp_path, "scan.pcd", pcd(np.full((4, 3), np.nan), Encoding.BINARY)))


@pytest.mark.parametrize("name", ["ascii.ply", "binary.ply", "spaces.xyz", "commas.csv", "double.npy"])
def test_nan_in_any_other_file_is_an_error(tmp_path: Path, name: str) -> None:
    table = VERTICES.copy()
    table[1] = np.nan
    with pytest.raises(NonFiniteScanError, match="1 of 4 points are NaN or infinite, the first at index 1"):
        load_scan(write(tmp_path, name, point_files(table)[name]))


def test_nan_in_a_scanned_mesh_is_an_error(tmp_path: Path) -> None:
    vertices = np.where(VERTICES == 8.0, np.nan, VERTICES)
    with pytest.raises(NonFiniteScanError):
        load_scan(write(tmp_path, "scan.stl", stl_bytes(vertices, FACES)))


@pytest.mark.parametrize(
    "name", ["ascii.ply", "binary.ply", "ascii.pcd", "binary.pcd", "commas.csv", "tabs.txt", "double.npy"]
)
def test_a_file_without_points_is_an_empty_scan(tmp_path: Path, name: str) -> None:
    with pytest.raises(EmptyScanError):
        load_scan(write(tmp_path, name, point_files(VERTICES[:0])[name]))


@pytest.mark.parametrize("name", ["binary.stl", "ascii.stl"])
def test_a_mesh_file_without_triangles_is_an_empty_scan(tmp_path: Path, name: str) -> None:
    with pytest.raises(EmptyScanError):
        load_scan(write(tmp_path, name, EMPTY_DESIGNS[name]))


def test_one_point_is_read_as_one_point(tmp_path: Path) -> None:
    for name, content in point_files(VERTICES[:1]).items():
        np.testing.assert_array_equal(load_scan(write(tmp_path, name, content)).points, VERTICES[:1])


BROKEN_SCANS = {
    "cut.pcd": pcd(VERTICES, Encoding.BINARY)[:-12],
    "cut within a point.pcd": pcd(VERTICES, Encoding.BINARY)[:-5],
    "cut compressed.pcd": pcd(VERTICES, Encoding.BINARY_COMPRESSED)[:-5],
    "cut ascii.pcd": b"\n".join(pcd(VERTICES, Encoding.ASCII).splitlines()[:-1]),
    "no position.pcd": pcd(VERTICES, Encoding.BINARY, names="x y range"),
    "header only.pcd": b"VERSION 0.7\nFIELDS x y z\n",
    "bytes.pcd": bytes(range(256)),
    "two columns.xyz": text(VERTICES[:, :2]),
    "neither normals nor colours.xyz": text(np.hstack([VERTICES, 2.0 * NORMALS])),
    "one column too many.xyz": text(np.hstack([BOTH, VERTICES[:, :2]])),
    "fewer than announced.pts": b"5\n" + text(VERTICES),
    "ragged.xyz": text(VERTICES) + b"1 2\n",
    "words.txt": b"x y z\n1 2 3\nfour five six\n",
    "prose.txt": b"The part was scanned on Monday.\nIt was cold.\n",
    "bytes.xyz": bytes(range(256)),
    "two decimal commas.txt": text(VERTICES[:, :2]).replace(b".", b","),
    "cut.npy": npy(VERTICES)[:-8],
    "bytes.npy": bytes(range(256)),
    "five columns.npy": npy(np.ones((5, 5))),
    "flat.npy": npy(np.ones(12)),
    "complex.npy": npy(VERTICES.astype(complex)),
    "objects.npy": npy(np.array([[None] * 3] * 4)),
    "no position.ply": ply(VERTICES, None).replace(b"double z", b"double w"),
    "no area.stl": stl_bytes(VERTICES, np.array([[0, 0, 1], [2, 2, 2]])),
    "vertex that is not there.ply": ply(VERTICES, FACES + 1),
}


@pytest.mark.parametrize("name", BROKEN_SCANS)
def test_a_broken_scan_is_an_error_that_names_the_file(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name, BROKEN_SCANS[name])
    with pytest.raises(ScanFileError) as caught:
        load_scan(path)
    assert caught.value.where == str(path)
    assert caught.value.remedy


def test_large_files_are_read(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-100.0, 100.0, (200_000, 3)).astype(np.float32)
    for name, content in {
        "scan.npy": npy(points),
        "scan.pcd": pcd(points, Encoding.BINARY),
        "scan.xyz": text(points),
        "scan.ply": ply(points, None, "binary_little_endian"),
    }.items():
        np.testing.assert_array_equal(load_scan(write(tmp_path, name, content)).points, points)
