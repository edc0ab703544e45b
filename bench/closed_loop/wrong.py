"""What becomes of scans that do not belong to the design as they are given."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

import mdf_core as mdf
from bench.cases import PARTS, WARP_MM, Problem
from bench.closed_loop.loops import OURS, Loop, build_printer, print_and_scan
from mdf_core.cycles import require_usable
from mdf_core.distortion import distortion_left
from mdf_core.errors import MdfError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.rigid import homogeneous
from mdf_core.settings import Settings
from mdf_core.virtual_cell import Printer

TOLERANCE_MM = 2.0 * WARP_MM
"""So that what is measured right passes."""

_INCH_MM, _METRE_MM = 25.4, 1000.0
_AWAY_MM = np.array([100.0, 0.0, 0.0])


@dataclass(frozen=True)
class Fate:
    """What became of a wrong input.

    Attributes
    ----------
    refusal : str
        Name of the error; empty where there is a redesign.
    verdict : str
        Of the inspection.
    left : float
        Of the distortion, in the print of the redesign.
    """

    refusal: str = ""
    verdict: str = ""
    left: float = float("nan")

    def __str__(self) -> str:
        return self.refusal or f"{self.verdict}, {self.left:.3f} left"


def wrong_inputs(part: str, points: int) -> dict[str, Fate]:
    """What becomes of scans that do not belong to the design as they are given."""
    (printer, problem), (_, foreign) = (
        _first_print(Loop(OURS, name, points, cycles=1, seed=0)) for name in (part, other_part(part))
    )
    places, normals = problem.scan.points, problem.scan.normals
    wrong = {
        "of another part": replace(problem, scan=foreign.scan, pose=foreign.pose),
        "in inches": replace(problem, scan=PointSet(places / _INCH_MM, normals)),
        "in metres": replace(problem, scan=PointSet(places / _METRE_MM, normals)),
        "pose 100 mm away": replace(problem, pose=homogeneous(np.eye(3), _AWAY_MM) @ problem.pose),
        "pose turned by 90° about z": replace(problem, pose=_turned(problem.design, "z", 90.0) @ problem.pose),
        "pose turned by 180° about x": replace(problem, pose=_turned(problem.design, "x", 180.0) @ problem.pose),
    }
    return {name: _fate(printer, each) for name, each in wrong.items()}


def other_part(part: str) -> str:
    return PARTS[(PARTS.index(part) + 1) % len(PARTS)]


def _first_print(loop: Loop) -> tuple[Printer, Problem]:
    printer = build_printer(loop)
    return printer, print_and_scan(loop, printer, printer.warp.design.vertices, loop.seed)


def _turned(design: Design, axis: str, degrees: float) -> Array:
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return homogeneous(rotation, design.centre - rotation @ design.centre)


def _fate(printer: Printer, problem: Problem) -> Fate:
    settings = Settings().replace({"pose.initial": problem.pose_numbers, "verdict.tolerance_mm": TOLERANCE_MM})
    places = problem.design.vertices
    try:
        inspection = mdf.inspect(problem.design, problem.scan, settings)
        # As the cell and the commands do.
        require_usable("scan", inspection.pose_ambiguous, inspection.outlier_share, settings)
        redesign = mdf.compensate(problem.design, [inspection], settings)
    except MdfError as error:
        return Fate(refusal=error.name)
    left, whole = (distortion_left(problem.design, printer.print_part(each))[0] for each in (redesign.vertices, places))
    return Fate(verdict=inspection.verdict[0].value, left=left / whole)
