"""The figures of the loops as tables and sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product

import numpy as np

import mdf_core as mdf
from bench.closed_loop.loops import METHODS, OURS, Cycle, Loop
from bench.closed_loop.plan import FEW_CYCLES, Plan, Row
from bench.closed_loop.wrong import Fate
from bench.report import markdown_table
from mdf_core.geometry import Array

_WANTED = (0.02, 0.01)  # left after one cycle, after two
_RIGHT = 0.1  # left: a pose was found though a wrong one was given


Results = Mapping[Loop, tuple[Cycle, ...]]
Fates = Mapping[str, Mapping[str, Fate]]
"""By part and by what is wrong."""


def figures(results: Results, loops: Iterable[Loop], number: int, name: str = "left") -> Array:
    """One figure of cycle `number`, from 0, of those loops that came so far."""
    return np.array([getattr(results[loop][number], name) for loop in loops if len(results[loop]) > number])


def span(values: Array) -> str:
    return f"{values.min():.3f} to {values.max():.3f}" if len(values) else "all refused"


def cell(results: Results, row: Row, number: int, name: str = "left") -> str:
    """Mean, with least and most of several, and how many loops were refused by then."""
    loops = [loop for loop in row.loops if loop.cycles > number]
    values = figures(results, loops, number, name)
    told = [f"{values.mean():.3f}"] if len(values) else []
    if len(values) > 1:
        told = [f"{values.mean():.3f} ({values.min():.3f}–{values.max():.3f})"]
    if len(values) < len(loops):
        told.append(f"{len(loops) - len(values)} refused")
    return ", ".join(told)


def mean(results: Results, row: Row, number: int, name: str) -> str:
    values = figures(results, row.loops, number, name)
    return f"{values.mean():.3f}" if len(values) and np.isfinite(values).all() else ""


# Tables


def _after(plan: Plan) -> list[str]:
    return [f"after {number}" for number in range(1, plan.cycles + 1)]


def _left(plan: Plan, results: Results, row: Row) -> list[str]:
    return [cell(results, row, number) for number in range(plan.cycles)]


def method_table(plan: Plan, results: Results) -> str:
    rows = [("any", "any", "no compensation", *["1"] * (plan.cycles + 1))]
    rows += [(*row.words, *_left(plan, results, row), cell(results, row, 0, "largest")) for row in plan.by_method]
    return markdown_table(("part", "printer", "method", *_after(plan), "largest after 1"), rows, 3)


def points_table(plan: Plan, results: Results) -> str:
    rows = [(*row.words, cell(results, row, 0), cell(results, row, 0, "largest")) for row in plan.by_points]
    return markdown_table(("method", "points", "after 1", "largest after 1"), rows, 1)


def prints_table(plan: Plan, results: Results) -> str:
    rows = [
        (*row.words, f"{variation / np.sqrt(prints):.3f}", *_left(plan, results, row))
        for row, (variation, prints) in zip(plan.by_prints, plan.repeated, strict=True)
    ]
    return markdown_table(("variation", "prints", "variation / √prints", *_after(plan)), rows, 0)


def estimates_table(plan: Plan, results: Results) -> str:
    cycles = range(min(plan.cycles, FEW_CYCLES))
    told = [f"{what} after {number + 1}" for number in cycles for what in ("left", "predicted", "variation found")]
    each = list(product(cycles, ("left", "predicted", "variation")))
    rows = [(*row.words, *(mean(results, row, number, name) for number, name in each)) for row in plan.by_prints]
    return markdown_table(("variation", "prints", *told), rows, 0)


def noise_table(plan: Plan, results: Results) -> str:
    rows = [(*row.words, *_left(plan, results, row)) for row in plan.by_noise]
    return markdown_table(("noise µm", *_after(plan)), rows, 0)


def hidden_table(plan: Plan, results: Results) -> str:
    each = list(product(dict.fromkeys((0, plan.cycles - 1)), ("left", "left_seen")))
    told = [f"{'seen, ' if name == 'left_seen' else ''}after {number + 1}" for number, name in each]
    rows = [
        (
            *row.words,
            *(cell(results, row, number, name) for number, name in each),
            *(f"{count}" for count in unmoved(results, [row])),
        )
        for row in plan.by_hidden
    ]
    return markdown_table(("part", "hidden", *told, "beyond the blend", "of them moved"), rows, 1)


def unmoved(results: Results, rows: Iterable[Row]) -> tuple[int, int]:
    """Vertices beyond the blend, over all cycles of all loops, and how many of them were moved."""
    cycles = [cycle for row in rows for loop in row.loops for cycle in results[loop]]
    return sum(cycle.beyond for cycle in cycles), sum(cycle.moved for cycle in cycles)


def wrong_table(fates: Fates) -> str:
    names = next(iter(fates.values()))
    rows = [(name, *(str(each[name]) for each in fates.values())) for name in names]
    return markdown_table(("scan", *fates), rows, 1 + len(fates))


# What is seen


def kept(results: Results, loops: Sequence[Loop]) -> str:
    """Whether a later cycle ever leaves more than the first."""
    left = [[cycle.left for cycle in results[loop]] for loop in loops if results[loop]]
    growth = np.array([max(values) / values[0] - 1.0 for values in left])
    count = int((growth > 0.0).sum())
    most = f", by {growth.max():.1%} at most" if count else ""
    return f"In {count} of {len(loops)} loops a later cycle leaves more than the first{most}."


def methods_seen(plan: Plan, results: Results) -> str:
    lines = []
    for name in METHODS:
        loops = plan.loops_of(name)
        spans = [f"{span(figures(results, loops, n))} after {n + 1}" for n in range(loops[0].cycles)]
        lines.append(f"- {name}: {', '.join(spans)}")
    ours = plan.loops_of(OURS)
    within = [
        f"at most {limit:g} after {number + 1} in {int((figures(results, ours, number) <= limit).sum())}"
        for number, limit in enumerate(_WANTED[: plan.cycles])
    ]
    return "\n".join([*lines, "", f"Ours leaves {', '.join(within)} of {len(ours)} loops.", kept(results, ours)])


def estimates_seen(plan: Plan, results: Results) -> str:
    every = [loop for row in plan.by_prints for loop in row.loops]
    repeated = [loop for loop in every if loop.prints > 1 and loop.variation > 0]
    told = []
    for name, loops in (("one print", [loop for loop in every if loop.prints == 1]), ("several that vary", repeated)):
        for number in range(min(plan.cycles, FEW_CYCLES)):
            ratios = figures(results, loops, number, "predicted") / figures(results, loops, number)
            told.append(f"- predicted over left, of {name}, after {number + 1}: {span(ratios)}")
    found = figures(results, repeated, 0, "variation") / np.array([loop.variation for loop in repeated])
    return "\n".join([*told, f"- variation found over the true one, after 1: {span(found)}"])


def wrong_seen(fates: Fates) -> str:
    every = [fate for each in fates.values() for fate in each.values()]
    refused = sum(bool(fate.refusal) for fate in every)
    right = sum(fate.left <= _RIGHT for fate in every)
    wrong = [fate.verdict for fate in every if fate.left > _RIGHT]
    return (
        f"Of {len(every)} inputs {refused} are refused, {right} are measured right all the same, and {len(wrong)} end\n"
        f"in a wrong redesign, {wrong.count(mdf.Verdict.PASS.value)} of these with the verdict PASS."
    )
