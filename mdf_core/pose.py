"""Rigid poses from an arbitrary start: many starts at once, trimmed point-to-plane ICP, the best distinct ones.

What the surface stage makes of the candidates decides between them, see `pose_choice`.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mdf_core.design_surface import spread_samples
from mdf_core.geometry import Array, Design
from mdf_core.rigid import homogeneous

_ROTATIONS = 512  # leaves no rotation farther than ~ 27° from a start
_COARSE_POINTS, _COARSE_STEPS = 200, 10
_CELLS = 48  # along each side of the grid by which the coarse steps look up what is nearest
_FINE_POINTS, _EARLY_STEPS, _FINE_STEPS = 500, 4, 8
_LAST_POINTS, _LAST_STEPS = 4_000, 24  # enough that some lie on the one tab that tells which way a disc is turned
_MODEL_POINTS = 10_000
_FINALISTS, _PROMISING = 40, 24
_INLIER_QUANTILE = 0.95  # every point of a partial scan still has its place on the design: only outliers are cut
_TIED = 1.3  # of the least mean distance: poses that a nearly symmetric part may have as well
_AT_REST = 1e-3  # in radians and units of the scale: a pose that moves no farther in a step has arrived
_NEAR = 0.1  # of the scale: what is no farther off counts in the end; a tab that has not met its place is no outlier
_DISTINCT = 0.15  # poses that move the points less than this share of the scale apart are one

_TURNED = np.radians(30.0)
_SPAN = (0.002, 0.998)  # of the points: a few may be none of the part's


class _Model:
    """Design samples with their normals, and which is the nearest one."""

    def __init__(self, design: Design) -> None:
        self.points, faces = spread_samples(design, _MODEL_POINTS)
        self.normals = design.face_normals[faces]
        self.scale = design.scale
        self._tree = KDTree(self.points, balanced_tree=False)
        self._low = self.points.min(axis=0) - 0.5 * design.scale
        extent = float((self.points.max(axis=0) + 0.5 * design.scale - self._low).max())
        self._cell = extent / _CELLS

    @cached_property
    def _sample_of_cell(self) -> NDArray[np.intp]:
        """A sample of the nearest cell of a grid that has one, for each cell, (c,); far away any near the foot does."""
        cells, samples = self._cells(self.points), np.full(_CELLS**3, -1)
        off_middle = (self.points - self._low) / self._cell % 1.0 - 0.5
        order = np.argsort(-(off_middle**2).sum(axis=1), kind="stable")
        samples[cells[order]] = order  # the one nearest to the middle of its cell is written last
        is_empty = (samples < 0).reshape((_CELLS,) * 3)
        nearest = distance_transform_edt(is_empty, return_distances=False, return_indices=True)
        found: NDArray[np.intp] = samples[np.ravel_multi_index(tuple(nearest), is_empty.shape).ravel()]
        return found

    def _cells(self, points: Array) -> NDArray[np.intp]:
        """Number of the cell each of `points` (n, 3) lies in, or of the one next to it, (n,)."""
        x, y, z = np.clip((points - self._low) / self._cell, 0, _CELLS - 1).astype(np.intp).T
        number: NDArray[np.intp] = (x * _CELLS + y) * _CELLS + z
        return number

    def nearest(self, points: Array, coarse: bool) -> tuple[Array, NDArray[np.intp]]:
        """Distance to and number of the sample nearest to each of `points` (n, 3), (n,) mm and (n,)."""
        if not coarse:
            distances, found = self._tree.query(points, workers=-1)
            return np.asarray(distances), np.asarray(found)
        index = self._sample_of_cell[self._cells(points)]
        away = self.points[index] - points
        return np.sqrt(np.einsum("ni,ni->n", away, away)), index


def candidate_poses(points: Array, design: Design, most: int, seed: int) -> Array:
    """The best distinct rigid poses of a scan, best first.

    Parameters
    ----------
    points : (n, 3) float64, mm
        In any frame.
    design : Design
    most : int
        Most poses returned.
    seed : int
        Draws the points that lead to them.

    Returns
    -------
    (k, 4, 4) float64
        T_design_scan, 1 ≤ k ≤ `most`.

    Notes
    -----
    Starts: the frames of the principal axes with every assignment of axes and signs, and rotations spread evenly over
    SO(3) (Alexa 2022, super-Fibonacci spirals), each about the centres.
    """
    model = _Model(design)
    probes = _pick(points, 50, seed)
    coarse, _ = _refine(_starts(points, design), _pick(points, _COARSE_POINTS, seed), model, _COARSE_STEPS, coarse=True)
    finalists = coarse[_distinct(coarse, probes, design.scale, _FINALISTS)]
    finalists = np.concatenate([finalists, _centred(finalists, _pick(points, _LAST_POINTS, seed), design)])
    few = _pick(points, _FINE_POINTS, seed)
    early, _ = _refine(finalists, few, model, _EARLY_STEPS, coarse=False)
    promising = early[_distinct(early, probes, design.scale, _PROMISING)]
    fine, costs = _refine(promising, few, model, _FINE_STEPS, coarse=False)
    best = _distinct(fine, probes, design.scale, most)
    is_tied = costs[best] <= _TIED * costs[0]  # the first one always is
    last = np.concatenate([_last_refined(fine[best[is_tied]], points, model, seed), fine[best[~is_tied]]])
    return last[_distinct(last, probes, design.scale, most)]


def _centred(poses: Array, points: Array, design: Design) -> Array:
    """The poses with the middle of what the scan spans on that of the design; ICP hardly slides a beam along itself."""
    axes = np.linalg.svd(design.vertices - design.vertices.mean(axis=0), full_matrices=False)[2]
    corners = np.quantile(points @ poses[:, :3, :3].transpose(0, 2, 1) @ axes.T, _SPAN, axis=1)
    middles = corners.mean(axis=0) + poses[:, :3, 3] @ axes.T
    along = design.vertices @ axes.T
    wanted = 0.5 * (along.min(axis=0) + along.max(axis=0))
    centred: Array = poses.copy()
    centred[:, :3, 3] += (wanted - middles) @ axes
    return centred


def refine_pose(pose: Array, points: Array, design: Design, seed: int) -> Array:
    """The given T_design_scan (4, 4) after a few ICP steps, with points that `seed` draws."""
    model = _Model(design)
    steps = _EARLY_STEPS + _FINE_STEPS
    fine, _ = _refine(pose[None], _pick(points, _FINE_POINTS, seed), model, steps, coarse=False)
    refined: Array = _last_refined(fine, points, model, seed)[0]
    return refined


def _last_refined(poses: Array, points: Array, model: _Model, seed: int) -> Array:
    """The poses after more steps with the few points that tell how a nearly symmetric part is turned."""
    if len(points) <= _FINE_POINTS:  # they have told all
        return poses
    last = _pick(points, _LAST_POINTS, seed)
    refined, _ = _refine(poses, last, model, _LAST_STEPS, coarse=False, reach=_NEAR * model.scale)
    return refined


def _pick(points: Array, count: int, seed: int) -> Array:
    """`count` of the points, spread at random."""
    index = np.random.default_rng(seed).permutation(len(points))[:count]
    picked: Array = points[np.sort(index)]
    return picked


def _starts(points: Array, design: Design) -> Array:
    scan_centre = np.median(points, axis=0)
    near = ((points - scan_centre) ** 2).sum(axis=1)
    core = points[near <= np.quantile(near, 0.98)]
    centre = core.mean(axis=0)
    _, scan_axes = np.linalg.eigh(np.cov((core - centre).T))
    samples, _ = spread_samples(design, 4_000)
    _, design_axes = np.linalg.eigh(np.cov((samples - samples.mean(axis=0)).T))
    scan_axes *= np.linalg.det(scan_axes)
    design_axes *= np.linalg.det(design_axes)
    cube = Rotation.create_group("O").as_matrix()
    rotations = np.concatenate([design_axes @ cube @ scan_axes.T, _spread_rotations(_ROTATIONS)])
    return np.stack([homogeneous(rotation, design.centre - rotation @ centre) for rotation in rotations])


def _spread_rotations(count: int) -> Array:
    """Evenly spread rotations, (count, 3, 3). Source: Alexa 2022, super-Fibonacci spirals."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / phi, 2.0 * np.pi * s / psi
    quaternions = np.stack([r * np.sin(a), r * np.cos(a), big_r * np.sin(b), big_r * np.cos(b)], axis=1)
    rotations: Array = Rotation.from_quat(quaternions).as_matrix()
    return rotations


def _refine(
    poses: Array, points: Array, model: _Model, steps: int, coarse: bool, reach: float = 0.0
) -> tuple[Array, Array]:
    """Trimmed point-to-plane ICP of every pose; the one with the least truncated mean distance comes first.

    Points within `reach` mm of the design count in any case.

    Returns
    -------
    (k, 4, 4) float64, (k,) float64
        The poses, and those mean distances in mm.
    """
    poses, restless = poses.copy(), np.arange(len(poses))
    for _ in range(steps):
        poses[restless], motions = _stepped(poses[restless], points, model, coarse, reach)
        restless = restless[motions > _AT_REST]
        if len(restless) == 0:
            break
    distances, _ = model.nearest(_placed(poses, points).reshape(-1, 3), coarse)
    costs = np.minimum(distances.reshape(len(poses), -1), 0.1 * model.scale).mean(axis=1)
    order = np.argsort(costs, kind="stable")
    return poses[order], costs[order]


def _stepped(poses: Array, points: Array, model: _Model, coarse: bool, reach: float) -> tuple[Array, Array]:
    """One step of `_refine`; and how far it goes, in radians and units of the scale, (k,)."""
    moved = _placed(poses, points)
    distances, index = model.nearest(moved.reshape(-1, 3), coarse)
    distances = distances.reshape(len(poses), -1)
    limit = np.maximum(np.quantile(distances, _INLIER_QUANTILE, axis=1, keepdims=True), reach)
    weights = (distances <= limit).astype(np.float64)
    normals = model.normals[index].reshape(moved.shape)
    offsets = np.einsum("kni,kni->kn", normals, model.points[index].reshape(moved.shape) - moved)
    centre = moved.mean(axis=1, keepdims=True)
    rows = np.concatenate([np.cross(moved - centre, normals), normals], axis=2)
    weighted = rows * weights[:, :, None]
    matrix = weighted.transpose(0, 2, 1) @ rows
    # The ridge holds rotations about an axis of symmetry and slides along a plate.
    matrix += np.diag([1e-4 * model.scale**2] * 3 + [1e-4] * 3) * len(points)
    turn_and_shift = np.linalg.solve(matrix, (weighted.transpose(0, 2, 1) @ offsets[:, :, None]))[:, :, 0]
    turn, shift = turn_and_shift[:, :3], turn_and_shift[:, 3:]
    turns = Rotation.from_rotvec(turn).as_matrix()
    stepped = poses.copy()
    shifts = centre[:, 0] + shift - np.einsum("kij,kj->ki", turns, centre[:, 0])
    stepped[:, :3, 3] = np.einsum("kij,kj->ki", turns, poses[:, :3, 3]) + shifts
    stepped[:, :3, :3] = turns @ poses[:, :3, :3]
    return stepped, np.linalg.norm(turn, axis=1) + np.linalg.norm(shift, axis=1) / model.scale


def _placed(poses: Array, points: Array) -> Array:
    """The points (n, 3) in each of the poses, (k, n, 3)."""
    placed: Array = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return placed


def is_turned(poses: Array, other: Array) -> NDArray[np.bool_]:
    """Whether each of `poses` (k, 4, 4) has an orientation of its own beside the `other`, however little that moves.

    A beam that is turned about its axis hardly moves.
    """
    traces = np.einsum("kij,ij->k", poses[:, :3, :3], other[:3, :3])
    turned: NDArray[np.bool_] = traces < 1.0 + 2.0 * np.cos(_TURNED)
    return turned


def _distinct(poses: Array, probes: Array, scale: float, most: int) -> NDArray[np.intp]:
    """Numbers of the first of every group of poses that put the `probes` in much the same places."""
    placed = _placed(poses, probes)
    kept: list[int] = []
    for number, where in enumerate(placed):
        apart = np.sqrt(((placed[kept] - where) ** 2).sum(axis=2).mean(axis=1))
        if ((apart > _DISTINCT * scale) | is_turned(poses[kept], poses[number])).all():
            kept.append(number)
        if len(kept) == most:
            break
    return np.array(kept)
