"""What a check of a redesign found, and how that is said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mdf_core.geometry import Array, shown

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Check:
    """One property of a redesign, and whether it holds.

    Attributes
    ----------
    name : str
    passed : bool
    finding : str
        What was found, in numbers with their units, and the limit.
    place : (x, y, z), mm, or None
        Where it is worst: the face's, edge's or vertex' place in the design, for self-intersections where the redesign
        is cut. None where the check passed.
    """

    name: str
    passed: bool
    finding: str
    place: Place | None


def limited(name: str, largest: float, limit: float, finding: str, place: Place) -> Check:
    """A check that passes while `largest` is no larger than `limit`; a limit of 0 is none."""
    passed = limit == 0.0 or largest <= limit
    return Check(name, passed, finding, None if passed else place)


def place_of(point: Array) -> Place:
    """A point (3,) mm as a check names it."""
    x, y, z = point.tolist()
    return x, y, z


def describe_failures(checks: Sequence[Check]) -> str:
    """The checks that failed in one line, each with its name, finding and place; empty if all passed."""
    return "; ".join(
        f"{check.name}: {check.finding}" + (f", near {shown(check.place)}" if check.place else "")
        for check in checks
        if not check.passed
    )
