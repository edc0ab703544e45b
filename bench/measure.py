"""One measurement in a process of its own: `python -m bench.measure METHOD POINTS` writes it as JSON."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass

import numpy as np

from bench.cases import build_problem
from bench.methods import RUN
from mdf_core.errors import MdfError
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.virtual_cell import fraction_unrecovered


@dataclass(frozen=True)
class Measurement:
    """What one run took and how good it was.

    Attributes
    ----------
    seconds, cpu_seconds : float
        Of the registration alone, the scan being in memory.
    peak_mib, before_mib : float
        Largest resident size of the process, and that before the registration: the scan and what made it.
    unrecovered : float
        Share of the distortion that was not found.
    std_ratio : float
        Predicted over actual RMS error; NaN where none is predicted.
    error : str
        Why there is no result.
    """

    seconds: float
    cpu_seconds: float
    peak_mib: float
    before_mib: float
    unrecovered: float = float("nan")
    std_ratio: float = float("nan")
    error: str = ""


def measure(method: str, points: int) -> Measurement:
    """Run it here and now."""
    problem = build_problem(points)
    before = _peak_mib()
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        displacement, std = RUN[method](problem)
        error = ""
    except MdfError as caught:
        error = str(caught)
    cost = (time.perf_counter() - wall, time.process_time() - cpu, _peak_mib(), before)
    if error:
        return Measurement(*cost, error=error)
    design, truth = problem.design, problem.displacement
    ratio = float("nan")
    if std is not None:
        weights = design.vertex_areas
        found, true = design.vertices + displacement, design.vertices + truth
        misfit = transform(best_rigid_fit(found, true, weights), found) - true
        actual = np.average((misfit**2).sum(axis=1), weights=weights)
        ratio = float(np.sqrt(np.average(std**2, weights=weights) / actual))
    return Measurement(*cost, unrecovered=fraction_unrecovered(design, truth, displacement), std_ratio=ratio)


def measure_apart(method: str, points: int, timeout: float) -> Measurement:
    """Run it in a process of its own, so that peak memory is its own."""
    command = [sys.executable, "-m", "bench.measure", method, str(points)]
    nothing = (float("nan"),) * 4
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return Measurement(*nothing, error=f"longer than {timeout:g} s")
    if done.returncode:
        return Measurement(*nothing, error=(done.stderr.strip().splitlines() or ["no message"])[-1])
    return Measurement(**json.loads(done.stdout))


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # KiB on Linux


if __name__ == "__main__":
    json.dump(asdict(measure(sys.argv[1], int(sys.argv[2]))), sys.stdout)
