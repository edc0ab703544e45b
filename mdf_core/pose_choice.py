"""Which pose explains the scan: every candidate is judged by what the surface stage makes of it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mdf_core.deformation import Deformation
from mdf_core.design_surface import DesignSurface
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.pose import candidate_poses, refine_pose
from mdf_core.progress import Progress, ProgressCallback, silent
from mdf_core.rigid import homogeneous, rotate, transform
from mdf_core.settings import PoseSettings, SurfaceSettings
from mdf_core.surface import SurfaceFit, fit_surface

_CANDIDATES = 10
_TRIAL_POINTS = 2_000
_TRIAL_SAMPLES = 30_000
_ROUNDS = ((_CANDIDATES, 3.0, 6), (4, 2.0, 12))  # candidates, kernel width (stiff first: large warps), most steps
_TRIAL_RANK = 60
_TRIAL_ALPHA = 10.0  # lets a stiff kernel bend by a tenth of the part's size
_AMBIGUOUS = 0.05  # candidates whose log evidence per point is this close are equally good
_SAME = 0.1  # poses that end nearer than this share of the scale are one
_NEAR = 0.1  # points within this share of the scale from the surface tell which way normals face
_TRUSTED = 0.75  # share of the normals that must face alike to be believed


@dataclass(frozen=True, eq=False)
class PoseChoice:
    """The pose and what else would do.

    Attributes
    ----------
    pose : (4, 4) float64
        T_design_scan.
    alternatives : tuple of (4, 4) float64
        Other poses that explain the scan equally well.
    motion : Deformation
        What the surface stage made of the posed scan while it judged; a start for the registration.
    """

    pose: Array
    alternatives: tuple[Array, ...]
    motion: Deformation


def choose_pose(
    scan: PointSet, design: Design, settings: PoseSettings, seed: int, progress: ProgressCallback
) -> PoseChoice:
    """The rigid pose of a scan in the design's frame.

    Parameters
    ----------
    scan : PointSet
        In any frame, with normals, whichever way they face.
    design : Design
    settings : PoseSettings
        With `initial` the search is left out: that pose is the only candidate, after a few ICP steps.
    seed : int
        Draws the points that judge.
    progress : callable

    Raises
    ------
    RegistrationFailedError
        No candidate lets the scan reach the surface.
    """
    if settings.initial:
        poses = refine_pose(_pose_from_numbers(settings.initial), scan.points, design)[None]
    else:
        poses = candidate_poses(scan.points, design, _CANDIDATES)
    surface = DesignSurface(design, _TRIAL_SAMPLES)
    progress(Progress("pose", 0.5, 0, float("nan")))
    trial = scan.take(np.sort(np.random.default_rng(seed).permutation(len(scan))[:_TRIAL_POINTS]))
    tried = [_Try(pose, placed, placed.points) for pose in poses for placed in [place(trial, pose, surface)]]
    done, total = 0, sum(min(count, len(poses)) for count, _, _ in _ROUNDS)
    for count, beta, steps in _ROUNDS:
        survivors, tried = tried[:count], []
        for one in survivors:
            with suppress(RegistrationFailedError):  # this one reaches nothing; the others decide
                tried.append(one.fitted(surface, beta, steps))
            done += 1
            progress(Progress("pose", 0.5 + 0.5 * done / total, done, float("nan")))
        sigma = min((one.sigma for one in tried), default=0.0)
        tried.sort(key=lambda one: -one.evidence(sigma))
    if not tried:
        raise RegistrationFailedError(
            "no pose brings the scan onto the design", "pose search", "check that the scan shows this part"
        )
    best = tried[0]
    limit = best.evidence(sigma) - _AMBIGUOUS * len(trial)
    alternatives = tuple(
        one.pose
        for one in tried[1:]
        if one.evidence(sigma) >= limit and _rms_distance(one.moved, best.moved) > _SAME * design.scale
    )
    return PoseChoice(best.pose, alternatives, best.motion)


@dataclass(frozen=True, eq=False)
class _Try:
    """A candidate pose and how far the surface stage has come with it."""

    pose: Array
    placed: PointSet
    moved: Array
    fit: SurfaceFit | None = None

    def fitted(self, surface: DesignSurface, beta: float, steps: int) -> _Try:
        settings = SurfaceSettings(rank=_TRIAL_RANK, max_steps=steps)
        fit = fit_surface(
            self.placed,
            surface,
            settings,
            beta,
            alpha=_TRIAL_ALPHA,
            moved=self.moved,
            tolerance=1e-3,
            wide=True,
            progress=silent,
        )
        return _Try(self.pose, self.placed, fit.moved, fit)

    @property
    def motion(self) -> Deformation:
        assert self.fit is not None
        return self.fit.deformation()

    @property
    def sigma(self) -> float:
        assert self.fit is not None
        return self.fit.sigma

    def evidence(self, sigma: float) -> float:
        assert self.fit is not None
        return self.fit.evidence(sigma)


def _rms_distance(a: Array, b: Array) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def place(scan: PointSet, pose: Array, surface: DesignSurface) -> PointSet:
    """The scan moved by `pose` (4, 4), its normals turned outward.

    Normals that mostly face as the design does are trusted, those that mostly face the other way are reversed, and
    where they face either way, as estimated ones do, each takes the side of the nearest surface.
    """
    assert scan.normals is not None, "the scan is prepared: it has normals"
    points, normals = transform(pose, scan.points), rotate(pose, scan.normals)
    closest = surface.closest(points)
    agreement = np.einsum("ij,ij->i", closest.normals, normals)
    clear = (np.abs(closest.distances) < _NEAR * surface.design.scale) & (np.abs(agreement) > 0.5)
    outward = (agreement[clear] > 0).mean() if clear.any() else 1.0
    if outward < 1.0 - _TRUSTED:
        normals = -normals
    elif outward < _TRUSTED:
        normals = np.where(agreement[:, None] < 0, -normals, normals)
    return PointSet(points, normals, scan.areas)


def _pose_from_numbers(numbers: tuple[float, ...]) -> Array:
    """T_design_scan (4, 4) from x y z (mm) qx qy qz qw; the quaternion need not be of unit length."""
    return homogeneous(Rotation.from_quat(numbers[3:]).as_matrix(), np.array(numbers[:3]))
