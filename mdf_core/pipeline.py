"""One scan's way from points to an inspection."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from mdf_core.averages import robust_sigma, weighted_median
from mdf_core.deformation import Deformation
from mdf_core.design_surface import Closest, DesignSurface, spread_samples
from mdf_core.errors import CloudFormatError, RegistrationFailedError, UnitMismatchError
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.inspection import Deviation, Inspection
from mdf_core.interpolation import interpolate
from mdf_core.last_step import measure_deformation
from mdf_core.memory import check_memory
from mdf_core.outliers import normalized_median_test, surface_distance_test
from mdf_core.pieces import PiecewiseDeformation, split_design
from mdf_core.pose_choice import PoseChoice, choose_pose, place
from mdf_core.progress import Progress, ProgressCallback, silent
from mdf_core.refinement import mesh_error
from mdf_core.regions import Region
from mdf_core.registration import register_mixture
from mdf_core.rigid import best_rigid_fit, transform
from mdf_core.sampling import crop, prepare, thin
from mdf_core.settings import Settings, ThinningSettings
from mdf_core.surface import register_surface

_LIKELY_FACTORS = {1000.0: "metres against millimetres", 25.4: "inches against millimetres", 10.0: "centimetres"}
_SIZE_RANGE = (0.5, 2.0)  # a scan with a hidden side may well seem smaller or larger
_FACTOR_SLACK = 1.3
_LEAST_EXPLAINED = 0.5
_EXPLAINED = 0.03  # of the scale: a scan point farther from the surface than this is not explained
_GAP = 2.0  # times the reach
_NEARBY = 24  # points looked at beside a vertex: at an edge the nearest may all lie on the other face
_SAME_SIDE = 0.1  # cosine; at right angles rounding would decide
_POORLY = 5.0  # times the usual standard deviation: the scan is near, but says little about where the vertex went
_WELL = 0.01  # of the displacement: what is known to that is measured, however well the rest is known
_BESIDE = 1.0  # of the scale: how far a hidden region has a say
_FEWEST_OF_A_PIECE = 100
_STAGES = {"prepare": (0.0, 0.05), "pose": (0.05, 0.5), "mixture": (0.5, 0.95), "surface": (0.5, 0.95)}


def inspect(
    design: Design,
    scan: PointSet,
    settings: Settings | None = None,
    progress: ProgressCallback | None = None,
    regions: Sequence[Region] = (),
) -> Inspection:
    """Measure how a scanned part is distorted against its design.

    Parameters
    ----------
    design : Design
    scan : PointSet
        In any frame, mm; normals and areas are used where the scanner knows them and estimated where not.
    settings : Settings, optional
    progress : callable, optional
        Called with `Progress` at every iteration; an exception it raises stops the work and reaches the caller.
    regions : sequence of Region, optional
        Those with a tolerance of their own are judged by it.

    Returns
    -------
    Inspection

    Raises
    ------
    CloudFormatError
        The points are not in space.
    TooFewPointsError, DegenerateScanError
        The scan cannot be registered.
    UnitMismatchError
        The scan's size differs from the design's by a factor.
    RegistrationFailedError
        No registration explains the scan.
    MemoryBudgetError
        It would need more memory than `memory_mib`.

    Notes
    -----
    The linear algebra runs on one thread: the matrices are small, threads would cost more than they gain where other
    processes share the cores, and the result does not depend on their number.
    """
    settings = settings or Settings()
    progress = progress or silent
    if scan.points.shape[1] != 3:
        raise CloudFormatError("points of a plane", "scan", "give x y z of every point")
    scan_sha256 = scan.sha256()
    scan = crop(scan, settings.crop)  # as `prepare` does; all that is left has a say in the last step
    check_memory(len(scan), design, settings)
    watch = _Watch(progress)
    with threadpool_limits(limits=1, user_api="blas"):
        with watch.stage("prepare"):
            prepared = prepare(scan, settings)
            _check_size(prepared, design)
            surface = DesignSurface(design)
        with watch.stage("pose"):
            choice = choose_pose(prepared, surface, settings.pose, settings.seed, watch.progress)
            placed = place(prepared, choice.pose, surface)
        stage = "surface" if settings.method == "surface" else "mixture"
        with watch.stage(stage):
            registered = _register(scan, placed, surface, choice, settings, watch.progress)
        with watch.stage("interpolation"):
            measured = _measure(placed, surface, registered, choice, settings)
    return replace(
        measured,
        scan_sha256=scan_sha256,
        settings=settings,
        regions=tuple(regions),
        stage_seconds=dict(watch.seconds),
    )


class _Watch:
    """Times the stages and turns their progress into that of the whole job."""

    def __init__(self, progress: ProgressCallback) -> None:
        self.seconds: dict[str, float] = {}
        self._report = progress

    def progress(self, step: Progress) -> None:
        begin, end = _STAGES[step.stage]
        self._report(replace(step, fraction=begin + (end - begin) * step.fraction))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = _STAGES.get(name, (0.95, 1.0))[0]
        self._report(Progress(name, begin, 0, float("nan")))
        started = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started


@dataclass(frozen=True, eq=False)
class _Registered:
    deformation: Deformation | PiecewiseDeformation
    moved: Array  # scan points on the design
    closest: Closest  # of those
    iterations: int
    stop_reason: str


def _check_size(scan: PointSet, design: Design) -> None:
    """Refuse a scan whose unit cannot be the declared one."""
    samples, _ = spread_samples(design, 5_000)
    assert scan.areas is not None, "the scan is prepared: it has areas"
    ratio = _spread(scan.points, scan.areas) / _spread(samples, np.ones(len(samples)))
    if _SIZE_RANGE[0] <= ratio <= _SIZE_RANGE[1]:
        return
    factor = ratio if ratio > 1 else 1.0 / ratio
    word = "larger" if ratio > 1 else "smaller"
    likely = [
        f" (about {known:g}: {name})"
        for known, name in _LIKELY_FACTORS.items()
        if known / _FACTOR_SLACK < factor < known * _FACTOR_SLACK
    ]
    raise UnitMismatchError(
        f"the scan is {factor:.4g} times {word} than the design{''.join(likely)}",
        "scan",
        "declare the unit of the scan and of the design, and check that the scan shows this part and nothing else, or "
        "crop it (crop.box_mm)",
    )


def _spread(points: Array, areas: Array) -> float:
    """Median distance from the median point, by area: neither outliers nor uneven density move it much."""
    weights = np.minimum(areas, 5.0 * np.median(areas))
    centre = [weighted_median(coordinate, weights) for coordinate in points.T]
    return weighted_median(np.linalg.norm(points - centre, axis=1), weights)


def _register(
    scan: PointSet,
    placed: PointSet,
    surface: DesignSurface,
    choice: PoseChoice,
    settings: Settings,
    progress: ProgressCallback,
) -> _Registered:
    if settings.method == "surface":
        pieces = split_design(surface.design)
        if len(pieces) == 1:
            return _register_piece(scan, placed, surface, choice, settings, progress)
        return _register_pieces(pieces, scan, placed, surface, choice, settings, progress)
    design, points = surface.design, settings.mixture.points
    target, _ = spread_samples(design, points)
    moving = thin(placed, ThinningSettings(target_points=points), settings.seed)
    mixture = register_mixture(moving, target, settings.mixture, settings.method == "mdf", design.scale, progress)
    moved = mixture.deformation.apply(placed.points)
    closest = surface.closest(moved, placed.normals)
    return _Registered(mixture.deformation, moved, closest, mixture.iterations, mixture.stop_reason)


def _register_piece(
    scan: PointSet,
    placed: PointSet,
    surface: DesignSurface,
    choice: PoseChoice,
    settings: Settings,
    progress: ProgressCallback,
) -> _Registered:
    result = register_surface(placed, surface, settings.surface, choice.motion, progress, whole=len(scan))
    fit = result.fit
    # Of a symmetric design no pose is believed anyway, and the user is told of the others.
    if not choice.is_symmetric and fit.squashes(placed):
        raise RegistrationFailedError(
            "the motion that brings the scan onto the design would squash it",
            "surface stage",
            "check that the scan shows this part, scan it from more sides, or give pose.initial",
        )
    deformation = measure_deformation(fit, placed, scan.points, choice.pose, surface, settings.surface, progress)
    return _Registered(deformation, fit.moved, fit.closest, result.iterations, fit.stop_reason)


def _register_pieces(
    pieces: list[Design],
    scan: PointSet,
    placed: PointSet,
    surface: DesignSurface,
    choice: PoseChoice,
    settings: Settings,
    progress: ProgressCallback,
) -> _Registered:
    """Each piece on its own, with the scan points that lie nearest to it after the motion that judged the pose."""
    rough = PiecewiseDeformation(tuple(pieces), (choice.motion,) * len(pieces))
    moved = choice.motion.apply(placed.points)
    of_placed = rough.piece_of(moved)
    of_scan = rough.piece_of(choice.motion.apply(transform(choice.pose, scan.points)))
    deformations, iterations, stop_reason = [], 0, "converged"
    for number, piece in enumerate(pieces):
        own = of_placed == number
        if own.sum() < _FEWEST_OF_A_PIECE:  # not seen: it moves with the rest and is not supported
            deformations.append(choice.motion)
            continue

        def share(step: Progress, done: int = number) -> None:
            progress(replace(step, fraction=(done + step.fraction) / len(pieces)))

        found = _register_piece(
            scan.take(of_scan == number), placed.take(own), DesignSurface(piece), choice, settings, share
        )
        assert isinstance(found.deformation, Deformation)
        deformations.append(found.deformation)
        moved[own] = found.moved
        iterations += found.iterations
        stop_reason = found.stop_reason if stop_reason == "converged" else stop_reason
    whole = PiecewiseDeformation(tuple(pieces), tuple(deformations))
    return _Registered(whole, moved, surface.closest(moved, placed.normals), iterations, stop_reason)


def _measure(
    placed: PointSet,
    surface: DesignSurface,
    registered: _Registered,
    choice: PoseChoice,
    settings: Settings,
) -> Inspection:
    """Everything an inspection says, from the registration."""
    design = surface.design
    motion, moved, closest = registered.deformation, registered.moved, registered.closest
    distances = np.linalg.norm(moved - closest.points, axis=1)
    explained = float((distances < _EXPLAINED * design.scale).mean())
    # A mixture is known to end off the surface; its residual says so.
    if settings.method == "surface" and explained < _LEAST_EXPLAINED:
        raise RegistrationFailedError(
            f"only {explained:.0%} of the scan lies on the design after registration",
            "scan",
            "check that the scan shows this part, or give pose.initial",
        )
    if settings.outliers.method == "surface_distance":
        is_outlier = surface_distance_test(distances, settings.outliers)
    else:
        is_outlier = normalized_median_test(placed.points, moved - placed.points, settings.outliers.median_threshold)
    supported = _reached(design, moved[~is_outlier], closest.normals[~is_outlier], settings)
    displacement = motion.displacement_at(design.vertices)
    supported &= _determined(design, displacement, motion, supported)
    if choice.is_symmetric:  # no pose is believed: that the motion to this one folds is no reason to refuse the scan
        supported &= np.isfinite(displacement).all(axis=1)

    weights = design.vertex_areas * supported
    if not weights.sum() > 0:
        weights = design.vertex_areas
    # The datum: the part's own place on the scanner is no distortion.
    _refuse_fold(displacement, supported)
    deformed = design.vertices + _extrapolated(design, displacement)
    datum = best_rigid_fit(deformed, design.vertices, weights)
    deformation = motion.without_rigid_part(design.vertices, weights).framed(choice.pose, datum)
    displacement = transform(datum, deformed) - design.vertices
    missed = mesh_error(design, deformation, displacement, supported)
    inverse_displacement = deformation.inverse_displacement_at(design.vertices)
    inverse_displacement = np.where(np.isfinite(inverse_displacement), inverse_displacement, -displacement)
    if settings.interpolation.method != "deformation":
        kept = ~is_outlier
        there, here = transform(datum, placed.points[kept]), moved[kept]
        displacement = _interpolated(here, there - here, design.vertices, displacement, settings)
        inverse_displacement = _interpolated(there, here - there, design.vertices, inverse_displacement, settings)
    resting = surface.closest(transform(datum, placed.points), placed.normals)
    return Inspection(
        design=design,
        deformation=deformation,
        displacement=displacement,
        inverse_displacement=inverse_displacement,
        std=deformation.std(design.vertices),
        supported=supported,
        deviation=Deviation(transform(datum, placed.points), resting.distances, is_outlier),
        residual_scale=robust_sigma(closest.distances),
        pose_ambiguous=bool(choice.alternatives),
        alternative_poses=choice.alternatives,
        iterations=registered.iterations,
        stop_reason=registered.stop_reason,
        settings=settings,
        scan_sha256="",
        mesh_error=missed,
    )


def _refuse_fold(displacement: Array, supported: NDArray[np.bool_]) -> None:
    """What was measured has a displacement."""
    has_own: NDArray[np.bool_] = np.asarray(np.isfinite(displacement).all(axis=1))
    folded = int((supported & ~has_own).sum())
    if folded or not has_own.any():
        raise RegistrationFailedError(
            f"the motion folds the part onto itself at {folded or len(has_own)} of {len(has_own)} vertices",
            "registration",
            "check that the scan shows this part, or register with a stiffer motion",
        )


def _extrapolated(design: Design, displacement: Array) -> Array:
    """The displacement of the nearest vertex where the motion has none of its own, as may be where no scan point is."""
    has_own = np.isfinite(displacement).all(axis=1)
    if has_own.all():
        return displacement
    nearest = KDTree(design.vertices[has_own]).query(design.vertices[~has_own])[1]
    result = displacement.copy()
    result[~has_own] = displacement[has_own][nearest]
    return result


def _interpolated(points: Array, values: Array, queries: Array, fallback: Array, settings: Settings) -> Array:
    """Interpolation between scan points, and the deformation itself where that has no value."""
    found = interpolate(points, values, queries, settings.interpolation.method, settings.interpolation.neighbours)
    return np.where(np.isfinite(found), found, fallback)


def _determined(
    design: Design, displacement: Array, motion: Deformation | PiecewiseDeformation, reached: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """All vertices but those beside a hidden region that are far less known than usual: extrapolated, most likely."""
    hidden = _hidden(design, reached)
    if not hidden.any():
        return reached
    std = motion.std(design.vertices)
    known = reached & np.isfinite(std) & np.isfinite(displacement).all(axis=1)
    if not known.any():
        return reached
    size = np.sqrt((displacement[known] ** 2).sum(axis=1).mean())
    distances, _ = KDTree(design.vertices[hidden]).query(design.vertices, workers=-1)
    poor = max(_POORLY * np.median(std[known]), _WELL * size)
    is_extrapolated: NDArray[np.bool_] = (std > poor) & (distances < _BESIDE * design.scale)
    return ~is_extrapolated


def _reached(design: Design, points: Array, normals: Array, settings: Settings) -> NDArray[np.bool_]:
    """Vertices that have registered scan points on their own side of the wall nearby."""
    if len(points) == 0:
        return np.zeros(len(design.vertices), dtype=np.bool_)
    spacing = np.sqrt(design.face_areas.sum() / len(points))
    reach = settings.verdict.support_distances * spacing
    count = min(_NEARBY, len(points))
    distances, index = KDTree(points).query(design.vertices, k=[*range(1, count + 1)], workers=-1)
    same_side = np.einsum("vki,vi->vk", normals[index], design.vertex_normals) > _SAME_SIDE
    away = np.where(same_side & (design.vertex_areas > 0)[:, None], distances, np.inf).min(axis=1)
    reached: NDArray[np.bool_] = away < reach
    # Between few points a single corner lies in a gap by chance.
    reached |= ~_hidden(design, reached) & (away < _GAP * reach)
    return reached


def _hidden(design: Design, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The corners of faces none of whose corners is reached: a single one is no hidden region."""
    hidden = np.zeros(len(reached), dtype=np.bool_)
    hidden[design.faces[~reached[design.faces].any(axis=1) & (design.face_areas > 0)]] = True
    return hidden
