"""The database below the ledger: opened, brought up to date, read and written; its errors told as ours."""

from __future__ import annotations

import sqlite3
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import URL, Connection, Engine, QueuePool, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError, StatementError

from mdf_core.errors import LedgerError

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


def require_existing(url: str) -> None:
    """Refuse the URL of a file that does not exist: whoever only asks does not want a new ledger.

    Raises
    ------
    LedgerError
    """
    address = _parse(url)
    if address.get_backend_name() == "sqlite" and not Path(str(address.database)).is_file():
        raise LedgerError("there is no such ledger", str(address.database), "check the path in the URL")


class LedgerDatabase:
    """The database at a URL, see `Ledger`; its folders are made, its tables made or brought up to date.

    Raises
    ------
    LedgerError
        See `Ledger`; also by `reading` and `writing`.
    """

    def __init__(self, url: str) -> None:
        address = _parse(url)
        self._where = address.set(query={}).render_as_string()
        with self._as_ledger_errors():
            if address.get_backend_name() == "sqlite" and address.database not in (None, "", ":memory:"):
                Path(str(address.database)).parent.mkdir(parents=True, exist_ok=True)
            self._engine = _engine(address)
        try:
            with self.writing() as connection:
                self._migrate(connection)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database; what is in it stays."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees what is committed."""
        with self._as_ledger_errors(), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction; writers take turns."""
        with self._as_ledger_errors(), self._engine.begin() as connection:
            for statement in _TAKE_TURNS[connection.dialect.name]:
                connection.exec_driver_sql(statement)
            yield connection

    @contextmanager
    def _as_ledger_errors(self) -> Iterator[None]:
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
