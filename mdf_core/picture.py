"""The deviation drawn on the part, for people."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from trimesh.remesh import subdivide_to_size

from mdf_core.distortion import distortion_left
from mdf_core.geometry import Array, Design, crosses_of
from mdf_core.inspection import Inspection
from mdf_core.rigid import best_rigid_fit, transform

_VIEWS = (("front", -60.0, 25.0), ("back", 120.0, 25.0), ("from below", -60.0, -35.0))  # azimuth, elevation in degrees
_COLOURS = "RdBu_r"
_GREY = (0.45, 0.45, 0.43)
_LONGEST_EDGE, _SHORTEST_EDGE = 1 / 30, 1 / 150  # of the part's diagonal
_MOST_FACES = 40_000
_SMALLEST_RANGE_MM = 1e-3


@dataclass(frozen=True, eq=False)
class PictureRow:
    """One displacement field to draw.

    Attributes
    ----------
    title : str
    displacement : (n, 3) float64, mm
        One per design vertex.
    supported : (n,) bool
        The others are drawn grey.
    """

    title: str
    displacement: Array
    supported: NDArray[np.bool_]


def inspection_row(inspection: Inspection) -> PictureRow:
    """The displacement of `inspection`, titled with its RMS and largest length and the share of the surface seen."""
    return measured_row(
        inspection.displacement,
        inspection.supported,
        inspection.rms_displacement,
        inspection.max_displacement,
        inspection.coverage,
    )


def measured_row(
    displacement: Array, supported: NDArray[np.bool_], rms_mm: float, largest_mm: float, coverage: float
) -> PictureRow:
    """A measured displacement (n, 3) mm with its numbers, all over the vertices that are `supported` (n,)."""
    title = (
        f"measured distortion: RMS {rms_mm:.3f} mm, largest {largest_mm:.3f} mm, {coverage:.0%} of the surface measured"
    )
    return PictureRow(title, displacement, supported)


def reprint_row(design: Design, printed_vertices: Array) -> PictureRow:
    """What is left of the distortion when the design's vertices come out at `printed_vertices` (n, 3) mm."""
    rms, largest = distortion_left(design, printed_vertices)
    placed = transform(best_rigid_fit(printed_vertices, design.vertices, design.vertex_areas), printed_vertices)
    title = f"left after printing the redesign: RMS {rms:.3f} mm, largest {largest:.3f} mm"
    return PictureRow(title, placed - design.vertices, np.ones(len(printed_vertices), dtype=np.bool_))


def draw(design: Design, rows: Sequence[PictureRow]) -> bytes:
    """The fields drawn on the design, one row each, all in one colour scale.

    Colour is the displacement along the outward normal: red stands out of the design surface, blue lies inside.

    Parameters
    ----------
    design : Design
    rows : sequence of PictureRow

    Returns
    -------
    bytes
        PNG; the same input gives the same bytes.

    Notes
    -----
    Cost: about 1 s for one row, whatever the size of the design: fine meshes are drawn coarser.
    """
    fields = np.hstack([np.where(row.supported[:, None], row.displacement, np.nan) for row in rows])
    triangles, signed = _drawable(design, fields)
    finite = np.abs(signed[np.isfinite(signed)])
    limit = max(float(np.percentile(finite, 99.5)) if finite.size else 0.0, _SMALLEST_RANGE_MM)
    mapped = ScalarMappable(Normalize(-limit, limit), _COLOURS)

    figure = Figure(figsize=(13.0, 0.8 + 4.1 * len(rows)), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for index, row in enumerate(rows):
        parts[index].suptitle(row.title, fontsize=13)
        axes = parts[index].subplots(1, len(_VIEWS))
        for axis, (name, azimuth, elevation) in zip(axes, _VIEWS, strict=True):
            _draw_view(axis, triangles, signed[:, index], _camera(azimuth, elevation), mapped)
            axis.set_title(name, fontsize=10, color="0.35")
        bar = parts[index].colorbar(mapped, ax=axes, shrink=0.8, pad=0.01, extend=_beyond(signed, limit))
        bar.set_label("displacement along the outward normal, mm")
    if np.isnan(signed).any():
        figure.supxlabel("dark grey: not measured", fontsize=10, color="0.35")
    png = io.BytesIO()
    figure.savefig(png, format="png")
    return png.getvalue()


def _beyond(signed: Array, limit: float) -> Any:
    """Which ends of the colour bar hide larger values."""
    low, high = bool(np.nanmin(signed, initial=0.0) < -limit), bool(np.nanmax(signed, initial=0.0) > limit)
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[low, high]


def _drawable(design: Design, fields: Array) -> tuple[Array, Array]:
    """Triangles (f, 3, 3), small enough to be sorted by depth, few enough to draw, and their values (f, k).

    `fields` (n, 3k) holds k displacements per vertex, NaN where there is none; a face takes the mean of its corners
    along its own normal, because at an edge of the part a vertex has no normal worth the name.
    """
    vertices, faces = design.vertices, design.faces
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if len(faces) > _MOST_FACES:
        boxes = np.round(vertices / (diagonal * _SHORTEST_EDGE)).astype(np.int64)
        _, first, box = np.unique(boxes, axis=0, return_index=True, return_inverse=True)
        faces = box.reshape(-1)[faces]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        vertices, fields, faces = vertices[first], fields[first], faces[whole]
        # Merging turns small faces over; their own normals still tell which way is out.
        normals = design.face_normals[whole]
    else:
        # The fields ride along as further coordinates, too small to count as length; so does where there is none.
        tiny = 1e-9
        ridden = np.hstack([vertices, np.nan_to_num(fields) * tiny, np.isnan(fields) * tiny])
        ridden, faces = subdivide_to_size(ridden, faces, diagonal * _LONGEST_EDGE, max_iter=20)
        vertices, fields, missing = np.split(ridden, [3, 3 + fields.shape[1]], axis=1)
        fields = np.where(missing > 0, np.nan, fields / tiny)
        normals = Design(vertices, faces).face_normals
    means = fields[faces].mean(axis=1).reshape(len(faces), -1, 3)
    return vertices[faces], np.einsum("fki,fi->fk", means, normals)


def _camera(azimuth: float, elevation: float) -> Array:
    """Rotation whose rows are right, up and towards the viewer."""
    turn, lift = np.deg2rad(azimuth), np.deg2rad(elevation)
    towards = np.array([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift)])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    return np.array([right, np.cross(towards, right), towards])


def _draw_view(axis: Axes, triangles: Array, values: Array, camera: Array, mapped: ScalarMappable) -> None:
    seen = triangles @ camera.T
    crosses = crosses_of(seen)
    lengths = np.linalg.norm(crosses, axis=1)
    light = np.array([0.25, 0.45, 0.86])
    lit = np.abs(np.divide(crosses @ light, lengths, out=np.zeros_like(lengths), where=lengths > 0))
    colours = np.asarray(mapped.to_rgba(np.nan_to_num(values)))[:, :3]
    colours[np.isnan(values)] = _GREY
    colours = np.clip(colours * (0.78 + 0.22 * lit[:, None]), 0.0, 1.0)
    # Painter's algorithm: the nearest last.
    order = np.argsort(seen[:, :, 2].mean(axis=1), kind="stable")
    painted = PolyCollection(seen[order][:, :, :2], facecolors=colours[order], edgecolors=colours[order])
    painted.set_linewidth(0.3)
    axis.add_collection(painted, autolim=False)
    low, high = seen[:, :, :2].min(axis=(0, 1)), seen[:, :, :2].max(axis=(0, 1))
    margin = 0.04 * float((high - low).max())
    axis.set_xlim(low[0] - margin, high[0] + margin)
    axis.set_ylim(low[1] - 3 * margin, high[1] + margin)
    axis.set_aspect("equal")
    axis.set_axis_off()
    _draw_scale(axis, float(high[0] - low[0]), (float(low[0]), float(low[1] - 2 * margin)))


def _draw_scale(axis: Axes, width: float, corner: tuple[float, float]) -> None:
    """A bar of round length, 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(width / 3.0))
    length = float(max(step for step in (power, 2 * power, 5 * power) if step <= width / 3.0))
    axis.plot([corner[0], corner[0] + length], [corner[1], corner[1]], color="0.25", linewidth=2.0)
    axis.annotate(
        f"{length:g} mm", (corner[0] + length, corner[1]), (5, -3), textcoords="offset points", fontsize=8, color="0.25"
    )
