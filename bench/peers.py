"""Other people's registration, each at the best settings that `python -m bench.tune` found for it.

Every one is given the true pose. Coherent point drift gets both clouds about one centre and in one scale, the
design's RMS radius, which is the unit of its settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from bench.cases import Problem
from bench.stopwatch import Stopwatch
from mdf_core.design_surface import spread_samples
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.interpolation import interpolate
from mdf_core.rigid import rotate, transform
from mdf_core.sampling import thin
from mdf_core.settings import ThinningSettings

# A k-d tree that takes few points with one coordinate in common (rustcpd's) meets none where no face is aligned.
_OFF_AXIS = Rotation.from_rotvec((0.3, 0.5, 0.7)).as_matrix()
_SMOOTHING_NEIGHBOURS = 8


@dataclass(frozen=True)
class DriftSettings:
    """What the libraries of coherent point drift have in common, in units of the design's RMS radius.

    Attributes
    ----------
    beta, alpha : float
        Width of the motion kernel and weight of the motion prior.
    neighbours : int
        Of every point in the sparse E-step, where there is one.
    moves_design : bool
        Whether samples of the design are moved onto the scan, or the scan onto them.
    samples : int
        Of the design; 0 for as many as the scan has points.
    outlier_share : float
    start_sd : float
        Standard deviation of the mixture at the start; the pose is known, so it need not span the part.
    rank : int
        Of the motion kernel, where it has one.
    tolerance : float
        Ends the iterations when the mixture's variance changes by less.
    max_iterations : int
    """

    beta: float
    alpha: float
    neighbours: int = 1
    moves_design: bool = False
    samples: int = 320_000
    outlier_share: float = 0.01
    start_sd: float = 0.1
    rank: int = 50
    tolerance: float = 1e-12
    max_iterations: int = 300


Register = Callable[[Array, Array], Array]
"""Takes the fixed and the moving points, gives the moved ones; this is what is timed."""


def rustcpd(settings: DriftSettings) -> Register:
    """Its fast mode: sparse E-step, pivoted Cholesky, single precision."""
    from rustcpd import register_deformable

    def register(fixed: Array, moving: Array) -> Array:
        result = register_deformable(
            fixed,
            moving,
            alpha=settings.alpha,
            beta=settings.beta,
            low_rank=settings.rank,
            low_rank_method="pivoted_cholesky",
            sigma2=settings.start_sd**2,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
            outlier_weight=settings.outlier_share,
            k=settings.neighbours,
            single_precision=True,
        )
        return np.asarray(result.points)

    return register


def biocpd(settings: DriftSettings) -> Register:
    """With the sparse E-step and pivoted Cholesky."""
    from biocpd import DeformableRegistration

    def register(fixed: Array, moving: Array) -> Array:
        registration = DeformableRegistration(
            X=fixed,
            Y=moving,
            alpha=settings.alpha,
            beta=settings.beta,
            num_eig=settings.rank,
            low_rank_method="pivoted_cholesky",
            sigma2=settings.start_sd**2,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
            w=settings.outlier_share,
            k=settings.neighbours,
            dtype=np.float64,  # its default, single precision, is no faster and misses half of the distortion
        )
        return np.asarray(registration.register()[0])

    return register


def pycpd(settings: DriftSettings) -> Register:
    """All of it dense; it has no other mode."""
    from pycpd import DeformableRegistration

    def register(fixed: Array, moving: Array) -> Array:
        registration = DeformableRegistration(
            X=fixed,
            Y=moving,
            alpha=settings.alpha,
            beta=settings.beta,
            sigma2=settings.start_sd**2,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
            w=settings.outlier_share,
        )
        return np.asarray(registration.register()[0])

    return register


@dataclass(frozen=True, eq=False)
class Drift:
    """A problem as coherent point drift sees it."""

    problem: Problem
    settings: DriftSettings
    fixed: Array
    moving: Array

    @classmethod
    def of(cls, problem: Problem, settings: DriftSettings) -> Drift:
        scan = transform(problem.pose, problem.scan.points)
        samples = even_samples(problem.design, settings.samples or len(scan))
        fixed, moving = (scan, samples) if settings.moves_design else (samples, scan)
        return cls(problem, settings, _scaled(fixed, problem.design), _scaled(moving, problem.design))

    def displacement(self, moved: Array) -> Array:
        """At the design's vertices, by inverse distance from the samples or the moved scan points; mm."""
        design = self.problem.design
        known, unknown = (self.moving, moved) if self.settings.moves_design else (moved, self.moving)
        vertices = _scaled(design.vertices, design)
        found = interpolate(known, unknown - known, vertices, "inverse_distance", _SMOOTHING_NEIGHBOURS)
        back: Array = found @ _OFF_AXIS * design.scale
        return back


def even_samples(design: Design, count: int) -> Array:
    """Nearly `count` points of the surface, one per box of a grid."""
    samples, _ = spread_samples(design, 8 * count)
    return thin(PointSet(samples), ThinningSettings(target_points=count), seed=0).points


def _scaled(points: Array, design: Design) -> Array:
    scaled: Array = (points - design.centre) / design.scale @ _OFF_AXIS.T
    return scaled


LIBRARIES: dict[str, Callable[[DriftSettings], Register]] = {"rustcpd": rustcpd, "biocpd": biocpd, "pycpd": pycpd}
LARGE = 10_000
"""Scans with more points have settings of their own."""
_SMALL_SCANS = DriftSettings(beta=2.0, alpha=1e4, neighbours=10)
_LARGE_SCANS = DriftSettings(beta=1.5, alpha=1e5, neighbours=3)
# Everything dense: more design samples would take hours, and the other direction gains nothing from them.
_DENSE = DriftSettings(moves_design=True, samples=2_000, beta=2.0, alpha=1e3, tolerance=1e-6, max_iterations=100)
TUNED = {
    "rustcpd": (_SMALL_SCANS, _LARGE_SCANS),
    "biocpd": (_SMALL_SCANS, _LARGE_SCANS),
    "pycpd": (_DENSE, _DENSE),
}
"""By library, for scans of up to and of more than `LARGE` points."""
QUICK_TOLERANCE = 1e-9
DEFAULT_TOLERANCE = 1e-3
"""Of all three libraries."""


def tuned(library: str, points: int) -> DriftSettings:
    """The settings for a scan of so many points."""
    return TUNED[library][points > LARGE]


# Rigid registration

_RIGID_SAMPLES = 100_000
_ICP_REACH_MM = 5.0
_ICP_STEPS = 50

Align = Callable[[], Array]
"""Gives the pose T_design_scan; this is what is timed."""


def open3d(problem: Problem, samples: Array, normals: Array) -> Align:
    """Point-to-plane ICP with Tukey's weights."""
    import open3d as o3d

    def cloud(points: Array) -> Any:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    scan, target = cloud(problem.scan.points), cloud(samples)
    target.normals = o3d.utility.Vector3dVector(normals)
    icp = o3d.pipelines.registration
    estimation = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(_ICP_REACH_MM))
    criteria = icp.ICPConvergenceCriteria(max_iteration=_ICP_STEPS)

    def align() -> Array:
        found = icp.registration_icp(scan, target, _ICP_REACH_MM, problem.pose, estimation, criteria)
        return np.array(found.transformation)

    return align


def small_gicp(problem: Problem, samples: Array, normals: Array) -> Align:
    """Point-to-plane ICP on one thread, its default; it estimates the normals itself."""
    import small_gicp as library

    def align() -> Array:
        found = library.align(
            samples,
            problem.scan.points,
            problem.pose,
            registration_type="PLANE_ICP",
            max_correspondence_distance=_ICP_REACH_MM,
            max_iterations=_ICP_STEPS,
        )
        return np.array(found.T_target_source)

    return align


RIGID_LIBRARIES: dict[str, Callable[[Problem, Array, Array], Align]] = {"open3d": open3d, "small_gicp": small_gicp}


def deviation_after(library: str, problem: Problem, stopwatch: Stopwatch) -> Array:
    """What inspection software shows: after a rigid alignment every scan point's distance along the nearest normal.

    Interpolated to the design's vertices, (n, 3) mm.
    """
    design = problem.design
    samples, faces = spread_samples(design, _RIGID_SAMPLES)
    normals = design.face_normals[faces]
    align = RIGID_LIBRARIES[library](problem, samples, normals)
    with stopwatch:
        pose = align()
    points, directions = transform(pose, problem.scan.points), problem.scan.normals
    assert directions is not None
    nearest = np.asarray(KDTree(samples).query(points)[1])
    offsets = ((points - samples[nearest]) * normals[nearest]).sum(axis=1)
    # Outliers, and points of the far side of a wall, belong to another place.
    belongs = (np.abs(offsets) < _ICP_REACH_MM) & ((rotate(pose, directions) * normals[nearest]).sum(axis=1) > 0.5)
    feet, moves = samples[nearest][belongs], (offsets[:, None] * normals[nearest])[belongs]
    return interpolate(feet, moves, design.vertices, "inverse_distance", _SMOOTHING_NEIGHBOURS)
