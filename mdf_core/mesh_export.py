"""Meshes as files for others: 3MF, which says its unit, and PLY, which holds fields at the vertices."""

from __future__ import annotations

import hashlib
import io
import re
import uuid
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from mdf_core.geometry import Array

_UUID = re.compile(rb'(?<=UUID=")[0-9a-f-]{36}(?=")')


def threemf_bytes(vertices: Array, faces: NDArray[np.integer]) -> bytes:
    """3MF file of a mesh with unit millimeter; the same mesh gives the same bytes.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.units = "mm"
    written = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(mesh.export(file_type="3mf"))) as source,
        zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for entry in source.infolist():
            target.writestr(zipfile.ZipInfo(entry.filename), _same_names(source.read(entry)), zipfile.ZIP_DEFLATED)
    return written.getvalue()


def _same_names(content: bytes) -> bytes:
    """The content with names that hang on it alone in place of random ones, and the same where they were the same."""
    anonymous = hashlib.sha256(_UUID.sub(b"", content)).hexdigest()
    order = {name: number for number, name in enumerate(dict.fromkeys(_UUID.findall(content)))}
    return _UUID.sub(
        lambda found: str(uuid.uuid5(uuid.NAMESPACE_OID, f"{anonymous} {order[found.group()]}")).encode(), content
    )


def ply_bytes(vertices: Array, faces: NDArray[np.integer], fields: Mapping[str, NDArray[Any]]) -> bytes:
    """Binary PLY file of a mesh with a property for each of `fields`, (n,) each, in their own data types.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (f, 3) int
    fields : mapping
        Name of the property to its values, (n,).
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False, vertex_attributes=dict(fields))
    written: bytes = mesh.export(file_type="ply", vertex_normal=False)
    return written
