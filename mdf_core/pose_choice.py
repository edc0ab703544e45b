"""Which pose explains the scan: every candidate is judged by what the surface stage makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from mdf_core.deformation import Deformation
from mdf_core.design_surface import DesignSurface, spread_samples
from mdf_core.errors import LOOK_AT_THE_SCAN, InvalidSettingError, RegistrationFailedError
from mdf_core.geometry import Array, PointSet
from mdf_core.pose import candidate_poses, is_turned, refine_pose
from mdf_core.progress import Progress, ProgressCallback, silent
from mdf_core.rigid import best_rigid_fit, homogeneous, inverse, rotate, transform
from mdf_core.settings import PoseSettings
from mdf_core.surface_fit import FitSettings, SurfaceFit, fit_surface
from mdf_core.threads import in_threads

_CANDIDATES = 10
# Kernel width (stiff first: large warps), stiffness (0: from the data), most steps, points that judge, how many stay
# unless they are hopeless, and how much log evidence per point the others, up to the most, may lack.
_ROUNDS = (
    (3.0, 10.0, 6, 1_000, 4, 0.4),
    (2.0, 10.0, 12, 2_000, 1, 0.2),
    (1.0, 0.0, 12, 2_000, 1, 0.03),
)
_MOST_SURVIVORS = 6
_HOPELESS = 2.5  # log evidence per point that a pose lacks; what the next round gives back is less
_TRIAL_RANK = 60
_TRIAL_TOLERANCE = 1e-3  # in units of the scale
_TRIAL_REMAINDER = 1e-7
_SAME = 0.1  # poses that end nearer than this share of the scale are one
_TWIN_SAMPLES = 500
_NEARLY, _SYMMETRIC = 0.1, 0.003  # of the scale: how far the moved design is off itself, before and after refinement
# Of the datum points' RMS distance from their middle: more than any print is distorted, or a point taken beside its
# place; points in another unit, or in another order, miss by more.
_DATUM_MISFIT = 0.25


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
    is_symmetric : bool
        The design is mapped onto itself by the motion from `pose` to another candidate: no scan can tell them apart.
    """

    pose: Array
    alternatives: tuple[Array, ...]
    motion: Deformation
    is_symmetric: bool


def choose_pose(
    scan: PointSet, surface: DesignSurface, settings: PoseSettings, seed: int, progress: ProgressCallback
) -> PoseChoice:
    """The rigid pose of a scan in the design's frame.

    Parameters
    ----------
    scan : PointSet
        In any frame, with normals, whichever way they face.
    surface : DesignSurface
    settings : PoseSettings
        With `initial` or datum points the search is left out: that pose is the only candidate, after a few ICP steps.
    seed : int
        Draws the points that lead to the candidates, and those that judge them.
    progress : callable

    Raises
    ------
    InvalidSettingError
        No rigid motion brings the datum points together.
    RegistrationFailedError
        No candidate lets the scan reach the surface, or the best one only by squashing the part.
    """
    design = surface.design
    initial = _initial_pose(settings)
    if initial is not None:
        poses = refine_pose(initial, scan.points, design, seed)[None]
    else:
        poses = candidate_poses(scan.points, design, _CANDIDATES, seed)
    progress(Progress("pose", 0.5, 0, float("nan")))
    order = np.random.default_rng(seed).permutation(len(scan))
    tried = [_Try(pose) for pose in poses]
    for number, (beta, alpha, steps, points, least, slack) in enumerate(_ROUNDS):
        trial, survivors, tried = scan.take(order[:points]), tried, []
        fit = partial(_Try.fitted, trial=trial, surface=surface, beta=beta, alpha=alpha, steps=steps)
        for done, fitted in enumerate(in_threads(fit, survivors), 1):
            if fitted:
                tried.append(fitted)
            fraction = (number + done / len(survivors)) / len(_ROUNDS)
            progress(Progress("pose", 0.5 + 0.5 * fraction, done, float("nan")))
        tried.sort(key=lambda one: -one.found.plausibility())
        lacking = [(tried[0].found.plausibility() - one.found.plausibility()) / len(trial) for one in tried]
        good, hopeful = (sum(lack <= most for lack in lacking) for most in (slack, _HOPELESS))
        tried = _apart(tried[: min(max(good, least), hopeful, _MOST_SURVIVORS)])
        if len(tried) == 1 and number > 0:
            break
    if not tried:
        raise RegistrationFailedError("no pose brings the scan onto the design", "pose search", LOOK_AT_THE_SCAN)
    best = tried[0]
    twins = _twins(best.pose, poses, surface, seed)
    # Of a symmetric design no pose is believed anyway, and the user is told of the others.
    if not twins:
        best.found.require_unsquashed("pose search")
    alternatives = tuple(one.pose for one in tried[1:]) or twins
    return PoseChoice(best.pose, alternatives, best.found.deformation(), bool(twins))


def _twins(best: Array, poses: Array, surface: DesignSurface, seed: int) -> tuple[Array, ...]:
    """Those of `poses` (k, 4, 4) that differ from the best one by a motion that maps the design onto itself.

    Whatever a distorted scan prefers of them, it cannot know.
    """
    design = surface.design
    samples, _ = spread_samples(design, _TWIN_SAMPLES)
    twins = []
    for pose in poses:
        motion = pose @ inverse(best)
        if _rms_distance(transform(motion, samples), samples) < _SAME * design.scale:
            continue
        if _rms(surface.closest(transform(motion, samples)).distances) > _NEARLY * design.scale:
            continue
        exact = refine_pose(motion, samples, design, seed)
        moved = transform(exact, samples)
        stays = _rms_distance(moved, samples) < _SAME * design.scale
        if not stays and _rms(surface.closest(moved).distances) < _SYMMETRIC * design.scale:
            twins.append(exact @ best)
    return tuple(twins)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


@dataclass(frozen=True, eq=False)
class _Try:
    """A candidate pose and how far the surface stage has come with it."""

    pose: Array
    fit: SurfaceFit | None = None

    @property
    def found(self) -> SurfaceFit:
        assert self.fit is not None
        return self.fit

    def fitted(self, trial: PointSet, surface: DesignSurface, beta: float, alpha: float, steps: int) -> _Try | None:
        """One round further; None: so placed, the scan does not reach the surface."""
        placed = place(trial, self.pose)
        settings = FitSettings(beta, alpha, _TRIAL_RANK, steps, _TRIAL_TOLERANCE, _TRIAL_REMAINDER, wide=True)
        moved = self.fit.motion().apply_roughly(placed.points) if self.fit else placed.points
        try:
            fit = fit_surface(placed, surface, settings, moved, silent)
        except RegistrationFailedError:
            return None
        return _Try(self.pose, fit)


def _apart(tried: list[_Try]) -> list[_Try]:
    """The candidates whose fits end in different places, the first of each group."""
    kept: list[_Try] = []
    for one in tried:
        scale = one.found.scale
        if all(
            _rms_distance(one.found.moved, other.found.moved) > _SAME * scale
            or is_turned(one.pose[None], other.pose).all()
            for other in kept
        ):
            kept.append(one)
    return kept


def _rms_distance(a: Array, b: Array) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def place(scan: PointSet, pose: Array) -> PointSet:
    """The scan moved by `pose` (4, 4), its normals facing as they did."""
    assert scan.normals is not None, "the scan is prepared: it has normals"
    return PointSet(transform(pose, scan.points), rotate(pose, scan.normals), scan.areas)


def _initial_pose(settings: PoseSettings) -> Array | None:
    """T_design_scan (4, 4) that the user gave, as a pose or by datum points; None if neither."""
    if settings.initial:
        rotation = Rotation.from_quat(settings.initial[3:])  # of whatever length
        return homogeneous(rotation.as_matrix(), np.array(settings.initial[:3]))
    if settings.datum_scan:
        return _datum_pose(*(np.reshape(numbers, (-1, 3)) for numbers in (settings.datum_scan, settings.datum_design)))
    return None


def _datum_pose(scan: Array, design: Array) -> Array:
    """The pose that brings datum points (k, 3) mm in the scan's frame onto the same ones of the design."""
    pose = best_rigid_fit(scan, design)
    missed = np.linalg.norm(transform(pose, scan) - design, axis=1)
    worst, spread = int(missed.argmax()), _rms_distance(design, design.mean(axis=0))
    if missed[worst] > _DATUM_MISFIT * spread:
        raise InvalidSettingError(
            f"no rigid motion brings the datum points together: number {worst + 1} ends {missed[worst]:.4g} mm off, "
            f"from {_coordinates(scan[worst])} in the scan to {_coordinates(design[worst])} in the design, where they "
            f"lie {spread:.4g} mm from their middle",
            "settings pose.datum_design and pose.datum_scan",
            "give both in mm and in the same order, and take that point at the same place of the part",
        )
    return pose


def _coordinates(point: Array) -> str:
    return " ".join(f"{coordinate:.6g}" for coordinate in point)
