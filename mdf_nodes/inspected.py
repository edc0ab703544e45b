"""Inspections and their displacement, as they come by topic: joined, and the newest of them at hand."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mdf_interfaces.msg import Inspection as InspectionMessage
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import NoInspectionError

_MOST_UNPAIRED = 4
_MOST_NAMED = 8


@dataclass(frozen=True, eq=False)
class Pair:
    """One inspection and its displacement."""

    inspection: InspectionMessage
    displacement: PointCloud2

    @property
    def job_id(self) -> str:
        """Of the inspection."""
        return str(self.inspection.job_id)


class Pairing:
    """Joins inspections and displacements by their stamps, whichever comes first.

    One scan may be registered several times; both topics keep the order, so the oldest ones belong together.
    """

    def __init__(self) -> None:
        self._unpaired: deque[Any] = deque(maxlen=_MOST_UNPAIRED)

    def add(self, message: Any) -> Pair | None:
        """The pair that `message` completes."""
        for other in self._unpaired:
            if type(other) is not type(message) and other.header.stamp == message.header.stamp:
                self._unpaired.remove(other)
                inspection, displacement = sorted((message, other), key=lambda each: isinstance(each, PointCloud2))
                return Pair(inspection, displacement)
        self._unpaired.append(message)
        return None


MOST_PAIRS = 50
"""Prints that somebody may name for a redesign."""


class RecentPairs:
    """The newest 50 pairs, or as many as `most_bytes` of displacements hold; the last one always.

    Not safe between threads.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._pairs: dict[str, Pair] = {}  # by job_id, the oldest first

    @property
    def latest(self) -> Pair | None:
        """The one that came last."""
        return next(reversed(self._pairs.values()), None)

    def add(self, pair: Pair) -> None:
        """Keep a pair, instead of an older one of the same job; the oldest of too many are forgotten."""
        self._pairs.pop(pair.job_id, None)
        self._pairs[pair.job_id] = pair
        held = sum(len(each.displacement.data) for each in self._pairs.values())
        for job_id in list(self._pairs)[:-1]:
            if held <= self._most_bytes and len(self._pairs) <= MOST_PAIRS:
                break
            held -= len(self._pairs.pop(job_id).displacement.data)

    def clear(self) -> None:
        """Forget all of them."""
        self._pairs.clear()

    def named(self, job_ids: Sequence[str]) -> list[Pair]:
        """Those of these jobs, in their order; without any the latest.

        Raises
        ------
        NoInspectionError
            One of them is not here.
        """
        if not self._pairs:
            raise NoInspectionError(
                "no print of what is printed now has been inspected", "topic inspection", "register a scan first"
            )
        missing = [job_id for job_id in job_ids if job_id not in self._pairs]
        if missing:
            here = list(self._pairs)[-_MOST_NAMED:]
            raise NoInspectionError(
                f"no inspection {', '.join(missing)} of a print of what is printed now is at hand",
                "job_ids",
                f"name some of the last ones, {', '.join(here)}, or register the scans again",
            )
        return [self._pairs[job_id] for job_id in job_ids or list(self._pairs)[-1:]]
