"""`python -m bench`: how long, how much memory, how accurate; beside other methods in the same run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from rich.console import Console
from rich.live import Live

from bench.cases import FULL_SIZES, SIZES, Case, quality_cases
from bench.measure import measure_apart
from bench.methods import METHODS, Method
from bench.report import QUALITY_HEADINGS, SCALING_HEADINGS, Row, command_line, figures_table, machine, write

PARTS = ("scaling", "quality")


def scaling_jobs(methods: list[Method], sizes: Iterable[int]) -> list[tuple[Method, Case]]:
    """The bracket at every size, by every method that is up to it."""
    return [(method, Case(points=points)) for points in sizes for method in methods if points <= method.most_points]


def quality_jobs(points: int) -> list[tuple[Method, Case]]:
    """The product, from the known pose."""
    return [(METHODS[0], case) for case in quality_cases(points)]


def measured(jobs: list[tuple[Method, Case]], timeout: float) -> Iterator[Row]:
    """One after the other; a method that ran out of time is not asked for larger scans."""
    given_up: set[str] = set()
    for method, case in jobs:
        if method.name not in given_up:
            found = measure_apart(method.name, case, timeout)
            if found.ran_out_of_time:
                given_up.add(method.name)
            yield Row(method, case, found)


def shown(console: Console, title: str, headings: tuple[str, ...], rows: Iterator[Row]) -> list[Row]:
    """All rows, each in a table on the terminal as soon as it is there."""
    table = figures_table(headings, 2, title)
    done = []
    with Live(table, console=console, auto_refresh=False, vertical_overflow="visible") as live:
        for row in rows:
            table.add_row(*(row.scaling_cells if headings == SCALING_HEADINGS else row.quality_cells))
            live.refresh()
            done.append(row)
    return done


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="points of the scans")
    parser.add_argument("--full", action="store_true", help=f"also {', '.join(f'{size:,}' for size in FULL_SIZES)}")
    names = [method.name for method in METHODS]
    parser.add_argument("--methods", nargs="+", choices=names, default=names)
    parser.add_argument("--only", choices=PARTS, help="one of the two tables")
    parser.add_argument("--quality-points", type=int, default=20_000, help="points of the second table's scans")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds after which a run is given up")
    parser.add_argument("--out", type=Path, help="write README.md, results.csv and scaling.png into this folder")
    options = parser.parse_args(arguments)
    command, where = command_line("bench", arguments), machine()

    console = Console()
    console.print(f"{command}\n{where}", highlight=False)
    missing = sorted({method.needs for method in METHODS if not method.is_available})
    if missing:
        console.print(f"left out, not installed: {', '.join(missing)}", highlight=False)
    methods = [method for method in METHODS if method.name in options.methods and method.is_available]
    sizes = [*options.sizes, *(FULL_SIZES if options.full else ())]
    scaling, quality = [], []
    if options.only != "quality":
        rows = measured(scaling_jobs(methods, sizes), options.timeout)
        scaling = shown(console, "time and error against the number of points", SCALING_HEADINGS, rows)
    if options.only != "scaling":
        rows = measured(quality_jobs(options.quality_points), options.timeout)
        quality = shown(console, "parts, warp lengths and noises", QUALITY_HEADINGS, rows)
    if options.out:
        write(options.out, scaling, quality, command, where)
    # What other methods cannot do is a result; what the product cannot do is a failure.
    return 1 if any(row.found.error for row in (*scaling, *quality) if row.method.is_product) else 0


if __name__ == "__main__":
    sys.exit(main())
