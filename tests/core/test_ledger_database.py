"""The database below the ledger: what cannot be used is told and left as it is, and what migrations lead to."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from ledger_samples import proposal, url_of, vertices_for
from sqlalchemy import Engine, create_engine, event
from sqlalchemy.dialects import postgresql
from sqlalchemy.schema import AddConstraint, CreateColumn, CreateIndex

from mdf_core import ledger_database
from mdf_core.errors import LedgerError
from mdf_core.estimate import Estimate
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import METADATA

EVIDENCE = Estimate.unknown(np.zeros((4, 3))).evidence

# Databases that cannot be used


def test_the_database_of_a_newer_software_is_refused_and_left_as_it_is(ledger: Ledger, tmp_path: Path) -> None:
    ledger.propose(proposal())
    ledger.close()
    with sqlite3.connect(tmp_path / "ledger.sqlite") as database:
        database.execute("UPDATE ledger_version SET version_num = '9999'")
        before = list(database.iterdump())
    with pytest.raises(LedgerError, match=r"ledger\.sqlite: it has version 9999 of a newer .* update the software"):
        Ledger(url_of(tmp_path))
    assert list(database.iterdump()) == before
    database.close()


def test_a_file_that_is_no_database_is_told_and_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "ledger.sqlite").write_bytes(b"no database" * 1000)
    with pytest.raises(LedgerError, match=r"ledger\.sqlite: .*not a database; put a backup in its place"):
        Ledger(url_of(tmp_path))
    assert (tmp_path / "ledger.sqlite").read_bytes() == b"no database" * 1000
    (tmp_path / "ledger.sqlite").unlink()
    with Ledger(url_of(tmp_path)) as ledger:
        assert ledger.history() == ()


def test_vertices_that_the_disk_has_spoilt_are_told(ledger: Ledger, tmp_path: Path) -> None:
    cycle = ledger.propose(proposal(vertices=vertices_for(1.0)))
    with sqlite3.connect(tmp_path / "ledger.sqlite") as database:
        blob = bytearray(database.execute("SELECT vertices FROM cycles").fetchone()[0])
        blob[len(blob) // 2] ^= 1
        database.execute("UPDATE cycles SET vertices = ?", (bytes(blob),))
    with pytest.raises(LedgerError, match="the ledger cannot be used"):
        ledger.vertices(cycle.id)
    assert ledger.history() == (cycle,)
    database.close()


def test_a_path_that_cannot_be_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "ledger.sqlite").mkdir()
    for folder in (tmp_path / "file", tmp_path):
        with pytest.raises(LedgerError, match=r"ledger\.sqlite: the ledger cannot be used: .+; .+"):
            Ledger(url_of(folder))


@contextlib.contextmanager
def nobody() -> Iterator[None]:
    """Root may write everywhere; so be someone else for a while."""
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)


def test_a_file_that_may_not_be_written_is_told() -> None:
    with tempfile.TemporaryDirectory() as folder:  # pytest's are root's alone
        path = Path(folder)
        Ledger(url_of(path)).close()
        (path / "ledger.sqlite").chmod(0o444)
        path.chmod(0o555)
        with nobody(), pytest.raises(LedgerError, match=r"ledger\.sqlite: .+; make the file and its folder writable"):
            Ledger(url_of(path))
        path.chmod(0o755)


def test_a_full_disk_is_told_and_once_there_is_space_the_ledger_goes_on(tmp_path: Path) -> None:
    disks: list[sqlite3.Connection] = []

    def limit(database: sqlite3.Connection, _: object) -> None:
        database.execute("PRAGMA max_page_count = 30")
        disks.append(database)

    event.listen(Engine, "connect", limit)
    try:
        with Ledger(url_of(tmp_path)) as ledger:
            first = ledger.propose(proposal())
            large = proposal(gain=0.5, vertices=vertices_for(1.0))
            with pytest.raises(LedgerError, match="full; free some space"):
                ledger.propose(large)
            assert ledger.history() == (first,)
            disks[-1].execute("PRAGMA max_page_count = 10000")
            second = ledger.propose(large)
            assert ledger.history() == (first, second)
    finally:
        event.remove(Engine, "connect", limit)


@pytest.mark.parametrize(
    "url",
    [
        "/a/ledger.sqlite",
        "postgresql://ada:secret@host:port/cell",
        "mysql://ada:secret@host/cell",
        "postgresql+psycopg2://ada:secret@host/cell",
    ],
)
def test_a_url_that_is_none_is_told_without_its_password(url: str) -> None:
    with pytest.raises(LedgerError, match="use sqlite:////absolute/path") as told:
        Ledger(url)
    assert "secret" not in str(told.value)


@pytest.mark.parametrize("scheme", ["postgresql", "postgresql+psycopg"])
def test_without_the_driver_of_postgresql_it_tells_which_to_install(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(LedgerError, match=r"host/cell: .*psycopg.*; pip install psycopg\[binary\]") as told:
        Ledger(f"{scheme}://ada:secret@host/cell?password=secret")
    assert "secret" not in str(told.value)


# Migrations


def schema(path: Path) -> tuple[list[object], ...]:
    """Columns, references, and the words of all that was made; a column that was added stands behind the rest."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT sql FROM sqlite_master WHERE tbl_name = 'cycles' ORDER BY name")
        words = [sorted(re.findall(r"[\w']+", sql)) for (sql,) in rows if sql]
        return (
            list(database.execute("PRAGMA table_info(cycles)")),
            list(database.execute("PRAGMA foreign_key_list(cycles)")),
            words,
        )


def test_the_migrations_lead_to_the_tables_that_the_code_uses(ledger: Ledger, tmp_path: Path) -> None:
    engine = create_engine(f"sqlite:///{tmp_path}/made_at_once.sqlite")
    METADATA.create_all(engine)
    assert schema(tmp_path / "ledger.sqlite") == schema(tmp_path / "made_at_once.sqlite")
    engine.dispose()
    engine = create_engine(url_of(tmp_path))
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"version_table": ledger_database._VERSION_TABLE})
        assert compare_metadata(context, METADATA) == []
    engine.dispose()


def test_the_migrations_make_the_same_tables_in_postgresql() -> None:
    script = io.StringIO()
    configuration = Config(output_buffer=script, attributes={"dialect_name": "postgresql"})
    configuration.set_main_option("script_location", ledger_database._MIGRATIONS)
    command.upgrade(configuration, "head", sql=True)
    made = " ".join(script.getvalue().split())
    cycles = METADATA.tables["cycles"]
    indexes, columns = map(CreateIndex, cycles.indexes), map(CreateColumn, cycles.columns)
    for part in (*indexes, *columns, *map(AddConstraint, cycles.foreign_key_constraints)):
        wanted = " ".join(str(part.compile(dialect=postgresql.dialect())).split())
        assert wanted.removeprefix("ALTER TABLE cycles ADD ") in made
    assert "ALTER TABLE cycles ADD COLUMN evidence BYTEA" in made
    assert "CREATE UNIQUE INDEX one_released ON cycles (part_id, design_sha256) WHERE state = 'released'" in made


def test_a_ledger_of_the_first_version_keeps_its_cycles_of_which_less_is_known(ledger: Ledger, tmp_path: Path) -> None:
    cycle = ledger.propose(proposal(evidence=EVIDENCE))
    ledger.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "ledger.sqlite")) as database:
        database.execute("ALTER TABLE cycles DROP COLUMN evidence")
        database.execute("UPDATE ledger_version SET version_num = '0001'")
        database.commit()
    with Ledger(url_of(tmp_path)) as brought_up_to_date:
        assert brought_up_to_date.history() == (cycle,)
        assert brought_up_to_date.evidence(cycle.id) is None
        following = brought_up_to_date.propose(proposal(gain=0.5, evidence=EVIDENCE))
        assert brought_up_to_date.evidence(following.id) is not None
