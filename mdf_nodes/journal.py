"""The cell's journal: every scan it has accepted, on disk until it is answered, whatever ends the processes.

And every result, until the part is redesigned against it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mdf_interfaces.msg import Inspection as InspectionMessage
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import StorageError, StorageFullError
from mdf_nodes.parameters import declare

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    source TEXT UNIQUE,              -- of a scan that scan_ingest handed over; NULL: it came another way
    fingerprint TEXT NOT NULL,       -- of stamp and data
    delivery INTEGER,                -- when its publisher sent it on the topic, ns; NULL: it has not come that way
    part_id TEXT NOT NULL,
    method TEXT NOT NULL,
    is_taken INTEGER NOT NULL,       -- by registration; 0: handed over only
    begun INTEGER NOT NULL DEFAULT 0,  -- how often
    accepted REAL NOT NULL,          -- seconds since 1970
    answered REAL,
    error_code INTEGER,
    design INTEGER                   -- number of the one that was set then; NULL: none was
);
CREATE TABLE IF NOT EXISTS clouds (number INTEGER PRIMARY KEY, cloud BLOB NOT NULL);  -- of jobs without an answer
CREATE TABLE IF NOT EXISTS results (  -- that compensation has not seen to
    number INTEGER PRIMARY KEY, job_id TEXT NOT NULL, inspection BLOB NOT NULL, displacement BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS takers (name TEXT PRIMARY KEY);  -- of results; without one none are kept
CREATE TABLE IF NOT EXISTS designs (  -- that were set by service, and those of the parameters then
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    path TEXT NOT NULL, unit TEXT NOT NULL, part_id TEXT NOT NULL,
    configured_path TEXT NOT NULL, configured_unit TEXT NOT NULL, configured_part_id TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS waiting ON jobs (answered) WHERE answered IS NULL;
CREATE INDEX IF NOT EXISTS by_fingerprint ON jobs (fingerprint);
"""
_DESIGN_OF_JOBS = """
ALTER TABLE jobs ADD COLUMN design INTEGER;
INSERT INTO designs SELECT * FROM design;
DROP TABLE design;
"""
_FILE_NAME = "journal.sqlite"
_BUSY_SECONDS = 10.0
_CLAIM_SECONDS, _CLAIM_POLL_SECONDS = 2.0, 0.05
_DATABASE_FULL = "database or disk is full"  # sqlite3 tells so; its number of the error only from Python 3.11 on
_KEPT = 10_000  # answered jobs
_KEPT_RESULT_BYTES = 256 * 2**20
_LOG_BYTES = 16 * 2**20
_MIB = 2**20


@dataclass(frozen=True, eq=False)
class Entry:
    """One accepted scan.

    Attributes
    ----------
    number : int
        Counts up; never used twice.
    cloud : PointCloud2
    part_id, method : str
        Of the request; empty: the node's own.
    is_on_disk : bool
        It may wait in the journal while the queue is full: it came from there, or `scan_ingest` put it there.
    """

    number: int
    cloud: PointCloud2
    part_id: str
    method: str
    is_on_disk: bool


class DesignChoice(NamedTuple):
    """Which design a cell inspects against: file, its unit, and the name of the part; no path: none."""

    path: str
    unit: str
    part_id: str


@dataclass(frozen=True, eq=False)
class _Row:
    source: str | None
    fingerprint: str
    delivery: int | None
    part_id: str
    method: str
    cloud: bytes

    def insert(self, database: sqlite3.Connection) -> int:
        cursor = database.execute(
            "INSERT INTO jobs (source, fingerprint, delivery, part_id, method, is_taken, accepted, design)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, (SELECT MAX(number) FROM designs))",
            (self.source, self.fingerprint, self.delivery, self.part_id, self.method, self.source is None, time.time()),
        )
        number = int(cursor.lastrowid or 0)
        database.execute("INSERT INTO clouds VALUES (?, ?)", (number, self.cloud))
        return number


class Journal:
    """SQLite database that the nodes of one cell share.

    Parameters
    ----------
    folder : Path, optional
        Made if missing. Without one the journal is in memory, of this process alone, and ends with it.
    floor_mib : int
        Free space below which nothing more is accepted.
    owner : str
        Name of the node; there can be one of a name at a journal.

    Raises
    ------
    StorageError
        The folder or the database cannot be used, or another process is at it under the same name.

    Notes
    -----
    A commit is on disk (write-ahead log, fsync) before the method that made it returns.
    """

    def __init__(self, folder: Path | None = None, floor_mib: int = 0, owner: str = "") -> None:
        self._folder, self._floor = folder, floor_mib
        self._lock = threading.Lock()
        self._claim = -1
        with self._translated_errors():
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                self._claim = _claim(folder / f".{owner}.lock", _CLAIM_SECONDS)
            try:
                self._open()
            except BaseException:
                self._release()
                raise

    def _open(self) -> None:
        # Two processes that change the journal's mode at once would find it locked.
        opening = -1 if self._folder is None else _claim(self._folder / ".opening.lock", _BUSY_SECONDS)
        try:
            self._database = sqlite3.connect(
                ":memory:" if self._folder is None else self._folder / _FILE_NAME,
                timeout=_BUSY_SECONDS,
                isolation_level=None,
                check_same_thread=False,
            )
            self._database.execute("PRAGMA auto_vacuum = FULL")  # what is answered takes no space
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")
            self._database.execute(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
            self._database.executescript(_SCHEMA)
            if "design" not in {column[1] for column in self._database.execute("PRAGMA table_info(jobs)")}:
                self._database.executescript(f"BEGIN; {_DESIGN_OF_JOBS} COMMIT;")  # it is of an earlier version
        finally:
            if opening >= 0:
                os.close(opening)

    def _release(self) -> None:
        if self._claim >= 0:
            os.close(self._claim)
            self._claim = -1

    def close(self) -> None:
        """Close the database; what is in it stays."""
        with self._lock:
            self._database.close()
            self._release()

    @property
    def folder(self) -> Path | None:
        """Where it is; None: in memory."""
        return self._folder

    @property
    def is_durable(self) -> bool:
        """Whether what is accepted outlives the process."""
        return self._folder is not None

    # What scan_ingest does

    def hand_over(self, source: str, cloud: PointCloud2) -> bool:
        """Put a scan on disk for registration; false: that source has been handed over before.

        Raises
        ------
        StorageFullError
            Less free space than the floor.
        """
        self._require_space()
        row = self._row(cloud, _fingerprint(cloud), source=source)
        with self._transaction() as database:
            if database.execute("SELECT 1 FROM jobs WHERE source = ?", (source,)).fetchone():
                return False
            row.insert(database)
            return True

    # What registration does

    def accept(self, cloud: PointCloud2, part_id: str = "", method: str = "") -> Entry:
        """Put a request on disk.

        Raises
        ------
        StorageFullError
            Less free space than the floor.
        """
        self._require_space()
        row = self._row(cloud, _fingerprint(cloud), part_id=part_id, method=method)
        with self._transaction() as database:
            number = row.insert(database)
        return Entry(number, cloud, part_id, method, is_on_disk=False)

    def arrive(self, cloud: PointCloud2, delivery: int) -> Entry | None:
        """A scan that has come by topic; None: the same one has come before, on whatever way.

        Late subscribers, so a node that was started again, are sent the last scans once more, with the time of the
        first `delivery`. A bag that is replayed again sends equal scans at other times.

        Raises
        ------
        StorageFullError
            Less free space than the floor.
        """
        fingerprint = _fingerprint(cloud)
        with self._transaction() as database:
            if database.execute(
                "SELECT 1 FROM jobs WHERE fingerprint = ? AND delivery = ?", (fingerprint, delivery)
            ).fetchone():
                return None
            handed_over = database.execute(
                "SELECT number, is_taken FROM jobs WHERE fingerprint = ? AND source IS NOT NULL AND delivery IS NULL"
                " ORDER BY number LIMIT 1",
                (fingerprint,),
            ).fetchone()
            if handed_over is not None:
                number, is_taken = handed_over
                database.execute("UPDATE jobs SET delivery = ?, is_taken = 1 WHERE number = ?", (delivery, number))
                return None if is_taken else Entry(number, cloud, "", "", is_on_disk=True)
        self._require_space()
        row = self._row(cloud, fingerprint, delivery=delivery)
        with self._transaction() as database:
            number = row.insert(database)
        return Entry(number, cloud, "", "", is_on_disk=False)

    def waiting(self, known: set[int], younger_excluded: float) -> Entry | None:
        """The oldest job that nobody is at: accepted before a crash, or handed over and never come by topic.

        Parameters
        ----------
        known : set of int
            Jobs that wait or run in this process.
        younger_excluded : float
            Seconds that a scan that was handed over is given to come by topic.
        """
        if not self.is_durable:
            return None
        marks = ",".join("?" * len(known))
        with self._transaction() as database:
            row = database.execute(
                f"SELECT number, cloud, part_id, method FROM jobs JOIN clouds USING (number) WHERE answered IS NULL"
                f" AND number NOT IN ({marks}) AND (is_taken OR accepted < ?) ORDER BY number LIMIT 1",
                (*sorted(known), time.time() - younger_excluded),
            ).fetchone()
            if row is None:
                return None
            number, cloud, part_id, method = row
            database.execute("UPDATE jobs SET is_taken = 1 WHERE number = ?", (number,))
        return Entry(number, deserialize_message(cloud, PointCloud2), part_id, method, is_on_disk=True)

    def begin(self, number: int) -> int:
        """The job is begun; how often it has been. One that takes the process with it is begun again and again."""
        with self._transaction() as database:
            database.execute("UPDATE jobs SET begun = begun + 1 WHERE number = ?", (number,))
            return int(database.execute("SELECT begun FROM jobs WHERE number = ?", (number,)).fetchone()[0])

    def postpone(self, number: int) -> None:
        """The job was stopped, by no fault of its own."""
        with self._transaction() as database:
            database.execute("UPDATE jobs SET begun = 0 WHERE number = ?", (number,))

    def answer(self, number: int, error_code: int) -> None:
        """The job has been answered; 0: with a result. The oldest answers are forgotten in time."""
        with self._transaction() as database:
            database.execute(
                "UPDATE jobs SET answered = ?, error_code = ? WHERE number = ?", (time.time(), error_code, number)
            )
            database.execute("DELETE FROM clouds WHERE number = ?", (number,))
            database.execute(
                "DELETE FROM jobs WHERE answered IS NOT NULL AND number <= ?"
                " AND number <= (SELECT MAX(number) FROM jobs) - ?",
                (number, _KEPT),
            )

    def keep_result(self, number: int, inspection: InspectionMessage, displacement: PointCloud2) -> None:
        """Keep the result of a job for compensation, if the cell has one; the oldest of too much are forgotten."""
        if not self.is_durable:
            return
        row = (number, inspection.job_id, serialize_message(inspection), serialize_message(displacement))
        with self._transaction() as database:
            if database.execute("SELECT 1 FROM takers").fetchone():
                database.execute("INSERT OR REPLACE INTO results VALUES (?, ?, ?, ?)", row)
                database.execute(
                    "DELETE FROM results WHERE number IN (SELECT number FROM (SELECT number,"
                    " SUM(LENGTH(displacement)) OVER (ORDER BY number DESC) AS held FROM results) WHERE held > ?)"
                    " AND number < ?",
                    (_KEPT_RESULT_BYTES, number),
                )

    # What compensation does

    def take_results(self, name: str, wanted: bool) -> None:
        """Have results kept for the node `name`, or not any more."""
        with self._transaction() as database:
            if wanted:
                database.execute("INSERT OR IGNORE INTO takers VALUES (?)", (name,))
            else:
                database.execute("DELETE FROM takers WHERE name = ?", (name,))
                database.execute("DELETE FROM results WHERE NOT EXISTS (SELECT 1 FROM takers)")

    def next_result(self, known: set[str]) -> tuple[InspectionMessage, PointCloud2] | None:
        """The oldest result that is kept, but for the jobs `known`.

        Raises
        ------
        StorageError
            It cannot be read, as after an update of the messages; it is not kept any more.
        """
        names = sorted(known)
        marks = ",".join("?" * len(names))
        with self._lock, self._translated_errors():
            row = self._database.execute(
                f"SELECT job_id, inspection, displacement FROM results WHERE job_id NOT IN ({marks})"
                " ORDER BY number LIMIT 1",
                names,
            ).fetchone()
        if row is None:
            return None
        job_id, inspection, displacement = row
        try:
            return deserialize_message(inspection, InspectionMessage), deserialize_message(displacement, PointCloud2)
        except Exception as error:  # rmw's own, and what it makes of nonsense
            self.forget_result(job_id)
            raise StorageError(
                f"the result of job {job_id} cannot be read: {error}",
                f"state_folder {self._folder}",
                "register the scan again",
            ) from error

    def forget_result(self, job_id: str) -> None:
        """The part has been redesigned against the result, or will never be."""
        with self._transaction() as database:
            database.execute("DELETE FROM results WHERE job_id = ?", (job_id,))

    def set_design(self, configured: DesignChoice, chosen: DesignChoice) -> None:
        """Remember the design that was set by service, until the parameters name another one."""
        with self._transaction() as database:
            database.execute("INSERT INTO designs VALUES (NULL, ?, ?, ?, ?, ?, ?)", (*chosen, *configured))
            database.execute(
                "DELETE FROM designs WHERE number < (SELECT MAX(number) FROM designs)"
                " AND number NOT IN (SELECT design FROM jobs WHERE answered IS NULL AND design IS NOT NULL)"
            )

    # What anybody may ask

    def design(self, configured: DesignChoice) -> DesignChoice:
        """The design that was set by service while the parameters were as now; else that of the parameters."""
        with self._lock, self._translated_errors():
            (number,) = self._database.execute("SELECT MAX(number) FROM designs").fetchone()
            return self._chosen(number, configured) or configured

    def design_of(self, number: int, configured: DesignChoice) -> DesignChoice | None:
        """The design of the cell when a job was accepted; None: not known, as the parameters were others."""
        with self._lock, self._translated_errors():
            (design,) = self._database.execute("SELECT design FROM jobs WHERE number = ?", (number,)).fetchone()
            if design is None and configured.path:
                return configured
            return self._chosen(design, configured)

    def _chosen(self, number: int | None, configured: DesignChoice) -> DesignChoice | None:
        """The design of that number, if it was set while the parameters were as now."""
        row = self._database.execute(
            "SELECT path, unit, part_id FROM designs WHERE number = ?"
            " AND configured_path = ? AND configured_unit = ? AND configured_part_id = ?",
            (number, *configured),
        ).fetchone()
        return None if row is None else DesignChoice(*row)

    def counts(self) -> tuple[int, int]:
        """How many jobs have been accepted since the journal began, and how many of them wait for an answer."""
        with self._lock, self._translated_errors():
            accepted = self._database.execute("SELECT COALESCE(MAX(number), 0) FROM jobs").fetchone()[0]
            waiting = self._database.execute("SELECT COUNT(*) FROM jobs WHERE answered IS NULL").fetchone()[0]
        return int(accepted), int(waiting)

    def free_mib(self) -> int | None:
        """Free space of the disk in MiB; None for a journal in memory."""
        if self._folder is None:
            return None
        with self._translated_errors():
            return shutil.disk_usage(self._folder).free // _MIB

    def _require_space(self) -> None:
        free = self.free_mib()
        if free is not None and free < self._floor:
            raise StorageFullError(
                f"{free} MiB free, less than the floor of {self._floor} MiB",
                str(self._folder),
                "free some space, or lower disk_floor_mib",
            )

    def _row(
        self,
        cloud: PointCloud2,
        fingerprint: str,
        *,
        part_id: str = "",
        method: str = "",
        source: str | None = None,
        delivery: int | None = None,
    ) -> _Row:
        """A new job; what takes long is done before the database is locked. In memory nothing is read back."""
        content = serialize_message(cloud) if self.is_durable else b""
        return _Row(source, fingerprint, delivery, part_id, method, content)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._translated_errors():
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
            except BaseException:
                if self._database.in_transaction:  # a full disk has ended it already
                    self._database.execute("ROLLBACK")
                raise
            self._database.execute("COMMIT")

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        """Errors of disk and database as ours."""
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            full = str(error) == _DATABASE_FULL or getattr(error, "errno", None) == errno.ENOSPC
            raise (StorageFullError if full else StorageError)(
                f"the journal cannot be used: {error}",
                f"state_folder {self._folder}",
                "free some space" if full else "make the folder writable, or choose another one",
            ) from error


def _claim(path: Path, seconds: float) -> int:
    """A lock that goes with the process, whatever happens to it; a process that is just ending is waited for.

    Raises
    ------
    StorageError
        Another process holds it.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    deadline = time.monotonic() + seconds
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise StorageError(
                    "another process is at the journal", str(path), "give each cell a namespace or a state folder"
                ) from None
            time.sleep(_CLAIM_POLL_SECONDS)
        except OSError:
            os.close(descriptor)
            raise
        else:
            return descriptor


def declare_journal(node: Node) -> None:
    """Declare the parameters of the journal."""
    declare(
        node,
        "state_folder",
        "",
        "Folder of the journal of accepted scans, which outlives the processes; empty: it ends with them",
        read_only=True,
    )
    declare(
        node,
        "disk_floor_mib",
        200,
        "Free space in the state folder below which nothing more is accepted",
        unit="MiB",
        minimum=0,
        maximum=1_000_000,
        read_only=True,
    )


def open_journal(node: Node) -> Journal:
    """The journal of the node's cell: one for each namespace in the state folder.

    Raises
    ------
    StorageError
        See `Journal`.
    """
    folder = node.get_parameter("state_folder").value
    namespace = node.get_namespace().strip("/")
    return Journal(
        Path(folder).absolute() / namespace if folder else None,
        node.get_parameter("disk_floor_mib").value,
        node.get_name(),
    )


def _fingerprint(cloud: PointCloud2) -> str:
    stamp: Any = cloud.header.stamp
    return f"{stamp.sec}.{stamp.nanosec:09d}-{hashlib.sha256(cloud.data).hexdigest()}"
