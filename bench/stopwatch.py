"""What a piece of work takes."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType

_RESET_PEAK = "5"  # proc(5), clear_refs


class Stopwatch:
    """`with stopwatch:` around the work, once; what comes before and after it is not counted. Linux only.

    Attributes
    ----------
    seconds, cpu_seconds : float
        Elapsed, and of all threads together.
    before_mib, peak_mib : float
        Resident size of the process when the work begins, and the largest during it.
    """

    seconds = cpu_seconds = before_mib = peak_mib = float("nan")

    def __enter__(self) -> None:
        Path("/proc/self/clear_refs").write_text(_RESET_PEAK)  # making the scan took memory of its own
        self.before_mib = _resident_mib("VmRSS")
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.seconds = time.perf_counter() - self._wall
        self.cpu_seconds = time.process_time() - self._cpu
        self.peak_mib = _resident_mib("VmHWM")


def _resident_mib(name: str) -> float:
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(lines[name].split()[0]) / 1024.0
