"""Measurements as tables on a terminal, as markdown, as CSV and as a picture."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
import shlex
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from bench import peers, tune
from bench.cases import WARP_MM, Case
from bench.measure import Measurement
from bench.methods import METHODS, Method
from mdf_core.files import write_atomically

_COSTS = ("time s", "CPU s", "peak MiB")
_QUALITY = ("frac", "possible", "std ratio")
SCALING_HEADINGS = ("method", "pose", "points", *_COSTS, *_QUALITY)
QUALITY_HEADINGS = ("part", "warp length mm", "noise µm", "ripple µm", *_COSTS, *_QUALITY)
_RECORDED_PACKAGES = ("numpy", "scipy", "trimesh")
_DOTS_PER_INCH = 80
_LONGEST_ERROR = 60
_LINE_STYLES = ("-", "--", ":")  # one library's variants

_INTRODUCTION = f"""\
# Benchmarks

Virtual parts of about 100 mm, warped by up to {WARP_MM:g} mm, scanned with noise and 1 % outliers anywhere in space.

- **time**, **CPU**: elapsed and processor seconds of the registration, from arrays in memory. Ours is the whole
  inspection: thinning, registration, displacement at every design vertex and its standard deviation. Of the peers
  only the registration counts; what converts its arrays and interpolates its result does not.
- **peak**: largest resident memory of the process meanwhile; the interpreter, the libraries and the scan count too.
- **frac**: share of the distortion that is *not* recovered. RMS error of the displacement over RMS displacement at the
  design's vertices, by area, after the best rigid fit, against the truth without noise: 0 all found, 1 nothing found.
- **possible**: the same for the best linear estimate that knows all but the distortion itself: from which place of the
  design each point came, the outliers, the noise, the distortion's correlation length and size.
  Of scans without noise less can be missed: these prints are meshes that were moved, and the creases between their flat
  facets tell more than distances along normals. The standard deviation does not count on them.
- **ripple**: an error of the scanner along the normals that points within 20 mm share; *possible* is without it.
- **std ratio**: predicted over actual RMS error; 1 is an honest standard deviation.

Every line is a process of its own.
"""

_PEERS = f"""\
## How the peers are run

- All of them start from the true pose. The point drifts get both clouds about one centre and in one common scale, the
  design's RMS radius, which is the unit of β and of the lengths below.
- Settings come from `python -m bench.tune` (a coordinate search on the share not recovered, the truth known) and single
  trials around what it found, on `{tune.PART}` with the seeds {" and ".join(map(str, tune.SEEDS))}: another part
  and other seeds than above.
- Both directions were tried, and more design samples than scan points: many samples of the noise-free design are what
  helps most. The first line of a library is run until more iterations do not help; *quick* and *default tolerance* are
  the same but stop at |Δσ²| < {peers.QUICK_TOLERANCE:g} and, the library's own, {peers.DEFAULT_TOLERANCE:g}.
- rustcpd and biocpd run with their sparse E-step and the kernel's pivoted Cholesky factor, rustcpd in single precision:
  the fast modes. pycpd has none; its design samples are few.
- Their displacement gets to the design's vertices by inverse-distance weighting of the 8 nearest points.
- Rigid ICP stands for what inspection software shows: distances along the normals after the alignment.
- MDF and CPD (ours) are the paper's mixture methods at default settings; a fold in their motion is refused.
"""


@dataclass(frozen=True)
class Row:
    """One measurement and what was measured."""

    method: Method
    case: Case
    found: Measurement

    @property
    def scaling_cells(self) -> tuple[str, ...]:
        return (self.method.label, self.method.pose, f"{self.case.points:,}", *_figures(self.found))

    @property
    def quality_cells(self) -> tuple[str, ...]:
        case = self.case
        errors = (f"{1000 * error:g}" for error in (case.noise_mm, case.ripple_mm))
        return (case.part, f"{case.warp_length_mm:g}", *errors, *_figures(self.found))


def _figures(found: Measurement) -> tuple[str, ...]:
    if found.error:
        costs = (_number(found.seconds, ".2f"), _number(found.cpu_seconds, ".2f"), _number(found.peak_mib, ".0f"))
        return (*costs, textwrap.shorten(found.error.replace("|", "/"), _LONGEST_ERROR, placeholder=" …"), "", "")
    costs = (f"{found.seconds:.2f}", f"{found.cpu_seconds:.2f}", f"{found.peak_mib:.0f}")
    return (*costs, f"{found.unrecovered:.4f}", _number(found.possible, ".4f"), _number(found.std_ratio, ".2f"))


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else ""


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """The first `words` columns flush left, the others flush right."""
    lines = [headings, ["---"] * words + ["---:"] * (len(headings) - words), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def command_line(module: str, arguments: list[str] | None) -> str:
    """What makes the results again; no arguments: those of this process."""
    return shlex.join(["python", "-m", module, *(sys.argv[1:] if arguments is None else arguments)])


def figures_table(headings: Sequence[str], words: int, title: str | None = None) -> Table:
    """For a terminal; as `markdown_table`, the first `words` columns are flush left, the others flush right."""
    table = Table(*headings, title=title)
    for column in table.columns[words:]:
        column.justify = "right"
    return table


def machine() -> str:
    """The machine and what runs on it."""
    processors = f"{_processor()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f} at the start"
    packages = [*_RECORDED_PACKAGES, *sorted({method.needs for method in METHODS if method.needs})]
    versions = ", ".join(f"{name} {found}" for name in packages if (found := _version(name)))
    return f"{processors}; Python {platform.python_version()}, {versions}"


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def page(scaling: Sequence[Row], quality: Sequence[Row], command: str, where: str) -> str:
    """README.md of the results."""
    parts = [_INTRODUCTION, f"Made by\n\n    {command}\n\non {where}.\n"]
    if scaling:
        case = scaling[0].case
        title = f"## Time and error against the number of points ({_told(case)})\n"
        table = markdown_table(SCALING_HEADINGS, [row.scaling_cells for row in scaling], 2)
        parts += [title, "![time and error against the number of points](scaling.png)\n", table]
    if quality:
        title = f"## Parts, warp lengths and noises (surface stage, {quality[0].case.points:,} points, known pose)\n"
        parts += [title, markdown_table(QUALITY_HEADINGS, [row.quality_cells for row in quality], 1)]
    if any(row.method.needs for row in scaling):
        parts += [_PEERS, _settings_table(), "The machine-readable results are in [results.csv](results.csv).\n"]
    return "\n".join(parts)


def _told(case: Case) -> str:
    return f"{case.part}, warp length {case.warp_length_mm:g} mm, noise {1000 * case.noise_mm:g} µm"


def _settings_table() -> str:
    names = [field.name for field in fields(peers.DriftSettings)]
    rows = []
    for library, pair in peers.TUNED.items():
        for scans, settings in zip((f"≤ {peers.LARGE:,}", f"> {peers.LARGE:,}"), pair, strict=True):
            values = [f"{value:g}" if isinstance(value, float) else str(value) for value in asdict(settings).values()]
            rows.append((library, scans, *values))
    return markdown_table(("library", "scan points", *names), rows, 1)


def comma_separated(rows: Sequence[Row]) -> str:
    """All rows, all figures."""
    text = io.StringIO()
    columns = [field.name for field in (*fields(Case), *fields(Measurement))]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "pose", *columns])
    for row in rows:
        figures = [*asdict(row.case).values(), *asdict(row.found).values()]
        writer.writerow(
            [row.method.name, row.method.pose, *(f"{x:.6g}" if isinstance(x, float) else x for x in figures)]
        )
    return text.getvalue()


def scaling_picture(rows: Sequence[Row]) -> bytes:
    """PNG of time and of error against the number of points, both axes logarithmic."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    time, error = figure.subplots(1, 2)
    families: dict[str, int] = {}
    for method in dict.fromkeys(row.method for row in rows):
        mine = [row for row in rows if row.method == method and not row.found.error]
        points = [row.case.points for row in mine]
        family = method.label.partition(",")[0]
        variant = families[family] = families.get(family, -1) + 1
        style = {
            "marker": "o",
            "markersize": 4,
            "color": f"C{list(families).index(family)}",
            "linestyle": _LINE_STYLES[variant],
            "linewidth": 2.5 if method.is_product else 1.2,
        }
        label = method.label + (", pose searched" if method.pose == "searched" else "")
        time.plot(points, [row.found.seconds for row in mine], label=label, **style)
        error.plot(points, [row.found.unrecovered for row in mine], label=label, **style)
    _finish(time, "registration time, s")
    _finish(error, "share of the distortion not recovered")
    figure.legend(*time.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    image = io.BytesIO()
    figure.savefig(image, dpi=_DOTS_PER_INCH, format="png")
    return image.getvalue()


def _finish(axes: Axes, label: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel="scan points", ylabel=label)
    axes.grid(which="major", alpha=0.4)
    axes.grid(which="minor", alpha=0.15)


def write(folder: Path, scaling: Sequence[Row], quality: Sequence[Row], command: str, where: str) -> None:
    """README.md, results.csv and, of the scaling, its picture."""
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "README.md", page(scaling, quality, command, where).encode())
    write_atomically(folder / "results.csv", comma_separated([*scaling, *quality]).encode())
    if scaling:
        write_atomically(folder / "scaling.png", scaling_picture(scaling))
