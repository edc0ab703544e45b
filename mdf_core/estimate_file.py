"""What was printed, as a file: an STL with the mesh alone, or a PLY that also holds what the prints before it say."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.exchange.ply import load_ply

from mdf_core.errors import DesignMismatchError
from mdf_core.estimate import Estimate, Evidence
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import load_design

_FIELDS = (
    *(f"before_{axis}" for axis in "xyz"),
    *(f"wanted_{axis}" for axis in "xyz"),
    "error",
    "prints",
    "variation",
)


def estimate_fields(estimate: Estimate) -> dict[str, NDArray[np.float32]]:
    """What a PLY file of the mesh needs at each vertex to say what the prints before it say; see `Estimate`."""
    evidence = estimate.evidence
    variation = np.full(len(estimate.vertices), evidence.variation)
    columns = np.column_stack([estimate.before, evidence.wanted, evidence.error, evidence.prints, variation])
    return dict(zip(_FIELDS, columns.T.astype(np.float32), strict=True))


def load_estimate(path: Path, design: Design) -> tuple[Estimate, str]:
    """Read a redesign, in the vertex order of its design, and the SHA-256 of the file.

    Parameters
    ----------
    path : Path
        STL or PLY in mm. Without the fields of `estimate_fields` nothing else is known of the mesh.
    design : Design

    Raises
    ------
    DesignFileError
        It cannot be read.
    DesignMismatchError
        It is no redesign of the design.
    """
    redesigned = load_design(path, "mm")
    triangles = redesigned.triangles
    vertices = design.vertices.copy()
    if triangles.shape == design.triangles.shape:
        vertices[design.faces.ravel()] = triangles.reshape(-1, 3)
    if triangles.shape != design.triangles.shape or not np.array_equal(vertices[design.faces], triangles):
        raise DesignMismatchError(
            "is no redesign of this design", str(path), "give the STL or the PLY that compensate wrote"
        )
    fields = _vertex_fields(path) if path.suffix.lower() == ".ply" else None
    if fields is None or len(fields) != len(vertices):
        return Estimate.unknown(vertices), redesigned.file_sha256
    # Other programs number vertices anew; at the corners of the faces it is known which is which.
    order = np.arange(len(vertices))
    order[design.faces.ravel()] = redesigned.faces.ravel()
    fields = fields[order]
    before = np.where(np.isfinite(fields[:, :3]), fields[:, :3], vertices)
    return Estimate(vertices, before, _evidence(fields)), redesigned.file_sha256


def _evidence(fields: Array) -> Evidence:
    """From the columns; nothing is known of vertices with entries that cannot be."""
    wanted, error, prints = fields[:, 3:6], fields[:, 6], fields[:, 7]
    can_be = np.isfinite(wanted).all(axis=1) & (error >= 0) & ((prints > 0) | np.isinf(error)) & np.isfinite(prints)
    variation = float(fields[0, 8])
    return Evidence(
        wanted=np.nan_to_num(wanted),
        error=np.where(can_be, error, np.inf),
        prints=np.where(can_be, prints, 0.0),
        variation=variation if 0.0 <= variation < np.inf else float("nan"),
    )


def _vertex_fields(path: Path) -> Array | None:
    """The fields as columns, (n, 9); None: the file has not all of them."""
    loaded: dict[str, Any] = load_ply(io.BytesIO(path.read_bytes()), fix_texture=False, skip_materials=True)
    vertex = loaded["metadata"]["_ply_raw"]["vertex"]
    if not set(_FIELDS) <= set(vertex["properties"]):
        return None
    return np.column_stack([np.asarray(vertex["data"][name], dtype=np.float64).reshape(-1) for name in _FIELDS])
