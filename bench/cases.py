"""What is measured: scans of virtual parts whose distortion is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from scipy.spatial.transform import Rotation

from mdf_core.geometry import Array, Design, PointSet
from mdf_core.rigid import inverse
from mdf_core.virtual_cell import ScannerSettings, VirtualScan, Warp, build_part, scan_part

WARP_MM = 2.5
SIZES = (1_000, 5_000, 20_000, 50_000, 100_000)
FULL_SIZES = (500_000, 1_000_000, 2_000_000)
PARTS = ("bracket", "clip", "hub")
WARP_LENGTHS_MM = (50.0, 35.0, 20.0, 12.0)
NOISES_MM = (0.0, 0.02, 0.1)
RIPPLE_MM = 0.03
RIPPLED_LENGTHS_MM = (50.0, 35.0)


@dataclass(frozen=True)
class Case:
    """A distorted part and its scan: warp of at most 2.5 mm, 1 % outliers, any place and rotation.

    Attributes
    ----------
    part : str
    points : int
    warp_length_mm : float
        The distortion at distance d correlates with exp(-d² / 2l²).
    noise_mm : float
        Standard deviation of every coordinate.
    seed : int
        Of the warp and of the scan.
    ripple_mm : float
        Standard deviation of an error along the normals that points within 20 mm share.
    """

    part: str = PARTS[0]
    points: int = 20_000
    warp_length_mm: float = WARP_LENGTHS_MM[0]
    noise_mm: float = 0.02
    seed: int = 0
    ripple_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Problem:
    """The design, its true displacement and the scan with the pose that a method may be given."""

    design: Design
    displacement: Array
    scan: PointSet
    pose: Array  # T_design_scan

    @property
    def pose_numbers(self) -> tuple[float, ...]:
        quaternion = Rotation.from_matrix(self.pose[:3, :3]).as_quat()
        return tuple(float(number) for number in (*self.pose[:3, 3], *quaternion))


def print_and_scan(case: Case) -> tuple[Warp, VirtualScan]:
    """The distortion, which knows its design, and the scan with all that is true about it; the same at every call."""
    design = build_part(case.part)
    warp = Warp(design, WARP_MM, case.warp_length_mm, case.seed)
    scanner = ScannerSettings(points=case.points, noise_mm=case.noise_mm, ripple_mm=case.ripple_mm, pose="random")
    return warp, scan_part(design.vertices + warp(design.vertices), design.faces, scanner, case.seed)


def build_problem(case: Case) -> Problem:
    """What a method gets of the case."""
    warp, virtual = print_and_scan(case)
    return Problem(warp.design, warp(warp.design.vertices), virtual.scan, inverse(virtual.pose))


def quality_cases(points: int) -> Iterator[Case]:
    """Every part with every warp length and noise, and by a scanner with a ripple."""
    for part, length, noise in product(PARTS, WARP_LENGTHS_MM, NOISES_MM):
        yield Case(part, points, length, noise)
    for part, length in product(PARTS, RIPPLED_LENGTHS_MM):
        yield Case(part, points, length, ripple_mm=RIPPLE_MM)
