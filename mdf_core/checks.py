"""What is checked of a redesign before it may be released for printing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdf_core.check_result import Check, place_of
from mdf_core.dimension_checks import fixed_regions, largest_move, stretch, volume, wall_thickness
from mdf_core.errors import DesignMismatchError
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import stl_coordinates
from mdf_core.self_intersections import self_intersections
from mdf_core.settings import ReleaseSettings
from mdf_core.surface_checks import degenerate_faces, orientation, watertight
from mdf_core.welded_mesh import WeldedMesh


def check_redesign(
    design: Design, vertices: Array, fixed: NDArray[np.bool_], settings: ReleaseSettings
) -> tuple[Check, ...]:
    """Check a redesign, which has the design's faces and vertex order, as it will lie in the binary STL (float32).

    - watertight: the surface of a closed design is still closed, and no two of its vertices came to lie on one spot.
    - orientation: no face is turned by 90 degrees or more, no closed body is inside out.
    - degenerate_faces: no face has lost nine tenths of its smallest height.
    - self_intersections: no two faces cut each other deeper than by 1e-5 of the design's RMS radius, or rounding, and
      no closed body lies inside another, that did not so in the design.
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
    moved = stl_coordinates(vertices)
    is_finite: NDArray[np.bool_] = np.asarray(np.isfinite(moved).all(axis=1))
    if not is_finite.all():
        return _checks_without_all_vertices(design, moved, fixed, is_finite)
    mesh = WeldedMesh(design)
    return (
        watertight(mesh, moved),
        orientation(mesh, moved),
        degenerate_faces(mesh, moved),
        self_intersections(mesh, moved),
        wall_thickness(mesh, moved, settings.max_thickness_change),
        stretch(mesh, moved, settings.max_stretch),
        largest_move(mesh, vertices, settings.max_move_mm),
        fixed_regions(design, moved, fixed),
        volume(mesh, moved),
    )


def _checks_without_all_vertices(
    design: Design, moved: Array, fixed: NDArray[np.bool_], is_finite: NDArray[np.bool_]
) -> tuple[Check, ...]:
    what = f"{np.count_nonzero(~is_finite)} of {len(is_finite)} vertices are NaN or infinite"
    place = place_of(design.vertices[is_finite.argmin()])
    names = ("watertight", "orientation", "degenerate_faces", "self_intersections", "wall_thickness", "stretch")
    unchecked = [Check(name, False, f"not checked: {what}", place) for name in (*names, "largest_move")]
    of_fixed = (
        fixed_regions(design, moved, fixed)
        if is_finite[fixed].all()
        else Check("fixed_regions", False, f"not checked: {what}", place)
    )
    return (*unchecked, of_fixed, Check("volume", True, f"not known: {what}", None))
