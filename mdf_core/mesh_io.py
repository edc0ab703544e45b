"""Design and scan files in, STL out: the only place where file formats and their units are known."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl

from mdf_core.errors import (
    DegenerateDesignError,
    DesignFileError,
    InvalidSettingError,
    MdfError,
    NonFiniteScanError,
    ScanFileError,
)
from mdf_core.geometry import Array, Design, PointSet, crosses_of, unit_vectors
from mdf_core.point_table import point_columns, read_point_text
from mdf_core.subdivision import subdivided
from mdf_core.units import millimetres_per, to_millimetres

Faces = NDArray[np.int64]

_STL_HEADER = b"mdf_core binary STL, millimetres".ljust(80)
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_PREFIX_BYTES = 84  # header and triangle count

# Names of units in 3MF files (core specification 3.4.1, and what trimesh says for a file that names none).
_UNIT_OF_3MF = {"millimeter": "mm", "millimeters": "mm", "centimeter": "cm", "inch": "inch", "meter": "m"}


def load_design(path: str | Path, unit: str = "mm", *, longest_edge_mm: float = 0.0) -> Design:
    """Read a design: STL (binary or ASCII), PLY, OBJ or 3MF.

    Vertices and faces keep the order of the file. STL has no vertices of its own: corners with equal coordinates become
    one vertex, numbered in order of first appearance, without any tolerance. Duplicate and degenerate faces stay.
    Faces with more than three corners are split into triangles; the bodies of a 3MF build are placed and joined. The
    corners of a closed mesh that is inside out are taken the other way round, so that faces look outward.

    Parameters
    ----------
    path : str or Path
    unit : str
        Unit of the file's coordinates, one of `mdf_core.units.UNITS`. A 3MF file names its own, which must agree.
    longest_edge_mm : float, optional
        Triangles with longer edges are split, as the setting ``design.longest_edge_mm`` does elsewhere: the surface
        stays the same, the vertices of the file come first, in their order. 0: the triangles stay as they are.

    Returns
    -------
    Design
        In mm, with the SHA-256 of the file's bytes.

    Raises
    ------
    DesignFileError
        Missing, a folder, unreadable, cut short, corrupt, or of an unknown type.
    DegenerateDesignError
        No triangles, or none with an area.
    InvalidSettingError
        An unknown unit, or one that contradicts the file's own; `longest_edge_mm` is negative or NaN, or so short that
        there would be more than 4 million triangles.
    """
    path = Path(path)
    millimetres_per(unit)
    readers = {".stl": _read_stl, ".ply": _read_ply, ".obj": _read_obj, ".3mf": _read_3mf(path, unit)}
    content, (vertices, faces, _) = _read(path, readers, DesignFileError)
    design = Design(to_millimetres(vertices, unit), faces, str(path), hashlib.sha256(content).hexdigest())
    outward = replace(design, faces=design.faces[:, ::-1]) if _is_inside_out(design) else design
    return subdivided(outward, longest_edge_mm)


def load_scan(path: str | Path, unit: str = "mm") -> PointSet:
    """Read a scan: a mesh (STL, PLY, OBJ) or points (PLY, OBJ, PCD, NPY, and text as XYZ, ASC, PTS, TXT or CSV).

    - Mesh: its vertices, with area-weighted vertex normals and a third of the area of the faces around each vertex.
      Vertices without an area (no face uses them) are left out.
    - PLY points: with nx ny nz if present. PCD points: with normal_x normal_y normal_z if present; points that are NaN
      in all of x, y, z are left out, because that is how organised clouds say "no return".
    - Text: columns x y z and, if present, nx ny nz, by a line of column names or told apart from intensity and colours
      as `mdf_core.point_table` says. NPY: an array of such columns without names.

    Parameters
    ----------
    path : str or Path
    unit : str
        Unit of the file's coordinates, one of `mdf_core.units.UNITS`.

    Returns
    -------
    PointSet
        In mm.

    Raises
    ------
    ScanFileError
        Missing, a folder, unreadable, cut short, corrupt, without x, y and z, or of an unknown type.
    EmptyScanError
        No points.
    NonFiniteScanError
        NaN or infinite values.
    InvalidSettingError
        An unknown unit.
    """
    return load_scan_and_hash(path, unit)[0]


def load_scan_and_hash(path: str | Path, unit: str = "mm") -> tuple[PointSet, str]:
    """A scan as `load_scan` reads it, and the SHA-256 of the file's bytes.

    Parameters
    ----------
    path, unit
        As of `load_scan`.

    Returns
    -------
    PointSet
        In mm.
    str
        Of the very bytes that were read: the file may be another at any time.

    Raises
    ------
    ScanFileError, EmptyScanError, NonFiniteScanError, InvalidSettingError
        As `load_scan`.
    """
    path = Path(path)
    millimetres_per(unit)
    content, (raw_vertices, faces, normals) = _read(path, _SCAN_READERS, ScanFileError)
    scan = PointSet(to_millimetres(raw_vertices, unit), None if normals is None else unit_normals(normals))
    digest = hashlib.sha256(content).hexdigest()
    return (scan if len(faces) == 0 else _scan_of_mesh(scan.points, faces, path)), digest


def stl_bytes(vertices: Array, faces: NDArray[np.integer]) -> bytes:
    """A mesh as binary STL; the same mesh gives the same bytes.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int
    """
    triangles = np.zeros(len(faces), _STL_TRIANGLE)
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    triangles["corners"] = corners
    triangles["normal"] = unit_vectors(crosses_of(corners))
    return _STL_HEADER + len(faces).to_bytes(4, "little") + triangles.tobytes()


def stl_coordinates(vertices: Array) -> Array:
    """Vertices (n, 3) mm as a binary STL holds them, in float32; what that cannot hold becomes infinite."""
    with np.errstate(over="ignore"):
        return vertices.astype(np.float32).astype(np.float64)


def unit_normals(normals: NDArray[np.floating]) -> Array | None:
    """Normals (n, D) at unit length, zero where they are zero, NaN or infinite; None if not one has a length.

    Drivers that declare normals and do not compute them send zeros; where a point has too few neighbours, many send
    NaN.
    """
    normals = np.asarray(normals, dtype=np.float64)
    result = unit_vectors(np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0))
    return result if len(result) == 0 or result.any() else None


def has_return(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which points (n, D) of an organised cloud the scanner measured: those that are not NaN in every coordinate, (n,).

    Raises
    ------
    NonFiniteScanError
        There are points and not one was measured.
    """
    measured: NDArray[np.bool_] = ~np.isnan(points).all(axis=1)
    if len(points) and not measured.any():
        raise NonFiniteScanError(
            f"all {len(points)} points are NaN", "scan", "check that the part is within the scanner's range"
        )
    return measured


# A reader takes the file's bytes and returns vertices (n, 3), faces (f, 3), possibly none, and normals (n, 3) or None.
_Raw = tuple[NDArray[np.floating], Faces, NDArray[np.floating] | None]
_Reader = Callable[[bytes], _Raw]
_NO_FACES: Faces = np.empty((0, 3), dtype=np.int64)


def _read(path: Path, readers: Mapping[str, _Reader], error_class: type[MdfError]) -> tuple[bytes, _Raw]:
    """The file's bytes and what its reader makes of them; whatever a reader raises becomes `error_class`."""
    reader = readers.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(readers)
        raise error_class(f"unknown file type {path.suffix!r}", str(path), f"use one of {known}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise error_class(f"cannot read the file: {error.strerror}", str(path), "check the path") from error
    if not content:
        raise error_class("the file has no bytes", str(path), "export it again")
    try:
        return content, reader(content)
    except MdfError:
        raise
    except Exception as error:  # readers fail in many ways on broken files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise error_class(
            f"not a readable {path.suffix[1:].upper()} file: {reason}", str(path), "export it again"
        ) from error


def _read_stl(content: bytes) -> _Raw:
    announced = int.from_bytes(content[80:_STL_PREFIX_BYTES], "little")
    is_binary = len(content) == _STL_PREFIX_BYTES + announced * _STL_TRIANGLE.itemsize
    is_text = content.lstrip()[:5].lower() == b"solid" and b"endsolid" in content.lower()
    if not is_binary and not is_text:
        raise ValueError(
            f"cut short or no STL: the header announces {announced} triangles, "
            f"the file has room for {max(len(content) - _STL_PREFIX_BYTES, 0) / _STL_TRIANGLE.itemsize:g}"
        )
    loaded = load_stl(io.BytesIO(content))
    solids = [loaded] if "vertices" in loaded else list(loaded["geometry"].values())
    corners = np.concatenate([np.empty((0, 3)), *(solid["vertices"] for solid in solids)])
    expected = announced if is_binary else content.lower().count(b"endfacet")
    if len(corners) != 3 * expected:
        raise ValueError(f"{expected} facets with {len(corners)} readable corners")
    vertices, faces = _merge_equal(corners)
    return vertices, faces.reshape(-1, 3), None


def _merge_equal(points: Array) -> tuple[Array, Faces]:
    """Distinct points in order of first appearance, and for every point the index of its like."""
    points = points + 0.0  # -0.0 equals 0.0
    order = np.lexsort(points.T)
    in_order = points[order]
    starts_group = np.ones(len(points), dtype=bool)
    starts_group[1:] = (in_order[1:] != in_order[:-1]).any(axis=1)
    # The sort is stable: every group starts with its first appearance.
    first = np.empty(len(points), dtype=np.int64)
    first[order] = order[starts_group][np.cumsum(starts_group) - 1]
    appears_first = first == np.arange(len(points))
    return points[appears_first], (np.cumsum(appears_first) - 1)[first]


def _is_inside_out(design: Design) -> bool:
    """Whether the mesh is closed and its faces, taken together, look inward; a cavity's own faces rightly do."""
    if design.face_volumes.sum() >= 0:
        return False
    starts, ends = design.faces.ravel(), np.roll(design.faces, -1, axis=1).ravel()
    count = len(design.vertices)
    # Of a closed mesh every edge is passed as often one way as the other.
    return bool((np.sort(starts * count + ends) == np.sort(ends * count + starts)).all())


def _read_ply(content: bytes) -> _Raw:
    # fix_texture would split vertices along the seams of a texture.
    loaded: dict[str, Any] = load_ply(io.BytesIO(content), fix_texture=False, skip_materials=True)
    elements = loaded["metadata"]["_ply_raw"]
    vertices = np.asarray(loaded.get("vertices", np.empty((0, 3))))
    faces = trimesh.geometry.triangulate_quads(loaded.get("faces", _NO_FACES)).reshape(-1, 3)
    for name, count in (("vertex", len(vertices)), ("face", len(faces))):
        announced = elements.get(name, {"length": 0})["length"]
        if count < announced:
            raise ValueError(f"cut short: {announced} of element {name} announced, {count} found")
    return vertices, faces, loaded.get("vertex_normals")


def _read_obj(content: bytes) -> _Raw:
    # trimesh splits vertices along the seams of textures and normals, and reorders faces by material; here the order of
    # the file is part of the result.
    vertices: list[list[str]] = []
    corners_of: list[tuple[int, int, int]] = []
    for line in content.decode("utf-8", "replace").replace("\\\n", " ").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append(words[1:4])
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/", 1)[0]) for word in words[1:]]
            if 0 in numbers or len(numbers) < 3:
                raise ValueError(f"bad face {line.strip()!r}")
            corners = [number - 1 if number > 0 else len(vertices) + number for number in numbers]
            corners_of.extend(zip(corners[:1] * (len(corners) - 2), corners[1:], corners[2:], strict=False))
    if not vertices:
        raise ValueError("no vertices")
    return np.array(vertices, dtype=np.float64), np.array(corners_of, dtype=np.int64).reshape(-1, 3), None


def _read_3mf(path: Path, unit: str) -> _Reader:
    def reader(content: bytes) -> _Raw:
        scene = trimesh.load_scene(io.BytesIO(content), file_type="3mf", process=False)
        own_unit = scene.metadata["units"]
        if _UNIT_OF_3MF.get(own_unit) != unit:
            remedy = f"declare {_UNIT_OF_3MF[own_unit]}" if own_unit in _UNIT_OF_3MF else "export it in millimetres"
            raise InvalidSettingError(f"declared in {unit}, but the file says {own_unit}", str(path), remedy)
        mesh = scene.to_mesh()
        return mesh.vertices.view(np.ndarray), mesh.faces.view(np.ndarray), None

    return reader


def _read_pcd(content: bytes) -> _Raw:
    from pypcd4 import PointCloud  # pulls in pydantic, which only PCD files should pay for

    cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(content)))  # type: ignore[arg-type]
    data = np.atleast_1d(cloud.pc_data)
    if len(data) != cloud.metadata.points:
        raise ValueError(f"cut short: {cloud.metadata.points} points announced, {len(data)} found")
    points = _columns(data, ("x", "y", "z"))
    if points is None:
        raise ValueError(f"no x, y and z among the fields {', '.join(cloud.fields)}")
    measured = has_return(points)
    normals = _columns(data, ("normal_x", "normal_y", "normal_z"))
    return points[measured], _NO_FACES, None if normals is None else normals[measured]


def _columns(data: NDArray[np.void], names: tuple[str, ...]) -> Array | None:
    present = data.dtype.names or ()
    if any(name not in present for name in names):
        return None
    return np.column_stack([data[name].astype(np.float64) for name in names])


def _read_text(content: bytes) -> _Raw:
    points, normals = read_point_text(content)
    return points, _NO_FACES, normals


def _read_npy(content: bytes) -> _Raw:
    points, normals = point_columns(np.load(io.BytesIO(content), allow_pickle=False))
    return points, _NO_FACES, normals


def _scan_of_mesh(vertices: Array, faces: Faces, path: Path) -> PointSet:
    try:
        mesh = Design(vertices, faces)
    except DegenerateDesignError as error:
        raise ScanFileError(error.what, str(path), "export the scan as a triangle mesh or as points") from error
    return PointSet(vertices, mesh.vertex_normals, mesh.vertex_areas).take(mesh.vertex_areas > 0)


_SCAN_READERS: Mapping[str, _Reader] = {
    ".stl": _read_stl,
    ".ply": _read_ply,
    ".obj": _read_obj,
    ".pcd": _read_pcd,
    ".xyz": _read_text,
    ".asc": _read_text,
    ".pts": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
    ".npy": _read_npy,
}
SCAN_FILE_TYPES = tuple(_SCAN_READERS)
"""Suffixes of the files that `load_scan` reads."""
