"""Design files: vertices and faces as they are in the file, in mm, and errors that name it."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import EMPTY_DESIGNS, FACES, VERTICES, ascii_stl, obj, ply, three_mf, write

from mdf_core.errors import DegenerateDesignError, DesignFileError, InvalidSettingError, ScanFileError
from mdf_core.mesh_io import load_design, load_scan, stl_bytes


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


def test_errors_keep_their_cause(tmp_path: Path) -> None:
    with pytest.raises(DesignFileError) as caught:
        load_design(tmp_path / "missing.stl")
    assert isinstance(caught.value.__cause__, FileNotFoundError)


@pytest.mark.parametrize("name", EMPTY_DESIGNS)
def test_a_design_without_a_surface_is_degenerate(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name, EMPTY_DESIGNS[name])
    with pytest.raises(DegenerateDesignError) as caught:
        load_design(path)
    assert caught.value.where == str(path)
