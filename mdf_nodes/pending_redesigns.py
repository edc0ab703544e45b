"""Which inspections a redesign is due against: those that wait, those under way, and those that are done with."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from mdf_core.errors import (
    DesignFileError,
    DesignMismatchError,
    InvalidSettingError,
    LedgerError,
    NotActiveError,
    OutputFolderError,
)
from mdf_nodes.inspected import Pair, RecentPairs
from mdf_nodes.journal import Journal

_MOST_DONE = 100
_RETRY_SECONDS = 10.0
_MENDABLE = (OutputFolderError, LedgerError, InvalidSettingError, DesignFileError)  # without another scan


class PendingRedesigns:
    """The inspections of the part on their way to a redesign.

    They come by topic, and those in the journal wait there as well. Each is taken once, collected until a cycle has
    enough prints, and then marked as done or, where its redesign failed, deferred.

    Parameters
    ----------
    journal : callable
        The journal that is open now. One in memory keeps no results: only what came last by topic waits.
    most_bytes : int
        Of displacements that are kept at hand.

    Attributes
    ----------
    lock : threading.RLock
        Every method holds it; to be held over several that belong together.
    """

    def __init__(self, journal: Callable[[], Journal], most_bytes: int) -> None:
        self.lock = threading.RLock()
        self._journal = journal
        self._recent = RecentPairs(most_bytes)  # of prints of what is printed now
        self._latest: Pair | None = None  # that came by topic, until it is taken
        self._collected: list[Pair] = []  # prints of a cycle that is not complete
        # By job_id:
        self._taken: set[str] = set()  # collected, or its redesign waits or runs
        self._deferred_until: dict[str, float] = {}
        self._done: deque[str] = deque(maxlen=_MOST_DONE)
        self._recorded: set[str] = set()

    # What comes in

    def add(self, pair: Pair) -> bool:
        """An inspection has come by topic; whether it takes the place of one that still waited."""
        with self.lock:
            replaces, self._latest = self._latest is not None, pair
            self._recent.add(pair)
            return replaces

    def drop_latest(self) -> bool:
        """Let what came last by topic wait no longer; whether it did."""
        with self.lock:
            did_wait, self._latest = self._latest is not None, None
            return did_wait

    def named(self, job_ids: Sequence[str]) -> list[Pair]:
        """Those of these jobs, in their order; without any the latest.

        Raises
        ------
        NoInspectionError
            One of them is not at hand.
        """
        with self.lock:
            return self._recent.named(job_ids)

    # The way to a redesign

    def take(self) -> Pair | None:
        """The next one: of those in the journal the oldest, then what came last by topic.

        So the last redesign is that of the last scan.

        Raises
        ------
        StorageError
            The journal cannot be used.
        """
        with self.lock:
            pair = self._next_kept() or self._next_by_topic()
            if pair is not None:
                self._taken.add(pair.job_id)
            return pair

    def _next_kept(self) -> Pair | None:
        now = time.monotonic()
        self._deferred_until = {job_id: due for job_id, due in self._deferred_until.items() if due > now}
        while (kept := self._journal().next_result(self._taken | self._deferred_until.keys())) is not None:
            pair = Pair(*kept)
            if pair.job_id not in self._done:
                return pair
            self._journal().forget_result(pair.job_id)  # it could not when this one was done
        return None

    def _next_by_topic(self) -> Pair | None:
        pair, self._latest = self._latest, None
        known = {*self._taken, *self._deferred_until, *self._done, *self._recorded}
        return None if pair is None or pair.job_id in known else pair

    @property
    def collected(self) -> tuple[Pair, ...]:
        """Prints of the cycle that is not complete."""
        return tuple(self._collected)

    def collect(self, pair: Pair, count: int) -> list[Pair]:
        """Add a print to its cycle; all `count` of them once it is complete, else none."""
        with self.lock:
            self._collected.append(pair)
            if len(self._collected) < count:
                return []
            complete, self._collected = self._collected, []
            return complete

    # What comes of them

    def give_back(self, pairs: Sequence[Pair]) -> None:
        """Their redesign could not be queued: those in the journal are taken again."""
        with self.lock:
            self._taken.difference_update(pair.job_id for pair in pairs)

    def mark_done(self, pairs: Sequence[Pair]) -> None:
        """Nothing more is to be done about them.

        Raises
        ------
        StorageError
            The journal cannot forget them now; it is asked to again.
        """
        with self.lock:
            self.give_back(pairs)
            if self._journal().is_durable:  # else a registration that was started again uses the same names again
                self._done.extend(pair.job_id for pair in pairs)
                for pair in pairs:
                    self._journal().forget_result(pair.job_id)

    def fail(self, pairs: Sequence[Pair], error: Exception) -> None:
        """Take again later what another try may mend; the rest is done with.

        Raises
        ------
        StorageError
            As `mark_done`.
        """
        with self.lock:
            self.give_back(pairs)
            if isinstance(error, NotActiveError):  # what is in the journal waits there
                if self._latest is None and any(pair is self._recent.latest for pair in pairs):
                    self._latest = self._recent.latest
            elif isinstance(error, DesignMismatchError) and self._journal().is_durable:
                self._defer(pairs, math.inf)  # until another design is set
            elif isinstance(error, _MENDABLE) and self._journal().is_durable:
                self._defer(pairs, time.monotonic() + _RETRY_SECONDS)
            else:
                self.mark_done(pairs)

    def _defer(self, pairs: Sequence[Pair], until: float) -> None:
        self._deferred_until.update((pair.job_id, until) for pair in pairs)

    # What else happens to the cell

    def retry_deferred(self) -> None:
        """Whatever they failed by may be mended."""
        with self.lock:
            self._deferred_until.clear()

    def set_recorded(self, job_ids: set[str]) -> None:
        """Jobs that the ledger knows: a late subscriber is sent the last one once more."""
        with self.lock:
            self._recorded = job_ids

    def forget_prints(self) -> None:
        """Something else is printed now: what was inspected before is no print of it.

        Raises
        ------
        StorageError
            As `mark_done`.
        """
        with self.lock:
            collected, self._collected = self._collected, []
            self._recent.clear()
            self._latest = None
            self.mark_done(collected)
