"""Points and triangles: the two inputs of every inspection, in mm."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mdf_core.errors import CloudFormatError, DegenerateDesignError, EmptyScanError, NonFiniteScanError

Array = NDArray[np.float64]


def shown(point: Iterable[float]) -> str:
    """A place in the design as it is told, to a tenth of a millimetre."""
    return f"({', '.join(f'{coordinate:.1f}' for coordinate in point)}) mm"


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of a surface (D = 3) or of a plane (D = 2).

    Attributes
    ----------
    points : (n, D) float64, mm
    normals : (n, D) float64 unit vectors, or None
        Outward where the scanner knows the side.
    areas : (n,) float64 mm², or None
        Surface area that each point stands for.

    Raises
    ------
    CloudFormatError
        Arrays whose shapes do not fit together.
    EmptyScanError
        No points.
    NonFiniteScanError
        NaN or infinite coordinates, normals or areas; the message counts them and names the first.
    """

    points: Array
    normals: Array | None = None
    areas: Array | None = None

    def __post_init__(self) -> None:
        if np.ndim(self.points) != 2 or np.shape(self.points)[1] not in (1, 2, 3):
            raise CloudFormatError(
                f"points of shape {np.shape(self.points)}", "scan", "give one row of up to three coordinates per point"
            )
        for name, expected in (("normals", np.shape(self.points)), ("areas", (len(self.points),))):
            values = getattr(self, name)
            if values is not None and np.shape(values) != expected:
                raise CloudFormatError(
                    f"{name} of shape {np.shape(values)} for points of shape {np.shape(self.points)}",
                    "scan",
                    f"give {name} of shape {expected}, or none",
                )
        if len(self.points) == 0:
            raise EmptyScanError("no points", "scan", "check the scanner's output")
        for name in ("points", "normals", "areas"):
            values = getattr(self, name)
            if values is None:
                continue
            values = np.ascontiguousarray(values, dtype=np.float64)
            object.__setattr__(self, name, values)
            bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            if bad.any():
                first = int(bad.argmax())
                raise NonFiniteScanError(
                    f"{int(bad.sum())} of {len(values)} {name} are NaN or infinite, the first at index {first}",
                    "scan",
                    "remove invalid points before sending the scan",
                )

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> PointSet:
        """The points at `index` with their normals and areas."""
        return PointSet(
            self.points[index],
            None if self.normals is None else self.normals[index],
            None if self.areas is None else self.areas[index],
        )

    def sha256(self) -> str:
        """Hash of points, normals and areas."""
        digest = hashlib.sha256()
        for values in (self.points, self.normals, self.areas):
            digest.update(b"-" if values is None else values.tobytes())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Design:
    """The design's triangles, their order and that of the vertices as in the file.

    Attributes
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64
    path : str
        The file it came from, empty if none.
    file_sha256 : str
        Hash of the file's bytes, empty if none.
    file_faces : (f,) int64, optional
        Number of the file's triangle that each face is a part of; None: the faces are the file's.

    Raises
    ------
    DegenerateDesignError
        No triangles, none with an area, indices out of range, or vertices that are not finite.
    """

    vertices: Array
    faces: NDArray[np.int64]
    path: str = ""
    file_sha256: str = ""
    file_faces: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        where = self.path or "design"
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, dtype=np.float64).reshape(-1, 3))
        object.__setattr__(self, "faces", np.ascontiguousarray(self.faces, dtype=np.int64).reshape(-1, 3))
        if len(self.faces) == 0 or len(self.vertices) == 0:
            raise DegenerateDesignError("no triangles", where, "export the design as a triangle mesh")
        if not np.isfinite(self.vertices).all():
            raise DegenerateDesignError("vertices that are NaN or infinite", where, "repair the mesh")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise DegenerateDesignError("a face names a vertex that does not exist", where, "repair the mesh")
        if not self.face_areas.sum() > 0:
            raise DegenerateDesignError("no triangle has an area", where, "export the design as a triangle mesh")

    @cached_property
    def triangles(self) -> Array:
        """Corners of every face, (f, 3, 3) mm."""
        return self.vertices[self.faces]

    @cached_property
    def _face_crosses(self) -> Array:
        return crosses_of(self.triangles)

    @cached_property
    def face_areas(self) -> Array:
        """Area of every face, (f,) mm²."""
        lengths: Array = np.linalg.norm(self._face_crosses, axis=1)
        return 0.5 * lengths

    @cached_property
    def face_normals(self) -> Array:
        """Unit normal of every face, (f, 3); zero where the face has no area."""
        lengths = 2.0 * self.face_areas[:, None]
        normals: Array = np.zeros_like(self._face_crosses)
        return np.divide(self._face_crosses, lengths, out=normals, where=lengths > 0)

    @cached_property
    def face_volumes(self) -> Array:
        """Six times the signed volume between every face and the centre, (f,) mm³; their sum is negative inside out."""
        return volumes_of(self.triangles - self.centre)

    @cached_property
    def vertex_areas(self) -> Array:
        """A third of the area of the faces around every vertex, (n,) mm²; zero for unreferenced vertices."""
        thirds = np.repeat(self.face_areas / 3.0, 3)
        return np.bincount(self.faces.ravel(), thirds, minlength=len(self.vertices)).astype(np.float64)

    @cached_property
    def vertex_normals(self) -> Array:
        """Unit mean of the normals of the faces around every vertex, by area, (n, 3); zero where they have no area."""
        weighted = np.repeat(self.face_normals * self.face_areas[:, None], 3, axis=0)
        corners, count = self.faces.ravel(), len(self.vertices)
        sums = np.stack([np.bincount(corners, column, minlength=count) for column in weighted.T], axis=1)
        return unit_vectors(sums.astype(np.float64, copy=False))

    @cached_property
    def centre(self) -> Array:
        """Area-weighted centre of the surface, (3,) mm."""
        centre: Array = np.average(self.triangles.mean(axis=1), axis=0, weights=self.face_areas)
        return centre

    @cached_property
    def scale(self) -> float:
        """Area-weighted RMS radius of the surface about its centre, mm: the length unit ``s`` of the registration."""
        # The mean of |x|² over a triangle is (|a|² + |b|² + |c|² + |a+b+c|²) / 12.
        corners = self.triangles - self.centre
        squares = ((corners**2).sum(axis=(1, 2)) + (corners.sum(axis=1) ** 2).sum(axis=1)) / 12.0
        return float(np.sqrt(np.average(squares, weights=self.face_areas)))


def members_of(counts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of groups of so many members, (g,), one after the other: the group of each member and its number there, (n,)."""
    groups = np.repeat(np.arange(len(counts)), counts)
    return groups, np.arange(len(groups)) - np.repeat(np.cumsum(counts) - counts, counts)


def unit_vectors(vectors: Array) -> Array:
    """`vectors` (n, D) with a length of 1; zero where they have none, NaN where they are NaN."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    result: Array = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths != 0)
    return result


def crosses_of(triangles: Array) -> Array:
    """Normals of `triangles` (f, 3, 3), twice the area long, (f, 3)."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def volumes_of(triangles: Array) -> Array:
    """Six times the signed volume between each of `triangles` (f, 3, 3) and the origin, (f,)."""
    volumes: Array = np.einsum("fi,fi->f", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    return volumes
