"""`python -m bench.paper_scale`: the paper's 3D experiment, its sizes and parameters, on a part whose truth is known.

1,990,267 scan points, thinned by a 2 mm box grid to one random point per box, are registered to 44,868 design nodes
with β = 3, α = 2, ω = 0.1; beside it the surface stage on the same points. The pose is known, all is in memory.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from trimesh.remesh import subdivide_to_size

import mdf_core as mdf
from bench.cases import WARP_LENGTHS_MM, WARP_MM, Problem
from bench.report import command_line, figures_table, machine, markdown_table
from bench.stopwatch import Stopwatch
from mdf_core.distortion import distortion_left, fraction_unrecovered
from mdf_core.files import write_atomically
from mdf_core.geometry import Design, PointSet
from mdf_core.progress import silent
from mdf_core.registration import register_mixture
from mdf_core.rigid import best_rigid_fit, inverse, transform
from mdf_core.sampling import areas_from_density, thin
from mdf_core.settings import MixtureSettings, ThinningSettings
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part

SCAN_NODES, DESIGN_NODES = 1_990_267, 44_868
BOX_MM, SEED = 2.0, 0
PAPER = MixtureSettings(beta=3.0, alpha=2.0, outlier_share=0.1)
HEADINGS = ("method", "points", "steps", "time s", "CPU s", "peak MiB", "frac", "left µm")


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method found: mm at the design's nodes."""

    displacement: np.ndarray
    redesign: np.ndarray
    points: int
    iterations: int


@dataclass(frozen=True)
class Result:
    """What it took and how good it was.

    Attributes
    ----------
    points, iterations : int
        Scan points that the registration took, and its iterations.
    seconds, cpu_seconds : float
        From the arrays in memory to the displacement and the redesign.
    peak_mib, before_mib : float
        Largest resident size of the process while it worked, and what it had before: interpreter and arrays.
    unrecovered : float
        Share of the distortion that was not found.
    left_mm : float
        RMS distortion of the next print, made from the redesign.
    distortion_mm : float
        That of the print that was scanned.
    """

    points: int
    iterations: int
    seconds: float
    cpu_seconds: float
    peak_mib: float
    before_mib: float
    unrecovered: float
    left_mm: float
    distortion_mm: float


def refined(design: Design, nodes: int) -> Design:
    """The same surface with exactly so many vertices."""
    low, high = 0.0, float(np.ptp(design.vertices, axis=0).max())  # longest edges that give too many, few enough
    finest = design.vertices, design.faces
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        vertices, faces = subdivide_to_size(design.vertices, design.faces, middle)
        if len(vertices) > nodes:
            low = middle
        else:
            high, finest = middle, (vertices, faces)
    vertices, faces = finest
    # Each of the largest faces gets one more, in its middle.
    largest = np.argsort(-Design(vertices, faces).face_areas, kind="stable")[: nodes - len(vertices)]
    a, b, c = faces[largest].T
    centre = len(vertices) + np.arange(len(largest))
    thirds = np.vstack([np.stack(corners, axis=1) for corners in ((a, b, centre), (b, c, centre), (c, a, centre))])
    centres = vertices[faces[largest]].mean(axis=1)
    return Design(np.vstack([vertices, centres]), np.vstack([np.delete(faces, largest, axis=0), thirds]))


def build() -> Problem:
    """The bracket of the other benchmarks with the paper's number of nodes, and a scan of its print in any pose.

    The scan brings the areas of its points, as that of the paper, a mesh, does: neighbours tell them only before it is
    thinned.
    """
    design = refined(build_part("bracket"), DESIGN_NODES)
    displacement = Warp(design, WARP_MM, WARP_LENGTHS_MM[0])(design.vertices)
    scanner = ScannerSettings(points=SCAN_NODES, pose="random")
    virtual = scan_part(design.vertices + displacement, design.faces, scanner)
    points = virtual.scan.points
    scan = PointSet(points, virtual.scan.normals, areas_from_density(points))
    return Problem(design, displacement, scan, inverse(virtual.pose))


def mixture(problem: Problem, area_weighted: bool) -> Answer:
    """The paper's way: box grid, registration of points to nodes, displacement at the nodes, redesign."""
    design = problem.design
    thinned = thin(problem.scan, ThinningSettings(box_mm=BOX_MM), SEED)
    scan = PointSet(transform(problem.pose, thinned.points), areas=thinned.areas)
    found = register_mixture(scan, design.vertices, PAPER, area_weighted, design.scale, silent)
    displaced = design.vertices + found.deformation.displacement_at(design.vertices)
    datum = best_rigid_fit(displaced, design.vertices, design.vertex_areas)
    deformation = replace(found.deformation, datum=datum)
    redesign = design.vertices + deformation.inverse_displacement_at(design.vertices)
    return Answer(transform(datum, displaced) - design.vertices, redesign, len(scan), found.iterations)


def surface(problem: Problem) -> Answer:
    settings = mdf.Settings().replace({"pose.initial": problem.pose_numbers})
    inspection = mdf.inspect(problem.design, problem.scan, settings)
    redesign = mdf.compensate(problem.design, [inspection], settings)
    points = len(inspection.deviation.is_outlier)
    return Answer(inspection.displacement, redesign.vertices, points, inspection.iterations)


METHODS: dict[str, tuple[str, Callable[[Problem], Answer]]] = {
    "mdf": ("MDF", lambda problem: mixture(problem, True)),
    "cpd": ("CPD", lambda problem: mixture(problem, False)),
    "surface": ("surface stage", surface),
}


def measure(method: str, path: Path) -> Result:
    """Run it here and now on the case saved at `path`."""
    with np.load(path) as case:
        design, scan = Design(case["vertices"], case["faces"]), PointSet(case["points"], case["normals"], case["areas"])
        problem = Problem(design, case["displacement"], scan, case["pose"])
    stopwatch = Stopwatch()
    with stopwatch:
        answer = METHODS[method][1](problem)
    # The warp is a field in space: it distorts the redesign as it did the design.
    warp = Warp(design, WARP_MM, WARP_LENGTHS_MM[0])
    return Result(
        points=answer.points,
        iterations=answer.iterations,
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        peak_mib=stopwatch.peak_mib,
        before_mib=stopwatch.before_mib,
        unrecovered=fraction_unrecovered(design, problem.displacement, answer.displacement),
        left_mm=distortion_left(design, answer.redesign + warp(answer.redesign))[0],
        distortion_mm=distortion_left(design, design.vertices + problem.displacement)[0],
    )


def measure_apart(method: str, path: Path, timeout: float) -> Result:
    """Run it in a process of its own, so that peak memory is its own."""
    command = [sys.executable, "-m", "bench.paper_scale", "--measure", method, "--case", str(path)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=timeout, check=True)
    return Result(**json.loads(done.stdout))


def cells(method: str, found: Result) -> tuple[str, ...]:
    return (
        METHODS[method][0],
        f"{found.points:,}",
        f"{found.iterations}",
        f"{found.seconds:.1f}",
        f"{found.cpu_seconds:.1f}",
        f"{found.peak_mib:.0f}",
        f"{found.unrecovered:.4f}",
        f"{1e3 * found.left_mm:.1f}",
    )


def markdown(rows: list[tuple[str, Result]], where: str, command: str) -> str:
    before = max(found.before_mib for _, found in rows)
    distortion = 1e3 * rows[0][1].distortion_mm
    text = f"""\
# At the paper's scale

A scan of {SCAN_NODES:,} points of the virtual bracket and a design of {DESIGN_NODES:,} nodes: the sizes of the paper's
3D experiment. The print is {distortion:.0f} µm (RMS) off its design, {1e3 * WARP_MM:.0f} µm at most; the scan has 20 µm
noise and 1 % outliers. MDF and CPD run with the paper's parameters (β = {PAPER.beta:g}, α = {PAPER.alpha:g},
ω = {PAPER.outlier_share:g}) on one random point per box of {BOX_MM:g} mm, with the design's nodes as data; the surface
stage runs with its defaults.

- **time**, **CPU**: from the arrays in memory and a known pose to the displacement at the nodes and the redesign.
- **peak**: every line is a process of its own; {before:.0f} MiB are the interpreter, the libraries and the arrays.
- **frac**: share of the distortion that is *not* recovered (0 all found, 1 nothing found).
- **left**: RMS distortion of the next print, made from the redesign.

Made by

    {command}

on {where}.

"""
    return text + markdown_table(HEADINGS, [cells(*row) for row in rows], 1)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.paper_scale", description=__doc__)
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds after which a method is given up")
    parser.add_argument("--out", type=Path, help="write the table as markdown to this file")
    parser.add_argument("--measure", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--case", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.measure:
        json.dump(asdict(measure(options.measure, options.case)), sys.stdout)
        return 0

    command, where = command_line("bench.paper_scale", arguments), machine()
    console = Console()
    console.print(f"{command}\n{where}", highlight=False)
    rows: list[tuple[str, Result]] = []
    with tempfile.TemporaryDirectory() as folder, console.status("printing and scanning") as status:
        path = Path(folder) / "case.npz"
        problem = build()
        design, scan = problem.design, problem.scan
        console.print(f"{len(scan):,} scan points, {len(design.vertices):,} design nodes", highlight=False)
        np.savez(
            path,
            vertices=design.vertices,
            faces=design.faces,
            displacement=problem.displacement,
            points=scan.points,
            normals=scan.normals,
            areas=scan.areas,
            pose=problem.pose,
        )
        for method, (label, _) in METHODS.items():
            status.update(label)
            rows.append((method, measure_apart(method, path, options.timeout)))
    table = figures_table(HEADINGS, 1)
    for row in rows:
        table.add_row(*cells(*row))
    console.print(table)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.out, markdown(rows, where, command).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
