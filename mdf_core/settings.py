"""One tree of frozen settings: the command's ``--set``, the nodes' parameters, the YAML file and the docs come from it.

A leaf is addressed by its dotted name, ``surface.rank``. Every leaf carries a description, a unit and a range.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mdf_core.errors import InvalidSettingError, UnknownMethodError

METHODS = ("surface", "mdf", "cpd")
"""Registration methods: the surface stage, area-weighted CPD, plain CPD."""

_LEAST_QUATERNION = 1e-6  # what is shorter or as much longer than 1 is a mistake, and its square may underflow
_LINE = 1e-3  # second principal extent of datum points / first
_SPOT = 1e-9  # of the coordinates: what is less is their rounding

Value = int | float | str | tuple[float, ...]
"""What a leaf may hold."""


def _leaf(
    default: Value,
    description: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    metadata = {
        "description": description,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class DesignSettings:
    """How the design is taken."""

    longest_edge_mm: float = _leaf(
        0.0,
        "Triangles with longer edges are split, when the design is loaded; 0: they stay as they are",
        "mm",
        0.0,
        1e6,
    )


@dataclass(frozen=True)
class CropSettings:
    """Which points of the scan are looked at."""

    box_mm: tuple[float, ...] = _leaf(
        (),
        "Box in the scan's frame, least x y z and greatest x y z: points outside, as of the table, are left out;"
        " empty: all points are the part's",
        "mm",
    )


@dataclass(frozen=True)
class ThinningSettings:
    """How many scan points the registration works on."""

    target_points: int = _leaf(25_000, "Scans with more points are thinned to about this many", "", 100, 5_000_000)
    box_mm: float = _leaf(0.0, "Edge of the thinning box; 0: from target_points", "mm", 0.0, 1000.0)


@dataclass(frozen=True)
class PoseSettings:
    """Where the rigid pose of the scan comes from."""

    initial: tuple[float, ...] = _leaf(
        (), "Initial pose T_design_scan as x y z (mm) qx qy qz qw; empty: search all rotations"
    )
    datum_design: tuple[float, ...] = _leaf(
        (), "Datum points in the design's frame, x y z of three or more in turn; they give the initial pose", "mm"
    )
    datum_scan: tuple[float, ...] = _leaf((), "The same datum points in the scan's frame, in the same order", "mm")


@dataclass(frozen=True)
class MixtureSettings:
    """Coherent point drift, plain (cpd) or area-weighted (mdf)."""

    beta: float = _leaf(3.0, "Width of the motion kernel, in units of the design's RMS radius", "", 0.01, 100.0)
    alpha: float = _leaf(2.0, "Weight of the motion prior", "", 1e-9, 1e9)
    outlier_share: float = _leaf(0.01, "Expected share of outliers", "", 0.0, 0.99)
    points: int = _leaf(
        5_000, "The scan is thinned to at most this many points, the design sampled by as many", "", 100, 100_000
    )
    rank: int = _leaf(
        0,
        "Rank of the motion kernel; 0: exact if 150 functions span it, else dense up to 2000 points, else 150",
        "",
        0,
        2000,
    )
    max_iterations: int = _leaf(500, "Most EM iterations", "", 1, 100_000)
    tolerance: float = _leaf(
        1e-4, "Stop when no point moves farther per iteration, in units of the design's RMS radius", "", 0.0, 1.0
    )


@dataclass(frozen=True)
class SurfaceSettings:
    """The surface stage: point-to-plane registration to the design triangles."""

    beta: tuple[float, ...] = _leaf(
        (2.8, 2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25),
        "Kernel widths to try, stiffest first, in units of the design's RMS radius",
        "",
        0.05,
        100.0,
    )
    alpha: float = _leaf(
        0.0, "Stiffness: the prior sd of the motion is the RMS radius / sqrt(alpha); 0: from the data", "", 0.0, 1e12
    )
    rank: int = _leaf(500, "Highest rank of the motion kernel", "", 4, 1000)
    max_steps: int = _leaf(15, "Most Gauss-Newton steps per kernel width", "", 1, 1000)
    tolerance: float = _leaf(
        1e-5, "Stop when the points' RMS motion in one step is below this, in units of the RMS radius", "", 0.0, 1.0
    )


@dataclass(frozen=True)
class OutlierSettings:
    """Which scan points are no part of the surface."""

    method: str = _leaf(
        "surface_distance",
        "surface_distance: far from the registered surface; normalized_median: the paper's test on the displacement",
        choices=("surface_distance", "normalized_median"),
    )
    threshold: float = _leaf(4.0, "surface_distance: limit in robust standard deviations", "", 0.1, 1000.0)
    floor_mm: float = _leaf(0.1, "surface_distance: never call a point nearer than this an outlier", "mm", 0.0, 1000.0)
    median_threshold: float = _leaf(2.0, "normalized_median: limit of the normalised residual", "", 0.1, 1000.0)


@dataclass(frozen=True)
class InterpolationSettings:
    """How the displacement gets from the scan points to the design vertices."""

    method: str = _leaf(
        "deformation",
        "deformation: evaluate the registration itself; the others interpolate between scan points",
        choices=("deformation", "knn", "linear", "inverse_distance"),
    )
    neighbours: int = _leaf(4, "Neighbours for knn and inverse_distance", "", 1, 1000)


@dataclass(frozen=True)
class CompensationSettings:
    """How the redesign is made from the displacement."""

    gain: float = _leaf(1.0, "Share of the displacement to compensate", "", -5.0, 5.0)
    lookup: str = _leaf(
        "spatial",
        "spatial: the distortion is a field in the printer's space; material: it sticks to the part",
        choices=("spatial", "material"),
    )
    significance: float = _leaf(
        1.0,
        "A shift below so many standard errors is not compensated, one above twice as many in full; 0: every shift",
        "",
        0.0,
        100.0,
    )
    blend_mm: float = _leaf(
        10.0, "Width of the transition from supported vertices to those that stay at nominal", "mm", 0.0, 1000.0
    )


@dataclass(frozen=True)
class ReleaseSettings:
    """What a redesign must keep to; one that fails a check is not released."""

    max_move_mm: float = _leaf(0.0, "Largest allowed move of a vertex; 0: no limit", "mm", 0.0, 1000.0)
    max_stretch: float = _leaf(0.2, "Largest allowed relative change of an edge's length; 0: no limit", "", 0.0, 10.0)
    max_thickness_change: float = _leaf(
        0.2, "Largest allowed relative change of the wall thickness; 0: no limit", "", 0.0, 10.0
    )


@dataclass(frozen=True)
class VerdictSettings:
    """When an inspection passes."""

    tolerance_mm: float = _leaf(0.0, "Largest allowed displacement; 0: none set, never PASS", "mm", 0.0, 1000.0)
    min_coverage: float = _leaf(0.7, "Least supported share of the design surface for a PASS", "", 0.0, 1.0)
    max_unseen_share: float = _leaf(
        0.0, "Largest share of the surface in gaps of the scan where many points are expected, for a PASS", "", 0.0, 1.0
    )
    max_outlier_share: float = _leaf(0.05, "Largest share of outliers among the scan points for a PASS", "", 0.0, 1.0)
    support_distances: float = _leaf(
        3.0, "A vertex is supported when scan points lie within this many mean point spacings", "", 0.5, 100.0
    )


@dataclass(frozen=True)
class Settings:
    """Everything an inspection and a redesign depend on besides their input.

    Raises
    ------
    InvalidSettingError
        A value of the wrong type or outside its range.
    UnknownMethodError
        A registration method that does not exist.
    """

    method: str = _leaf("surface", "Registration method", choices=METHODS)
    seed: int = _leaf(0, "Seed of every random choice", "", 0, 2**31 - 1)
    memory_mib: int = _leaf(
        2_048, "Most memory an inspection may need; what would need more is refused before it starts", "MiB", 1, 2**24
    )
    design: DesignSettings = field(default_factory=DesignSettings)
    crop: CropSettings = field(default_factory=CropSettings)
    thinning: ThinningSettings = field(default_factory=ThinningSettings)
    pose: PoseSettings = field(default_factory=PoseSettings)
    mixture: MixtureSettings = field(default_factory=MixtureSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    outliers: OutlierSettings = field(default_factory=OutlierSettings)
    interpolation: InterpolationSettings = field(default_factory=InterpolationSettings)
    compensation: CompensationSettings = field(default_factory=CompensationSettings)
    release: ReleaseSettings = field(default_factory=ReleaseSettings)
    verdict: VerdictSettings = field(default_factory=VerdictSettings)

    def __post_init__(self) -> None:
        for name, leaf, value in leaves(self):
            _check(name, leaf, value)
        _check_box(self.crop.box_mm)
        _check_initial(self.pose.initial)
        _check_datum(self.pose)
        if not self.surface.beta:
            raise InvalidSettingError("no kernel width", "setting surface.beta", "give at least one")

    def replace(self, changes: Mapping[str, Value | str]) -> Settings:
        """These settings with some leaves changed.

        Parameters
        ----------
        changes : mapping
            Dotted leaf name to value; text is converted to the leaf's type (tuples as comma-separated numbers).

        Raises
        ------
        InvalidSettingError
            An unknown name, text that does not convert, or a value outside its range.
        UnknownMethodError
            A registration method that does not exist.
        """
        known = {name: value for name, _, value in leaves(self)}
        for name in changes:
            if name not in known:
                raise InvalidSettingError("unknown setting", f"setting {name}", f"use one of {', '.join(known)}")
        converted = {name: _convert(name, value, known[name]) for name, value in changes.items()}
        return self._replaced(known | converted)

    def _replaced(self, values: Mapping[str, Value]) -> Settings:
        branches: dict[str, Any] = {}
        for entry in dataclasses.fields(self):
            branch = getattr(self, entry.name)
            if dataclasses.is_dataclass(branch):
                prefix = entry.name + "."
                inner = {name.removeprefix(prefix): v for name, v in values.items() if name.startswith(prefix)}
                branches[entry.name] = dataclasses.replace(branch, **inner)  # type: ignore[type-var]
            else:
                branches[entry.name] = values[entry.name]
        return Settings(**branches)

    def flat(self) -> dict[str, Value]:
        """Dotted leaf name to value, in the order of definition; 5 given for a floating-point setting comes as 5.0."""
        return {
            name: float(value) if isinstance(leaf.default, float) and isinstance(value, int) else value
            for name, leaf, value in leaves(self)
        }

    def sha256(self) -> str:
        """Hash of all values; equal settings have equal hashes."""
        return hashlib.sha256(json.dumps(self.flat(), sort_keys=True).encode()).hexdigest()


def leaves(settings: Settings) -> Iterator[tuple[str, dataclasses.Field[Any], Value]]:
    """Dotted name, dataclass field (its metadata holds description, unit, minimum, maximum, choices) and value."""
    for entry in dataclasses.fields(settings):
        branch = getattr(settings, entry.name)
        if dataclasses.is_dataclass(branch):
            for inner in dataclasses.fields(branch):
                yield f"{entry.name}.{inner.name}", inner, getattr(branch, inner.name)
        else:
            yield entry.name, entry, branch


def _check_box(box: tuple[float, ...]) -> None:
    if len(box) not in (0, 6) or any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
        raise InvalidSettingError(
            f"{box} is no box", "setting crop.box_mm", "give the least x y z and the greatest x y z, or none"
        )


def _check_initial(pose: tuple[float, ...]) -> None:
    where = "setting pose.initial"
    if len(pose) not in (0, 7):
        raise InvalidSettingError(f"{len(pose)} numbers", where, "give x y z qx qy qz qw, or none")
    if pose and not _LEAST_QUATERNION <= math.hypot(*pose[3:]) <= 1.0 / _LEAST_QUATERNION:
        raise InvalidSettingError(
            f"the quaternion {pose[3:]} of length {math.hypot(*pose[3:]):g} is no rotation",
            where,
            "give x y z qx qy qz qw; 0 0 0 1 turns nothing",
        )


def _check_datum(pose: PoseSettings) -> None:
    where, design, scan = "settings pose.datum_design and pose.datum_scan", pose.datum_design, pose.datum_scan
    if len(design) != len(scan) or len(design) % 3 or 0 < len(design) < 9:
        raise InvalidSettingError(
            f"{len(design)} numbers in the design's frame and {len(scan)} in the scan's",
            where,
            "give x y z of the same three or more points in both, or none",
        )
    if pose.initial and design:
        raise InvalidSettingError(
            "both an initial pose and datum points", "settings pose.initial and pose.datum_design", "give one of them"
        )
    for name, numbers in (("datum_design", design), ("datum_scan", scan)):
        if numbers and not _span_a_plane(numbers):
            raise InvalidSettingError(
                f"the points {numbers} lie on one line or one spot, which leaves the rotation open",
                f"setting pose.{name}",
                "give three or more points that lie well apart and not in a row",
            )


def _span_a_plane(numbers: tuple[float, ...]) -> bool:
    points = np.reshape(numbers, (-1, 3))
    spreads = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spreads[1] > max(_LINE * spreads[0], _SPOT * np.abs(points).max()))


def _check(name: str, leaf: dataclasses.Field[Any], value: Any) -> None:
    where = f"setting {name}"
    default = leaf.default
    if isinstance(default, float) and (not isinstance(value, int | float) or isinstance(value, bool)):
        raise InvalidSettingError(f"{value!r} is not a number", where)
    if isinstance(default, int) and (not isinstance(value, int) or isinstance(value, bool)):
        raise InvalidSettingError(f"{value!r} is not a whole number", where)
    if isinstance(default, tuple) and not (
        isinstance(value, tuple) and all(isinstance(part, float) and math.isfinite(part) for part in value)
    ):
        raise InvalidSettingError(f"{value!r} is not a tuple of finite floating-point numbers", where)
    if isinstance(default, str) and value not in leaf.metadata["choices"]:
        error = UnknownMethodError if name == "method" else InvalidSettingError
        raise error(f"unknown value {value!r}", where, f"use one of {', '.join(leaf.metadata['choices'])}")
    minimum, maximum = leaf.metadata["minimum"], leaf.metadata["maximum"]
    if minimum is None or maximum is None:
        return
    for number in value if isinstance(value, tuple) else (value,):
        if not minimum <= number <= maximum:  # so that NaN fails
            raise InvalidSettingError(f"{number!r} is outside {minimum:g} .. {maximum:g}", where)


def _convert(name: str, value: Any, current: Value) -> Value:
    try:
        if isinstance(current, tuple):
            parts = [part for part in value.split(",") if part.strip()] if isinstance(value, str) else value
            return tuple(float(part) for part in parts)
        if isinstance(value, str) and isinstance(current, int):
            return int(value)
        if isinstance(current, float) and not isinstance(value, bool):
            return float(value)
    except (TypeError, ValueError):
        kind = "comma-separated numbers" if isinstance(current, tuple) else f"a {type(current).__name__}"
        raise InvalidSettingError(f"{value!r} is not {kind}", f"setting {name}") from None
    return value  # type: ignore[no-any-return]
