"""What one scan says about one design: the displacement, how sure it is, and the verdict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mdf_core.averages import rms_length
from mdf_core.deformation import Deformation
from mdf_core.geometry import Array, Design, shown
from mdf_core.pieces import PiecewiseDeformation
from mdf_core.regions import Region
from mdf_core.settings import Settings

_FEWEST_POINTS = 200  # of a scan whose standard deviation can be believed
_COVERAGE_FACTOR = 2.0  # times the standard deviation: expanded uncertainty, as decision rules take it (ISO 14253-1)
_AT_REST = ("converged", "sigma_floor")


class Verdict(Enum):
    """Missing data never reads as PASS."""

    NO_DECISION = "NO DECISION"
    PASS = "PASS"
    FAIL = "FAIL"


@dataclass(frozen=True, eq=False)
class Deviation:
    """The registered scan against the design surface, one entry per scan point used.

    Attributes
    ----------
    points : (m, 3) float64, mm
        Scan points in the design frame, rigidly placed (not deformed).
    signed_distance : (m,) float64, mm
        To the nearest design surface, positive outside the material.
    is_outlier : (m,) bool
    """

    points: Array
    signed_distance: Array
    is_outlier: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """RMS distance of the points that are no outliers, mm; NaN without any."""
        kept = self._kept()
        return float(np.sqrt((kept**2).mean())) if len(kept) else float("nan")

    @property
    def p95(self) -> float:
        """95th percentile of their distances either way, mm."""
        kept = self._kept()
        return float(np.percentile(kept, 95)) if len(kept) else float("nan")

    @property
    def max(self) -> float:
        """Largest of their distances either way, mm."""
        kept = self._kept()
        return float(kept.max()) if len(kept) else float("nan")

    @property
    def profile(self) -> float:
        """Width of the zone about the design's surface that holds them all, mm: the profile of a surface (ISO 1101)."""
        return 2.0 * self.max

    def _kept(self) -> Array:
        kept: Array = np.abs(self.signed_distance[~self.is_outlier])
        return kept


@dataclass(frozen=True)
class RegionVerdict:
    """How one region of the part, or what is in none, keeps to its tolerance.

    Attributes
    ----------
    name : str
        Of the region; empty: the part, but for its regions with tolerances of their own.
    tolerance : float, mm
    max_displacement : float, mm
        Largest supported one; NaN without any.
    coverage : float
        Supported share of its surface.
    verdict : Verdict
    reasons : tuple of str
        In words, unless it is PASS.
    """

    name: str
    tolerance: float
    max_displacement: float
    coverage: float
    verdict: Verdict
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of `mdf_core.inspect`; lengths in mm, one entry per design vertex.

    Attributes
    ----------
    displacement : (n, 3) float64, mm
        Where the vertex went in the print, minus where it should be; no rigid part.
    inverse_displacement : (n, 3) float64, mm
        Where the material now found at the vertex's nominal position belongs, minus that position.
    std : (n,) float64, mm
        Posterior standard deviation of the displacement (RMS length of the error vector), which has no rigid part;
        NaN: nothing is known, as where the method has none.
    supported : (n,) bool
        False where the scan does not reach: the displacement there is extrapolation.
    disputed : (n,) bool
        Where most of the scan points nearby are outliers: a dent or a burr, of which there is no displacement; not
        supported.
    unseen : (n,) bool
        In patches of the surface without a scan point, though many would be expected there: a feature that was not
        printed, or that the scanner did not see; not supported.
    unexplained : (n,) float64, mm
        How far the scan lies off the surface after registration, where that is more than chance; else 0. A shallow dent
        or bump that the displacement does not follow, or an error of the scan that neighbouring points share.
    face_displacement : (f,) float64, mm
        Largest displacement within each triangle, its corners left aside; 0 without an area; NaN: not known.
    residual_scale : float, mm
        Robust standard deviation of the scan to the design surface after registration, less such errors.
    regions : tuple of Region
        Those with a tolerance are judged by it.
    mesh_error : float, mm
        RMS of what is missed between the vertices, see `mdf_core.coarseness.between_vertices`.
    pose_ambiguous : bool
        Other poses explain the scan equally well; they are in `alternative_poses`.
    """

    design: Design
    deformation: Deformation | PiecewiseDeformation
    displacement: Array
    inverse_displacement: Array
    std: Array
    supported: NDArray[np.bool_]
    disputed: NDArray[np.bool_]
    unseen: NDArray[np.bool_]
    unexplained: Array
    face_displacement: Array
    deviation: Deviation
    residual_scale: float
    pose_ambiguous: bool
    alternative_poses: tuple[Array, ...]
    iterations: int
    stop_reason: str
    settings: Settings
    scan_sha256: str
    regions: tuple[Region, ...] = ()
    mesh_error: float = 0.0
    stage_seconds: dict[str, float] = field(default_factory=dict)

    @property
    def pose(self) -> Array:
        """T_design_scan, (4, 4)."""
        return self.deformation.pose

    @property
    def coverage(self) -> float:
        """Share of the design's surface that is supported."""
        areas = self.design.vertex_areas
        return float(areas[self.supported].sum() / areas.sum())

    @property
    def outlier_share(self) -> float:
        """Share of the scan points judged outliers."""
        return float(self.deviation.is_outlier.mean())

    @property
    def rms_displacement(self) -> float:
        """Area-weighted RMS length of the supported displacement, mm; NaN without support."""
        return rms_length(self.displacement, self.design.vertex_areas * self.supported)

    @property
    def p95_displacement(self) -> float:
        """95th percentile of the supported displacement's length, mm; NaN without support."""
        return float(np.percentile(self._lengths[self.supported], 95)) if self.supported.any() else float("nan")

    @property
    def max_displacement(self) -> float:
        """Largest supported displacement, mm; NaN without support."""
        return float(self._lengths[self.supported].max()) if self.supported.any() else float("nan")

    @cached_property
    def _lengths(self) -> Array:
        lengths: Array = np.linalg.norm(self.displacement, axis=1)
        return lengths

    @property
    def verdict(self) -> tuple[Verdict, tuple[str, ...]]:
        """The verdict and, unless it is PASS, the reasons in words."""
        undecided = _undecided(self)
        parts = self.region_verdicts
        if self.settings.verdict.tolerance_mm == 0 and self._beside_regions().any():
            undecided.insert(0, "no tolerance is set (verdict.tolerance_mm)")
        undecided += [reason for part in parts if part.verdict is Verdict.NO_DECISION for reason in part.reasons]
        if undecided:
            return Verdict.NO_DECISION, tuple(dict.fromkeys(undecided))
        failed = tuple(reason for part in parts if part.verdict is Verdict.FAIL for reason in part.reasons)
        return (Verdict.FAIL, failed) if failed else (Verdict.PASS, ())

    @property
    def region_verdicts(self) -> tuple[RegionVerdict, ...]:
        """Of the part where none of its regions has a tolerance of its own, and of each region that has."""
        parts = [(region.name, region.tolerance_mm, region.vertices) for region in self.regions if region.tolerance_mm]
        tolerance, rest = self.settings.verdict.tolerance_mm, self._beside_regions()
        if tolerance > 0 and rest.any():
            parts.insert(0, ("", tolerance, rest))
        return tuple(_judge(self, *part) for part in parts)

    def _beside_regions(self) -> NDArray[np.bool_]:
        """Vertices that the tolerance of the part is for, (n,)."""
        rest = np.ones_like(self.supported)
        for region in self.regions:
            if region.tolerance_mm > 0:
                rest &= ~region.vertices
        return rest


def _undecided(inspection: Inspection) -> list[str]:
    """What stands in the way of any verdict."""
    settings = inspection.settings.verdict
    undecided = []
    if not inspection.supported.any():
        undecided.append("the scan supports no vertex")
    if len(inspection.deviation.points) < _FEWEST_POINTS:
        undecided.append(
            f"the scan has {len(inspection.deviation.points)} points; with fewer than {_FEWEST_POINTS} the standard "
            "deviation says little"
        )
    if inspection.coverage < settings.min_coverage:
        undecided.append(
            f"the scan supports {inspection.coverage:.0%} of the surface, {settings.min_coverage:.0%} are needed"
        )
    if inspection.outlier_share > settings.max_outlier_share:
        undecided.append(
            f"{inspection.outlier_share:.1%} of the scan are outliers, {settings.max_outlier_share:.1%} are allowed; "
            "crop.box_mm leaves out what lies beside the part, pose.initial helps where the pose is wrong"
        )
    if inspection.disputed.any():
        undecided.append(
            f"most scan points at {inspection.disputed.sum()} vertices "
            f"about {_middle(inspection.design, inspection.disputed)} are outliers: a dent, a burr, or what is no "
            "part of it; look there"
        )
    if inspection.pose_ambiguous:
        undecided.append("more than one pose explains the scan; give pose.initial")
    if inspection.stop_reason not in _AT_REST:
        undecided.append(f"the registration had not come to rest ({inspection.stop_reason} reached)")
    if np.isnan(inspection.std[inspection.supported]).any():
        undecided.append(f"the method {inspection.settings.method} gives no standard deviation")
    return undecided


def _judge(inspection: Inspection, name: str, tolerance: float, vertices: NDArray[np.bool_]) -> RegionVerdict:
    """The verdict on some vertices."""
    settings, where = inspection.settings.verdict, f"{name}: " if name else ""
    beside = "" if name or vertices.all() else " beside the regions"
    seen, areas = inspection.supported & vertices, inspection.design.vertex_areas
    coverage = float(areas[seen].sum() / areas[vertices].sum()) if areas[vertices].sum() > 0 else float(seen.any())
    undecided = []
    if not vertices.all() and coverage < settings.min_coverage:
        undecided.append(
            f"{where}the scan supports {coverage:.0%} of it{beside}, {settings.min_coverage:.0%} are needed"
        )
    largest_std = float(np.max(inspection.std[seen], initial=0.0))
    if largest_std > tolerance:
        undecided.append(f"{where}the standard deviation reaches {largest_std:.3g} mm, above the tolerance")
    lengths = inspection._lengths[seen]
    margins = _COVERAGE_FACTOR * inspection.std[seen]
    largest = float(lengths.max()) if len(lengths) else float("nan")
    if not len(lengths):
        undecided.append(f"{where}the scan supports no vertex of it")
    elif np.isnan(largest):
        undecided.append(f"{where}the displacement is not a number")
    elif largest <= tolerance:
        undecided += [where + doubt for doubt in _doubts(inspection, tolerance, vertices)]
    elif (least := float((lengths - margins).max())) <= tolerance:
        undecided.append(
            f"{where}the displacement of {largest:.4g} mm may be within the tolerance of {tolerance:g} mm: less "
            f"{_COVERAGE_FACTOR:g} standard deviations it is {max(least, 0.0):.4g} mm"
        )
    if undecided:
        verdict, reasons = Verdict.NO_DECISION, tuple(undecided)
    elif largest <= tolerance:
        verdict, reasons = Verdict.PASS, ()
    else:
        verdict = Verdict.FAIL
        reasons = (f"{where}displacement {largest:.3f} mm above tolerance {tolerance:.3f} mm",)
    return RegionVerdict(name, tolerance, largest, coverage, verdict, reasons)


def _doubts(inspection: Inspection, tolerance: float, vertices: NDArray[np.bool_]) -> Iterator[str]:
    """What speaks against a PASS of these vertices, though none that is supported is displaced too far."""
    design, seen = inspection.design, inspection.supported & vertices
    lengths = inspection._lengths
    reached = lengths + _COVERAGE_FACTOR * inspection.std
    most = float(reached[seen].max())
    if not most <= tolerance:
        yield (
            f"the displacement may be above the tolerance of {tolerance:g} mm: with {_COVERAGE_FACTOR:g} standard "
            f"deviations it reaches {most:.4g} mm"
        )
    is_off = seen & (inspection.unexplained > 0)
    with_off = np.where(is_off, reached + inspection.unexplained, 0.0)
    if not with_off.max() <= tolerance:
        off = inspection.unexplained[with_off.argmax()]
        low, high = np.percentile(inspection.unexplained[is_off], (25.0, 75.0))
        is_everywhere = low > 0.5 * high and design.vertex_areas[is_off].sum() > 0.5 * design.vertex_areas[seen].sum()
        kind = "a coating, or walls of another thickness: it is so nearly everywhere"
        yield (
            f"about {shown(design.vertices[with_off.argmax()])} the scan lies {off:.3g} mm off what the displacement "
            f"explains: {kind if is_everywhere else 'a shallow dent or bump, or an error of the scan; look there'}"
        )
    within = inspection.face_displacement[seen[design.faces].all(axis=1)]
    if not np.max(within, initial=0.0) <= tolerance:
        yield (
            f"between the design's vertices the displacement reaches {np.max(within):.4g} mm; refine its triangles by "
            "design.longest_edge_mm"
        )
    missed, areas = inspection.unseen & vertices, design.vertex_areas
    if areas[missed].sum() > inspection.settings.verdict.max_unseen_share * areas[vertices].sum():
        yield (
            f"no scan point on {areas[missed].sum():.0f} mm² about {_middle(design, missed)}, where "
            "many are expected: missing, or not seen; scan it too, or allow it by verdict.max_unseen_share"
        )


def _middle(design: Design, vertices: NDArray[np.bool_]) -> str:
    """One of the vertices, in the middle."""
    places = design.vertices[vertices]
    return shown(places[((places - places.mean(axis=0)) ** 2).sum(axis=1).argmin()])
