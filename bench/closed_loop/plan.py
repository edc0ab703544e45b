"""Which loops are run, and the rows of the tables that they answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from bench.cases import NOISES_MM
from bench.closed_loop.loops import METHODS, MODELS, OURS, Loop

HIDDEN = 0.2
DENSER = 25
FEW_CYCLES = 2
"""Enough to see how the others go on."""

_MOST_PRINTS = 16  # of a loop that makes several per cycle


@dataclass(frozen=True)
class Row:
    """Loops that differ by part and seed only, and the words before their figures."""

    words: tuple[str, ...]
    loops: list[Loop]


@dataclass(frozen=True)
class Plan:
    """How much is run; every question is answered by rows."""

    parts: Sequence[str]
    prints: Sequence[int]
    variations: Sequence[float]
    cycles: int
    points: int
    seeds: int

    def row(self, words: tuple[str, ...], method: str, parts: Sequence[str] = (), **kind: Any) -> Row:
        """Of all parts, or of those given, with every seed."""
        each = product(parts or self.parts, range(self.seeds))
        cycles = self.cycles if method == OURS else min(self.cycles, FEW_CYCLES)
        loops = [Loop(method, part, self.points, cycles, seed) for part, seed in each]
        return Row(words, [replace(loop, **kind) for loop in loops])

    @property
    def by_method(self) -> list[Row]:
        kinds = product(self.parts, MODELS, METHODS)
        return [self.row((part, model, name), name, [part], model=model) for part, model, name in kinds]

    def loops_of(self, method: str) -> list[Loop]:
        return [loop for row in self.by_method for loop in row.loops if loop.method == method]

    @property
    def by_points(self) -> list[Row]:
        few, many = self.points, DENSER * self.points
        sparse = [self.row((name, f"{few:,}"), name) for name in METHODS]
        return sparse + [self.row((name, f"{many:,}"), name, points=many, cycles=1) for name in METHODS]

    @property
    def repeated(self) -> list[tuple[float, int]]:
        return list(product(self.variations, self.prints))

    @property
    def by_prints(self) -> list[Row]:
        return [self._repeated(variation, prints) for variation, prints in self.repeated]

    def _repeated(self, variation: float, prints: int) -> Row:
        # Several prints that are all alike only average the noise of the scans: one cycle shows it.
        most = _MOST_PRINTS // prints if variation else 1
        cycles = self.cycles if prints == 1 else min(self.cycles, max(most, 1))
        return self.row((f"{variation:g}", f"{prints}"), OURS, variation=variation, prints=prints, cycles=cycles)

    @property
    def by_noise(self) -> list[Row]:
        return [self.row((f"{1e3 * noise:g}",), OURS, noise_mm=noise) for noise in NOISES_MM]

    @property
    def by_hidden(self) -> list[Row]:
        kinds = product(self.parts, (0.0, HIDDEN))
        return [self.row((part, f"{hidden:g}"), OURS, [part], hidden=hidden) for part, hidden in kinds]

    @property
    def loops(self) -> list[Loop]:
        rows = (*self.by_method, *self.by_points, *self.by_prints, *self.by_noise, *self.by_hidden)
        return list(dict.fromkeys(loop for row in rows for loop in row.loops))
