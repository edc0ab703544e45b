"""Regions of a design: what must not move, and what has a tolerance of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.design_surface import DesignSurface
from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import load_design
from mdf_core.units import UNITS

_WITHIN_MM = 0.05  # what rounding and tessellation leave between a vertex and the plane or surface it lies on
_INSIDE = 0.5  # winding number
_SELECTORS = ("box", "plane", "mesh", "faces", "build_plate")
_OPTIONS = ("name", "fixed", "blend_mm", "tolerance_mm", "within_mm", "unit")


@dataclass(frozen=True, eq=False)
class Region:
    """Some vertices of a design, and what holds for them.

    Attributes
    ----------
    name : str
    vertices : (n,) bool
    is_fixed : bool
        A redesign leaves them exactly at nominal.
    blend_mm : float
        Width of the transition from there to what is compensated in full.
    tolerance_mm : float
        Largest allowed displacement; 0: that of the part.
    mesh_path : str
        File of the mesh that selected the vertices; empty: none did.
    mesh_sha256 : str
        Hash of that file's bytes, empty without one.
    """

    name: str
    vertices: NDArray[np.bool_]
    is_fixed: bool = False
    blend_mm: float = 5.0
    tolerance_mm: float = 0.0
    mesh_path: str = ""
    mesh_sha256: str = ""


def load_regions(path: str | Path, design: Design) -> tuple[Region, ...]:
    """The regions that a YAML file names, on a design.

    Parameters
    ----------
    path : path
        A list of regions; each has a `name`, what holds for it (`fixed: true` with `blend_mm`, `tolerance_mm`), and one
        of these, in the design's frame and mm: `box` [x y z of one corner, x y z of the other]; `plane` [x y z of a
        point, x y z of the normal]; `mesh`, a file (`unit`), beside the YAML file or with its whole path: the vertices
        in it or on its surface; `faces`, a list of their numbers; `build_plate: true`: the lowest vertices. `within_mm`
        says how far from plane, surface or plate, or outside the box, a vertex may lie.
    design : Design

    Returns
    -------
    tuple of Region

    Raises
    ------
    InvalidSettingError
        The file cannot be read, a region is not understood, has an entry that says nothing there, or holds no vertex.
    DesignFileError
        A mesh cannot be read.
    """
    return load_regions_and_hash(path, design)[0]


def load_regions_and_hash(path: str | Path, design: Design) -> tuple[tuple[Region, ...], str]:
    """Regions as `load_regions` reads them, and the SHA-256 of the YAML file's bytes.

    Parameters
    ----------
    path, design
        As of `load_regions`.

    Returns
    -------
    tuple of Region
    str
        Of the very bytes that were read: the file may be another at any time.

    Raises
    ------
    InvalidSettingError, DesignFileError
        As `load_regions`.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
        entries = yaml.safe_load(content.decode("utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise InvalidSettingError(f"cannot be read: {error}", str(path), "give a YAML file with a list") from error
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise InvalidSettingError("holds no list of regions", str(path), "begin each region with `- name: …`")
    regions = tuple(_region(entry, design, path, number) for number, entry in enumerate(entries, 1))
    names = [region.name for region in regions]
    if len(set(names)) < len(names):
        raise InvalidSettingError("two regions of the same name", str(path), "give each a name of its own")
    return regions, hashlib.sha256(content).hexdigest()


def fixed_vertices(regions: Sequence[Region], count: int) -> NDArray[np.bool_]:
    """Which of the design's `count` vertices must stay at nominal, (n,)."""
    fixed = np.zeros(count, dtype=np.bool_)
    for region in regions:
        if region.is_fixed:
            fixed |= region.vertices
    return fixed


def free_share(regions: Sequence[Region], vertices: Array) -> Array:
    """How far each of `vertices` (n, 3) mm may follow its shift: 0 in fixed regions, rising smoothly to 1 beside them.

    Returns
    -------
    (n,) float64
    """
    share = np.ones(len(vertices))
    for region in regions:
        if region.is_fixed:
            distances, _ = KDTree(vertices[region.vertices]).query(vertices, workers=-1)
            # Another vertex at the same place, as where a mesh is cut, is not told apart from the fixed one.
            # The distances are finite, so without a blend every one above 0 is far beyond it.
            with np.errstate(over="ignore"):
                rising = smooth_step(np.asarray(distances) / max(region.blend_mm, np.finfo(np.float64).tiny))
            share = np.minimum(share, np.where(region.vertices, 0.0, rising))
    return share


def smooth_step(values: Array) -> Array:
    """0 up to 0, 1 from 1 on, without a kink between."""
    inside = np.clip(values, 0.0, 1.0)
    rising: Array = inside**2 * (3.0 - 2.0 * inside)
    return rising


@dataclass(frozen=True, eq=False)
class _Entry:
    """What the selectors need besides their own value."""

    design: Design
    within: float  # mm
    where: str


def _region(entry: Mapping[str, Any], design: Design, path: Path, number: int) -> Region:
    where = f"{path}: region {entry.get('name', number)!r}"
    unknown = sorted(set(map(str, entry)) - {*_SELECTORS, *_OPTIONS})
    if unknown:
        raise InvalidSettingError(f"unknown entry {unknown[0]!r}", where, f"use {', '.join((*_OPTIONS, *_SELECTORS))}")
    selectors = [name for name in _SELECTORS if name in entry]
    if len(selectors) != 1:
        raise InvalidSettingError(
            f"{len(selectors)} of {', '.join(_SELECTORS)}", where, "give exactly one of them for a region"
        )
    if not isinstance(entry.get("name"), str):
        raise InvalidSettingError("no name", where, "give it a name")
    blend, tolerance, within = (
        _length(entry, name, default, where)
        for name, default in (("blend_mm", 5.0), ("tolerance_mm", 0.0), ("within_mm", _WITHIN_MM))
    )
    is_fixed = entry.get("fixed", False)
    if not isinstance(is_fixed, bool):
        raise InvalidSettingError(f"fixed is {is_fixed!r}", where, "write true or false")
    if not is_fixed and tolerance == 0:
        raise InvalidSettingError("neither fixed nor with a tolerance", where, "write fixed: true or tolerance_mm")
    _require_meaning(entry, is_fixed, where)
    unit = entry.get("unit", "mm")
    if unit not in UNITS:
        raise InvalidSettingError(f"unit is {unit!r}", where, f"write {', '.join(UNITS)}")
    mask = load_design(path.parent / str(entry["mesh"]), unit) if "mesh" in entry else None
    value = entry[selectors[0]] if mask is None else mask
    vertices = _SELECT[selectors[0]](value, _Entry(design, within, where))
    vertices &= np.bincount(design.faces.ravel(), minlength=len(vertices)) > 0  # those that no face uses are no part
    if not vertices.any():
        raise InvalidSettingError("no vertex of the design lies in it", where, "give it in mm, in the design's frame")
    mesh_file = () if mask is None else (mask.path, mask.file_sha256)
    return Region(entry["name"], vertices, is_fixed, blend, tolerance, *mesh_file)


def _require_meaning(entry: Mapping[str, Any], is_fixed: bool, where: str) -> None:
    """Refuse what would be passed over: who writes it relies on it."""
    for option, is_idle, beside, remedy in (
        ("unit", "mesh" not in entry, "without mesh", "give the numbers in mm, and leave it out"),
        ("blend_mm", not is_fixed, "without fixed: true", "leave it out, or write fixed: true"),
        ("within_mm", "faces" in entry, "with faces", "leave it out"),
    ):
        if option in entry and is_idle:
            raise InvalidSettingError(f"{option} says nothing {beside}", where, remedy)


def _length(entry: Mapping[str, Any], name: str, default: float, where: str) -> float:
    value = entry.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
        raise InvalidSettingError(f"{name} is {value!r}", where, "give a length in mm, 0 or more")
    return float(value)


def _numbers(value: Any, where: str, what: str) -> Array:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise InvalidSettingError(f"{value!r} are not six numbers", where, f"give {what}")
    return numbers


def _in_box(value: Any, entry: _Entry) -> NDArray[np.bool_]:
    corners = _numbers(value, entry.where, "x y z of both corners").reshape(2, 3)
    low, high = corners.min(axis=0) - entry.within, corners.max(axis=0) + entry.within
    inside: NDArray[np.bool_] = ((entry.design.vertices >= low) & (entry.design.vertices <= high)).all(axis=1)
    return inside


def _on_plane(value: Any, entry: _Entry) -> NDArray[np.bool_]:
    point, normal = _numbers(value, entry.where, "x y z of a point and x y z of the normal").reshape(2, 3)
    length = float(np.linalg.norm(normal))
    if length == 0:
        raise InvalidSettingError("a normal without direction", entry.where, "give x y z of the normal")
    near: NDArray[np.bool_] = np.abs((entry.design.vertices - point) @ normal / length) <= entry.within
    return near


def _in_mesh(mask: Design, entry: _Entry) -> NDArray[np.bool_]:
    on = DesignSurface(mask).closest(entry.design.vertices).points - entry.design.vertices
    inside = np.abs(igl.fast_winding_number(mask.vertices, mask.faces, entry.design.vertices)) > _INSIDE
    selected: NDArray[np.bool_] = (np.linalg.norm(on, axis=1) <= entry.within) | inside
    return selected


def _of_faces(value: Any, entry: _Entry) -> NDArray[np.bool_]:
    numbers, faces = value if isinstance(value, list) else [], entry.design.faces
    # Of a design that was refined those of the file count, which a viewer shows.
    of_file = np.arange(len(faces)) if entry.design.file_faces is None else entry.design.file_faces
    last = int(of_file.max())
    if not numbers or not all(type(number) is int and 0 <= number <= last for number in numbers):
        raise InvalidSettingError("no list of faces of the design", entry.where, f"give numbers from 0 to {last}")
    vertices = np.zeros(len(entry.design.vertices), dtype=np.bool_)
    vertices[faces[np.isin(of_file, numbers)].ravel()] = True
    return vertices


def _on_build_plate(value: Any, entry: _Entry) -> NDArray[np.bool_]:
    if value is not True:
        raise InvalidSettingError(f"build_plate is {value!r}", entry.where, "write build_plate: true")
    heights = entry.design.vertices[:, 2]
    lowest: NDArray[np.bool_] = heights <= entry.design.triangles[:, :, 2].min() + entry.within
    return lowest


_SELECT = {
    "box": _in_box,
    "plane": _on_plane,
    "mesh": _in_mesh,
    "faces": _of_faces,
    "build_plate": _on_build_plate,
}
