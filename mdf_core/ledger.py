"""The ledger: every redesign of every part, what it was made from, who decided about it, and how well it printed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import sqlite3
import threading
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import (
    JSON,
    URL,
    CheckConstraint,
    Column,
    Connection,
    DateTime,
    Double,
    Engine,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    QueuePool,
    Row,
    String,
    Table,
    Text,
    and_,
    create_engine,
    delete,
    event,
    insert,
    make_url,
    or_,
    select,
    text,
    update,
)
from sqlalchemy.exc import ArgumentError, SQLAlchemyError, StatementError

from mdf_core.checks import Check
from mdf_core.errors import CycleStateError, LedgerError
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
    """A redesign as recorded; `Ledger.vertices` has its vertices. What `Proposal` tells is not told again.

    Attributes
    ----------
    id : int
        Of the cycle, in the ledger; counts up.
    number : int
        1 for a redesign against prints of the nominal design, else that of `previous` + 1.
    state : CycleState
    reprints : tuple of ScanReference
        Scans of prints of the redesign.
    settings : mapping
        Dotted leaf name to value, as `Settings.flat`.
    predicted_residual_mm, distortion_over_move : float or None
        None: not known.
    measured_residual_mm, measured_residual_std_mm : float or None
        RMS distortion that the reprints show, and its standard deviation; None: not known (yet).
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
_CYCLES = Table(
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
    Column("vertices", LargeBinary, nullable=False),  # the last one: SQLite reads through it to what lies behind
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
_COLUMNS = _CYCLES.c
_SHOWN = select(*(_COLUMNS[entry.name] for entry in dataclasses.fields(Cycle)))

_DRIVERS = {
    "sqlite": "sqlite+pysqlite",
    "sqlite+pysqlite": "sqlite+pysqlite",
    "postgresql": "postgresql+psycopg",
    "postgresql+psycopg": "postgresql+psycopg",
}
_MIGRATIONS = "mdf_core:migrations"
_VERSION_TABLE = "ledger_version"
_MIGRATION_LOCK = threading.Lock()  # Alembic's environment is one for the process
_BUSY_SECONDS, _BUSY_POLL_SECONDS = 10.0, 0.02
_LOG_BYTES = 16 * 2**20
_CHECKS = "checks"  # who decides about a redesign that fails one
_KEPT_PROPOSALS = 200  # of a part and design that nobody has decided about
_TAKE_TURNS = {
    "sqlite": ("BEGIN IMMEDIATE",),
    "postgresql": (
        # What the writer before has committed is seen, whatever the server's default.
        "SET TRANSACTION ISOLATION LEVEL READ COMMITTED",
        f"SET LOCAL lock_timeout = {int(1000 * _BUSY_SECONDS)}",
        "SELECT pg_advisory_xact_lock(7304214811)",
    ),
}
_URL_REMEDY = "use sqlite:////absolute/path/ledger.sqlite or postgresql+psycopg://user@host/database"
_REMEDIES = {
    "free some space": ("is full", "No space left"),
    "put a backup in its place, or choose another file": ("not a database", "malformed"),
    "end the program that keeps it locked, or try again": ("locked", "lock timeout"),
    "make the file and its folder writable, or choose another one": (
        "readonly",
        "unable to open",
        "Permission denied",
        "Read-only",
    ),
}


def ledger_url(path: Path) -> str:
    """URL of the SQLite ledger in a file, whatever characters its path has."""
    return URL.create("sqlite", database=str(path.absolute())).render_as_string(hide_password=False)


class Ledger:
    """Database of the cycles, which any number of processes and threads may share.

    Parameters
    ----------
    url : str
        ``sqlite:////absolute/path/ledger.sqlite`` or ``postgresql://user@host/database``; ``sqlite://`` is in memory
        and ends with the ledger. The folders of a file are made, the tables made or brought up to date.

    Raises
    ------
    LedgerError
        The database cannot be used, or a newer version of the software has written it. So do all methods.

    Notes
    -----
    Every change is one transaction, on disk before its method returns (SQLite: write-ahead log, fsync). Writers take
    turns; readers never wait for those of other processes. Every method may be called again when its answer was lost:
    what is as asked already stays as it is.
    """

    def __init__(self, url: str) -> None:
        address = _parse(url)
        self._where = address.set(query={}).render_as_string()
        with self._told():
            if address.get_backend_name() == "sqlite" and address.database not in (None, "", ":memory:"):
                Path(str(address.database)).parent.mkdir(parents=True, exist_ok=True)
            self._engine = _engine(address)
        try:
            with self._transaction() as connection:
                self._migrate(connection)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database; what is in it stays."""
        self._engine.dispose()

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # What changes the ledger

    def propose(self, proposal: Proposal, rejection: str = "") -> Cycle:
        """Record a redesign.

        Parameters
        ----------
        proposal : Proposal
        rejection : str
            Why it is rejected at once, as by a check that failed; empty: it is not.

        Returns
        -------
        Cycle
            For an equal proposal that has been recorded before, that one, in the state that it is in.

        Raises
        ------
        CycleStateError
            `previous` is not the released cycle of the part.
        """
        fingerprint, now = proposal.fingerprint(), _now()
        entries = _entries(proposal) | {
            "fingerprint": fingerprint,
            "state": (CycleState.REJECTED if rejection else CycleState.PROPOSED).value,
            "created": now,
            "decided": now if rejection else None,
            "decided_by": _CHECKS if rejection else "",
            "reason": rejection,
        }
        query = _SHOWN.where(_COLUMNS.fingerprint == fingerprint)
        with self._transaction() as connection:
            row = connection.execute(query).one_or_none()
            if row is None:
                current = _current(connection, proposal.part_id, proposal.design_sha256)
                _require_current(proposal.previous, current, f"part {proposal.part_id}")
                number = current.number + 1 if current else 1
                connection.execute(insert(_CYCLES).values(entries | {"number": number}))
                row = connection.execute(query).one()
                _forget_old_proposals(connection, proposal.part_id, proposal.design_sha256)
            return _cycle(row)

    def release(self, cycle_id: int, by: str) -> Cycle:
        """Make a proposed redesign the part's released one, in the place of its predecessor.

        Raises
        ------
        CycleStateError
            It is not proposed, or its predecessor is not the released one any more.
        """
        with self._transaction() as connection:
            cycle = _cycle_of(connection, cycle_id)
            if cycle.state is CycleState.RELEASED:
                return cycle
            _require_proposed(cycle, "released")
            current = _current(connection, cycle.part_id, cycle.design_sha256)
            _require_current(cycle.previous, current, _name(cycle))
            if current is not None:
                _set(connection, current.id, state=CycleState.SUPERSEDED.value)
            _decide(connection, cycle_id, CycleState.RELEASED, by, "")
            return _cycle_of(connection, cycle_id)

    def reject(self, cycle_id: int, by: str, reason: str) -> Cycle:
        """Record that a proposed redesign is not to be used.

        Raises
        ------
        CycleStateError
            It is not proposed.
        """
        with self._transaction() as connection:
            cycle = _cycle_of(connection, cycle_id)
            if cycle.state is CycleState.REJECTED:
                return cycle
            _require_proposed(cycle, "rejected")
            _decide(connection, cycle_id, CycleState.REJECTED, by, reason)
            return _cycle_of(connection, cycle_id)

    def roll_back(self, cycle_id: int, by: str, reason: str) -> Cycle | None:
        """Take back the released redesign; its predecessor is the released one again.

        Returns
        -------
        Cycle or None
            What is released now; None: the nominal design counts.

        Raises
        ------
        CycleStateError
            The cycle is not the released one.
        """
        with self._transaction() as connection:
            cycle = _cycle_of(connection, cycle_id)
            if cycle.state not in (CycleState.RELEASED, CycleState.ROLLED_BACK):
                raise CycleStateError(
                    f"it is {cycle.state.value} and cannot be rolled back", _name(cycle), "name the released cycle"
                )
            if cycle.state is CycleState.RELEASED:
                _decide(connection, cycle_id, CycleState.ROLLED_BACK, by, reason)
                if cycle.previous is not None:
                    _set(connection, cycle.previous, state=CycleState.RELEASED.value)
            return _current(connection, cycle.part_id, cycle.design_sha256)

    def note_reprint(self, cycle_id: int, residual_mm: float, std_mm: float, inputs: Sequence[ScanReference]) -> Cycle:
        """Record what prints of a redesign have shown.

        Parameters
        ----------
        cycle_id : int
        residual_mm, std_mm : float
            RMS distortion over all prints of the redesign so far, and its standard deviation; NaN: not known. They
            replace those of an earlier call.
        inputs : sequence of ScanReference
            Scans of the prints; those that are new are added.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        with self._transaction() as connection:
            reprints = dict.fromkeys((*_cycle_of(connection, cycle_id).reprints, *inputs))
            _set(
                connection,
                cycle_id,
                reprints=[dataclasses.asdict(scan) for scan in reprints],
                measured_residual_mm=_known(residual_mm),
                measured_residual_std_mm=_known(std_mm),
            )
            return _cycle_of(connection, cycle_id)

    # What only reads it

    def current(self, part_id: str, design_sha256: str) -> Cycle | None:
        """The released redesign of a part; None: the nominal design counts."""
        with self._told(), self._engine.connect() as connection:
            return _current(connection, part_id, design_sha256)

    def history(self, part_id: str = "", design_sha256: str = "") -> tuple[Cycle, ...]:
        """All cycles of a part and a design, oldest first; empty: of any."""
        query = _SHOWN.order_by(_COLUMNS.id)
        if part_id:
            query = query.where(_COLUMNS.part_id == part_id)
        if design_sha256:
            query = query.where(_COLUMNS.design_sha256 == design_sha256)
        with self._told(), self._engine.connect() as connection:
            return tuple(_cycle(row) for row in connection.execute(query))

    def by_redesign(self, stl_sha256: str) -> Cycle | None:
        """The cycle whose redesign is that file, None: no cycle's; of several the released one, else the newest."""
        query = _SHOWN.where(_COLUMNS.stl_sha256 == stl_sha256)
        query = query.order_by((_COLUMNS.state == CycleState.RELEASED.value).desc(), _COLUMNS.id.desc()).limit(1)
        with self._told(), self._engine.connect() as connection:
            row = connection.execute(query).one_or_none()
            return None if row is None else _cycle(row)

    def vertices(self, cycle_id: int) -> Array:
        """The vertices of a redesign, (n, 3) float64 in mm, to the bit as proposed.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        query = select(_COLUMNS.vertices, _COLUMNS.vertex_count).where(_COLUMNS.id == cycle_id)
        with self._told(), self._engine.connect() as connection:
            row = connection.execute(query).one_or_none()
            if row is None:
                raise _unknown(cycle_id)
            return np.frombuffer(zlib.decompress(row.vertices), "<f8").reshape(row.vertex_count, 3).astype(np.float64)

    def _migrate(self, connection: Connection) -> None:
        # Alembic takes a third of a second to import, which every node and command would spend.
        from alembic import command
        from alembic.config import Config
        from alembic.migration import MigrationContext
        from alembic.script import ScriptDirectory

        configuration = Config(attributes={"connection": connection})
        configuration.set_main_option("script_location", _MIGRATIONS)
        scripts = ScriptDirectory.from_config(configuration)
        versions = [script.revision for script in scripts.walk_revisions()]
        present = MigrationContext.configure(connection, opts={"version_table": _VERSION_TABLE}).get_current_revision()
        if present is not None and present not in versions:
            raise LedgerError(
                f"it has version {present} of a newer software, this one knows {versions[0]}",
                self._where,
                "update the software, or choose another ledger",
            )
        if present != versions[0]:
            with _MIGRATION_LOCK:
                command.upgrade(configuration, "head")

    @contextmanager
    def _transaction(self) -> Iterator[Connection]:
        with self._told(), self._engine.begin() as connection:
            for statement in _TAKE_TURNS[connection.dialect.name]:
                connection.exec_driver_sql(statement)
            yield connection

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Errors of disk and database, and content that is not what was written, as ours."""
        try:
            yield
        except (OSError, ValueError, SQLAlchemyError, zlib.error) as error:
            # Without the statement and its parameters.
            message = " ".join(str(error.orig if isinstance(error, StatementError) else error).split())
            remedies = (remedy for remedy, signs in _REMEDIES.items() if any(sign in message for sign in signs))
            raise LedgerError(
                f"the ledger cannot be used: {message}",
                self._where,
                next(remedies, "see that the database is there, whole and writable"),
            ) from error


def _parse(url: str) -> URL:
    try:
        address = make_url(url)
    except (ArgumentError, ValueError):
        # The text is not told: there may be a password in it.
        raise LedgerError("not the URL of a database", "ledger", _URL_REMEDY) from None
    if address.drivername not in _DRIVERS:
        raise LedgerError(f"a ledger cannot be in {address.drivername}", "ledger", _URL_REMEDY)
    return address


def _engine(address: URL) -> Engine:
    """The engine, not connected yet; the threads of a process take turns at one connection."""
    is_sqlite = address.get_backend_name() == "sqlite"
    try:
        engine = create_engine(
            address.set(drivername=_DRIVERS[address.drivername]),
            poolclass=QueuePool,
            pool_size=1,
            max_overflow=0,
            pool_pre_ping=True,
            connect_args={"check_same_thread": False, "timeout": _BUSY_SECONDS} if is_sqlite else {},
        )
    except ImportError as error:
        raise LedgerError(
            f"the driver of PostgreSQL is missing: {error}",
            address.set(query={}).render_as_string(),
            "pip install psycopg[binary]",
        ) from error
    if is_sqlite:
        event.listen(engine, "connect", _prepare)
    return engine


def _prepare(database: sqlite3.Connection, _: object) -> None:
    database.isolation_level = None  # transactions begin where we say
    deadline = time.monotonic() + _BUSY_SECONDS
    while True:
        try:
            database.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError as error:
            # SQLite does not wait here when another process changes the mode at the same time.
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
            time.sleep(_BUSY_POLL_SECONDS)
    database.execute("PRAGMA synchronous = FULL")
    database.execute("PRAGMA foreign_keys = ON")
    database.execute(f"PRAGMA journal_size_limit = {_LOG_BYTES}")


def _entries(proposal: Proposal) -> dict[str, Any]:
    """Columns of a proposal; what takes long is done before the database is locked."""
    vertices = np.ascontiguousarray(proposal.vertices, "<f8")
    return {
        "part_id": proposal.part_id,
        "design_sha256": proposal.design_sha256,
        "previous": proposal.previous,
        "gain": float(proposal.gain),
        "lookup": proposal.lookup,
        "stl_path": proposal.stl_path,
        "stl_sha256": proposal.stl_sha256,
        "inputs": [dataclasses.asdict(scan) for scan in proposal.inputs],
        "reprints": [],
        "settings": proposal.settings.flat(),
        "settings_sha256": proposal.settings.sha256(),
        "software_version": proposal.software_version,
        "checks": [dataclasses.asdict(check) for check in proposal.checks],
        "residual_before_mm": _known(proposal.residual_before_mm),
        "predicted_residual_mm": _known(proposal.predicted_residual_mm),
        "distortion_over_move": _known(proposal.distortion_over_move),
        "vertex_count": len(vertices),
        "vertices": zlib.compress(vertices.tobytes(), 1),
    }


def _cycle(row: Row[Any]) -> Cycle:
    entries = dict(row._mapping)
    return Cycle(
        **entries
        | {
            "state": CycleState(row.state),
            "inputs": tuple(ScanReference(**scan) for scan in row.inputs),
            "reprints": tuple(ScanReference(**scan) for scan in row.reprints),
            "settings": {
                name: tuple(value) if isinstance(value, list) else value for name, value in row.settings.items()
            },
            "checks": tuple(
                Check(**check | {"place": check["place"] and tuple(check["place"])}) for check in row.checks
            ),
            "created": _in_utc(row.created),
            "decided": None if row.decided is None else _in_utc(row.decided),
        }
    )


def _cycle_of(connection: Connection, cycle_id: int) -> Cycle:
    row = connection.execute(_SHOWN.where(_COLUMNS.id == cycle_id)).one_or_none()
    if row is None:
        raise _unknown(cycle_id)
    return _cycle(row)


def _current(connection: Connection, part_id: str, design_sha256: str) -> Cycle | None:
    row = connection.execute(
        _SHOWN.where(
            _COLUMNS.part_id == part_id,
            _COLUMNS.design_sha256 == design_sha256,
            _COLUMNS.state == CycleState.RELEASED.value,
        )
    ).one_or_none()
    return None if row is None else _cycle(row)


def _forget_old_proposals(connection: Connection, part_id: str, design_sha256: str) -> None:
    """Keep what somebody decided about for ever, and of the rest the newest: a cell may propose with every scan."""
    own = (_COLUMNS.part_id == part_id, _COLUMNS.design_sha256 == design_sha256)
    by_checks = and_(_COLUMNS.state == CycleState.REJECTED.value, _COLUMNS.decided_by == _CHECKS)
    undecided = (*own, or_(_COLUMNS.state == CycleState.PROPOSED.value, by_checks))
    oldest_kept = (
        select(_COLUMNS.id).where(*undecided).order_by(_COLUMNS.id.desc()).offset(_KEPT_PROPOSALS - 1).limit(1)
    )
    oldest = connection.execute(oldest_kept).scalar_one_or_none()
    if oldest is not None:
        connection.execute(delete(_CYCLES).where(*undecided, _COLUMNS.id < oldest))


def _set(connection: Connection, cycle_id: int, **entries: Any) -> None:
    connection.execute(update(_CYCLES).where(_COLUMNS.id == cycle_id).values(entries))


def _decide(connection: Connection, cycle_id: int, state: CycleState, by: str, reason: str) -> None:
    _set(connection, cycle_id, state=state.value, decided=_now(), decided_by=by, reason=reason)


def _require_proposed(cycle: Cycle, wanted: str) -> None:
    if cycle.state is not CycleState.PROPOSED:
        raise CycleStateError(
            f"it is {cycle.state.value} and cannot be {wanted}", _name(cycle), "choose a cycle that is proposed"
        )


def _require_current(previous: int | None, current: Cycle | None, where: str) -> None:
    if previous != (current.id if current else None):
        starts, counts = ("nominal" if id is None else f"cycle {id}" for id in (previous, current and current.id))
        raise CycleStateError(
            f"the redesign starts from {starts}, what is released is {counts}",
            where,
            f"scan a print of {counts} and redesign from it",
        )


def _unknown(cycle_id: int) -> CycleStateError:
    return CycleStateError("there is none", f"cycle {cycle_id}", "look it up in the history")


def _name(cycle: Cycle) -> str:
    return f"cycle {cycle.id} of part {cycle.part_id}"


def _known(value: float) -> float | None:
    """NaN as None: SQLite has no NaN."""
    return None if math.isnan(value) else float(value)


def _now() -> datetime:
    return datetime.now(timezone.utc)


def _in_utc(moment: datetime) -> datetime:
    """SQLite gives no zone, PostgreSQL the session's."""
    return moment.replace(tzinfo=timezone.utc) if moment.tzinfo is None else moment.astimezone(timezone.utc)
