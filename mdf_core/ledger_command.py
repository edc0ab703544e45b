"""``mdf ledger``: show the redesigns of parts, release them, or go back."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from mdf_core.command import cycle_line, warn

if TYPE_CHECKING:
    from mdf_core.ledger import Ledger

_PIPED_WIDTH = 240
_URL = "such as sqlite:////absolute/path/ledger.sqlite"


def add_ledger(commands: Any) -> None:
    """The command ``ledger``."""
    steps = commands.add_parser("ledger", help="show the redesigns of parts, release them, or go back").add_subparsers(
        required=True, metavar="STEP"
    )
    shown = steps.add_parser("show", help="all cycles, oldest first")
    shown.add_argument("url", metavar="URL", help=_URL)
    shown.add_argument("--part-id", metavar="NAME", default="", help="only those of this part")
    shown.set_defaults(run=_show)
    for name, run, text in (
        ("release", _release, "from now on this redesign is what is printed"),
        ("reject", _reject, "this redesign is not to be printed"),
        ("roll-back", _roll_back, "print what was printed before this redesign"),
    ):
        step = steps.add_parser(name, help=text)
        step.add_argument("url", metavar="URL", help=_URL)
        step.add_argument("cycle", metavar="ID", type=int, help="of the redesign, as show lists it")
        step.add_argument("--by", metavar="NAME", required=True, help="who decides")
        if run is not _release:
            step.add_argument("--reason", metavar="TEXT", required=True, help="why")
        step.set_defaults(run=run)


def _existing_ledger(url: str) -> Ledger:
    from mdf_core.ledger import Ledger
    from mdf_core.ledger_database import require_existing

    require_existing(url)
    return Ledger(url)


def _show(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.table import Table

    with _existing_ledger(options.url) as ledger:
        cycles = ledger.history(options.part_id)
    table = Table()
    residuals = ("before mm", "expected mm", "last reprint mm")
    for heading in ("id", "part", "design", "cycle", "gain", "state", *residuals, "by", "reason"):
        table.add_column(heading)
    for cycle in cycles:
        figures = (cycle.residual_before_mm, cycle.predicted_residual_mm, cycle.measured_residual_mm)
        shown = ["" if figure is None else f"{figure:.3f}" for figure in figures]
        texts = (cycle.part_id, cycle.design_sha256[:8], str(cycle.number), f"{cycle.gain:g}", cycle.state.value)
        table.add_row(str(cycle.id), *texts, *shown, cycle.decided_by, cycle.reason)
    # What is piped on is not cut to the width of a terminal.
    Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH).print(table)


def _release(options: argparse.Namespace) -> None:
    from mdf_core.cycles import require_file

    with _existing_ledger(options.url) as ledger:
        require_file(ledger.cycle(options.cycle))
        print(cycle_line(ledger.release(options.cycle, options.by)))


def _reject(options: argparse.Namespace) -> None:
    with _existing_ledger(options.url) as ledger:
        print(cycle_line(ledger.reject(options.cycle, options.by, options.reason)))


def _roll_back(options: argparse.Namespace) -> None:
    from mdf_core.cycles import has_its_file

    with _existing_ledger(options.url) as ledger:
        current = ledger.roll_back(options.cycle, options.by, options.reason)
    print("printed from now on: " + ("the design" if current is None else f"{cycle_line(current)}, {current.stl_path}"))
    if current is not None and not has_its_file(current):
        warn(f"{current.stl_path} is gone, or not the redesign that was released: do not print it")
