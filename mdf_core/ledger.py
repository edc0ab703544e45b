"""The ledger: every redesign of every part, what it was made from, who decided about it, and how well it printed."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, Select, and_, delete, insert, or_, select, update

from mdf_core.check_result import Check
from mdf_core.errors import CycleStateError
from mdf_core.estimate import Evidence
from mdf_core.geometry import Array
from mdf_core.ledger_database import LedgerDatabase
from mdf_core.ledger_entries import CYCLES, Cycle, CycleState, Proposal, ScanReference

_COLUMNS = CYCLES.c
_SHOWN = select(*(_COLUMNS[entry.name] for entry in dataclasses.fields(Cycle)))
_CHECKS = "checks"  # who decides about a redesign that fails one
_KEPT_PROPOSALS = 200  # of a part and design that nobody has decided about


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
        self._database = LedgerDatabase(url)

    def close(self) -> None:
        """Close the database; what is in it stays."""
        self._database.close()

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
        with self._database.writing() as connection:
            row = connection.execute(query).one_or_none()
            if row is None:
                current = _current(connection, proposal.part_id, proposal.design_sha256)
                _require_current(proposal.previous, current, f"part {proposal.part_id}")
                number = current.number + 1 if current else 1
                connection.execute(insert(CYCLES).values(entries | {"number": number}))
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
        with self._database.writing() as connection:
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
        with self._database.writing() as connection:
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
        with self._database.writing() as connection:
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
        """Record what prints of a redesign show that were measured together.

        Parameters
        ----------
        cycle_id : int
        residual_mm, std_mm : float
            RMS distortion that they have in common, and its standard deviation; NaN: not known. They replace those of
            an earlier call: what the prints before have in common with these the ledger cannot know.
        inputs : sequence of ScanReference
            Scans of these prints; those that are new are added.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        with self._database.writing() as connection:
            reprints = dict.fromkeys((*_cycle_of(connection, cycle_id).reprints, *inputs))
            _set(
                connection,
                cycle_id,
                reprints=[dataclasses.asdict(scan) for scan in reprints],
                measured_residual_mm=_known(residual_mm),
                measured_residual_std_mm=_known(std_mm),
            )
            return _cycle_of(connection, cycle_id)

    def note_file(self, cycle_id: int, stl_path: str) -> Cycle:
        """Record that the file of a redesign lies elsewhere now.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        with self._database.writing() as connection:
            _set(connection, cycle_id, stl_path=stl_path)
            return _cycle_of(connection, cycle_id)

    # What only reads it

    def cycle(self, cycle_id: int) -> Cycle:
        """The cycle with that id.

        Raises
        ------
        CycleStateError
            There is none.
        """
        with self._database.reading() as connection:
            return _cycle_of(connection, cycle_id)

    def current(self, part_id: str, design_sha256: str) -> Cycle | None:
        """The released redesign of a part; None: the nominal design counts."""
        with self._database.reading() as connection:
            return _current(connection, part_id, design_sha256)

    def history(self, part_id: str = "", design_sha256: str = "") -> tuple[Cycle, ...]:
        """All cycles of a part and a design, oldest first; empty: of any."""
        query = _SHOWN.order_by(_COLUMNS.id)
        if part_id:
            query = query.where(_COLUMNS.part_id == part_id)
        if design_sha256:
            query = query.where(_COLUMNS.design_sha256 == design_sha256)
        with self._database.reading() as connection:
            return tuple(_cycle(row) for row in connection.execute(query))

    def waiting(self, part_id: str, design_sha256: str, previous: int | None) -> tuple[Cycle, ...]:
        """Cycles that follow on what was printed and that nobody has decided about, oldest first.

        `previous` is the cycle that was printed; None: the design.
        """
        return tuple(
            cycle
            for cycle in self.history(part_id, design_sha256)
            if cycle.state is CycleState.PROPOSED and cycle.previous == previous
        )

    def kept_files(self, part_id: str, design_sha256: str) -> tuple[str, ...]:
        """Paths of the redesigns that are printed, or would be after some roll-backs."""
        kept = (CycleState.RELEASED, CycleState.SUPERSEDED)
        return tuple(cycle.stl_path for cycle in self.history(part_id, design_sha256) if cycle.state in kept)

    def vertices(self, cycle_id: int) -> Array:
        """The vertices of a redesign, (n, 3) float64 in mm, to the bit as proposed.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        query = select(_COLUMNS.vertices, _COLUMNS.vertex_count).where(_COLUMNS.id == cycle_id)
        with self._database.reading() as connection:
            row = _row_of(connection, query, cycle_id)
            return np.frombuffer(zlib.decompress(row.vertices), "<f8").reshape(row.vertex_count, 3).astype(np.float64)

    def evidence(self, cycle_id: int) -> Evidence | None:
        """What a redesign rests on, to the bit as proposed in float32; None: not known.

        Raises
        ------
        CycleStateError
            There is no such cycle.
        """
        query = select(_COLUMNS.evidence).where(_COLUMNS.id == cycle_id)
        with self._database.reading() as connection:
            row = _row_of(connection, query, cycle_id)
            return None if row.evidence is None else _unpacked(row.evidence)


def _packed(evidence: Evidence) -> bytes:
    columns = np.column_stack([evidence.wanted, evidence.error, evidence.prints])
    return zlib.compress(np.append(evidence.variation, columns).astype("<f4").tobytes(), 1)


def _unpacked(content: bytes) -> Evidence:
    variation, columns = np.split(np.frombuffer(zlib.decompress(content), "<f4").astype(np.float64), [1])
    columns = columns.reshape(-1, 5)
    return Evidence(columns[:, :3], columns[:, 3], columns[:, 4], float(variation[0]))


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
        "evidence": None if proposal.evidence is None else _packed(proposal.evidence),
    }


def _cycle(row: Row[Any]) -> Cycle:
    try:
        return _as_written(row)
    except (TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"row {row.id} is not what was written: {error!r}") from error


def _as_written(row: Row[Any]) -> Cycle:
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
    return _cycle(_row_of(connection, _SHOWN.where(_COLUMNS.id == cycle_id), cycle_id))


def _row_of(connection: Connection, query: Select[Any], cycle_id: int) -> Row[Any]:
    row = connection.execute(query).one_or_none()
    if row is None:
        raise _unknown(cycle_id)
    return row


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
        connection.execute(delete(CYCLES).where(*undecided, _COLUMNS.id < oldest))


def _set(connection: Connection, cycle_id: int, **entries: Any) -> None:
    connection.execute(update(CYCLES).where(_COLUMNS.id == cycle_id).values(entries))


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
