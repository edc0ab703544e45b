"""What a scan needs before it is registered: checks, fewer points, the area that each stands for, and normals."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.averages import weighted_median
from mdf_core.errors import DegenerateScanError, InvalidSettingError, TooFewPointsError
from mdf_core.geometry import Array, PointSet
from mdf_core.settings import CropSettings, Settings, ThinningSettings

_FEWEST_POINTS = 50
_STRAY = 20.0  # times the median distance from the middle: no point of a part is that far out
_LINE = 1e-3  # second principal standard deviation / first
_PLANE = 2e-3  # third / first
_LEAST_FILL = 0.9  # of target_points
_MOST_BOXES_PER_AXIS = 2**20  # three box numbers fit into one int64
_DENSE_BOXES = 2**24  # more boxes than this are renumbered instead of tabulated
_NEIGHBOURHOOD, _NEIGHBOURHOOD_REACH = 12, 2.0  # points, and how many box edges away they may be
_NEARLY_EMPTY = 0.04  # of the median population of a neighbourhood
_EMPTY_BOX = 0.01  # of the median population of a box
_RETHIN = 0.8  # of the boxes: with fewer populated ones the boxes are chosen again
_DENSITY_NEIGHBOURS = 8
_NORMAL_NEIGHBOURS = 16  # the point itself among them
_UNIT_ERROR = 1e-6  # of a unit normal's length, which rounding makes
_CHUNK = 65_536  # neighbourhoods at a time; bounds the memory


def check_scan(scan: PointSet) -> None:
    """Refuse a scan that no registration can use.

    Raises
    ------
    TooFewPointsError
        Fewer than 50 points.
    DegenerateScanError
        Points on one spot, one line or (D = 3) one plane, or areas that are negative or all zero.
    """
    count, dimension = scan.points.shape
    if count < _FEWEST_POINTS:
        raise TooFewPointsError(
            f"{count} point{'s' if count > 1 else ''}", "scan", f"a registration needs at least {_FEWEST_POINTS}"
        )
    if scan.areas is not None and not (scan.areas.min() >= 0.0 and scan.areas.max() > 0.0):
        raise DegenerateScanError("areas that are negative or all zero", "scan", "send positive areas, or none")
    # One point that a depth camera puts 65 m away must not make a line of the others.
    away = np.linalg.norm(scan.points - np.median(scan.points, axis=0), axis=1)
    central = scan.points[away <= _STRAY * np.median(away)] if np.median(away) > 0 else scan.points
    variances = np.linalg.eigvalsh(np.cov(central.T, bias=True))[::-1]
    deviations = np.sqrt(np.maximum(variances, 0.0))
    extents = " x ".join(f"{2.0 * deviation:.3g}" for deviation in deviations)
    sizes = f"(two standard deviations along the principal axes: {extents} mm)"
    if deviations[0] <= 1e-12 * max(1.0, float(np.abs(scan.points).max())):
        raise DegenerateScanError("all points lie on one spot", "scan", "check the scanner's output")
    if deviations[1] < _LINE * deviations[0]:
        raise DegenerateScanError(f"all points lie on one line {sizes}", "scan", "scan the part from more sides")
    if dimension == 3 and deviations[2] < _PLANE * deviations[0]:
        raise DegenerateScanError(f"all points lie in one plane {sizes}", "scan", "scan the part from more sides")


def areas_from_density(points: Array) -> Array:
    """Area that each point stands for, from the distances to its neighbours.

    A ball around a point that reaches its k-th neighbour holds k points besides its centre, so each stands for 1/k of
    the ball's section through the surface; this is averaged over the outer half of the neighbours. Exact copies of
    a point share its area. Towards the rim of an open surface areas come out too large, at most about twice.

    Parameters
    ----------
    points : (n, D) float64, mm
        Of a surface in space or of a filled plane set.

    Returns
    -------
    (n,) float64, mm²

    Raises
    ------
    DegenerateScanError
        All points lie on one spot.

    Notes
    -----
    Cost O(n log n). Source: k-th neighbour density estimate, Loftsgaarden & Quesenberry 1965.
    """
    distinct, copy_of, copies = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    neighbours = min(_DENSITY_NEIGHBOURS, len(distinct) - 1)
    if neighbours < 1:
        raise DegenerateScanError("all points lie on one spot", "scan", "check the scanner's output")
    # The point itself is its first neighbour.
    ranks = np.arange((neighbours + 1) // 2, neighbours + 1)
    distances, _ = KDTree(distinct).query(distinct, k=ranks + 1, workers=-1)
    areas: Array = (math.pi * distances**2 / ranks).mean(axis=1)
    return (areas / copies)[copy_of.reshape(-1)]


def estimate_normals(points: Array) -> Array:
    """Unit normals of the planes through each point's neighbours; which side is outward is not known.

    Parameters
    ----------
    points : (n, D) float64, mm

    Returns
    -------
    (n, D) float64

    Notes
    -----
    Cost O(n log n). Source: Hoppe et al. 1992, section 3.2.
    """
    neighbours = min(_NORMAL_NEIGHBOURS, len(points))
    tree = KDTree(points)
    normals = np.empty_like(points)
    for begin in range(0, len(points), _CHUNK):
        chunk = slice(begin, begin + _CHUNK)
        _, index = tree.query(points[chunk], k=np.arange(1, neighbours + 1), workers=-1)
        around = points[index]
        around -= around.mean(axis=1, keepdims=True)
        # eigh sorts ascending: the first eigenvector has the least variance.
        normals[chunk] = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    return normals


def thin(scan: PointSet, settings: ThinningSettings, seed: int) -> PointSet:
    """Keep one random point per box of a grid, and give it the areas of the others.

    A random point keeps the noise of the scan unbiased, where the centroid of a box lies inside every bend. The choice
    hangs on a random rank of each point, so a point that moves to another box changes no third one. Points keep
    their order.

    Parameters
    ----------
    scan : PointSet
    settings : ThinningSettings
        With `box_mm` > 0 the edge of the boxes; else scans of more than `target_points` are thinned to at most that
        many, and at least 90 % of it where the points allow. Points in nearly empty neighbourhoods are dropped.
    seed : int

    Raises
    ------
    InvalidSettingError
        The box edge is too small for the size of the scan.

    Notes
    -----
    Cost O(n log n). Source: paper, 3D experiment. Boxes of `box_mm` begin at its multiples: what was thinned
    once is not thinned again.
    """
    count = len(scan)
    if settings.box_mm == 0.0 and count <= settings.target_points:
        return scan
    axes = np.ascontiguousarray(scan.points.T)  # twice as fast, axis by axis
    edge, origin = settings.box_mm, axes.min(axis=1)
    if edge > 0:
        origin = np.floor(origin / edge) * edge
    else:
        edge = _edge_for(axes, settings.target_points)
    boxes = number_boxes(axes, edge, origin)
    if boxes is None:
        raise InvalidSettingError(
            f"{edge:g} mm is too small for a scan of {np.ptp(scan.points, axis=0).max():g} mm",
            "setting thinning.box_mm",
            "use larger boxes, or 0",
        )
    by_rank = np.random.default_rng(seed).permutation(count)
    winners = np.full(boxes.max() + 1, -1)
    winners[boxes[by_rank]] = by_rank  # of several points in a box the last one assigned stays
    kept = np.sort(winners[winners >= 0])
    counts = np.bincount(boxes)
    populated = _is_populated(scan.points[kept], counts[boxes[kept]], edge)
    if settings.box_mm == 0.0 and populated.mean() < _RETHIN:
        # Outliers have taken places that the surface may have: choose the boxes again without them.
        is_populated = np.zeros(len(counts), dtype=np.bool_)
        is_populated[boxes[kept]] = populated
        return thin(scan.take(is_populated[boxes]), settings, seed)
    kept = kept[populated]
    result = scan.take(kept)
    if scan.areas is None:
        return result
    return PointSet(result.points, result.normals, np.bincount(boxes, scan.areas)[boxes[kept]])


def _is_populated(points: Array, counts: NDArray[np.int64], edge: float) -> NDArray[np.bool_]:
    """Which of the points kept, each standing for `counts` scan points, have company.

    One point per box makes scattered outliers, alone in their boxes, as many as the surface's points: of 2 000 000
    points 1 % become 40 %. A sparse part of the surface still holds a tenth of what others do, an outlier a hundredth.
    """
    neighbours = min(_NEIGHBOURHOOD, len(points))
    distances, index = KDTree(points).query(
        points, k=[*range(1, neighbours + 1)], distance_upper_bound=_NEIGHBOURHOOD_REACH * edge, workers=-1
    )
    found = np.isfinite(distances)
    populations = np.where(found, counts[np.where(found, index, 0)], 0).sum(axis=1)
    enough: NDArray[np.bool_] = populations >= _NEARLY_EMPTY * weighted_median(populations, counts)
    return enough & (counts >= _EMPTY_BOX * weighted_median(counts, counts))


def crop(scan: PointSet, settings: CropSettings) -> PointSet:
    """The points inside the box of the settings; all of them without a box.

    Raises
    ------
    TooFewPointsError
        The box holds fewer than 50.
    """
    if not settings.box_mm:
        return scan
    box = np.reshape(settings.box_mm, (2, 3))
    inside = ((scan.points >= box[0]) & (scan.points <= box[1])).all(axis=1)
    if inside.all():
        return scan
    if inside.sum() < _FEWEST_POINTS:
        least, greatest = (
            np.array2string(each, precision=1, suppress_small=True, floatmode="fixed")
            for each in (scan.points.min(0), scan.points.max(0))
        )
        raise TooFewPointsError(
            f"only {int(inside.sum())} of {len(scan)} points lie in the box of crop.box_mm; "
            f"the scan reaches from {least} to {greatest} mm",
            "scan",
            "move or widen the box; it is in the scan's frame and in mm",
        )
    return scan.take(inside)


def prepare(scan: PointSet, settings: Settings) -> PointSet:
    """The scan as the registration takes it: cropped, checked, thinned, with areas and normals.

    The box comes first: of a part on a table that is thinned before, hardly a point would be left.
    Areas that the scan does not bring come from the density of the points kept, and normals from their neighbours;
    these face either way at random. Those that it brings may have any length; zero is no normal.
    A scan that is small enough and has both comes out as it went in.

    Raises
    ------
    TooFewPointsError, DegenerateScanError
        See `crop` and `check_scan`.
    InvalidSettingError
        See `thin`.
    """
    scan = crop(scan, settings.crop)
    check_scan(scan)
    scan = thin(scan, settings.thinning, settings.seed)
    normals = scan.normals
    return PointSet(
        scan.points,
        _unsided_normals(scan.points, settings.seed) if normals is None or not normals.any() else _unit(normals),
        areas_from_density(scan.points) if scan.areas is None else scan.areas,
    )


def _unit(normals: Array) -> Array:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    is_other = (np.abs(lengths - 1.0) > _UNIT_ERROR) & (lengths > 0)
    return normals / np.where(is_other, lengths, 1.0)


def _unsided_normals(points: Array, seed: int) -> Array:
    """Estimated normals that face either way at random, so that none can seem to know the outside."""
    sides: Array = np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(points), 1))
    return sides * estimate_normals(points)


def number_boxes(axes: Array, edge: float, origin: Array) -> NDArray[np.int64] | None:
    """The box that each point of `axes` (D, n) lies in, (n,); the first begins at `origin` (D,), below all points.

    Returns
    -------
    (n,) int64, or None
        Small numbers, the same for points in one box of edge `edge`; None if int64 cannot number the boxes.
    """
    shape = [int(extent / edge) + 1 for extent in axes.max(axis=1) - origin]
    if math.prod(shape) >= 2**63:
        return None
    boxes = np.zeros(axes.shape[1], dtype=np.int64)
    for coordinates, least, length in zip(axes, origin, shape, strict=True):
        boxes *= length
        boxes += ((coordinates - least) / edge).astype(np.int64)
    if math.prod(shape) > _DENSE_BOXES:
        boxes = np.unique(boxes, return_inverse=True)[1].reshape(-1)
    return boxes


def _edge_for(axes: Array, target: int) -> float:
    """Box edge in mm that leaves at most `target` of the points (D, n), and at least 90 % of that if any edge does."""
    # A sample of a few points per box nearly fills the boxes, and costs a tenth.
    stride = max(1, axes.shape[1] // (8 * target))
    start = float(np.ptp(axes, axis=1).max()) / math.sqrt(target)
    if stride > 1:
        start = _search_edge(axes[:, ::stride], target, start)
    return _search_edge(axes, target, start)


def _search_edge(axes: Array, target: int, edge: float) -> float:
    """Secant steps in log(edge), log(count) that halve the bracket when they are slow.

    Sets that no edge thins to the target (a lattice of pixels, many copies) end with the narrowed bracket.
    """
    finest = max(float(np.ptp(axes, axis=1).max()), np.finfo(float).tiny) / _MOST_BOXES_PER_AXIS
    aim = math.log(0.5 * (1.0 + _LEAST_FILL) * target)
    low, high = math.log(finest), math.inf  # too many points at low, few enough at high
    slope, previous = -2.0, None  # the count of a surface falls with the square of the edge
    position = math.log(max(edge, finest))
    for step in itertools.count():
        boxes = number_boxes(axes, math.exp(position), axes.min(axis=1))
        assert boxes is not None  # finest sees to it
        count = int(np.count_nonzero(np.bincount(boxes)))
        excess = math.log(count) - aim
        if count > target:
            low = position
        else:
            high = position
        if _LEAST_FILL * target <= count <= target or high - low < 0.01:
            break
        if previous is not None and position != previous[0]:
            slope = min((excess - previous[1]) / (position - previous[0]), -0.1)
        previous = (position, excess)
        position -= excess / slope
        if not low < position < high or step % 3 == 2:
            position = 0.5 * (low + high) if math.isfinite(high) else max(position, low + 1.0)
    return math.exp(high)
