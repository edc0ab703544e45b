"""The methods that are compared: each takes a problem and gives the displacement at the design's vertices."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import mdf_core as mdf
from bench import peers
from bench.cases import Problem
from bench.stopwatch import Stopwatch
from mdf_core.geometry import Array

Answer = tuple[Array, Array | None]
"""Displacement (n, 3) and its standard deviation (n,) in mm, None where a method knows none."""


@dataclass(frozen=True)
class Method:
    """A way to register.

    Attributes
    ----------
    name, label : str
    pose : {"known", "searched"}
        Whether it is given the true pose.
    run : callable
        Times only the registration, from arrays in memory, and the part's own conversions not at all.
    most_points : float
        Larger scans are out of the question.
    needs : str
        Package that the project does not depend on.
    """

    name: str
    label: str
    pose: Literal["known", "searched"]
    run: Callable[[Problem, Stopwatch], Answer]
    most_points: float = float("inf")
    needs: str = ""

    @property
    def is_product(self) -> bool:
        return self.name.startswith("surface")

    @property
    def is_available(self) -> bool:
        return not self.needs or importlib.util.find_spec(self.needs) is not None


def _inspected(knows_pose: bool = True, method: str = "surface") -> Callable[[Problem, Stopwatch], Answer]:
    """The whole inspection at its default settings: thinning, registration, field and standard deviation."""

    def run(problem: Problem, stopwatch: Stopwatch) -> Answer:
        initial = problem.pose_numbers if knows_pose else ()
        settings = mdf.Settings().replace({"method": method, "pose.initial": initial})
        with stopwatch:
            inspection = mdf.inspect(problem.design, problem.scan, settings)
        return inspection.displacement, inspection.std

    return run


def _drifted(library: str, tolerance: float | None = None) -> Callable[[Problem, Stopwatch], Answer]:
    """At the best settings, or with another tolerance than that."""

    def run(problem: Problem, stopwatch: Stopwatch) -> Answer:
        settings = peers.tuned(library, len(problem.scan))
        if tolerance is not None:
            settings = replace(settings, tolerance=tolerance)
        drift = peers.Drift.of(problem, settings)
        register = peers.LIBRARIES[library](settings)
        with stopwatch:
            moved = register(drift.fixed, drift.moving)
        return drift.displacement(moved), None

    return run


def _aligned(library: str) -> Callable[[Problem, Stopwatch], Answer]:
    return lambda problem, stopwatch: (peers.deviation_after(library, problem, stopwatch), None)


METHODS = (
    Method("surface", "surface stage", "known", _inspected()),
    Method("surface_search", "surface stage", "searched", _inspected(knows_pose=False)),
    Method("mdf", "MDF (ours)", "known", _inspected(method="mdf"), 5_000),
    Method("cpd", "CPD (ours)", "known", _inspected(method="cpd"), 5_000),
    Method("rustcpd", "rustcpd", "known", _drifted("rustcpd"), needs="rustcpd"),
    Method("rustcpd_quick", "rustcpd, quick", "known", _drifted("rustcpd", peers.QUICK_TOLERANCE), needs="rustcpd"),
    Method(
        "rustcpd_default",
        "rustcpd, default tolerance",
        "known",
        _drifted("rustcpd", peers.DEFAULT_TOLERANCE),
        needs="rustcpd",
    ),
    Method("biocpd", "biocpd", "known", _drifted("biocpd"), needs="biocpd"),
    Method(
        "biocpd_default",
        "biocpd, default tolerance",
        "known",
        _drifted("biocpd", peers.DEFAULT_TOLERANCE),
        needs="biocpd",
    ),
    Method("pycpd", "pycpd", "known", _drifted("pycpd"), 5_000, needs="pycpd"),
    Method("open3d", "Open3D ICP, rigid", "known", _aligned("open3d"), needs="open3d"),
    Method("small_gicp", "small_gicp, rigid", "known", _aligned("small_gicp"), needs="small_gicp"),
)
