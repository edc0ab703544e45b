"""One measurement in a process of its own: `python -m bench.measure METHOD CASE` writes it as JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass

import numpy as np

from bench.cases import Case, Problem, build_problem
from bench.methods import METHODS, Answer
from bench.possible import MOST_POINTS, possible_unrecovered
from bench.stopwatch import Stopwatch
from mdf_core.distortion import fraction_unrecovered
from mdf_core.errors import MdfError
from mdf_core.rigid import best_rigid_fit, transform

_NAN = float("nan")


@dataclass(frozen=True)
class Measurement:
    """What one run took and how good it was.

    Attributes
    ----------
    seconds, cpu_seconds : float
        Of the registration alone, the scan being in memory.
    peak_mib, before_mib : float
        Largest resident size of the process during the registration, and that when it begins.
    unrecovered : float
        Share of the distortion that was not found.
    std_ratio : float
        Predicted over actual RMS error; NaN where none is predicted.
    possible : float
        Share that was not found at best, see `possible_unrecovered`; NaN for peers and large scans.
    error : str
        Why there is no result.
    ran_out_of_time : bool
    """

    seconds: float = _NAN
    cpu_seconds: float = _NAN
    peak_mib: float = _NAN
    before_mib: float = _NAN
    unrecovered: float = _NAN
    std_ratio: float = _NAN
    possible: float = _NAN
    error: str = ""
    ran_out_of_time: bool = False


def measure(method: str, case: Case) -> Measurement:
    """Run it here and now."""
    problem, stopwatch = build_problem(case), Stopwatch()
    chosen = next(each for each in METHODS if each.name == method)
    try:
        displacement, std = chosen.run(problem, stopwatch)
    except MdfError as caught:
        return Measurement(*_cost(stopwatch), error=str(caught))
    unrecovered = fraction_unrecovered(problem.design, problem.displacement, displacement)
    is_compared = chosen.is_product and case.points <= MOST_POINTS
    possible = possible_unrecovered(case) if is_compared else _NAN
    return Measurement(*_cost(stopwatch), unrecovered, std_ratio(problem, (displacement, std)), possible)


def _cost(stopwatch: Stopwatch) -> tuple[float, float, float, float]:
    return stopwatch.seconds, stopwatch.cpu_seconds, stopwatch.peak_mib, stopwatch.before_mib


def std_ratio(problem: Problem, answer: Answer) -> float:
    """RMS of the predicted standard deviation over that of the error, by area."""
    displacement, std = answer
    if std is None:
        return _NAN
    design, weights = problem.design, problem.design.vertex_areas
    found, true = design.vertices + displacement, design.vertices + problem.displacement
    misfit = transform(best_rigid_fit(found, true, weights), found) - true
    return float(np.sqrt(np.average(std**2, weights=weights) / np.average((misfit**2).sum(axis=1), weights=weights)))


def measure_apart(method: str, case: Case, timeout: float) -> Measurement:
    """Run it in a process of its own, so that peak memory is its own and a crash is one result."""
    command = [sys.executable, "-m", "bench.measure", method, json.dumps(asdict(case))]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return Measurement(error=f"longer than {timeout:g} s", ran_out_of_time=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return Measurement(error=lines[-1] if lines else f"exit status {done.returncode}")
    return Measurement(**json.loads(done.stdout.splitlines()[-1]))  # libraries may print


if __name__ == "__main__":
    print(json.dumps(asdict(measure(sys.argv[1], Case(**json.loads(sys.argv[2]))))))
