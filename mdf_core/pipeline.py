"""One scan's way from points to an inspection."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from threadpoolctl import threadpool_limits

from mdf_core.averages import robust_sigma
from mdf_core.design_surface import DesignSurface
from mdf_core.errors import CloudFormatError
from mdf_core.geometry import Design, PointSet
from mdf_core.inspection import Inspection
from mdf_core.measurement import measure
from mdf_core.memory import check_memory
from mdf_core.methods import Task, register
from mdf_core.pose_choice import choose_pose, place
from mdf_core.progress import Progress, ProgressCallback, silent
from mdf_core.regions import Region
from mdf_core.sampling import crop, prepare
from mdf_core.scan_size import check_size
from mdf_core.settings import Settings

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
    InvalidSettingError
        The datum points or the thinning box do not go with the scan.
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
            check_size(prepared, design)
            surface = DesignSurface(design)
        with watch.stage("pose"):
            choice = choose_pose(prepared, surface, settings.pose, settings.seed, watch.progress)
            placed = place(prepared, choice.pose)
        with watch.stage("surface" if settings.method == "surface" else "mixture"):
            task = Task(scan, placed, surface, choice, settings, watch.progress)
            registered = register(task)
        with watch.stage("interpolation"):
            measured = measure(task, registered)
    return Inspection(
        design=design,
        **vars(measured),
        residual_scale=robust_sigma(registered.closest.distances - registered.offsets),
        pose_ambiguous=bool(choice.alternatives),
        alternative_poses=choice.alternatives,
        iterations=registered.iterations,
        stop_reason=registered.stop_reason,
        settings=settings,
        scan_sha256=scan_sha256,
        regions=tuple(regions),
        stage_seconds=watch.seconds,
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
