"""What is checked of a redesign before it may be released for printing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import igl
import igl.predicates
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from mdf_core.errors import DesignMismatchError
from mdf_core.geometry import Array, Design
from mdf_core.settings import ReleaseSettings

_Index = NDArray[np.int64]

_GRAIN = 4.0  # float32 spacings at the design's largest coordinate: more than rounding changes any length by
_SLIVER_HEIGHT, _SLIVER_SHAPE = 1e-3, 0.1  # of the design's scale and of the face's longest edge
_LEAST_HEIGHT = 0.1  # of what it was: a face that keeps less has collapsed
_THICKEST_WALL = 0.25  # of the design's scale


@dataclass(frozen=True)
class Check:
    """One property of a redesign, and whether it holds.

    Attributes
    ----------
    name : str
    passed : bool
    finding : str
        What was found, in numbers with their units, and the limit.
    place : (x, y, z), mm, or None
        Where it is worst: the face's, edge's or vertex' place in the design, for self-intersections where the redesign
        is cut. None where the check passed.
    """

    name: str
    passed: bool
    finding: str
    place: tuple[float, float, float] | None


def check_redesign(
    design: Design, vertices: Array, fixed: NDArray[np.bool_], settings: ReleaseSettings
) -> tuple[Check, ...]:
    """Check a redesign, which has the design's faces and vertex order, as it will lie in the binary STL (float32).

    - watertight: the surface of a closed design is still closed, and no two of its vertices came to lie on one spot.
    - orientation: no face is turned by 90 degrees or more, no closed body is inside out.
    - degenerate_faces: no face has lost nine tenths of its smallest height.
    - self_intersections: no two faces cut each other, and no closed body lies inside another, that did not so in the
      design.
    - wall_thickness: from the centroid of every face straight through the material to the other side, the distance
      between the same two points of the material changes by no more than `max_thickness_change`. Only walls are
      measured, that is up to a quarter of the design's RMS radius: a rod of 100 mm may become 1 mm longer, a wall of
      2 mm may not become 1 mm thinner.
    - stretch: no edge changes its length by more than `max_stretch`.
    - largest_move: no vertex moves farther than `max_move_mm`.
    - fixed_regions: no fixed vertex moved.
    - volume: always passes; tells how the enclosed volume changes.

    Parameters
    ----------
    design : Design
    vertices : (n, 3) float64, mm
        Of the redesign. Where some are NaN or infinite, every check that needs all of them fails.
    fixed : (n,) bool
        Vertices that must not have moved at all.
    settings : ReleaseSettings
        The limits; a limit of 0 is none.

    Returns
    -------
    tuple of Check
        All nine, in the order above; the same for the same input.

    Raises
    ------
    DesignMismatchError
        `vertices` or `fixed` are not those of the design.

    Notes
    -----
    Slivers, thinner than a thousandth of the design's RMS radius and than a tenth of their longest edge, are left out
    of orientation, degenerate_faces and wall_thickness: the slightest bend turns them over, and no printer sees it.
    Nor do the faces beside a sliver that turned over count as cutting each other; they overlap by its height. Where the
    design itself is cut, the faces that touch a cut pair may cut each other, too: a smooth move carries the line of the
    cut over to the next face. Lengths may change by what rounding to float32 does to them.

    Cost O(f log f) for f faces: 0.5 s for 20 000, 4 s for 200 000 on two cores, half of it for self_intersections;
    twice that where large bodies lie within each other's bounds. Other threads of the process wait meanwhile.
    """
    vertices, fixed = np.asarray(vertices, dtype=np.float64), np.asarray(fixed, dtype=np.bool_)
    for name, shape, expected in (
        ("vertices", vertices.shape, design.vertices.shape),
        ("fixed", fixed.shape, design.vertices.shape[:1]),
    ):
        if shape != expected:
            raise DesignMismatchError(
                f"{name} of shape {shape} for a design that needs {expected}",
                design.path or "design",
                "give the redesign of this design",
            )
    moved = _rounded(vertices)
    is_finite: NDArray[np.bool_] = np.asarray(np.isfinite(moved).all(axis=1))
    if not is_finite.all():
        return _checks_without_all_vertices(design, moved, fixed, is_finite)
    mesh = _Mesh(design)
    return (
        _watertight(mesh, moved),
        _orientation(mesh, moved),
        _degenerate_faces(mesh, moved),
        _self_intersections(mesh, moved),
        _wall_thickness(mesh, moved, settings.max_thickness_change),
        _stretch(mesh, moved, settings.max_stretch),
        _largest_move(mesh, vertices, settings.max_move_mm),
        _fixed_regions(design, moved, fixed),
        _volume(mesh, moved),
    )


def told(checks: Sequence[Check]) -> str:
    """The checks that failed in one line, each with its name, finding and place; empty if all passed."""
    return "; ".join(
        f"{check.name}: {check.finding}" + (f", near ({_numbers(check.place)}) mm" if check.place else "")
        for check in checks
        if not check.passed
    )


def _numbers(place: tuple[float, float, float]) -> str:
    return ", ".join(f"{coordinate:.1f}" for coordinate in place)


@dataclass(frozen=True, eq=False)
class _Mesh:
    """The design as the checks look at it: its faces joined where their corners lie on the same spot."""

    design: Design

    @cached_property
    def used(self) -> _Index:
        """The vertices that faces use, in order."""
        return np.unique(self.design.faces)

    @cached_property
    def spots(self) -> _Index:
        """See `spots_of`; in the design."""
        return self.spots_of(self.design.vertices)

    @cached_property
    def faces(self) -> _Index:
        """The design's faces, the corners on one spot named by the same vertex, (f, 3)."""
        return self.spots[self.design.faces]

    def spots_of(self, vertices: Array) -> _Index:
        """For each of `vertices` (n, 3) the first one on the same spot, (n,); those that no face uses are left out."""
        spots = np.arange(len(vertices))
        _, first, inverse = np.unique(vertices[self.used], axis=0, return_index=True, return_inverse=True)
        spots[self.used] = self.used[first[inverse.reshape(-1)]]
        return spots

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge joins exactly two faces."""
        return _is_closed(self.faces)

    @cached_property
    def bodies(self) -> _Index:
        """The connected body that each face belongs to, (f,), numbered from 0."""
        count = len(self.design.vertices)
        starts, ends = self.faces[:, [0, 1]].ravel(), self.faces[:, [1, 2]].ravel()
        joined = csr_matrix((np.ones(len(starts)), (starts, ends)), shape=(count, count))
        _, labels = connected_components(joined, directed=False)
        return np.unique(labels[self.faces[:, 0]], return_inverse=True)[1].reshape(-1)

    @cached_property
    def first_faces(self) -> _Index:
        """The first face of each body, (b,)."""
        return np.unique(self.bodies, return_index=True)[1]

    @cached_property
    def grain(self) -> float:
        """Changes of a length below this many mm are rounding."""
        return _GRAIN * float(np.spacing(np.float32(np.abs(self.design.vertices[self.used]).max())))

    @cached_property
    def heights(self) -> Array:
        """Smallest height of every face, (f,) mm."""
        return _heights(self.design.triangles)

    @cached_property
    def sliver_height(self) -> float:
        """Slivers are thinner than this, mm."""
        return _SLIVER_HEIGHT * self.design.scale

    @cached_property
    def is_sliver(self) -> NDArray[np.bool_]:
        """Faces whose shape and direction mean nothing, (f,): thin and long, or no thicker than rounding may be."""
        longest = _edge_lengths(self.design.triangles).max(axis=1)
        is_thin = (self.heights <= self.sliver_height) & (self.heights <= _SLIVER_SHAPE * longest)
        sliver: NDArray[np.bool_] = is_thin | (self.heights <= 4.0 * self.grain)
        return sliver

    def centroid(self, face: int) -> tuple[float, float, float]:
        """Centroid of a face in the design."""
        return _place(self.design.triangles[face].mean(axis=0))


# The checks


def _watertight(mesh: _Mesh, moved: Array) -> Check:
    if not mesh.is_closed:
        return Check("watertight", True, "the design is open itself: not every edge joins exactly two faces", None)
    spots = mesh.spots_of(moved)
    changed = np.flatnonzero(spots != mesh.spots)
    # Rounding may well join what it alone keeps apart.
    distances = np.linalg.norm(mesh.design.vertices[changed] - mesh.design.vertices[spots[changed]], axis=1)
    joined = changed[distances > mesh.grain]
    if len(joined):
        finding = f"{len(joined)} of {len(mesh.used)} vertices came to lie on the spot of another one (limit 0)"
        return Check("watertight", False, finding, _place(mesh.design.vertices[joined[0]]))
    if len(changed) and not _is_closed(spots[mesh.design.faces]):
        finding = (
            f"the surface is torn open: {len(changed)} vertices left the spot they shared with another one (limit 0)"
        )
        return Check("watertight", False, finding, _place(mesh.design.vertices[changed[0]]))
    return Check("watertight", True, "every edge joins exactly two faces, as in the design", None)


def _orientation(mesh: _Mesh, moved: Array) -> Check:
    turns = np.where((mesh.heights > 0) & ~_slivers_left(mesh, moved), _turns(mesh, moved), 0.0)
    worst = int(turns.argmax())
    flipped = int((turns >= 90.0).sum())
    if flipped:
        finding = f"{flipped} of {len(turns)} faces are flipped, turned by up to {turns[worst]:.0f}° (limit 90°)"
        return Check("orientation", False, finding, mesh.centroid(worst))
    before, after = _body_volumes(mesh, mesh.design.triangles), _body_volumes(mesh, moved[mesh.design.faces])
    has_volume = np.abs(before) > mesh.grain * np.bincount(mesh.bodies, mesh.design.face_areas)
    inside_out = np.flatnonzero(mesh.is_closed & has_volume & (before * after <= 0.0))
    if len(inside_out):
        finding = f"{len(inside_out)} of {len(before)} bodies are inside out"
        return Check("orientation", False, finding, mesh.centroid(mesh.first_faces[inside_out[0]]))
    return Check("orientation", True, f"no face is turned by more than {turns[worst]:.1f}° (limit 90°)", None)


def _degenerate_faces(mesh: _Mesh, moved: Array) -> Check:
    heights = _heights(moved[mesh.design.faces])
    kept = np.ones(len(heights))
    np.divide(heights, mesh.heights, out=kept, where=~mesh.is_sliver)
    worst = int(kept.argmin())
    limit = f"(limit {100 * _LEAST_HEIGHT:.0f} %)"
    collapsed = int((kept < _LEAST_HEIGHT).sum())
    if not collapsed:
        finding = f"every face keeps {100 * kept[worst]:.0f} % or more of its smallest height {limit}"
        return Check("degenerate_faces", True, finding, None)
    change = f"from {mesh.heights[worst]:.3g} mm to {heights[worst]:.3g} mm"
    finding = f"{collapsed} of {len(kept)} faces have collapsed, the smallest height of one {change} {limit}"
    return Check("degenerate_faces", False, finding, mesh.centroid(worst))


def _self_intersections(mesh: _Mesh, moved: Array) -> Check:
    known, found = _cutting_pairs(mesh, _rounded(mesh.design.vertices)), _cutting_pairs(mesh, moved)
    turned = np.flatnonzero(_slivers_left(mesh, moved) & (_turns(mesh, moved) >= 90.0))
    excused = _is_near(found, known, mesh.faces) | _is_near(found, np.column_stack([turned, turned]), mesh.faces)
    new = found[~excused]
    if len(new):
        place = _place(_cut_place(moved[mesh.design.faces[new[0]]]))
        return Check("self_intersections", False, f"{len(new)} new pairs of faces cut each other (limit 0)", place)
    if mesh.is_closed:
        before, after = _depths(mesh, mesh.design.vertices), _depths(mesh, moved)
        # Of a body that is cut it depends on the corner that is asked for whether it lies inside.
        is_cut = np.isin(np.arange(len(before)), mesh.bodies[np.vstack([known, found])])
        passed_through = np.flatnonzero(~is_cut & (before != after))
        if len(passed_through):
            finding = f"{len(passed_through)} of {len(before)} bodies went into another or came out of it (limit 0)"
            face = mesh.first_faces[passed_through[0]]
            return Check("self_intersections", False, finding, _place(moved[mesh.design.faces[face]].mean(axis=0)))
    own = f"; {len(known)} pairs of the design itself do" if len(known) else ""
    return Check("self_intersections", True, f"no new pair of faces cuts each other (limit 0){own}", None)


def _wall_thickness(mesh: _Mesh, moved: Array, limit: float) -> Check:
    thickest = _THICKEST_WALL * mesh.design.scale
    faces, opposite, shares = _walls(mesh, thickest)
    if len(faces) == 0:
        return Check("wall_thickness", True, f"the design has no wall of up to {thickest:.1f} mm", None)
    before, after = (
        np.linalg.norm(np.einsum("wc,wci->wi", shares, corners[opposite]) - corners[faces].mean(axis=1), axis=1)
        for corners in (mesh.design.triangles, moved[mesh.design.faces])
    )
    changes = _relative_changes(before, after, mesh.grain)
    worst = int(changes.argmax())
    what = f"walls of up to {thickest:.1f} mm change their thickness"
    finding = _change_told(what, float(changes[worst]), float(before[worst]), float(after[worst]), limit)
    return _limited("wall_thickness", float(changes[worst]), limit, finding, mesh.centroid(int(faces[worst])))


def _stretch(mesh: _Mesh, moved: Array, limit: float) -> Check:
    before, after = _edge_lengths(mesh.design.triangles), _edge_lengths(moved[mesh.design.faces])
    changes = _relative_changes(before, after, mesh.grain)
    face, edge = divmod(int(changes.argmax()), 3)
    largest, old, new = (float(values[face, edge]) for values in (changes, before, after))
    ends = mesh.design.triangles[face][[edge, (edge + 1) % 3]]
    finding = _change_told("edges change their length", largest, old, new, limit)
    return _limited("stretch", largest, limit, finding, _place(ends.mean(axis=0)))


def _largest_move(mesh: _Mesh, vertices: Array, limit: float) -> Check:
    moves = np.linalg.norm(vertices - mesh.design.vertices, axis=1)
    worst = int(moves.argmax())
    told_limit = f"limit {limit:g} mm" if limit else "no limit is set"
    finding = f"vertices move by up to {moves[worst]:.3f} mm ({told_limit})"
    largest = max(float(moves[worst]) - mesh.grain, 0.0)
    return _limited("largest_move", largest, limit, finding, _place(mesh.design.vertices[worst]))


def _fixed_regions(design: Design, moved: Array, fixed: NDArray[np.bool_]) -> Check:
    vertices = np.flatnonzero(fixed)
    if len(vertices) == 0:
        return Check("fixed_regions", True, "no vertex is fixed", None)
    moves = np.linalg.norm(moved[vertices] - _rounded(design.vertices[vertices]), axis=1)
    worst = int(moves.argmax())
    if moves[worst] == 0.0:
        return Check("fixed_regions", True, f"none of {len(vertices)} fixed vertices moved (limit 0 mm)", None)
    what = f"{np.count_nonzero(moves)} of {len(vertices)} fixed vertices moved"
    finding = f"{what}, by up to {moves[worst]:.3g} mm (limit 0 mm)"
    return Check("fixed_regions", False, finding, _place(design.vertices[vertices[worst]]))


def _volume(mesh: _Mesh, moved: Array) -> Check:
    before = float(_body_volumes(mesh, mesh.design.triangles).sum())
    if not mesh.is_closed or abs(before) <= mesh.grain * mesh.design.face_areas.sum():
        return Check("volume", True, "the design encloses no volume", None)
    after = float(_body_volumes(mesh, moved[mesh.design.faces]).sum())
    change = f"{100 * (after / before - 1):+.3f} %"
    return Check("volume", True, f"the enclosed volume changes by {change}, from {before:.6g} to {after:.6g} mm³", None)


def _checks_without_all_vertices(
    design: Design, moved: Array, fixed: NDArray[np.bool_], is_finite: NDArray[np.bool_]
) -> tuple[Check, ...]:
    what = f"{np.count_nonzero(~is_finite)} of {len(is_finite)} vertices are NaN or infinite"
    place = _place(design.vertices[is_finite.argmin()])
    names = ("watertight", "orientation", "degenerate_faces", "self_intersections", "wall_thickness", "stretch")
    unchecked = [Check(name, False, f"not checked: {what}", place) for name in (*names, "largest_move")]
    if is_finite[fixed].all():
        fixed_regions = _fixed_regions(design, moved, fixed)
    else:
        fixed_regions = Check("fixed_regions", False, f"not checked: {what}", place)
    return (*unchecked, fixed_regions, Check("volume", True, f"not known: {what}", None))


# Limits and how they are told


def _relative_changes(before: Array, after: Array, grain: float) -> Array:
    """Of lengths, relative to what they were; what rounding may have done is taken off."""
    changes = np.maximum(np.abs(after - before) - grain, 0.0)
    relative: Array = np.divide(changes, before, out=np.zeros_like(changes), where=before > 0)
    return relative


def _change_told(what: str, largest: float, before: float, after: float, limit: float) -> str:
    told_limit = f"limit {100 * limit:g} %" if limit else "no limit is set"
    return f"{what} by up to {100 * largest:.1f} % ({told_limit}), from {before:.3g} mm to {after:.3g} mm"


def _limited(name: str, largest: float, limit: float, finding: str, place: tuple[float, float, float]) -> Check:
    passed = limit == 0.0 or largest <= limit
    return Check(name, passed, finding, None if passed else place)


def _place(point: Array) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z


# Geometry


def _rounded(vertices: Array) -> Array:
    """Coordinates as a binary STL holds them; what float32 cannot hold becomes infinite."""
    with np.errstate(over="ignore"):
        return vertices.astype(np.float32).astype(np.float64)


def _is_closed(faces: _Index) -> bool:
    """Whether every edge joins exactly two of `faces` (f, 3); those that name a vertex twice have no say."""
    has_three_corners = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    ends = np.sort(faces[has_three_corners][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(ends[:, 0] * (faces.max() + 1) + ends[:, 1], return_counts=True)
    return bool((counts == 2).all())


def _crosses(triangles: Array) -> Array:
    """Normals of `triangles` (f, 3, 3), twice the area long, (f, 3)."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _edge_lengths(triangles: Array) -> Array:
    """Of the edges from each corner of `triangles` (f, 3, 3) to the next, (f, 3)."""
    lengths: Array = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    return lengths


def _heights(triangles: Array) -> Array:
    """Smallest height of `triangles` (f, 3, 3), (f,); zero where there is no area."""
    double_areas = np.linalg.norm(_crosses(triangles), axis=1)
    longest = _edge_lengths(triangles).max(axis=1)
    heights: Array = np.divide(double_areas, longest, out=np.zeros_like(longest), where=longest > 0)
    return heights


def _slivers_left(mesh: _Mesh, moved: Array) -> NDArray[np.bool_]:
    """Slivers of the design that are no thicker than slivers in the redesign either, (f,)."""
    left: NDArray[np.bool_] = mesh.is_sliver & (_heights(moved[mesh.design.faces]) <= mesh.sliver_height)
    return left


def _turns(mesh: _Mesh, moved: Array) -> Array:
    """Angle between every face's normals in the design and in the redesign, (f,) degrees.

    90 where the face had no area, 0 where it has none left.
    """
    crosses = _crosses(moved[mesh.design.faces])
    lengths = np.linalg.norm(crosses, axis=1)
    cosines = np.ones(len(crosses))
    np.divide(np.einsum("fi,fi->f", crosses, mesh.design.face_normals), lengths, out=cosines, where=lengths > 0)
    turns: Array = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return turns


def _body_volumes(mesh: _Mesh, triangles: Array) -> Array:
    """What each body encloses, (b,) mm³; means something for closed bodies only."""
    corners = triangles - mesh.design.centre
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.bincount(mesh.bodies, volumes) / 6.0


def _cutting_pairs(mesh: _Mesh, vertices: Array) -> _Index:
    """Faces that cut or touch each other elsewhere than at a common edge or corner, (p, 2) in ascending order."""
    faces = mesh.spots_of(vertices)[mesh.design.faces]
    # A face without an area cuts nothing that the faces beside it do not; the predicates take it for a coplanar one.
    solid = np.flatnonzero(_crosses(vertices[faces]).any(axis=1))
    _, found, _ = igl.predicates.find_self_intersections(vertices, np.ascontiguousarray(faces[solid]))
    pairs = np.sort(solid[found.reshape(-1, 2)], axis=1)
    # Faces with a common edge are found where one folds back on the other; orientation tells that.
    common = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None, :]).sum(axis=(1, 2))
    # Threads find them in any order.
    return np.unique(pairs[common < 2], axis=0)


def _is_near(pairs: _Index, known: _Index, faces: _Index) -> NDArray[np.bool_]:
    """Which of `pairs` (p, 2) are among `known` (k, 2) or touch such a pair, one face the one, one the other, (p,)."""
    if len(pairs) == 0 or len(known) == 0:
        return np.zeros(len(pairs), dtype=np.bool_)
    count = len(faces)
    at_corner = csr_matrix((np.ones(3 * count), (np.repeat(np.arange(count), 3), faces.ravel())))
    first, second = known.T
    cuts = csr_matrix((np.ones(2 * len(known)), (np.r_[first, second], np.r_[second, first])), shape=(count, count))
    one, other = (at_corner[side] @ at_corner.T for side in pairs.T)
    near: NDArray[np.bool_] = np.asarray((one @ cuts).multiply(other).sum(axis=1)).reshape(-1) > 0
    return near


def _cut_place(pair: Array) -> Array:
    """Middle of the box that two triangles (2, 3, 3) have in common, (3,)."""
    middle: Array = 0.5 * (pair.min(axis=1).max(axis=0) + pair.max(axis=1).min(axis=0))
    return middle


def _depths(mesh: _Mesh, vertices: Array) -> _Index:
    """In how many other bodies the first corner of each body lies, (b,)."""
    by_body = np.argsort(mesh.bodies, kind="stable")
    starts = np.searchsorted(mesh.bodies[by_body], np.arange(len(mesh.first_faces)))
    faces = mesh.faces[by_body]
    points = vertices[faces[starts, 0]]
    corners = vertices[faces]
    lows, highs = np.minimum.reduceat(corners.min(axis=1), starts), np.maximum.reduceat(corners.max(axis=1), starts)
    depths = np.zeros(len(starts), dtype=np.int64)
    for body, body_faces in enumerate(np.split(faces, starts[1:])):
        in_box = ((points > lows[body]) & (points < highs[body])).all(axis=1)
        in_box[body] = False
        if in_box.any():
            turns = igl.winding_number(vertices, np.ascontiguousarray(body_faces), points[in_box])
            depths[in_box] += np.abs(turns) > 0.5
    return depths


def _walls(mesh: _Mesh, thickest: float) -> tuple[_Index, _Index, Array]:
    """Faces with material behind them, (w,), the face on its other side, (w,), and where on that: shares, (w, 3)."""
    design = mesh.design
    asked = np.flatnonzero(~mesh.is_sliver)
    inward = -design.face_normals[asked]
    # Off the face by what rounding may do, lest the ray end where it starts.
    starts = design.triangles[asked].mean(axis=1) + mesh.grain * inward
    tree = igl.AABB()
    tree.init(design.vertices, design.faces)
    hit, _, shares = tree.intersect_ray_first(design.vertices, design.faces, starts, inward, thickest)
    # Where bodies overlap, or in an open design, the ray may enter material instead of leaving it.
    leaves = (hit >= 0) & (np.einsum("ri,ri->r", design.face_normals[hit], inward) > 0)
    u, v = shares[leaves].T
    return asked[leaves], hit[leaves], np.column_stack([1.0 - u - v, u, v])
