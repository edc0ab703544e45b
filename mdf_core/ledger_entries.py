"""What the ledger holds: redesigns as they are proposed and recorded, and the table they lie in."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum

from sqlalchemy import (
    JSON,
    CheckConstraint,
    Column,
    DateTime,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    text,
)

from mdf_core.check_result import Check
from mdf_core.estimate import Evidence
from mdf_core.geometry import Array
from mdf_core.settings import Settings, Value


class CycleState(Enum):
    """What has become of a redesign; at most one of a part and design is released."""

    PROPOSED = "proposed"
    RELEASED = "released"
    REJECTED = "rejected"
    SUPERSEDED = "superseded"
    ROLLED_BACK = "rolled_back"


@dataclass(frozen=True)
class ScanReference:
    """A scan, and the inspection of it.

    Attributes
    ----------
    sha256 : str
        Of the scan.
    job_id : str
    """

    sha256: str
    job_id: str


@dataclass(frozen=True, eq=False)
class Proposal:
    """A redesign to be recorded.

    Attributes
    ----------
    part_id : str
    design_sha256 : str
        Of the nominal design's file.
    previous : int or None
        Id of the cycle whose prints were measured; None: prints of the nominal design.
    gain : float
    lookup : str
    vertices : (n, 3) float64, mm
        Of the redesign.
    stl_path, stl_sha256 : str
        Of the redesign's file.
    inputs : sequence of ScanReference
        Scans that the redesign was made from.
    settings : Settings
    software_version : str
    residual_before_mm : float
        RMS distortion that the input scans show.
    predicted_residual_mm : float
        RMS distortion expected of prints of the redesign; NaN: not known.
    distortion_over_move : float
        Share of the redesign's move that the distortion of the input scans shows, backwards; NaN: nothing moved.
    checks : sequence of Check
    evidence : Evidence, optional
        What the redesign rests on; kept in float32.
    """

    part_id: str
    design_sha256: str
    previous: int | None
    gain: float
    lookup: str
    vertices: Array
    stl_path: str
    stl_sha256: str
    inputs: Sequence[ScanReference]
    settings: Settings
    software_version: str
    residual_before_mm: float
    predicted_residual_mm: float = math.nan
    distortion_over_move: float = math.nan
    checks: Sequence[Check] = ()
    evidence: Evidence | None = None

    def fingerprint(self) -> str:
        """SHA-256 that equal proposals share: those of the same scans, design and settings with the same outcome."""
        identity = (
            self.part_id,
            self.design_sha256,
            self.previous,
            float(self.gain),
            self.lookup,
            [scan.sha256 for scan in self.inputs],
            self.settings.sha256(),
            self.stl_sha256,
        )
        return hashlib.sha256(json.dumps(identity).encode()).hexdigest()


@dataclass(frozen=True)
class Cycle:
    """A redesign as recorded; `Ledger` has its vertices and what they rest on. What `Proposal` tells is not told again.

    Attributes
    ----------
    id : int
        Of the cycle, in the ledger; counts up.
    number : int
        1 for a redesign against prints of the nominal design, else that of `previous` + 1.
    state : CycleState
    reprints : tuple of ScanReference
        Scans of all prints of the redesign so far.
    settings : mapping
        Dotted leaf name to value, as `Settings.flat`.
    predicted_residual_mm, distortion_over_move : float or None
        None: not known.
    measured_residual_mm, measured_residual_std_mm : float or None
        RMS distortion that the prints have in common that were measured last, and its standard deviation; None: not
        known (yet).
    created, decided : datetime
        UTC; `decided` is None while nobody has.
    decided_by, reason : str
        Of the last decision about this very cycle: its release, rejection or rollback.
    """

    id: int
    part_id: str
    design_sha256: str
    number: int
    previous: int | None
    gain: float
    lookup: str
    state: CycleState
    stl_path: str
    stl_sha256: str
    inputs: tuple[ScanReference, ...]
    reprints: tuple[ScanReference, ...]
    settings: Mapping[str, Value] = field(hash=False)
    settings_sha256: str
    software_version: str
    checks: tuple[Check, ...]
    residual_before_mm: float
    predicted_residual_mm: float | None
    distortion_over_move: float | None
    measured_residual_mm: float | None
    measured_residual_std_mm: float | None
    created: datetime
    decided: datetime | None
    decided_by: str
    reason: str


METADATA = MetaData()
"""What the migrations lead to."""

_IS_RELEASED = text("state = 'released'")
CYCLES = Table(
    "cycles",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("fingerprint", String(64), nullable=False),
    Column("part_id", Text, nullable=False),
    Column("design_sha256", String(64), nullable=False),
    Column("number", Integer, nullable=False),
    Column("previous", Integer, ForeignKey("cycles.id", name="previous_cycle")),
    Column("gain", Double, nullable=False),
    Column("lookup", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("stl_path", Text, nullable=False),
    Column("stl_sha256", String(64), nullable=False),
    Column("inputs", JSON, nullable=False),
    Column("reprints", JSON, nullable=False),
    Column("settings", JSON, nullable=False),
    Column("settings_sha256", String(64), nullable=False),
    Column("software_version", Text, nullable=False),
    Column("checks", JSON, nullable=False),
    Column("residual_before_mm", Double, nullable=False),
    Column("predicted_residual_mm", Double),
    Column("distortion_over_move", Double),
    Column("measured_residual_mm", Double),
    Column("measured_residual_std_mm", Double),
    Column("created", DateTime(timezone=True), nullable=False),
    Column("decided", DateTime(timezone=True)),
    Column("decided_by", Text, nullable=False),
    Column("reason", Text, nullable=False),
    Column("vertex_count", Integer, nullable=False),
    # The last ones: SQLite reads through them to what lies behind.
    Column("vertices", LargeBinary, nullable=False),
    Column("evidence", LargeBinary),
    CheckConstraint(f"state IN ({', '.join(repr(state.value) for state in CycleState)})", name="known_state"),
    Index("one_cycle_of_a_fingerprint", "fingerprint", unique=True),
    Index("cycles_of_a_part", "part_id", "design_sha256"),
    Index("cycles_of_a_file", "stl_sha256"),
    Index(
        "one_released",
        "part_id",
        "design_sha256",
        unique=True,
        sqlite_where=_IS_RELEASED,
        postgresql_where=_IS_RELEASED,
    ),
)
