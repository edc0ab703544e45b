"""The figures, as PNG; the same results give the same picture."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from bench.paper import square
from bench.paper.line import STRETCH, Line
from bench.paper.meshes import Mesh
from bench.paper.part import Measured, Printed, Redesigned
from bench.paper.square import DESIGN, LEVELS, Case, Family
from mdf_core.design_surface import spread_samples
from mdf_core.distortion import distortion_left
from mdf_core.inspection import Inspection
from mdf_core.picture import PictureRow, draw
from mdf_core.rigid import best_rigid_fit, inverse, transform

_DPI = 100
_COLOURS = 256  # of the palette; true colours would double the files
_NAMES = {"cpd": "CPD, equal weights", "mdf": "MDF, area weights"}
_BARS = {"cpd": "tab:orange", "mdf": "tab:blue"}
_DESIGN, _SCAN, _GREY = "tab:red", "tab:blue", "0.55"
_ARROWS = 5.0  # how much longer than true
_UNDERSIDE_MM = 0.5
_SECTION, _SECTION_MM = 0.55, 1.0  # where along y, and half its thickness
_SAMPLES = 60_000


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return _small(buffer.getvalue())


def _small(png: bytes) -> bytes:
    """The picture with a palette instead of true colours."""
    buffer = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE).save(
        buffer, format="png", optimize=True
    )
    return buffer.getvalue()


def _bare(axes: Axes, title: str = "") -> None:
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=9)


# The line


def line(example: Line) -> bytes:
    """The design above, the scan below, and where each scan point is taken back to."""
    panels = {"the truth": example.places, _NAMES["cpd"]: example.found["cpd"], _NAMES["mdf"]: example.found["mdf"]}
    figure = _figure(9.0, 2.2)
    design = np.linspace(0.0, 1.0, len(example.places))
    scan = 0.5 + STRETCH * (example.places - 0.5)
    for axes, (name, found) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        axes.plot(design, np.ones_like(design), "o-", color=_DESIGN, markersize=7, fillstyle="none", label="design")
        axes.plot(scan, np.zeros_like(scan), "s-", color=_SCAN, markersize=5, label="scan")
        axes.plot(found, np.ones_like(found), "x", color=_SCAN, markersize=7, label="scan, taken back")
        for begin, end in zip(scan, found, strict=True):
            axes.plot([begin, end], [0.0, 1.0], color=_GREY, linewidth=0.7)
        axes.set_ylim(-0.4, 1.4)
        axes.set_axis_off()
        axes.set_title(name, fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return _png(figure)


# The square


def meshes(case: Case) -> bytes:
    """The design's mesh, the scan's on the undistorted square, and the scan's on the distorted one."""
    panels = [
        ("design", DESIGN.nodes, DESIGN, _DESIGN),
        ("scan, in the material", case.mesh.nodes, case.mesh, _SCAN),
        ("scan, distorted", case.scan, case.mesh, _SCAN),
    ]
    figure = _figure(9.0, 3.2)
    for axes, (title, places, mesh, colour) in zip(figure.subplots(1, 3), panels, strict=True):
        axes.triplot(*places.T, mesh.triangles, color=colour, linewidth=0.5)
        _bare(axes, title)
    return _png(figure)


def densities(mesh: Mesh, sigma: float) -> bytes:
    """The mixture's density of three point sets that stand for the same square."""
    axis = np.linspace(0.0, 1.0, 81)
    places = np.stack(np.meshgrid(axis, axis, indexing="xy"), axis=-1).reshape(-1, 2)
    panels = {
        "refined mesh, equal weights": square.mixture_density(mesh, False, sigma, places),
        "refined mesh, area weights": square.mixture_density(mesh, True, sigma, places),
        "uniform mesh": square.mixture_density(DESIGN, False, sigma, places),
    }
    largest = max(values.max() for values in panels.values())
    figure = _figure(9.0, 2.9)
    shown = figure.subplots(1, 3)
    for axes, (title, values) in zip(shown, panels.items(), strict=True):
        image = axes.imshow(
            values.reshape(len(axis), -1), origin="lower", extent=(0, 1, 0, 1), vmin=0.0, vmax=largest, cmap="viridis"
        )
        _bare(axes, title)
    figure.colorbar(image, ax=shown, shrink=0.8, label="density")
    return _png(figure)


def registration(cases: Sequence[Case]) -> bytes:
    """Before, after CPD and after MDF, a row per case."""
    figure = _figure(9.0, 3.0 * len(cases))
    for row, case in zip(figure.subplots(len(cases), 3, squeeze=False), cases, strict=True):
        panels = {f"level {case.level:.2f}": case.scan}
        panels |= {_NAMES[name]: motion.apply(case.scan) for name, motion in case.motions.items()}
        for axes, (title, scan) in zip(row, panels.items(), strict=True):
            axes.plot(*DESIGN.nodes.T, "o", color=_DESIGN, markersize=2.6, markeredgewidth=0.5, fillstyle="none")
            axes.plot(*scan.T, ".", color=_SCAN, markersize=2.2)
            _bare(axes, title)
    return _png(figure)


def displacement(case: Case) -> bytes:
    """Six panels: x and y, applied and as found by either method."""
    fields = {"applied": square.deformed(DESIGN.nodes, case.level, case.seed) - DESIGN.nodes}
    fields |= {_NAMES[name]: motion.displacement_at(DESIGN.nodes) for name, motion in case.motions.items()}
    figure = _figure(9.0, 5.4)
    for index, (row, letter) in enumerate(zip(figure.subplots(2, 3), "xy", strict=True)):
        largest = max(np.abs(values[:, index]).max() for values in fields.values())
        levels = np.linspace(-largest, largest, 21)
        for axes, (name, values) in zip(row, fields.items(), strict=True):
            image = axes.tricontourf(*DESIGN.nodes.T, DESIGN.triangles, values[:, index], levels=levels, cmap="RdBu_r")
            _bare(axes, f"u{letter}, {name}")
        figure.colorbar(image, ax=row, shrink=0.85)
    return _png(figure)


def corner_errors(families: Sequence[Family]) -> bytes:
    """Bars are means over the cases, dots single cases."""
    figure = _figure(9.0, 3.2)
    places = np.arange(len(LEVELS))
    for axes, family in zip(figure.subplots(1, len(families)), families, strict=True):
        for side, method in zip((-0.2, 0.2), _NAMES, strict=True):
            means = [family.error(level, method, "corners") for level in LEVELS]
            bars = axes.bar(places + side, means, 0.38, color=_BARS[method], label=_NAMES[method])
            axes.bar_label(bars, fmt="%.4f", fontsize=7, padding=2)
            for place, level in zip(places, LEVELS, strict=True):
                single = [case.error(method, "corners") for case in family.cases[level]]
                axes.plot(np.full(len(single), place + side + 0.14), single, ".", color="0.2", markersize=3)
        axes.set_xticks(places, [f"level {level:.2f}" for level in LEVELS])
        contrast = np.mean([mesh.contrast for mesh in family.meshes])
        axes.set_title(f"contrast of the areas {contrast:.0f}", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(y=0.15)
        axes.set_ylabel("mean error of the four corners", fontsize=8)
    axes.legend(fontsize=8, frameon=False)
    return _png(figure)


# The part


def part_registration(printed: Printed, found: dict[str, Measured]) -> bytes:
    """Above: a section, before and after. Below: what is missing to the true place, on the underside."""
    figure = _figure(9.5, 5.6)
    design = printed.design
    measured = {name: one.inspection for name, one in found.items() if one.inspection is not None}
    scan, true = _true_places(printed, next(iter(measured.values())))
    panels = {"scan on design": scan} | {f"after {name}": one.deformation.apply(scan) for name, one in measured.items()}
    samples, _ = spread_samples(design, _SAMPLES)
    height = design.vertices[:, 1].min() + _SECTION * np.ptp(design.vertices[:, 1])
    cut, cut_design = (np.abs(points[:, 1] - height) < _SECTION_MM for points in (true, samples))
    underside = true[:, 2] < _UNDERSIDE_MM
    for index, (title, points) in enumerate(panels.items()):
        axes = figure.add_subplot(2, len(panels), index + 1)
        axes.scatter(*samples[cut_design][:, [0, 2]].T, s=2.5, color=_DESIGN, linewidths=0)
        axes.scatter(*points[cut][:, [0, 2]].T, s=5.0, color=_SCAN, linewidths=0)
        _bare(axes, f"{title} (section)")
        axes = figure.add_subplot(2, len(panels), len(panels) + index + 1)
        missing = points - true
        axes.quiver(
            *true[underside, :2].T,
            *(_ARROWS * missing[underside, :2].T),
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.003,
            color=_SCAN,
        )
        rms = float(np.sqrt((missing**2).sum(axis=1).mean()))
        _bare(axes, f"off by {rms:.2f} mm RMS (underside, arrows x {_ARROWS:.0f})")
    return _png(figure)


def _true_places(printed: Printed, inspection: Inspection) -> tuple[np.ndarray, np.ndarray]:
    """The registered scan points that are no outliers, and where they belong on the design."""
    scan = transform(inverse(inspection.pose), inspection.deviation.points)
    index = printed.scan_index(scan)
    real = ~printed.virtual.is_outlier[index]
    index = index[real]
    triangles = printed.design.triangles[printed.virtual.source_faces[index]]
    return scan[real], np.einsum("nc,ncd->nd", printed.virtual.barycentric[index], triangles)


def part_deviation(printed: Printed, redesigns: dict[str, np.ndarray]) -> bytes:
    """The first print, and the prints of the redesigns, coloured by how far they stand out of the design."""
    design = printed.design
    everywhere = np.ones(len(design.vertices), dtype=np.bool_)
    rows = []
    for name, vertices in {"printed from the design": design.vertices, **redesigns}.items():
        came_out = printed.printer.print_part(vertices)
        placed = transform(best_rigid_fit(came_out, design.vertices, design.vertex_areas), came_out)
        rms, largest = distortion_left(design, came_out)
        rows.append(
            PictureRow(f"{name}: RMS {rms:.3f} mm, largest {largest:.3f} mm", placed - design.vertices, everywhere)
        )
    picture = Image.open(io.BytesIO(draw(design, rows)))
    buffer = io.BytesIO()
    picture.resize((900, round(picture.height * 900 / picture.width)), Image.Resampling.LANCZOS).save(buffer, "png")
    return _small(buffer.getvalue())


def part_left(table: dict[str, list[Redesigned]]) -> bytes:
    """What is left after one redesign, by method and way."""
    figure = _figure(8.0, 4.2)
    axes = figure.subplots()
    names = [one.way.name for one in next(iter(table.values()))]
    places, height = np.arange(len(names))[::-1], 0.8 / len(table)
    colours = ("tab:blue", "tab:olive", "tab:green")
    for index, (method, rows) in enumerate(table.items()):
        offset = (0.5 * (len(table) - 1) - index) * height
        bars = axes.barh(places + offset, [one.left[0] for one in rows], height, color=colours[index], label=method)
        axes.bar_label(bars, fmt="%.3f", fontsize=7, padding=2)
    axes.set_yticks(places, names, fontsize=8)
    axes.set_xlabel("distortion of the second print / of the first", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.12)
    figure.legend(loc="outside upper center", ncols=len(table), fontsize=8, frameon=False)
    return _png(figure)
