"""`python -m bench.paper`: the paper's experiments with figures and numbers, written as a page."""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import scipy
from rich.console import Console
from threadpoolctl import threadpool_limits

import mdf_core
from bench.paper.page import SECTIONS, Section, page
from bench.report import command_line
from mdf_core.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.paper", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="a page with these alone")
    parser.add_argument("--cases", type=int, default=3, help="random cases to average over, at most 3 in space")
    parser.add_argument("--out", type=Path, default=ROOT / "docs/experiments", help="folder of README.md and figures")
    options = parser.parse_args(arguments)
    if options.cases < 1:
        parser.error("--cases must be 1 or more")
    console = Console()
    sections: list[Section] = []
    started = time.process_time()
    # The matrices are small: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"), console.status("running") as status:
        for name in options.only:
            status.update(name)
            begun = time.perf_counter()
            sections.append(SECTIONS[name](options.cases))
            console.print(f"{name}: {time.perf_counter() - begun:.0f} s", highlight=False)
    write(options.out, sections, made_by(command_line("bench.paper", arguments), started))
    console.print(f"{options.out / 'README.md'}", highlight=False)
    return 0


def write(folder: Path, sections: Sequence[Section], made_by_line: str) -> None:
    for section in sections:
        for name, png in section.figures.items():
            write_atomically(folder / name, png)
    write_atomically(folder / "README.md", page(sections, made_by_line).encode())


def made_by(command: str, started: float) -> str:
    versions = {
        "mdf_core": mdf_core.__version__,
        "Python": platform.python_version(),
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
        "Matplotlib": matplotlib.__version__,
    }
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    seconds = time.process_time() - started
    return (
        f"Written by `{command}` (`make experiments`) in {seconds:.0f} s of CPU time on {platform.machine()} with "
        f"{os.cpu_count()} CPUs. {told}."
    )


if __name__ == "__main__":
    sys.exit(main())
