from __future__ import annotations

import hashlib
import io
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pypcd4 import Encoding, PointCloud

from mdf_core.errors import (
    DegenerateDesignError,
    DesignFileError,
    EmptyScanError,
    InvalidSettingError,
    NonFiniteScanError,
    ScanFileError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import has_return, load_design, load_scan, stl_bytes, unit_normals

# A tetrahedron whose coordinates are exact in float32 and in decimal text.
VERTICES = np.array([[0.5, 0.25, 0.0], [8.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 2.5]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def ascii_stl(vertices: np.ndarray, faces: np.ndarray, name: str = "part") -> str:
    lines = [f"solid {name}"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {!r} {!r} {!r}".format(*map(float, vertices[corner])) for corner in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""])


def obj(vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = ["v {} {} {}".format(*vertex) for vertex in vertices]
    return "\n".join(lines + ["f {} {} {}".format(*(face + 1)) for face in faces]) + "\n"


def ply(vertices: np.ndarray, faces: np.ndarray | None, encoding: str = "ascii", extra: str = "") -> bytes:
    header = f"ply\nformat {encoding} 1.0\nelement vertex {len(vertices)}\n"
    names = ("x", "y", "z", "nx", "ny", "nz")[: vertices.shape[1]]
    header += "".join(f"property double {name}\n" for name in names) + extra
    if faces is not None:
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    header += "end_header\n"
    faces = np.empty((0, 3), int) if faces is None else faces
    if encoding == "ascii":
        rows = [" ".join(map(repr, map(float, vertex))) for vertex in vertices]
        return (header + "\n".join(rows + ["3 {} {} {}".format(*face) for face in faces]) + "\n").encode()
    order = "<" if encoding == "binary_little_endian" else ">"
    packed = np.zeros(len(faces), [("count", "u1"), ("corners", order + "i4", 3)])
    packed["count"], packed["corners"] = 3, faces
    return header.encode() + vertices.astype(order + "f8").tobytes() + packed.tobytes()


def three_mf(unit: str | None = "millimeter", meshes: int = 1, faces: np.ndarray = FACES) -> bytes:
    """A 3MF file of tetrahedra, the second one shifted by (100, 0, 0)."""
    vertices = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*vertex) for vertex in VERTICES)
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*face) for face in faces)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    objects = f'<object id="1" type="model">{mesh}</object>'
    items = ['<item objectid="1"/>', '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 100 0 0"/>'][:meshes]
    namespace = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    attribute = "" if unit is None else f' unit="{unit}"'
    model = (
        f'<?xml version="1.0"?><model{attribute} xmlns="{namespace}">'
        f"<resources>{objects}</resources><build>{''.join(items)}</build></model>"
    )
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
    return buffer.getvalue()


def indexed_files() -> dict[str, bytes]:
    return {
        "ascii.ply": ply(VERTICES, FACES),
        "little.ply": ply(VERTICES, FACES, "binary_little_endian"),
        "big.ply": ply(VERTICES, FACES, "binary_big_endian"),
        "part.obj": obj(VERTICES, FACES).encode(),
        "part.3mf": three_mf(),
    }


# --- designs: what is read -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", indexed_files())
def test_indexed_formats_keep_vertices_and_faces_as_they_are(tmp_path: Path, name: str) -> None:
    content = indexed_files()[name]
    path = write(tmp_path, name, content)
    design = load_design(path)
    np.testing.assert_array_equal(design.vertices, VERTICES)
    np.testing.assert_array_equal(design.faces, FACES)
    assert design.path == str(path)
    assert design.file_sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize("content", [stl_bytes(VERTICES, FACES), ascii_stl(VERTICES, FACES)], ids=["binary", "ascii"])
def test_stl_corners_become_connected_vertices_in_order_of_appearance(tmp_path: Path, content: bytes) -> None:
    design = load_design(write(tmp_path, "part.STL", content))
    np.testing.assert_array_equal(design.vertices, VERTICES[[0, 2, 1, 3]])
    np.testing.assert_array_equal(design.triangles, VERTICES[FACES])
    assert trimesh.Trimesh(design.vertices, design.faces, process=False).is_watertight


def test_stl_corners_are_joined_without_any_tolerance(tmp_path: Path) -> None:
    triangles = np.zeros((2, 3, 3), np.float32)
    triangles[:, 1, 0], triangles[:, 2, 1] = 1.0, 1.0
    triangles[1, 1, 0] = np.nextafter(np.float32(1.0), np.float32(2.0))
    triangles[1, 0, 0] = -0.0
    design = load_design(write(tmp_path, "part.stl", stl_bytes(triangles.reshape(-1, 3), np.arange(6).reshape(2, 3))))
    assert design.faces.tolist() == [[0, 1, 2], [0, 3, 2]]
    assert design.vertices[3, 0] == 1.0 + 2.0**-23


def test_duplicate_and_degenerate_faces_keep_their_place(tmp_path: Path) -> None:
    faces = np.array([[0, 2, 1], [0, 0, 1], [0, 2, 1], [1, 2, 3]])
    for name, content in {
        "a.stl": stl_bytes(VERTICES, faces),
        "b.stl": ascii_stl(VERTICES, faces).encode(),
        "c.ply": ply(VERTICES, faces),
        "d.obj": obj(VERTICES, faces).encode(),
    }.items():
        design = load_design(write(tmp_path, name, content))
        np.testing.assert_array_equal(design.triangles, VERTICES[faces])


def test_unreferenced_and_repeated_vertices_of_indexed_formats_stay(tmp_path: Path) -> None:
    vertices = np.vstack([VERTICES[3], VERTICES, VERTICES[0]])
    for name, content in {"a.ply": ply(vertices, FACES + 1), "b.obj": obj(vertices, FACES + 1).encode()}.items():
        design = load_design(write(tmp_path, name, content))
        np.testing.assert_array_equal(design.vertices, vertices)
        np.testing.assert_array_equal(design.faces, FACES + 1)


def test_a_closed_mesh_that_is_inside_out_is_turned(tmp_path: Path) -> None:
    design = load_design(write(tmp_path, "part.ply", ply(VERTICES, FACES[:, ::-1])))
    assert (design.faces == FACES).all() and design.faces.flags.c_contiguous


@pytest.mark.parametrize("mesh", ["open", "a solid and its cavity"])
def test_faces_that_look_inward_for_a_reason_stay(tmp_path: Path, mesh: str) -> None:
    if mesh == "open":
        vertices, faces = VERTICES, FACES[1:, ::-1]
    else:
        vertices = np.vstack([VERTICES, 0.25 * VERTICES + 0.5])
        faces = np.vstack([FACES, FACES[:, ::-1] + len(VERTICES)])
    np.testing.assert_array_equal(load_design(write(tmp_path, "part.ply", ply(vertices, faces))).faces, faces)


def test_several_solids_of_an_ascii_stl_are_joined_in_order(tmp_path: Path) -> None:
    moved = VERTICES + np.array([100.0, 0.0, 0.0])
    path = write(tmp_path, "two.stl", ascii_stl(VERTICES, FACES, "b") + ascii_stl(moved, FACES, "a"))
    np.testing.assert_array_equal(load_design(path).triangles, np.concatenate([VERTICES[FACES], moved[FACES]]))


def test_a_binary_stl_may_begin_with_solid(tmp_path: Path) -> None:
    content = b"solid part".ljust(80) + stl_bytes(VERTICES, FACES)[80:]
    np.testing.assert_array_equal(load_design(write(tmp_path, "part.stl", content)).triangles, VERTICES[FACES])


def test_the_bodies_of_a_3mf_are_placed_and_joined(tmp_path: Path) -> None:
    design = load_design(write(tmp_path, "two.3mf", three_mf(meshes=2)))
    moved = VERTICES + np.array([100.0, 0.0, 0.0])
    np.testing.assert_array_equal(design.vertices, np.concatenate([VERTICES, moved]))
    np.testing.assert_array_equal(design.faces, np.concatenate([FACES, FACES + 4]))


OBJ_VARIANTS = {
    "texture and normal indices": ("vt 0 0\nvt 1 0\nvn 0 0 1\n", "f 1/1/1 3/2/1 2/1/1\nf 1/2/1 2/2/1 4/1/1\n"),
    "normal indices only": ("vn 0 0 1\nvn 1 0 0\n", "f 1//1 3//2 2//1\nf 1//2 2//2 4//1\n"),
    "counted from the end": ("", "f -4 -2 -3\nf -4 -3 -1\n"),
    "several materials": ("mtllib none.mtl\n", "usemtl b\nf 1 3 2\nusemtl a\nf 1 2 4\n"),
    "groups, objects, comments": ("# a comment\no part\ng one\ns off\n", "f 1 3 2\r\ng two\nf 1 2 \\\n4\n"),
}


@pytest.mark.parametrize("variant", OBJ_VARIANTS)
def test_obj_files_of_every_kind_keep_the_order_of_the_file(tmp_path: Path, variant: str) -> None:
    head, tail = OBJ_VARIANTS[variant]
    text = head + "".join("v {} {} {}\n".format(*vertex) for vertex in VERTICES) + tail
    design = load_design(write(tmp_path, "part.obj", text))
    np.testing.assert_array_equal(design.vertices, VERTICES)
    assert design.faces.tolist() == [[0, 2, 1], [0, 1, 3]]


def test_polygons_are_split_into_triangles_in_place(tmp_path: Path) -> None:
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv -1 .5 0\n"
    design = load_design(write(tmp_path, "part.obj", square + "f 1 2 3 4\nf 1 4 5\nf 1 2 3 4 5\n"))
    assert design.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    quads = b"".join(
        [
            b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n",
            b"element face 1\nproperty list uchar int vertex_index\nend_header\n",
            b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
        ]
    )
    assert load_design(write(tmp_path, "part.ply", quads)).face_areas.sum() == 1.0


def test_texture_coordinates_of_a_ply_do_not_split_vertices(tmp_path: Path) -> None:
    head, body = ply(VERTICES, FACES).decode().split("end_header\n")
    head = head.replace("property double z\n", "property double z\nproperty double s\nproperty double t\n")
    rows = body.splitlines()
    rows[:4] = [f"{row} 0.{index} 0.5" for index, row in enumerate(rows[:4])]
    design = load_design(write(tmp_path, "part.ply", head + "end_header\n" + "\n".join(rows) + "\n"))
    np.testing.assert_array_equal(design.vertices, VERTICES)
    np.testing.assert_array_equal(design.faces, FACES)


# --- units -----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("written", "unit", "factor"),
    [("inch", "inch", 25.4), ("meter", "m", 1000.0), ("centimeter", "cm", 10.0), (None, "mm", 1.0)],
)
def test_a_3mf_whose_unit_agrees_is_read_in_it(tmp_path: Path, written: str | None, unit: str, factor: float) -> None:
    path = write(tmp_path, "part.3mf", three_mf(written))
    np.testing.assert_array_equal(load_design(path, unit).vertices, VERTICES * factor)


@pytest.mark.parametrize(
    ("written", "declared", "remedy"),
    [
        ("inch", "mm", "declare inch"),
        ("millimeter", "m", "declare mm"),
        ("micron", "mm", "export it in millimetres"),
        ("foot", "inch", "export it in millimetres"),
    ],
)
def test_a_3mf_whose_unit_contradicts_is_refused_naming_both(
    tmp_path: Path, written: str, declared: str, remedy: str
) -> None:
    path = write(tmp_path, "part.3mf", three_mf(written))
    expected = f"^{re.escape(str(path))}: declared in {declared}, but the file says {written}; {remedy}$"
    with pytest.raises(InvalidSettingError, match=expected):
        load_design(path, declared)


# --- files that cannot be read ---------------------------------------------------------------------------------------


BROKEN_MESHES = {
    "no bytes.stl": b"",
    "no bytes.ply": b"",
    "no bytes.obj": b"",
    "cut in the header.stl": stl_bytes(VERTICES, FACES)[:50],
    "cut.stl": stl_bytes(VERTICES, FACES)[:-1],
    "longer than it says.stl": stl_bytes(VERTICES, FACES) + b"\0",
    "wrong count.stl": stl_bytes(VERTICES, FACES)[:80] + b"\x05\0\0\0" + stl_bytes(VERTICES, FACES)[84:],
    "cut ascii.stl": ascii_stl(VERTICES, FACES)[:400],
    "second solid cut.stl": ascii_stl(VERTICES, FACES) + ascii_stl(VERTICES, FACES)[:400],
    "words for numbers.stl": ascii_stl(VERTICES, FACES).replace("8.0", "eight"),
    "number missing.stl": ascii_stl(VERTICES, FACES).replace("vertex 8.0 0.0 0.0", "vertex 8.0 0.0"),
    "text.stl": b"this is no mesh",
    "bytes.stl": bytes(range(256)) * 3,
    "cut.ply": ply(VERTICES, FACES, "binary_little_endian")[:-3],
    "header only.ply": ply(VERTICES, FACES).split(b"end_header")[0],
    "cut after vertices.ply": b"\n".join(ply(VERTICES, FACES).splitlines()[:-4]),
    "cut within vertices.ply": b"\n".join(ply(VERTICES, FACES).splitlines()[:-6]),
    "face cut.ply": b"\n".join(ply(VERTICES, FACES).splitlines()[:-1]) + b"\n3 0 3",
    "bytes.ply": bytes(range(256)),
    "words for numbers.obj": obj(VERTICES, FACES).replace("8.0", "eight"),
    "number missing.obj": obj(VERTICES, FACES).replace("v 8.0 0.0 0.0", "v 8.0 0.0"),
    "face of two.obj": obj(VERTICES, FACES) + "f 1 2\n",
    "face of zero.obj": obj(VERTICES, FACES) + "f 0 1 2\n",
    "bytes.obj": bytes(range(256)),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # numpy.fromstring within trimesh, on broken text
@pytest.mark.parametrize("name", BROKEN_MESHES)
def test_a_broken_mesh_is_an_error_that_names_the_file(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name, BROKEN_MESHES[name])
    for load, error in ((load_design, DesignFileError), (load_scan, ScanFileError)):
        with pytest.raises(error) as caught:
            load(path)
        assert caught.value.where == str(path)
        assert caught.value.remedy


def test_a_cut_stl_tells_how_much_is_missing(tmp_path: Path) -> None:
    path = write(tmp_path, "part.stl", stl_bytes(VERTICES, FACES)[:-50])
    with pytest.raises(DesignFileError, match="header announces 4 triangles, the file has room for 3"):
        load_design(path)


@pytest.mark.parametrize(
    "content", [b"no zip", three_mf()[:-40], three_mf().replace(b"3dmodel", b"4dmodel"), three_mf(meshes=0)]
)
def test_a_broken_3mf_is_an_error(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(DesignFileError, match="not a readable 3MF file"):
        load_design(write(tmp_path, "part.3mf", content))


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


def test_errors_keep_their_cause(tmp_path: Path) -> None:
    with pytest.raises(DesignFileError) as caught:
        load_design(tmp_path / "missing.stl")
    assert isinstance(caught.value.__cause__, FileNotFoundError)


EMPTY_DESIGNS = {
    "binary.stl": stl_bytes(VERTICES, FACES[:0]),
    "ascii.stl": b"solid part\nendsolid part\n",
    "points.ply": ply(VERTICES, None),
    "no faces.ply": ply(VERTICES, FACES[:0]),
    "nothing.ply": ply(VERTICES[:0], FACES[:0]),
    "points.obj": obj(VERTICES, FACES[:0]).encode(),
    "no faces.3mf": three_mf(faces=FACES[:0]),
    "no area.stl": stl_bytes(VERTICES, np.array([[0, 0, 1], [2, 2, 2]])),
    "vertex that is not there.ply": ply(VERTICES, FACES + 1),
    "vertex that is not there.obj": obj(VERTICES, FACES + 1).encode(),
    "not finite.stl": stl_bytes(np.where(VERTICES == 8.0, np.nan, VERTICES), FACES),
}


@pytest.mark.parametrize("name", EMPTY_DESIGNS)
def test_a_design_without_a_surface_is_degenerate(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name, EMPTY_DESIGNS[name])
    with pytest.raises(DegenerateDesignError) as caught:
        load_design(path)
    assert caught.value.where == str(path)


# --- scans -----------------------------------------------------------------------------------------------------------


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


# --- helpers and STL output ------------------------------------------------------------------------------------------


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
