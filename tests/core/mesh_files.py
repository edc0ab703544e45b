"""Files of a tetrahedron, as designs and scans are written."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from mdf_core.mesh_io import stl_bytes

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
