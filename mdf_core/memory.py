"""How much memory an inspection will need, known before any is taken."""

from __future__ import annotations

from mdf_core.errors import MemoryBudgetError
from mdf_core.facets import MOST_FACETS
from mdf_core.geometry import Design
from mdf_core.motion_basis import most_centres
from mdf_core.registration import AUTOMATIC_RANK, LARGEST_DENSE
from mdf_core.settings import Settings

_DOUBLE = 8  # bytes
_PER_SCAN_POINT = 15  # doubles: positions before and after, cells, distances, normals
_PER_FACE = 40  # doubles: corners, normals, and the samples of a face in two k-d trees
_PER_ROW = 3.5  # copies of a row of features: raw, transformed, denoised, and the motion's
_MATRICES = 5  # normal equations, their factor, its inverse
_SAMPLES = 5_000_000  # bytes, of the surface
_AFFINE = 4


def predicted_memory(scan_points: int, design: Design, settings: Settings) -> dict[str, int]:
    """What an inspection needs at most, in bytes, by what needs it.

    Parameters
    ----------
    scan_points : int
        Before thinning.
    design : Design
    settings : Settings

    Returns
    -------
    dict
        `scan`, `design` and `motion`; the scan itself, which the caller holds, is not counted.
    """
    kept = _kept(scan_points, settings)
    if settings.method == "surface":
        centres = max(most_centres(settings.surface.rank, kept), 1)
        features = centres + _AFFINE
        motion = _PER_ROW * kept * features + _MATRICES * (3 * features + centres) ** 2  # an offset beside the motion
    else:
        points = min(kept, settings.mixture.points)
        is_dense = settings.mixture.rank == 0 and points <= LARGEST_DENSE  # then there is no posterior
        features = points if is_dense else min(settings.mixture.rank or AUTOMATIC_RANK, points)
        motion = _PER_ROW * points * features + (0 if is_dense else _MATRICES * (3 * features) ** 2)
    faces = len(design.faces)
    surfaces = faces + min(faces, MOST_FACETS)  # the design's, and the print's with flat facets
    return {
        "scan": _DOUBLE * _PER_SCAN_POINT * scan_points,
        "design": _DOUBLE * _PER_FACE * surfaces + 2 * _SAMPLES,
        "motion": int(_DOUBLE * motion),
    }


def check_memory(scan_points: int, design: Design, settings: Settings) -> None:
    """Refuse an inspection that would need more than `settings.memory_mib`.

    Raises
    ------
    MemoryBudgetError
        With the sizes of what needs the memory and the settings that lower it.
    """
    needs = predicted_memory(scan_points, design, settings)
    total = sum(needs.values())
    if total <= settings.memory_mib * 2**20:
        return
    words = {
        "scan": f"{scan_points:,} scan points",
        "design": f"{len(design.faces):,} design triangles",
        "motion": f"the motion of {_kept(scan_points, settings):,} points",
    }
    parts = ", ".join(f"{words[part]} {size / 2**20:,.0f} MiB" for part, size in needs.items())
    raise MemoryBudgetError(
        f"the inspection needs about {total / 2**20:,.0f} MiB, memory_mib allows {settings.memory_mib:,} ({parts})",
        "scan",
        "thin the scan before it is sent, lower thinning.target_points or surface.rank, or raise memory_mib",
    )


def _kept(scan_points: int, settings: Settings) -> int:
    """Most points that thinning leaves."""
    return min(scan_points, settings.thinning.target_points) if settings.thinning.box_mm == 0 else scan_points
