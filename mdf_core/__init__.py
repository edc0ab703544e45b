"""Measure how a printed part is distorted and redesign it so that the next print comes out right.

Millimetres and float64 throughout; nothing here imports ROS.
"""

from mdf_core.compensation import Redesign, compensate
from mdf_core.errors import MdfError
from mdf_core.geometry import Design, PointSet
from mdf_core.inspection import Inspection, Verdict
from mdf_core.mesh_io import load_design, load_scan
from mdf_core.pipeline import inspect
from mdf_core.progress import Progress
from mdf_core.settings import Settings

__version__ = "0.1.0"

__all__ = [
    "Design",
    "Inspection",
    "MdfError",
    "PointSet",
    "Progress",
    "Redesign",
    "Settings",
    "Verdict",
    "compensate",
    "inspect",
    "load_design",
    "load_scan",
]
