"""A small part and scans of it, quick to register."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from manifold3d import Manifold
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.geometry import Design, PointSet
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.settings import Settings
from mdf_nodes.conversions import scan_message

QUICK_SETTINGS = Settings().replace(
    {
        "pose.initial": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "surface.rank": 40,
        "surface.beta": (1.5,),
    }
)
"""A registration that starts at the true pose."""

QUICK = (
    *("-p", "pose.initial:=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]"),
    *("-p", "surface.rank:=40"),
    *("-p", "surface.beta:=[1.5]"),
)
"""The same as ROS arguments."""


def write_design(folder: Path) -> Design:
    """An angle with a step, about 60 mm long, saved as design.stl."""
    solid = Manifold.cube((60.0, 30.0, 8.0)) + Manifold.cube((10.0, 30.0, 40.0)) + Manifold.cube((30.0, 8.0, 20.0))
    mesh = solid.refine_to_length(6.0).to_mesh64()
    path = folder / "design.stl"
    path.write_bytes(stl_bytes(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)))
    return load_design(path, "mm")


def scan_of(design: Design, points: int = 3000, bend: float = 0.5, seed: int = 0) -> PointSet:
    """Random points of the bent part with their normals; `bend` is the largest displacement in mm."""
    rng = np.random.default_rng(seed)
    faces = rng.choice(len(design.faces), size=points, p=design.face_areas / design.face_areas.sum())
    at = np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), size=points), design.triangles[faces])
    at[:, 2] += bend * (at[:, 0] / 60.0) ** 2
    return PointSet(at, design.face_normals[faces])


def cloud_of(scan: PointSet, second: int = 1) -> PointCloud2:
    """A scan as a driver sends it, stamped with `second`."""
    return scan_message(scan, Header(stamp=Time(sec=second), frame_id="scanner"))


def parameters(**values: Any) -> tuple[str, ...]:
    """ROS arguments that set parameters; dots are written as ``__``."""
    return tuple(part for name, value in values.items() for part in ("-p", f"{name.replace('__', '.')}:={value}"))
