"""The last step of the surface stage: how the design was moved, from every point of the scan.

The iterations move the scan onto the design, with thousands of its points. Millions tell the motion from the noise far
better, and by then all of them lie so close to the surface that what is left is linear. It is solved for the motion of
the design: that is where a distortion is smooth, and what is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import noise_sigma, robust_sigma, tukey_weights
from mdf_core.deformation import Deformation
from mdf_core.design_motion import DesignMotion, Equations, Prior
from mdf_core.design_surface import Closest, DesignSurface
from mdf_core.facets import MOST_FACETS, BentFacets, FlatFacets
from mdf_core.geometry import Array, Design, PointSet
from mdf_core.lone_points import ShownPlaces
from mdf_core.motion_basis import most_centres, motion_basis, negligible_remainder
from mdf_core.normal_equations import posterior_covariance
from mdf_core.prior_choice import with_evident_prior
from mdf_core.progress import Progress, ProgressCallback
from mdf_core.rigid import transform
from mdf_core.sampling import number_boxes
from mdf_core.settings import SurfaceSettings
from mdf_core.surface_fit import SurfaceFit
from mdf_core.threads import in_threads

_CHUNK = 65_536  # points at a time; bounds the memory
_CELL = 0.05  # of the kernel width: points of a cell that face alike share their row of the normal equations
_MOST_CELLS = 40_000  # on the design, about
_REACH = 10.0  # standard deviations; at half of that a point has no weight
_LEAST_SIGMA = 2e-5  # of the scale; a noise-free scan has no spread to divide by
_FEW = 2_000  # points, enough to tell how far flat facets lie from bent ones
_TELLING = 0.1  # of the noise: what is less cannot be told from it
_CLEARLY_LESS = 0.9  # of the squared residuals
_SHARPENINGS = 3
_LESS_NOISE = 0.9  # of what was assumed
_LEAST_KEPT = 0.85  # mean weight; noise leaves 0.91: what leaves less is not all noise
_LEAST_NOISE = 5e-7  # of the scale; the arithmetic's own
_FACINGS = 8  # steps from -1 to 0 in which each component of a normal is told apart


@dataclass(frozen=True, eq=False)
class _Rows:
    """Points of the scan, or means over those of a cell that face alike."""

    weight: Array  # (g,)
    foot: Array  # (g, 3) mm, on the design
    normal: Array  # (g, 3), of the design there
    offset: Array  # (g, 3) mm, from the foot to the posed point

    def without(self, which: NDArray[np.bool_]) -> _Rows:
        """All but those, (g,)."""
        return _Rows(self.weight[~which], self.foot[~which], self.normal[~which], self.offset[~which])


@dataclass(frozen=True, eq=False)
class Measured:
    """The motion of the design onto the posed scan, from all points.

    Attributes
    ----------
    deformation : Deformation
        With its posterior covariance.
    uneven_offset : callable, or None
        How far the scan lies off along the normals at places (n, 3) of the design, (n,) mm, where that varies over the
        part and is taken for no part of the motion.
    """

    deformation: Deformation
    uneven_offset: Callable[[Array], Array] | None


def measure_deformation(
    fit: SurfaceFit,
    placed: PointSet,
    points: Array,
    pose: Array,
    surface: DesignSurface,
    settings: SurfaceSettings,
    progress: ProgressCallback,
) -> Measured:
    """Measure the motion of the design onto the posed scan with every point.

    Parameters
    ----------
    fit : SurfaceFit
        Converged.
    placed : PointSet
        The scan that was fitted, in the design frame.
    points : (n, 3) float64, mm
        The whole scan, in its own frame; if it is larger than `placed`, every point counts.
    pose : (4, 4) float64
        That `placed` was placed with.
    surface : DesignSurface
    settings : SurfaceSettings
    progress : callable
        Called after every chunk; an exception it raises stops the work.

    Notes
    -----
    The fitted motion u, from each place c of the design to where it lies in the posed scan, says which place each
    point y comes from, but for a slide along the surface. The printed surface there has the normal m = ∇(c + u)⁻ᵀ n,
    by nature of normals, and the motion meets m · u(c) = m · (y - c) whatever the point slid: linear in u.

    Points are moved and measured to the surface one by one; the rows of the normal equations are shared by points of a
    cell that is small against the kernel. Where flat facets would lie visibly off bent ones, both are tried, and the
    smaller residuals decide. Cost O(n) and O(g · rank²) for g cells; memory 100 bytes per point.
    """
    is_whole = len(points) > len(placed)
    if is_whole:
        rows, sigma = _rows_of_all(fit, points, pose, surface, progress)
    else:
        rows, sigma = _rows_of_fit(fit, placed), fit.sigma

    def told() -> None:
        progress(Progress("surface", 1.0, 0, sigma))

    bent, is_fixed = _bent_equations(fit, rows), settings.alpha > 0
    best = bent.solve(Prior([fit.basis], np.array([fit.alpha])), sigma, is_fixed, told)
    if not is_whole:  # the rows of a whole scan are means over several facets
        best = _best_facets(best, rows, surface, is_fixed, told)
    best = with_evident_prior(best, fit.beta, surface.design, settings, len(fit.moved), told)
    if not is_whole:
        best = _sharpened(best, rows, surface, settings, len(fit.moved), told)
    known = best.solved
    if isinstance(best.equations.facets, FlatFacets):
        # The creases between flat facets also tell how these moved along the surface. A print may have none: what is
        # said to be known does not rest on them.
        sums = replace(bent, weights=best.equations.weights).summed(best.prior, told)
        known = sums.solve(best.prior, best.sigma)
    basis, solution = best.prior.basis, best.solved.solution
    rank = len(basis.centres)
    deformation = replace(
        fit.motion(),
        basis=basis,
        coefficients=fit.scale * solution[:rank],
        affine=fit.scale * solution[rank:],
        covariance=posterior_covariance(known.factor, best.sigma),
    )
    return Measured(deformation, best.offset if len(best.solved.offsets) > 1 else None)


def _bent_equations(fit: SurfaceFit, rows: _Rows) -> Equations:
    jacobian = fit.motion().jacobian(rows.foot)
    normals = np.linalg.solve(jacobian.transpose(0, 2, 1), rows.normal[:, :, None])[:, :, 0].astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances = np.einsum("gi,gi->g", normals, rows.offset)
    return Equations(BentFacets(rows.foot), normals, distances, rows.weight, fit.origin, fit.scale)


def _flat_equations(found: DesignMotion, rows: _Rows, design: Design) -> Equations:
    """Between the points and the facets that the motion found so far brings nearest to them."""
    points = rows.foot + rows.offset
    printed = Design(design.vertices + found.displacement(BentFacets(design.vertices)), design.faces)
    closest = DesignSurface(printed).closest(points, found.equations.normals)
    flat = FlatFacets.below(closest, printed, design)
    distances = np.einsum("gi,gi->g", closest.normals, points - flat.places())
    return replace(found.equations, facets=flat, normals=closest.normals, distances=distances)


def _best_facets(
    bent: DesignMotion, rows: _Rows, surface: DesignSurface, fixed: bool, told: Callable[[], None]
) -> DesignMotion:
    """The motion with flat facets, if that clearly leaves less; else the one with bent facets."""
    if len(surface.design.faces) > MOST_FACETS or _chord(bent, rows.foot, surface) < _TELLING * bent.sigma:
        return bent
    told()
    flat = _flat_equations(bent, rows, surface.design).solve(bent.prior, bent.sigma, fixed, told)
    return flat if flat.misfit() < _CLEARLY_LESS * bent.misfit() else bent


def _chord(found: DesignMotion, feet: Array, surface: DesignSurface) -> float:
    """RMS distance in mm, along the normals, between facets that bend with the motion and facets that stay flat."""
    few, design = slice(None, None, max(len(feet) // _FEW, 1)), surface.design
    bent, flat = BentFacets(feet[few]), FlatFacets.below(surface.closest(feet[few]), design, design)
    apart = found.displacement(bent) - found.displacement(flat)
    return float(np.sqrt((np.einsum("ij,ij->i", apart, found.equations.normals[few]) ** 2).mean()))


def _sharpened(
    best: DesignMotion,
    rows: _Rows,
    surface: DesignSurface,
    settings: SurfaceSettings,
    points: int,
    told: Callable[[], None],
) -> DesignMotion:
    """The motion again, as long as there turns out to be less noise than was taken into account."""
    for _ in range(_SHARPENINGS):
        residuals = best.residuals()
        sigma = max(noise_sigma(residuals, best.determined), _LEAST_NOISE * surface.design.scale)
        weights = tukey_weights(residuals, sigma)
        if sigma > _LESS_NOISE * best.sigma or weights.mean() < _LEAST_KEPT:
            break
        noise, rank = sigma / surface.design.scale, settings.rank
        bases = [
            motion_basis(surface.design, float(basis.width), rank, points, negligible_remainder(alpha, noise))
            for basis, alpha in zip(best.prior.bases, best.prior.alphas, strict=True)
        ]
        refined = replace(best.prior, bases=bases)
        if sum(refined.ranks) >= most_centres(rank, points):
            break  # what is left is more than so many functions can follow, not noise
        is_flat = isinstance(best.equations.facets, FlatFacets)
        equations = _flat_equations(best, rows, surface.design) if is_flat else best.equations
        best = replace(equations, weights=weights).solve(refined, sigma, settings.alpha > 0, told)
    return best


def _rows_of_fit(fit: SurfaceFit, placed: PointSet) -> _Rows:
    feet, normals = _feet(fit.moved, fit.closest), fit.closest.normals
    offsets = placed.points - feet
    # Not `fit.moved`: of points that went to and fro between faces in the end, it is the motion of another face.
    left = np.einsum("ij,ij->i", normals, offsets - fit.motion().displacement_at(feet))
    weights = np.where(fit.counts, np.nan_to_num(tukey_weights(left - fit.offset, fit.sigma)), 0.0)
    counts = weights > 0
    return _Rows(weights[counts], feet[counts], normals[counts], offsets[counts])


def _rows_of_all(
    fit: SurfaceFit, points: Array, pose: Array, surface: DesignSurface, progress: ProgressCallback
) -> tuple[_Rows, float]:
    placed = np.empty_like(points)

    def place(chunk: slice) -> None:
        placed[chunk] = transform(pose, points[chunk])

    for _ in _in_chunks(len(points), place):
        progress(Progress("surface", 0.95, 0, fit.sigma))
    area = surface.design.face_areas.sum()
    # Of rough motions the rows would cost most.
    edge = max(_CELL * fit.beta * fit.scale, float(np.sqrt(area / _MOST_CELLS)))
    cells = _cells(placed, edge, surface)
    back = _LinearInverse.of(fit.motion(), placed, cells)
    # What is farther off counts for nothing, and looking for it would take longest.
    reach = _REACH * fit.sigma + 2.0 * surface.pitch
    distances, normals, feet = np.empty(len(points)), np.empty_like(points), np.empty_like(points)
    is_near = np.empty(len(points), dtype=np.bool_)

    def measure(chunk: slice) -> None:
        moved = back(placed[chunk], cells[chunk])
        closest = surface.closest_within(moved, reach)
        distances[chunk], normals[chunk], feet[chunk] = closest.distances, closest.normals, _feet(moved, closest)
        is_near[chunk] = ((moved - closest.points) ** 2).sum(axis=1) < reach**2

    for share in _in_chunks(len(points), measure):
        progress(Progress("surface", 0.95 + 0.05 * share, 0, fit.sigma))
    distances -= fit.offset
    sigma = robust_sigma(distances[is_near]) if is_near.any() else fit.sigma
    sigma = max(sigma, _LEAST_SIGMA * fit.scale)
    weights = np.where(is_near, tukey_weights(distances, sigma), 0.0)
    placed -= feet
    rows = _grouped(cells, feet, normals, placed, weights)
    shown = ShownPlaces(fit.closest.points[fit.counts], fit.closest.normals[fit.counts])
    return rows.without(shown.leave_out(rows.foot, rows.normal)), sigma


def _feet(moved: Array, closest: Closest) -> Array:
    """Straight below the points, beside an edge as well: what lies off along the surface is no distance."""
    return moved - closest.distances[:, None] * closest.normals


@dataclass(frozen=True, eq=False)
class _LinearInverse:
    """The way back from the posed scan to the design, taken to be linear in each cell."""

    centres: Array  # (k, 3) mm, mean of the cell's points
    feet: Array  # (k, 3) mm, where they come from
    inverse: Array  # (k, 3, 3)

    @classmethod
    def of(cls, motion: Deformation, placed: Array, cells: NDArray[np.intp]) -> _LinearInverse:
        counts = np.bincount(cells)
        centres = np.stack([np.bincount(cells, axis) for axis in placed.T], axis=1) / counts[:, None]
        feet = motion.apply_roughly(centres)
        return cls(centres, feet, np.linalg.inv(motion.jacobian(feet)).astype(np.float64))

    def __call__(self, placed: Array, cells: NDArray[np.intp]) -> Array:
        """Where posed points (n, 3) of these `cells` (n,) come from, (n, 3) mm."""
        away = (placed - self.centres[cells])[:, :, None]
        moved: Array = self.feet[cells] + (self.inverse[cells] @ away)[:, :, 0]
        return moved


def _in_chunks(count: int, work: Callable[[slice], None]) -> Iterator[float]:
    """Do the work on `count` points chunk by chunk; yields the share that is done."""
    chunks = [slice(begin, begin + _CHUNK) for begin in range(0, count, _CHUNK)]
    for done, _ in enumerate(in_threads(work, chunks), 1):
        yield done / len(chunks)


def _cells(points: Array, edge: float, surface: DesignSurface) -> NDArray[np.intp]:
    """Which cell of a grid each point lies in, numbered without gaps, (n,); what is far off counts as on the border."""
    corners, margin = surface.design.triangles.reshape(-1, 3), surface.design.scale
    nearby = np.clip(points, corners.min(axis=0) - margin, corners.max(axis=0) + margin)
    boxes = number_boxes(nearby.T, edge, nearby.min(axis=0))
    assert boxes is not None  # the edge is never so short that they could not be numbered
    return np.unique(boxes, return_inverse=True)[1].reshape(-1)


def _grouped(cells: NDArray[np.intp], feet: Array, normals: Array, offsets: Array, weights: Array) -> _Rows:
    facings = np.round(_FACINGS * normals).astype(np.int64) + _FACINGS
    for axis in range(3):
        cells = cells * (2 * _FACINGS + 1) + facings[:, axis]
    row_of = np.unique(cells, return_inverse=True)[1].reshape(-1)
    weight = np.bincount(row_of, weights).astype(np.float64)
    counts = weight > 0

    def mean(vectors: Array) -> Array:
        sums = np.stack([np.bincount(row_of, weights * axis) for axis in vectors.T], axis=1)
        return sums[counts] / weight[counts, None]

    return _Rows(weight[counts], mean(feet), mean(normals), mean(offsets))
