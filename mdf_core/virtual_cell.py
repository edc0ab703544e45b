"""A simulated printer and scanner whose truth is known: parts, smooth warps, scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.remesh import subdivide_to_size

from mdf_core.averages import rms_length
from mdf_core.errors import InvalidSettingError
from mdf_core.geometry import Array, Design, PointSet, unit_vectors
from mdf_core.rigid import homogeneous, rotate, transform

_EDGE_MM = 2.5  # of the solids that the parts are made of
_LONGEST_EDGE_MM = 4.0  # of the parts: a third of the shortest correlation length that is of use
_SEGMENTS = 48
_WAVES = 64
_BENDING, _SHRINKAGE = 0.5, 0.25  # RMS relative to the waves; ~0.2 % shrinkage for 1 mm on a 100 mm part
_OUTLIER_MARGIN = 0.1  # of the bounding box's diagonal
_FARTHEST_MM = 200.0
_WARP_STREAM, _PRINT_STREAM, _SCAN_STREAM = 1, 2, 3  # equal seeds must not make a warp and a print's variation alike


def _fine(solid: Manifold) -> Manifold:
    """Refined before any boolean, lest a hole's edge fan out into slivers across a whole face."""
    return solid.refine_to_length(_EDGE_MM)


def _box(size: tuple[float, float, float], corner: tuple[float, float, float]) -> Manifold:
    return _fine(Manifold.cube(size)).translate(corner)


def _profile(outline: CrossSection, height: float) -> Manifold:
    return _fine(Manifold.extrude(outline, height))


def _bar(radius: float, length: float, base: tuple[float, float, float], tilt: float = 0.0) -> Manifold:
    """Cylinder from `base` along z, or tilted from there towards x, in degrees."""
    solid = _fine(Manifold.cylinder(length, radius, circular_segments=_SEGMENTS))
    return solid.rotate((0.0, tilt, 0.0)).translate(base)


def _hole(radius: float, x: float, y: float) -> Manifold:
    """A drill along z through every part."""
    return _bar(radius, 70.0, (x, y, -5.0))


def _as_design(solid: Manifold) -> Design:
    mesh = solid.to_mesh64()
    vertices, faces = subdivide_to_size(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), _LONGEST_EDGE_MM
    )
    # Vertices exact in float32 survive a binary STL unchanged.
    return Design(vertices.astype(np.float32), faces)


def _bracket() -> Design:
    def rib(length: float, height: float, y: float) -> Manifold:
        outline = CrossSection([[(2.0, 2.0), (length, 2.0), (2.0, height)]])
        return _profile(outline, 4.0).rotate((90.0, 0.0, 0.0)).translate((0.0, y, 0.0))

    solid = _box((100.0, 50.0, 5.0), (0.0, 0.0, 0.0)) + _box((5.0, 50.0, 70.0), (0.0, 0.0, 0.0))
    solid += rib(60.0, 45.0, 12.0) + rib(35.0, 60.0, 44.0)
    solid -= _hole(5.0, 82.0, 14.0) + _hole(3.5, 84.0, 38.0) + _hole(6.5, 50.0, 27.0)
    return _as_design(solid - _bar(7.0, 20.0, (-10.0, 25.0, 52.0), 90.0))


def _clip() -> Design:
    ring = CrossSection.circle(43.0, _SEGMENTS) - CrossSection.circle(39.0, _SEGMENTS)
    opening = CrossSection([[(0.0, 0.0), (60.0, -24.0), (60.0, 38.0)]])
    lip = CrossSection.square((14.0, 3.5)).translate((32.5, 24.5))
    foot = CrossSection.square((4.0, 12.0)).translate((-14.0, -51.5))
    solid = _profile((ring - opening) + lip + foot, 22.0)
    return _as_design(solid - _bar(3.0, 30.0, (-60.0, 4.0, 9.0), 90.0))


def _hub() -> Design:
    solid = _bar(40.0, 6.0, (0.0, 0.0, 0.0)) + _bar(17.0, 53.0, (0.0, 0.0, 2.0))
    solid += _bar(8.0, 34.0, (0.0, 0.0, 34.0), 90.0)
    solid -= _hole(12.0, 0.0, 0.0) + _bar(5.0, 50.0, (0.0, 0.0, 34.0), 90.0)
    for angle in np.deg2rad((30.0, 120.0, 210.0, 300.0)):
        solid -= _hole(3.0, 31.0 * np.cos(angle), 31.0 * np.sin(angle))
    return _as_design(solid)


def _plate() -> Design:
    holes = _hole(6.0, 18.0, 16.0) + _hole(4.0, 80.0, 45.0) + _hole(2.5, 30.0, 48.0) + _hole(8.0, 58.0, 20.0)
    return _as_design(_box((100.0, 60.0, 3.0), (0.0, 0.0, 0.0)) - holes)


def _housing() -> Design:
    solid = _box((90.0, 60.0, 35.0), (0.0, 0.0, 0.0)) - _box((83.0, 53.0, 35.0), (3.5, 3.5, 3.0))
    for x, y, height in ((12.0, 12.0, 20.0), (78.0, 12.0, 20.0), (20.0, 47.0, 26.0)):
        solid += _bar(5.0, height, (x, y, 1.0))
        solid -= _bar(2.0, 40.0, (x, y, 8.0))
    return _as_design(solid - _bar(9.0, 20.0, (80.0, 32.0, 18.0), 90.0))


def _pair() -> Design:
    block = _box((40.0, 30.0, 12.0), (0.0, 0.0, 0.0)) - _hole(5.0, 12.0, 18.0)
    angle = _box((35.0, 45.0, 5.0), (55.0, -5.0, 0.0)) + _box((5.0, 30.0, 28.0), (85.0, -5.0, 0.0))
    return _as_design(block + (angle - _hole(4.0, 66.0, 28.0)))


PARTS: dict[str, Callable[[], Design]] = {
    "bracket": _bracket,
    "clip": _clip,
    "hub": _hub,
    "plate": _plate,
    "housing": _housing,
    "pair": _pair,
}
"""The parts by name: an L-shaped bracket with ribs, a thin bent clip, a nearly rotation-symmetric hub, a flat plate,
an open housing, and a pair of bodies that do not touch. All about 100 mm, watertight, no edge over 4 mm."""


def build_part(name: str) -> Design:
    """The part called `name`; the same bytes every time.

    Raises
    ------
    InvalidSettingError
        `name` is not one of `PARTS`.
    """
    try:
        build = PARTS[name]
    except KeyError:
        raise InvalidSettingError(f"unknown part {name!r}", "part", f"use one of {', '.join(PARTS)}") from None
    return build()


@dataclass(frozen=True, eq=False)
class _Field:
    """A vector field that is linear in its features: plane waves, products of coordinates, coordinates and one."""

    centre: Array
    scale: float
    frequencies: Array  # (3, k) rad/mm
    phases: Array  # (k,)
    coefficients: Array  # (k + 9 + 3 + 1, 3) mm

    def features(self, points: Array) -> Array:
        """Features at `points` (n, 3), (n, k + 13)."""
        placed = (points - self.centre) / self.scale
        waves = np.cos(points @ self.frequencies + self.phases)
        products = (placed[:, :, None] * placed[:, None, :]).reshape(-1, 9)
        return np.hstack([waves, products, placed, np.ones((len(points), 1))])

    def __call__(self, points: Array) -> Array:
        """The field at `points` (n, 3) in mm, (n, 3) mm."""
        return self.features(points) @ self.coefficients


def _wave_shapes(correlation_length_mm: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies (3, k) in rad/mm and phases (k,) of plane waves.

    Source: random Fourier features of the kernel exp(-d² / 2l²), Rahimi & Recht 2007.
    """
    return rng.normal(size=(3, _WAVES)) / correlation_length_mm, rng.uniform(0.0, 2.0 * np.pi, size=_WAVES)


def _waves(rng: np.random.Generator) -> Array:
    coefficients = np.zeros((_WAVES + 13, 3))
    coefficients[:_WAVES] = rng.normal(size=(_WAVES, 3))
    return coefficients


def _bending(design: Design, rng: np.random.Generator) -> Array:
    """Bending of a beam along the longest axis e about a random axis: x² n - 2 x z e, z measured along n."""
    _, axes = np.linalg.eigh(np.cov((design.vertices - design.centre).T, aweights=design.vertex_areas))
    along = axes[:, 2]
    angle = rng.uniform(0.0, 2.0 * np.pi)
    across = np.cos(angle) * axes[:, 0] + np.sin(angle) * axes[:, 1]
    products = np.einsum("i,j,k->ijk", along, along, across) - 2.0 * np.einsum("i,j,k->ijk", along, across, along)
    coefficients = np.zeros((_WAVES + 13, 3))
    coefficients[_WAVES : _WAVES + 9] = products.reshape(9, 3)
    return coefficients


def _shrinkage(rng: np.random.Generator) -> Array:
    coefficients = np.zeros((_WAVES + 13, 3))
    coefficients[_WAVES + 9 : _WAVES + 12] = -np.diag(rng.uniform(0.5, 1.5, size=3))
    return coefficients


def _normalised(coefficients: Array, features: Array, design: Design) -> Array:
    """`coefficients` without their rigid part and with RMS 1 mm over the design's surface.

    Taking out the least squares translation and infinitesimal rotation leaves a field for which the best finite rigid
    fit, too, is the identity: its covariance with the positions is symmetric.
    """
    weights = design.vertex_areas / design.vertex_areas.sum()
    placed = features[:, -4:-1]
    values = features @ coefficients
    translation = weights @ values
    moment = weights @ np.cross(placed, values - translation)
    spread = placed.T @ (weights[:, None] * placed)
    turn = np.linalg.solve(np.trace(spread) * np.eye(3) - spread, moment)
    coefficients = coefficients.copy()
    coefficients[-4:-1] -= np.cross(turn, np.eye(3))  # row i is turn x e_i
    coefficients[-1] -= translation
    return coefficients / rms_length(features @ coefficients, weights)


def _random_field(
    design: Design, correlation_length_mm: float, rng: np.random.Generator, bending: float, shrinkage: float
) -> _Field:
    """Waves of RMS 1 mm and bending and shrinkage of the given RMS (mm), none with a rigid part."""
    frequencies, phases = _wave_shapes(correlation_length_mm, rng)
    blank = _Field(design.centre, design.scale, frequencies, phases, np.zeros((_WAVES + 13, 3)))
    features = blank.features(design.vertices)
    coefficients = _normalised(_waves(rng), features, design)
    if bending > 0:
        coefficients += bending * _normalised(_bending(design, rng), features, design)
    if shrinkage > 0:
        coefficients += shrinkage * _normalised(_shrinkage(rng), features, design)
    return replace(blank, coefficients=coefficients)


class Warp:
    """How a printer distorts a part: smooth waves, bending and anisotropic shrinkage, as heat would do.

    Defined everywhere in space; on the design it has no rigid part, so all of it is distortion.

    Parameters
    ----------
    design : Design
    amplitude_mm : float
        Largest displacement of any design vertex.
    correlation_length_mm : float
        Length l of the waves, whose values at distance d correlate with exp(-d² / 2l²).
    seed : int

    Raises
    ------
    InvalidSettingError
        Negative amplitude, or a correlation length that is not positive.
    """

    def __init__(self, design: Design, amplitude_mm: float, correlation_length_mm: float = 35.0, seed: int = 0) -> None:
        _require(amplitude_mm >= 0, "amplitude_mm", amplitude_mm, "0 or more")
        _require(correlation_length_mm > 0, "correlation_length_mm", correlation_length_mm, "more than 0")
        self.design = design
        self.amplitude_mm = amplitude_mm
        self.correlation_length_mm = correlation_length_mm
        rng = np.random.default_rng([_WARP_STREAM, seed])
        field = _random_field(design, correlation_length_mm, rng, _BENDING, _SHRINKAGE)
        largest = np.linalg.norm(field(design.vertices), axis=1).max()
        self._field = replace(field, coefficients=field.coefficients * (amplitude_mm / largest))
        self.rms_mm = rms_length(self(design.vertices), design.vertex_areas)

    def __call__(self, points: Array) -> Array:
        """Displacement at `points` (n, 3) in mm, (n, 3) mm."""
        return self._field(points)


@dataclass(frozen=True, eq=False)
class Printer:
    """A printer that distorts every part in the same way, up to a variation from print to print.

    Attributes
    ----------
    warp : Warp
    model : {"spatial", "material"}
        spatial: the distortion is a field in the printer's space, print(p) = p + f(p). material: it sticks to the
        part, print(c_i) = c_i + f(x_i) wherever the redesign puts vertex i of the design.
    variation : float
        RMS of the variation from print to print, relative to the RMS of the warp.

    Raises
    ------
    InvalidSettingError
        Unknown model or negative variation.
    """

    warp: Warp
    model: Literal["spatial", "material"] = "spatial"
    variation: float = 0.0

    def __post_init__(self) -> None:
        _require(self.model in ("spatial", "material"), "model", self.model, "spatial or material")
        _require(self.variation >= 0, "variation", self.variation, "0 or more")

    def print_part(self, vertices: Array, seed: int | None = None, material_vertices: Array | None = None) -> Array:
        """Where the vertices of a part come out.

        Parameters
        ----------
        vertices : (n, 3) float64, mm
            The design or a redesign.
        seed : int, optional
            Which print it is; without it the printer makes its mean print.
        material_vertices : (n, 3) float64, mm, optional
            Nominal places of `vertices`; without them those of the warp's design, vertex by vertex.

        Returns
        -------
        (n, 3) float64, mm

        Raises
        ------
        InvalidSettingError
            A material printer was given another number of vertices than of nominal places.
        """
        places = vertices
        if self.model == "material":
            places = self.warp.design.vertices if material_vertices is None else material_vertices
            _require(len(places) == len(vertices), "material_vertices", len(places), f"{len(vertices)} places")
        printed: Array = vertices + self.warp(places)
        if seed is not None and self.variation > 0:
            rng = np.random.default_rng([_PRINT_STREAM, seed])
            field = _random_field(self.warp.design, self.warp.correlation_length_mm, rng, 0.0, 0.0)
            printed += self.variation * self.warp.rms_mm * field(places)
        return printed


@dataclass(frozen=True, eq=False)
class ScannerSettings:
    """What the scanner sees and how well.

    Attributes
    ----------
    points : int
        Points of the scan, outliers included.
    noise_mm : float
        Standard deviation of every coordinate.
    ripple_mm : float
        Standard deviation of an error along the normals that neighbouring points share.
    ripple_length_mm : float
        That error at distance d correlates with exp(-d² / 2l²).
    outlier_share : float
        Share of points that lie anywhere in the padded bounding box.
    density_contrast : float
        95th over 5th percentile of the density of the points; it grows smoothly along a random direction.
    pose : {"identity", "random"}, or (4, 4) float64
        T_scan_design; random: any rotation, up to 200 mm away.
    hidden_share : float
        Share of the area that the scanner does not see: the side that lies far along and faces `hidden_direction`.
    hidden_direction : (3,) float, optional
        In the design's frame; without it a random one.
    normals : bool
        Whether the scan has normals.
    normal_noise : float, rad
        Standard deviation of the normals' tilt about either axis.

    Raises
    ------
    InvalidSettingError
        A value out of range.
    """

    points: int = 20_000
    noise_mm: float = 0.02
    ripple_mm: float = 0.0
    ripple_length_mm: float = 20.0
    outlier_share: float = 0.01
    density_contrast: float = 1.0
    pose: Literal["identity", "random"] | Array = "identity"
    hidden_share: float = 0.0
    hidden_direction: tuple[float, float, float] | None = None
    normals: bool = True
    normal_noise: float = 0.03

    def __post_init__(self) -> None:
        _require(self.points >= 1, "points", self.points, "1 or more")
        _require(self.noise_mm >= 0, "noise_mm", self.noise_mm, "0 or more")
        _require(self.ripple_mm >= 0, "ripple_mm", self.ripple_mm, "0 or more")
        _require(self.ripple_length_mm > 0, "ripple_length_mm", self.ripple_length_mm, "more than 0")
        _require(0 <= self.outlier_share <= 1, "outlier_share", self.outlier_share, "0 to 1")
        _require(self.density_contrast >= 1, "density_contrast", self.density_contrast, "1 or more")
        _require(0 <= self.hidden_share < 1, "hidden_share", self.hidden_share, "0 to less than 1")
        _require(self.normal_noise >= 0, "normal_noise", self.normal_noise, "0 or more")
        known = self.pose in ("identity", "random") if isinstance(self.pose, str) else np.shape(self.pose) == (4, 4)
        _require(bool(known), "pose", self.pose, "identity, random or a 4x4 matrix")
        direction = self.hidden_direction
        _require(direction is None or any(direction), "hidden_direction", direction, "a direction with a length")


@dataclass(frozen=True, eq=False)
class VirtualScan:
    """A scan and what is true about it.

    Attributes
    ----------
    scan : PointSet
        In the scanner's frame, mm.
    pose : (4, 4) float64
        T_scan_design.
    is_outlier : (n,) bool
    source_faces : (n,) int64
        Face that each point was taken from, -1 for outliers.
    barycentric : (n, 3) float64
        Where on that face, zero for outliers.
    seen_vertices : (v,) bool
        Vertices of the part that touch a face the scanner sees.
    """

    scan: PointSet
    pose: Array
    is_outlier: NDArray[np.bool_]
    source_faces: NDArray[np.int64]
    barycentric: Array
    seen_vertices: NDArray[np.bool_]


def scan_part(
    printed_vertices: Array, faces: NDArray[np.int64], settings: ScannerSettings | None = None, seed: int = 0
) -> VirtualScan:
    """Scan a printed part.

    Density and visibility are decided face by face, so faces should be small against the part. Each option draws from
    a stream of its own: the same seed gives the same points whatever the noise and the pose.

    Parameters
    ----------
    printed_vertices : (v, 3) float64, mm
    faces : (f, 3) int64
    settings : ScannerSettings, optional
    seed : int

    Returns
    -------
    VirtualScan

    Raises
    ------
    DegenerateDesignError
        The part has no area.
    """
    settings = settings or ScannerSettings()
    part = Design(printed_vertices, faces)
    streams = np.random.default_rng([_SCAN_STREAM, seed]).spawn(7)
    pose_rng, direction_rng, surface_rng, noise_rng, normal_rng, outlier_rng, ripple_rng = streams
    pose = _pose(settings.pose, pose_rng)
    density_direction, hidden_direction = direction_rng.normal(size=(2, 3))
    if settings.hidden_direction is not None:
        hidden_direction = np.asarray(settings.hidden_direction, dtype=np.float64)

    seen = ~_hidden_faces(part, hidden_direction, settings.hidden_share)
    weights = np.where(seen, part.face_areas, 0.0)
    weights *= _density(part, weights, density_direction, settings.density_contrast)
    source_faces = surface_rng.choice(len(part.faces), size=settings.points, p=weights / weights.sum())
    barycentric = surface_rng.dirichlet(np.ones(3), size=settings.points)
    points = np.einsum("nc,ncd->nd", barycentric, part.triangles[source_faces])
    normals = part.face_normals[source_faces]
    if settings.ripple_mm > 0:
        points += settings.ripple_mm * _ripple(points, settings.ripple_length_mm, ripple_rng)[:, None] * normals
    points += settings.noise_mm * noise_rng.normal(size=points.shape)
    tilt = settings.normal_noise * normal_rng.normal(size=normals.shape)
    normals = unit_vectors(normals + tilt - (tilt * normals).sum(axis=1, keepdims=True) * normals)

    is_outlier = np.zeros(settings.points, dtype=np.bool_)
    count = round(settings.outlier_share * settings.points)
    is_outlier[outlier_rng.permutation(settings.points)[:count]] = True
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    margin = _OUTLIER_MARGIN * np.linalg.norm(high - low)
    points[is_outlier] = outlier_rng.uniform(low - margin, high + margin, size=(count, 3))
    normals[is_outlier] = unit_vectors(outlier_rng.normal(size=(count, 3)))
    source_faces[is_outlier] = -1
    barycentric[is_outlier] = 0.0

    seen_vertices = np.zeros(len(part.vertices), dtype=np.bool_)
    seen_vertices[part.faces[seen]] = True
    scan = PointSet(transform(pose, points), rotate(pose, normals) if settings.normals else None)
    return VirtualScan(scan, pose, is_outlier, source_faces, barycentric, seen_vertices)


def _pose(pose: str | Array, rng: np.random.Generator) -> Array:
    if not isinstance(pose, str):
        return np.array(pose, dtype=np.float64)
    if pose == "identity":
        return np.eye(4)
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return homogeneous(rotation, _FARTHEST_MM * rng.uniform() * unit_vectors(rng.normal(size=(1, 3)))[0])


def _ripple(points: Array, correlation_length_mm: float, rng: np.random.Generator) -> Array:
    """A smooth function of RMS 1 at the points, (n,)."""
    frequencies, phases = _wave_shapes(correlation_length_mm, rng)
    rippled: Array = np.cos(points @ frequencies + phases).sum(axis=1) * np.sqrt(2.0 / _WAVES)
    return rippled


def _hidden_faces(part: Design, direction: Array, share: float) -> NDArray[np.bool_]:
    """The faces that lie farthest along and face `direction` most, together `share` of the area."""
    direction = direction / np.linalg.norm(direction)
    along = (part.triangles.mean(axis=1) - part.centre) @ direction
    order = np.argsort(-(along / part.scale + part.face_normals @ direction), kind="stable")
    middle = np.cumsum(part.face_areas[order]) - 0.5 * part.face_areas[order]
    hidden = np.zeros(len(part.faces), dtype=np.bool_)
    hidden[order] = middle < share * part.face_areas.sum()
    return hidden


def _density(part: Design, seen_areas: Array, direction: Array, contrast: float) -> Array:
    """Relative density of the points on every face, (f,).

    With q the share of the seen area that lies below a face along `direction`, the density 1 / (1 - q (1 - a)) makes
    the logarithm of the density uniform over the POINTS; a = contrast^(-1 / 0.9) puts the wanted ratio between their
    5th and 95th percentile.
    """
    order = np.argsort(part.triangles.mean(axis=1) @ direction, kind="stable")
    below = np.empty(len(order))
    below[order] = np.cumsum(seen_areas[order]) - 0.5 * seen_areas[order]
    density: Array = 1.0 / (1.0 - below / seen_areas.sum() * (1.0 - contrast ** (-1.0 / 0.9)))
    return density


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        raise InvalidSettingError(f"{value!r} is not allowed", name, f"use {allowed}")
