"""Experiment 2: a printed part in space, from the scan to the redesign and the next prints."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import KDTree

import mdf_core as mdf
from mdf_core.design_surface import DesignSurface
from mdf_core.distortion import distortion_left, fraction_unrecovered
from mdf_core.errors import RegistrationFailedError
from mdf_core.geometry import Design, PointSet
from mdf_core.inspection import Inspection
from mdf_core.interpolation import interpolate
from mdf_core.outliers import surface_distance_test
from mdf_core.rigid import inverse, transform
from mdf_core.sampling import thin
from mdf_core.settings import OutlierSettings, Settings
from mdf_core.virtual_cell import Printer, ScannerSettings, VirtualScan, Warp, build_part, scan_part

BOX_MM = 2.0
SCANNER = ScannerSettings(points=200_000, noise_mm=0.02, outlier_share=0.01, density_contrast=10.0)
_KNOWN_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # the paper has no pose search either
PRODUCT = Settings().replace({"pose.initial": _KNOWN_POSE})
PAPER = PRODUCT.replace(
    {
        "method": "mdf",
        "thinning.box_mm": BOX_MM,
        "mixture.beta": 3.0,
        "mixture.alpha": 2.0,
        "mixture.outlier_share": 0.1,
        "outliers.method": "normalized_median",
        "outliers.median_threshold": 2.0,
    }
)
NEIGHBOURS = (1, 4, 8, 16, 32)


@dataclass(frozen=True)
class Case:
    """A virtual part, scaled by `size`, and how its print is distorted."""

    part: str
    size: float
    warp_mm: float
    correlation_length_mm: float
    seed: int


BRACKETS = tuple(Case("bracket", 1.0, 2.5, 50.0, seed) for seed in range(3))
OTHERS = (
    Case("bracket", 0.5, 1.25, 25.0, 0),
    Case("clip", 1.0, 2.5, 50.0, 0),
    Case("plate", 1.0, 2.5, 50.0, 0),
    Case("plate", 0.6, 1.5, 30.0, 0),
)


@dataclass(frozen=True, eq=False)
class Printed:
    """The first print of a case and its scan."""

    case: Case
    design: Design
    printer: Printer
    virtual: VirtualScan

    @property
    def displacement(self) -> np.ndarray:
        return self.printer.warp(self.design.vertices)

    def scan_index(self, points: np.ndarray) -> np.ndarray:
        """Which points of the first print's scan these are, up to rounding."""
        return np.asarray(KDTree(self.virtual.scan.points).query(points)[1])

    def scan_of(self, vertices: np.ndarray, seed: int) -> VirtualScan:
        return scan_part(self.printer.print_part(vertices), self.design.faces, SCANNER, seed)

    def left(self, vertices: np.ndarray) -> float:
        """RMS distortion of the print of these vertices over that of the design's print."""
        first, _ = distortion_left(self.design, self.printer.print_part(self.design.vertices))
        return distortion_left(self.design, self.printer.print_part(vertices))[0] / first

    def missed(self, inspection: Inspection) -> float:
        return fraction_unrecovered(self.design, self.displacement, inspection.displacement, inspection.supported)


def print_and_scan(case: Case) -> Printed:
    part = build_part(case.part)
    design = Design(part.vertices * case.size, part.faces)
    printer = Printer(Warp(design, case.warp_mm, case.correlation_length_mm, case.seed))
    virtual = scan_part(printer.print_part(design.vertices), design.faces, SCANNER, case.seed)
    return Printed(case, design, printer, virtual)


def thinned(scan: PointSet, settings: Settings) -> tuple[PointSet, Settings]:
    """The scan as the boxes leave it, if there are any, and the settings that take all of it."""
    if not settings.thinning.box_mm:
        return scan, settings
    scan = thin(scan, settings.thinning, settings.seed)
    return scan, settings.replace({"thinning.box_mm": 0.0, "mixture.points": len(scan)})


def inspect(design: Design, scan: PointSet, settings: Settings) -> Inspection:
    """As `mdf_core.inspect`; a mixture gets all points that the boxes leave, and as many of the design."""
    return mdf.inspect(design, *thinned(scan, settings))


@dataclass(frozen=True, eq=False)
class Measured:
    """What one method says of one print.

    Attributes
    ----------
    missed : float
        Share of the distortion that was not recovered; NaN without an inspection.
    refusal : str
        Why there is no inspection.
    """

    points: int
    inspection: Inspection | None
    missed: float
    refusal: str = ""


def measure(printed: Printed, settings: Settings) -> Measured:
    points = len(thinned(printed.virtual.scan, settings)[0])
    try:
        inspection = inspect(printed.design, printed.virtual.scan, settings)
    except RegistrationFailedError as error:
        return Measured(points, None, float("nan"), str(error))
    return Measured(points, inspection, printed.missed(inspection))


METHODS = {
    "CPD": PAPER.replace({"method": "cpd"}),
    "MDF": PAPER,
    "surface, same points": PAPER.replace({"method": "surface"}),
    "surface": PRODUCT,
}


# From the scan points to the design's vertices


@dataclass(frozen=True)
class Way:
    """How the displacement gets from the scan points to the vertices."""

    name: str
    method: str = ""
    neighbours: int = 1

    def field(self, inspection: Inspection) -> tuple[Inspection, float]:
        """The inspection as this way has it, and the share of vertices that it leaves to the registration itself."""
        if not self.method:
            return inspection, 0.0
        scan = transform(inverse(inspection.pose), inspection.deviation.points)
        kept = ~inspection.deviation.is_outlier
        there, here = inspection.deviation.points[kept], inspection.deformation.apply(scan[kept])
        vertices = inspection.design.vertices
        found = [
            interpolate(points, values, vertices, self.method, self.neighbours)
            for points, values in ((here, there - here), (there, here - there))
        ]
        known = [np.isfinite(values) for values in found]
        changed = replace(
            inspection,
            displacement=np.where(known[0], found[0], inspection.displacement),
            inverse_displacement=np.where(known[1], found[1], inspection.inverse_displacement),
        )
        return changed, float((~known[1]).any(axis=1).mean())


ITSELF = Way("the registration itself")
LINEAR = Way("linear", "linear")
KNN = tuple(Way(f"KNN, k = {count}", "knn", count) for count in NEIGHBOURS)
INVERSE_DISTANCE = Way("inverse distance, 4", "inverse_distance", 4)
WAYS = (LINEAR, *KNN, INVERSE_DISTANCE, ITSELF)


@dataclass(frozen=True)
class Redesigned:
    """What a way of redesign leaves of the distortion, cycle after cycle."""

    way: Way
    missed: float
    outside: float
    left: tuple[float, ...]


def redesign_vertices(printed: Printed, inspection: Inspection, way: Way) -> np.ndarray:
    return mdf.compensate(printed.design, [way.field(inspection)[0]]).vertices


def redesign(printed: Printed, first: Inspection, settings: Settings, way: Way, cycles: int) -> Redesigned:
    """Print, compensate, print; from the second cycle on the correction is added to the redesign before."""
    design = printed.design
    inspection, outside = way.field(first)
    vertices = redesign_vertices(printed, first, way)
    left = [printed.left(vertices)]
    for cycle in range(1, cycles):
        scan = printed.scan_of(vertices, 1000 * cycle + printed.case.seed).scan
        vertices = vertices + redesign_vertices(printed, inspect(design, scan, settings), way) - design.vertices
        left.append(printed.left(vertices))
    return Redesigned(way, printed.missed(inspection), outside, tuple(left))


# Outliers


@dataclass(frozen=True)
class OutlierCounts:
    """What the two tests find among the points that were registered."""

    points: int
    outliers: int
    found: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By test: outliers found, and points of the surface taken for outliers."""


def count_outliers(printed: Printed, inspection: Inspection) -> OutlierCounts:
    deviation = inspection.deviation
    scan = transform(inverse(inspection.pose), deviation.points)
    true = printed.virtual.is_outlier[printed.scan_index(scan)]
    moved = inspection.deformation.apply(scan)
    feet = DesignSurface(printed.design).closest(moved).points
    distant = surface_distance_test(np.linalg.norm(moved - feet, axis=1), OutlierSettings())
    flags = {"normalised median": deviation.is_outlier, "distance to the surface": distant}
    found = {name: (int((flag & true).sum()), int((flag & ~true).sum())) for name, flag in flags.items()}
    return OutlierCounts(len(true), int(true.sum()), found)
