"""What a piece of work takes."""

from __future__ import annotations

import resource
import time
from types import TracebackType


class Stopwatch:
    """`with stopwatch:` around the work, once; what comes before and after it is not counted.

    Attributes
    ----------
    seconds, cpu_seconds : float
        Elapsed, and of all threads together.
    peak_mib, before_mib : float
        Largest resident size of the process so far, at the end of the work and at its beginning.
    """

    seconds = cpu_seconds = peak_mib = before_mib = float("nan")

    def __enter__(self) -> None:
        self.before_mib = _peak_mib()
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.seconds = time.perf_counter() - self._wall
        self.cpu_seconds = time.process_time() - self._cpu
        self.peak_mib = _peak_mib()


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # KiB on Linux
