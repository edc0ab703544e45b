"""The registration by the method that the settings name; by pieces where the design has several."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mdf_core.deformation import Deformation
from mdf_core.design_surface import Closest, DesignSurface, spread_samples
from mdf_core.errors import LOOK_AT_THE_SCAN, RegistrationFailedError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.last_step import measure_deformation
from mdf_core.outliers import surface_distance_test
from mdf_core.outward import outward
from mdf_core.pieces import PiecewiseDeformation, split_design
from mdf_core.pose_choice import PoseChoice
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.registration import register_mixture
from mdf_core.rigid import transform
from mdf_core.sampling import thin
from mdf_core.settings import Settings, ThinningSettings
from mdf_core.support import disputed_vertices
from mdf_core.surface import SurfaceRegistration, register_surface
from mdf_core.surface_fit import SurfaceFit

_LEAST_EXPLAINED = 0.5
_EXPLAINED = 0.03  # of the scale: a scan point farther from the surface than this is not explained
_FEWEST_OF_A_PIECE = 100


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be registered.

    Attributes
    ----------
    scan : PointSet
        All points, in their own frame.
    placed : PointSet
        The prepared scan in the design's frame, with normals.
    surface : DesignSurface
    choice : PoseChoice
        How it was placed.
    settings : Settings
    progress : callable
    """

    scan: PointSet
    placed: PointSet
    surface: DesignSurface
    choice: PoseChoice
    settings: Settings
    progress: ProgressCallback


@dataclass(frozen=True, eq=False)
class Registered:
    """What the registration has found.

    Attributes
    ----------
    deformation : Deformation or PiecewiseDeformation
        `start` and `datum` are the identity: it is that of the placed scan.
    moved : (m, 3) float64, mm
        The placed points on the design.
    closest : Closest
        Of those.
    offsets : (m,) float64, mm
        What is known of their distances along the normals, though it is no part of the motion.
    iterations : int
    stop_reason : str
        See `mdf_core.registration.MixtureRegistration`.
    """

    deformation: Deformation | PiecewiseDeformation
    moved: Array
    closest: Closest
    offsets: Array
    iterations: int
    stop_reason: str

    @cached_property
    def distances(self) -> Array:
        """Of the moved points to the surface, less what is known of them, (m,) mm, none negative."""
        left = self.moved - self.closest.points - self.offsets[:, None] * self.closest.normals
        distances: Array = np.linalg.norm(left, axis=1)
        return distances


def register(task: Task) -> Registered:
    """Register a placed scan.

    Raises
    ------
    RegistrationFailedError
        The method finds no motion, or that of the surface stage squashes the part or leaves most of the scan off it.
    """
    if task.settings.method != "surface":
        return _register_mixture(task)
    pieces = split_design(task.surface.design)
    registered = _register_piece(task) if len(pieces) == 1 else _register_pieces(task, pieces)
    # A mixture is known to end off the surface; its residual says so.
    explained = float((registered.distances < _EXPLAINED * task.surface.design.scale).mean())
    if explained < _LEAST_EXPLAINED:
        raise RegistrationFailedError(
            f"only {explained:.0%} of the scan lies on the design after registration",
            "scan",
            LOOK_AT_THE_SCAN,
        )
    return registered


def _register_mixture(task: Task) -> Registered:
    design, settings, placed = task.surface.design, task.settings, task.placed
    target, _ = spread_samples(design, settings.mixture.points)
    moving = thin(placed, ThinningSettings(target_points=settings.mixture.points), settings.seed)
    area_weighted = settings.method == "mdf"
    mixture = register_mixture(moving, target, settings.mixture, area_weighted, design.scale, task.progress)
    moved = mixture.deformation.apply(placed.points)
    closest = task.surface.closest(moved, outward(placed, moved, task.surface).normals)
    offsets = np.zeros(len(moved))
    return Registered(mixture.deformation, moved, closest, offsets, mixture.iterations, mixture.stop_reason)


def _register_piece(task: Task) -> Registered:
    placed, surface, choice, settings = task.placed, task.surface, task.choice, task.settings.surface
    result = register_surface(placed, surface, settings, choice.motion, task.progress, whole=len(task.scan))
    if _is_disputed(task, result.fit):
        result = _from_afar(task, result)
    fit = result.fit
    if not choice.is_symmetric:
        fit.require_unsquashed("surface stage")
    measured = measure_deformation(fit, placed, task.scan.points, choice.pose, surface, settings, task.progress)
    moved, closest, offsets = fit.moved, fit.closest, np.zeros(len(fit.moved))
    if measured.uneven_offset:  # which the fit has followed, and the motion has not
        moved = measured.deformation.apply_roughly(placed.points)
        closest = surface.closest(moved, outward(placed, moved, surface).normals)
        offsets = measured.uneven_offset(closest.points)
    return Registered(measured.deformation, moved, closest, offsets, result.iterations, fit.stop_reason)


def _is_disputed(task: Task, fit: SurfaceFit) -> bool:
    """Whether outliers lie side by side on the design."""
    is_outlier = surface_distance_test(np.linalg.norm(fit.moved - fit.closest.points, axis=1), task.settings.outliers)
    spacings = task.settings.verdict.support_distances
    return bool(disputed_vertices(task.surface.design, fit.closest, is_outlier, spacings).any())


def _from_afar(task: Task, first: SurfaceRegistration) -> SurfaceRegistration:
    """What seems a dent may be faces that the fit has lost: once more with them, and the larger evidence decides."""
    placed, settings = task.placed, task.settings.surface

    def told(step: Progress) -> None:
        task.progress(replace(step, fraction=1.0, iteration=first.iterations + step.iteration))

    try:
        again = register_surface(
            placed, task.surface, settings, task.choice.motion, told, whole=len(task.scan), from_afar=True
        )
    except RegistrationFailedError:  # then the first one stands
        return first
    sigma = min(first.fit.sigma, again.fit.sigma)
    is_better = again.fit.evidence(sigma) > first.fit.evidence(sigma) and not again.fit.squashes()
    best = again if is_better else first
    return replace(best, iterations=first.iterations + again.iterations)


def _register_pieces(task: Task, pieces: list[Design]) -> Registered:
    """Each piece on its own, with the scan points that lie nearest to it after the motion that judged the pose."""
    motion = task.choice.motion
    rough = PiecewiseDeformation(tuple(pieces), (motion,) * len(pieces))
    moved = motion.apply_roughly(task.placed.points)
    of_placed = rough.piece_of(moved)
    of_scan = rough.piece_of(motion.apply_roughly(transform(task.choice.pose, task.scan.points)))
    deformations, offsets, iterations, stop_reason = [], np.zeros(len(moved)), 0, "converged"
    for number, piece in enumerate(pieces):
        own = of_placed == number
        if own.sum() < _FEWEST_OF_A_PIECE:  # not seen: it moves with the rest and is not supported
            deformations.append(motion)
            continue

        def share(step: Progress, done: int = number) -> None:
            task.progress(replace(step, fraction=(done + step.fraction) / len(pieces)))

        scan, placed = task.scan.take(of_scan == number), task.placed.take(own)
        found = _register_piece(replace(task, scan=scan, placed=placed, surface=DesignSurface(piece), progress=share))
        assert isinstance(found.deformation, Deformation)
        deformations.append(found.deformation)
        moved[own], offsets[own] = found.moved, found.offsets
        iterations += found.iterations
        stop_reason = found.stop_reason if stop_reason == "converged" else stop_reason
    whole = PiecewiseDeformation(tuple(pieces), tuple(deformations))
    closest = task.surface.closest(moved, outward(task.placed, moved, task.surface).normals)
    return Registered(whole, moved, closest, offsets, iterations, stop_reason)
