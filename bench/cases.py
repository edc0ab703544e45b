"""What is measured: a scan of the virtual bracket, whose distortion is known, registered by one method."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mdf_core.geometry import Design, PointSet
from mdf_core.rigid import inverse
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part

WARP_MM, CORRELATION_LENGTH_MM = 2.5, 50.0
SIZES = (1_000, 5_000, 20_000, 100_000)
FULL_SIZE = 2_000_000


@dataclass(frozen=True)
class Method:
    """A way to register, and the scans it is fit for."""

    name: str
    label: str
    searches_pose: bool
    most_points: int
    needs: str = ""  # package that the project does not depend on

    @property
    def is_product(self) -> bool:
        return self.name.startswith("surface")

    @property
    def is_available(self) -> bool:
        return not self.needs or importlib.util.find_spec(self.needs) is not None


METHODS = (
    Method("surface", "surface stage", searches_pose=False, most_points=FULL_SIZE),
    Method("surface_search", "surface stage", searches_pose=True, most_points=FULL_SIZE),
    Method("cpd", "CPD (ours)", searches_pose=False, most_points=5_000),
    Method("mdf", "MDF (ours)", searches_pose=False, most_points=5_000),
    Method("pycpd", "pycpd, low rank", searches_pose=False, most_points=5_000, needs="pycpd"),
    Method("open3d", "Open3D ICP, rigid", searches_pose=False, most_points=100_000, needs="open3d"),
)


@dataclass(frozen=True, eq=False)
class Problem:
    """The design, its true displacement and the scan with the pose that a method may be given."""

    design: Design
    displacement: np.ndarray
    scan: PointSet
    pose: np.ndarray  # T_design_scan

    @property
    def pose_numbers(self) -> tuple[float, ...]:
        quaternion = Rotation.from_matrix(self.pose[:3, :3]).as_quat()
        return tuple(float(number) for number in (*self.pose[:3, 3], *quaternion))


def build_problem(points: int) -> Problem:
    """The same one at every call: 20 µm noise, 1 % outliers, any pose."""
    design = build_part("bracket")
    displacement = Warp(design, WARP_MM, CORRELATION_LENGTH_MM)(design.vertices)
    scanner = ScannerSettings(points=points, pose="random")
    virtual = scan_part(design.vertices + displacement, design.faces, scanner)
    return Problem(design, displacement, virtual.scan, inverse(virtual.pose))
