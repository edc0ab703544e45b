"""Each method takes a problem and gives the displacement at the design's vertices and, if it can, its sd."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import mdf_core as mdf
from bench.cases import Problem
from mdf_core.design_surface import spread_samples
from mdf_core.interpolation import interpolate
from mdf_core.rigid import transform
from mdf_core.settings import Value

Answer = tuple[np.ndarray, np.ndarray | None]


def inspected(problem: Problem, **changes: Value) -> Answer:
    settings = mdf.Settings().replace({name.replace("__", "."): value for name, value in changes.items()})
    inspection = mdf.inspect(problem.design, problem.scan, settings)
    return inspection.displacement, inspection.std


def surface(problem: Problem) -> Answer:
    return inspected(problem, pose__initial=problem.pose_numbers)


def surface_search(problem: Problem) -> Answer:
    return inspected(problem)


def cpd(problem: Problem) -> Answer:
    return inspected(problem, method="cpd", pose__initial=problem.pose_numbers)


def mdf_mixture(problem: Problem) -> Answer:
    return inspected(problem, method="mdf", pose__initial=problem.pose_numbers)


def pycpd(problem: Problem) -> Answer:
    """With β and α of the paper, in units of the design's RMS radius, and as many design points as scan points."""
    from pycpd import DeformableRegistration

    design, scale = problem.design, problem.design.scale
    placed = (transform(problem.pose, problem.scan.points) - design.centre) / scale
    target, _ = spread_samples(design, len(placed))
    registration = DeformableRegistration(
        X=(target - design.centre) / scale, Y=placed, alpha=2.0, beta=3.0, w=0.01, low_rank=True, num_eig=150
    )
    moved, _ = registration.register()
    there, here = (points * scale + design.centre for points in (placed, moved))
    return interpolate(here, there - here, design.vertices, "inverse_distance", 4), None


def open3d(problem: Problem) -> Answer:
    """A rigid pose knows no distortion: what it costs is of interest, not what it finds."""
    import open3d as o3d

    def cloud(points: np.ndarray) -> o3d.geometry.PointCloud:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    samples, faces = spread_samples(problem.design, 100_000)
    target = cloud(samples)
    target.normals = o3d.utility.Vector3dVector(problem.design.face_normals[faces])
    registration = o3d.pipelines.registration
    estimation = registration.TransformationEstimationPointToPlane()
    registration.registration_icp(cloud(problem.scan.points), target, 5.0, problem.pose, estimation)
    return np.zeros_like(problem.displacement), None


RUN: dict[str, Callable[[Problem], Answer]] = {
    "surface": surface,
    "surface_search": surface_search,
    "cpd": cpd,
    "mdf": mdf_mixture,
    "pycpd": pycpd,
    "open3d": open3d,
}
