"""The journal: what is accepted is on disk, and every scan of the cell is in it once."""

from __future__ import annotations

import errno
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mdf_interfaces.msg import Inspection as InspectionMessage
from rclpy.serialization import serialize_message
from samples import cloud_of
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import StorageError, StorageFullError
from mdf_core.geometry import PointSet
from mdf_nodes import journal as journal_module
from mdf_nodes.context import child_environment
from mdf_nodes.journal import DesignChoice, Journal

CLOUD = cloud_of(PointSet(np.arange(30.0).reshape(10, 3)), second=7)
OTHER = cloud_of(PointSet(np.arange(30.0).reshape(10, 3)), second=8)


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return Journal(tmp_path, owner="registration")


def reopened(journal: Journal, folder: Path) -> Journal:
    journal.close()
    return Journal(folder, owner="registration")


def test_what_was_accepted_and_not_answered_waits_in_the_next_process(journal: Journal, tmp_path: Path) -> None:
    answered, left = journal.accept(CLOUD), journal.accept(OTHER, "flange", "mdf")
    journal.answer(answered.number, 0)
    again = reopened(journal, tmp_path)
    entry = again.waiting(set(), 60.0)
    assert entry is not None
    assert (entry.number, entry.cloud, entry.part_id, entry.method) == (left.number, OTHER, "flange", "mdf")
    assert again.waiting({entry.number}, 60.0) is None
    assert again.counts() == (2, 1)
    again.answer(entry.number, 303)
    assert reopened(again, tmp_path).waiting(set(), 60.0) is None


def test_a_scan_that_is_sent_once_more_to_a_late_subscriber_is_known(journal: Journal, tmp_path: Path) -> None:
    first = journal.arrive(CLOUD, delivery=100)
    assert first is not None
    assert journal.arrive(CLOUD, delivery=100) is None
    journal.answer(first.number, 0)
    again = reopened(journal, tmp_path)
    assert again.arrive(CLOUD, delivery=100) is None
    # A replay sends the same scan at another time, and wants an answer.
    replayed = again.arrive(CLOUD, delivery=200)
    assert replayed is not None and replayed.number > first.number


def test_a_scan_handed_over_on_disk_is_one_job_whether_it_comes_by_topic_or_not(
    journal: Journal, tmp_path: Path
) -> None:
    ingest = Journal(tmp_path, owner="scan_ingest")
    assert ingest.hand_over("a", CLOUD)
    assert journal.waiting(set(), 60.0) is None, "it may still come by topic"
    by_topic = journal.arrive(CLOUD, delivery=100)
    assert by_topic is not None and by_topic.is_on_disk
    journal.answer(by_topic.number, 0)

    assert ingest.hand_over("b", CLOUD)
    from_disk = journal.waiting(set(), 0.0)
    assert from_disk is not None and from_disk.cloud == CLOUD
    assert journal.arrive(CLOUD, delivery=200) is None, "it comes late"
    journal.answer(from_disk.number, 0)
    assert journal.counts() == (2, 0)


def test_a_source_is_handed_over_once(journal: Journal) -> None:
    assert journal.hand_over("scan.ply 17 4711", CLOUD)
    assert not journal.hand_over("scan.ply 17 4711", CLOUD)
    assert journal.counts() == (1, 1)


def test_below_the_floor_of_free_space_nothing_is_accepted_and_answers_are_still_noted(tmp_path: Path) -> None:
    roomy = Journal(tmp_path, owner="registration")
    accepted = roomy.accept(CLOUD)
    full = Journal(tmp_path, floor_mib=10**9, owner="scan_ingest")
    for refused in (
        lambda: full.accept(CLOUD),
        lambda: full.arrive(CLOUD, delivery=1),
        lambda: full.hand_over("a", CLOUD),
    ):
        with pytest.raises(StorageFullError, match=r"MiB free.*disk_floor_mib"):
            refused()
    full.answer(accepted.number, 0)
    assert full.counts() == (1, 0)


def test_what_is_answered_takes_no_space(journal: Journal, tmp_path: Path) -> None:
    entries = [journal.accept(PointCloud2(data=bytes(4_000_000))) for _ in range(5)]
    for entry in entries:
        journal.answer(entry.number, 0)
    reopened(journal, tmp_path).close()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 200_000


def test_a_journal_has_one_process_of_a_name(journal: Journal, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="another process is at the journal"):
        Journal(tmp_path, owner="registration")
    assert Journal(tmp_path, owner="scan_ingest").counts() == (0, 0)
    reopened(journal, tmp_path).close()


def test_a_folder_that_cannot_be_used_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"state_folder .*file"):
        Journal(tmp_path / "file")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "journal.sqlite").write_bytes(b"no database" * 1000)
    for _ in range(2):  # the first try does not keep the second one out
        with pytest.raises(StorageError, match="not a database"):
            Journal(tmp_path / "broken", owner="registration")
    (tmp_path / "broken" / "journal.sqlite").unlink()
    assert Journal(tmp_path / "broken", owner="registration").counts() == (0, 0)


def test_a_journal_of_an_earlier_version_is_taken_over(tmp_path: Path) -> None:
    configured, chosen = DesignChoice("a.stl", "mm", ""), DesignChoice("b.stl", "mm", "b")
    journal = Journal(tmp_path)
    journal.set_design(configured, chosen)
    waiting = journal.accept(PointCloud2())
    journal.close()
    with closing(sqlite3.connect(tmp_path / "journal.sqlite")) as database:
        database.execute("CREATE TABLE design AS SELECT * FROM designs")
        database.execute("DELETE FROM designs")
        database.execute("ALTER TABLE jobs DROP COLUMN design")
        database.commit()
    for _ in range(2):
        journal = Journal(tmp_path)
        assert journal.design(configured) == chosen
        assert journal.design_of(waiting.number, configured) == configured  # it was not noted
        journal.close()


def test_a_job_keeps_the_design_that_was_set_when_it_was_accepted(journal: Journal) -> None:
    configured = DesignChoice("a.stl", "mm", "")
    chosen = [DesignChoice(f"{name}.stl", "mm", name) for name in "bcd"]
    jobs = [journal.accept(PointCloud2())]
    for choice in chosen:
        journal.set_design(configured, choice)
        jobs.append(journal.accept(PointCloud2()))
    assert [journal.design_of(job.number, configured) for job in jobs] == [configured, *chosen]
    assert journal.design_of(jobs[1].number, DesignChoice("other.stl", "mm", "")) is None
    assert journal.design_of(jobs[0].number, DesignChoice("", "mm", "")) is None


def test_a_full_disk_is_told_from_other_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "full").write_text("")
    with pytest.raises(StorageError, match="make the folder writable"):
        Journal(tmp_path / "full")

    def no_space(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    journal = Journal(tmp_path / "state")
    monkeypatch.setattr(shutil, "disk_usage", no_space)
    with pytest.raises(StorageFullError, match="free some space"):
        journal.free_mib()


def test_without_a_folder_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    journal = Journal()
    journal.answer(journal.accept(CLOUD).number, 0)
    assert journal.counts() == (1, 0)
    assert not list(tmp_path.iterdir())


ACCEPT_WITHOUT_END = """
import sys
from pathlib import Path
from sensor_msgs.msg import PointCloud2
from mdf_nodes.journal import Journal
journal, cloud = Journal(Path(sys.argv[1]), owner="registration"), PointCloud2(data=bytes(100_000))
while True:
    entry = journal.accept(cloud)
    print(entry.number, flush=True)
    if entry.number % 3 == 0:
        journal.answer(entry.number, 0)
        print(-entry.number, flush=True)
"""


@pytest.mark.parametrize("told", [1, 20, 50])
def test_what_it_said_is_on_disk_whenever_the_process_is_killed(told: int, tmp_path: Path) -> None:
    command = [sys.executable, "-c", ACCEPT_WITHOUT_END, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=child_environment()) as process:
        assert process.stdout is not None
        lines = [int(process.stdout.readline()) for _ in range(told)]
        process.send_signal(signal.SIGKILL)
        lines += [int(line) for line in process.stdout.read().split("\n")[:-1]]
    accepted, answered = {line for line in lines if line > 0}, {-line for line in lines if line < 0}
    journal, waiting = Journal(tmp_path, owner="registration"), set[int]()
    while (entry := journal.waiting(waiting, 60.0)) is not None:
        waiting.add(entry.number)
    # What was under way when it was killed may or may not be there: at most one of each.
    assert accepted - answered - waiting <= {max(accepted)}
    assert len(waiting - accepted) <= 1
    assert not waiting & answered


def result(journal: Journal, name: str) -> int:
    number = journal.accept(CLOUD).number
    journal.keep_result(number, InspectionMessage(job_id=name), CLOUD)
    journal.answer(number, 0)
    return number


def test_results_wait_in_order_until_they_are_forgotten(journal: Journal, tmp_path: Path) -> None:
    result(journal, "nobody takes it")
    compensation = Journal(tmp_path, owner="compensation")
    compensation.take_results("compensation", True)
    for name in ("first", "second"):
        result(journal, name)
    found = compensation.next_result(set())
    assert found is not None
    assert (found[0].job_id, found[1]) == ("first", CLOUD)
    assert compensation.next_result({"first"})[0].job_id == "second"
    compensation.forget_result("first")
    compensation.close()
    again = Journal(tmp_path, owner="compensation")
    assert again.next_result(set())[0].job_id == "second"
    again.take_results("compensation", False)
    assert again.next_result(set()) is None
    result(journal, "third")
    assert again.next_result(set()) is None


def test_a_result_that_cannot_be_read_is_told_once_and_stands_in_nobodys_way(journal: Journal, tmp_path: Path) -> None:
    journal.take_results("compensation", True)
    number = result(journal, "of another version")
    result(journal, "readable")
    with sqlite3.connect(tmp_path / "journal.sqlite") as database:
        database.execute("UPDATE results SET inspection = ? WHERE number = ?", (b"\x00\x01\x00\x00short", number))
    with pytest.raises(StorageError, match="the result of job of another version cannot be read"):
        journal.next_result(set())
    assert journal.next_result(set())[0].job_id == "readable"


def test_of_too_many_results_the_newest_are_kept(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "_KEPT_RESULT_BYTES", 2 * len(serialize_message(CLOUD)))
    journal.take_results("compensation", True)
    for name in "abcd":
        result(journal, name)
    assert journal.next_result(set())[0].job_id == "c"
    monkeypatch.setattr(journal_module, "_KEPT_RESULT_BYTES", 1)
    result(journal, "e")
    assert journal.next_result(set())[0].job_id == "e"
