"""`python -m bench`: how long, how much memory, how accurate; beside other methods in the same run."""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import sys
from pathlib import Path

import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

from bench.cases import FULL_SIZE, METHODS, SIZES, Method
from bench.measure import Measurement, measure_apart
from mdf_core.files import write_atomically

HEADINGS = ("method", "pose", "points", "seconds", "CPU s", "peak MiB", "not recovered", "predicted / actual sd")
Row = tuple[Method, int, Measurement]


def cells(method: Method, points: int, found: Measurement) -> tuple[str, ...]:
    cost = (f"{found.seconds:.2f}", f"{found.cpu_seconds:.2f}", f"{found.peak_mib:.0f}")
    quality = (f"{found.unrecovered:.4f}", "" if np.isnan(found.std_ratio) else f"{found.std_ratio:.2f}")
    pose = "searched" if method.searches_pose else "known"
    return (method.label, pose, f"{points:,}", *cost, *((found.error, "") if found.error else quality))


def machine() -> str:
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}"
    load = os.getloadavg()[0]
    return f"{platform.machine()}, {os.cpu_count()} CPUs, load {load:.1f} at the start, {versions}"


def markdown(rows: list[Row], command: str, where: str) -> str:
    lines = [
        "Virtual bracket of 100 mm, warped by up to 2.5 mm, 20 µm noise, 1 % outliers. Not recovered: the share of the",
        "distortion that was missed (0 all found, 1 nothing found). Every line is a process of its own; its peak",
        "memory counts the interpreter, the scan and what made it.",
        "",
        f"Made by `{command}` on {where}.",
        "",
        "| " + " | ".join(HEADINGS) + " |",
        "|---|---|" + "---:|" * (len(HEADINGS) - 2),
        *("| " + " | ".join(cells(*row)) + " |" for row in rows),
    ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="points of the scans")
    parser.add_argument("--full", action="store_true", help=f"also {FULL_SIZE:,} points")
    names = [method.name for method in METHODS]
    parser.add_argument("--methods", nargs="+", choices=names, default=names)
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds after which a run is given up")
    parser.add_argument("--out", type=Path, help="write the table as markdown to this file")
    options = parser.parse_args(arguments)
    given = sys.argv[1:] if arguments is None else arguments
    command, where = shlex.join(["python", "-m", "bench", *given]), machine()

    console = Console()
    console.print(f"{command}\n{where}", highlight=False)
    missing = sorted({method.needs for method in METHODS if not method.is_available})
    if missing:
        console.print(f"left out, not installed: {', '.join(missing)}", highlight=False)
    rows: list[Row] = []
    with console.status("measuring") as status:
        for points in [*options.sizes, *([FULL_SIZE] if options.full else [])]:
            for method in METHODS:
                if method.name in options.methods and method.is_available and points <= method.most_points:
                    status.update(f"{method.label}, {points:,} points")
                    rows.append((method, points, measure_apart(method.name, points, options.timeout)))
    table = Table(*HEADINGS)
    for column in table.columns[2:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*cells(*row))
    console.print(table)
    if options.out:
        write_atomically(options.out, markdown(rows, command, where).encode())
    # What other methods cannot do is a result; what the product cannot do is a failure.
    return 1 if any(found.error for method, _, found in rows if method.is_product) else 0


if __name__ == "__main__":
    sys.exit(main())
