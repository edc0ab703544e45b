"""`python -m bench.closed_loop`: what is left of the distortion when print, scan and redesign follow one another."""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track

from bench.cases import PARTS
from bench.closed_loop.loops import close
from bench.closed_loop.page import page, picture
from bench.closed_loop.plan import Plan
from bench.closed_loop.wrong import wrong_inputs
from bench.report import command_line, machine
from mdf_core.files import write_atomically


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.closed_loop", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--prints", nargs="+", type=int, default=(1, 3, 8), help="prints per cycle")
    parser.add_argument("--cycles", type=int, default=4)
    parser.add_argument("--variations", nargs="+", type=float, default=(0.0, 0.1, 0.3), help="from print to print")
    parser.add_argument("--points", type=int, default=8_000, help="points of the scans")
    parser.add_argument("--seeds", type=int, default=3, help="warps, each with prints and scans of its own")
    parser.add_argument("--jobs", type=int, default=1, help="loops at a time")
    parser.add_argument("--out", type=Path, help="write the tables as markdown to this file, and a PNG beside it")
    options = parser.parse_args(arguments)
    if min(*options.prints, options.cycles, options.seeds, options.jobs) < 1:
        parser.error("--prints, --cycles, --seeds and --jobs must be 1 or more")
    command, where = command_line("bench.closed_loop", arguments), machine()
    plan = Plan(options.parts, options.prints, options.variations, options.cycles, options.points, options.seeds)
    console = Console()
    begun = time.perf_counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        cycles = track(pool.map(close, plan.loops), "loops", total=len(plan.loops), console=console)
        results = dict(zip(plan.loops, cycles, strict=True))
        fates = dict(zip(plan.parts, pool.map(partial(wrong_inputs, points=plan.points), plan.parts), strict=True))
    minutes = (time.perf_counter() - begun) / 60.0
    picture_name = options.out.with_suffix(".png").name if options.out else ""
    made = f"Made by\n\n    {command}\n\nin {minutes:.0f} min on {where}."
    text = page(plan, results, fates, picture_name, made)
    console.print(Markdown(text))
    if options.out:
        write_atomically(options.out, text.encode())
        write_atomically(options.out.with_suffix(".png"), picture(plan, results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
