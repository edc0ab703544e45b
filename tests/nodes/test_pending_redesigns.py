"""Which inspections a redesign is due against, and what becomes of those whose redesign fails."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Time
from mdf_interfaces.msg import Inspection
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.errors import (
    CompensationRefusedError,
    DesignMismatchError,
    NoInspectionError,
    NotActiveError,
    OutputFolderError,
    StorageError,
)
from mdf_nodes import pending_redesigns
from mdf_nodes.inspected import Pair
from mdf_nodes.journal import Journal
from mdf_nodes.pending_redesigns import PendingRedesigns

Keep = Callable[..., list[Pair]]
BYTES = 1000
REFUSED = CompensationRefusedError("of another part", "inspection")
MENDABLE = OutputFolderError("in the way", "results")
MISMATCH = DesignMismatchError("belongs to another design", "inspection")
STOPPED = NotActiveError("deactivated", "compensation")


def pair(job_id: str) -> Pair:
    header = Header(stamp=Time(sec=1))
    return Pair(Inspection(header=header, job_id=job_id), PointCloud2(header=header, data=bytes(10)))


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    opened = Journal(tmp_path, owner="compensation")
    opened.take_results("compensation", True)
    return opened


@pytest.fixture
def keep(tmp_path: Path, journal: Journal) -> Keep:
    """Has registration keep results of these names."""
    registration = Journal(tmp_path, owner="registration")

    def keep_results(*names: str) -> list[Pair]:
        pairs = [pair(name) for name in names]
        for each in pairs:
            number = registration.accept(each.displacement).number
            registration.keep_result(number, each.inspection, each.displacement)
        return pairs

    return keep_results


@pytest.fixture
def pending(journal: Journal) -> PendingRedesigns:
    return PendingRedesigns(lambda: journal, BYTES)


def taken(pending: PendingRedesigns) -> list[str]:
    """The jobs of all that can be taken now, in order."""
    return [each.job_id for each in iter(pending.take, None)]


def kept(journal: Journal) -> list[str]:
    """The jobs whose results the journal keeps."""
    names: list[str] = []
    while (result := journal.next_result(set(names))) is not None:
        names.append(result[0].job_id)
    return names


def test_those_in_the_journal_are_taken_first_and_each_of_them_once(pending: PendingRedesigns, keep: Keep) -> None:
    keep("a", "b")
    pending.add(pair("c"))
    assert taken(pending) == ["a", "b", "c"]
    keep("d")
    assert taken(pending) == ["d"]


def test_what_comes_by_topic_and_from_the_journal_is_one(pending: PendingRedesigns, keep: Keep) -> None:
    (kept_pair,) = keep("a")
    pending.add(kept_pair)
    assert taken(pending) == ["a"]


def test_only_the_last_one_by_topic_waits_and_it_is_told_when_it_takes_a_place(pending: PendingRedesigns) -> None:
    assert not pending.add(pair("a"))
    assert pending.add(pair("b"))
    assert taken(pending) == ["b"]
    assert not pending.add(pair("c"))
    assert pending.drop_latest() and not pending.drop_latest()
    assert taken(pending) == []


def test_a_job_that_the_ledger_knows_is_not_taken_when_it_is_sent_once_more(pending: PendingRedesigns) -> None:
    pending.set_recorded({"a"})
    pending.add(pair("a"))
    assert taken(pending) == []


def test_a_cycle_is_collected_until_it_is_complete(pending: PendingRedesigns) -> None:
    first, second, third = pair("a"), pair("b"), pair("c")
    assert pending.collect(first, 2) == [] and pending.collected == (first,)
    assert pending.collect(second, 2) == [first, second] and pending.collected == ()
    assert pending.collect(third, 1) == [third]


def test_what_is_done_is_forgotten_and_does_not_come_again(
    pending: PendingRedesigns, journal: Journal, keep: Keep
) -> None:
    pairs = keep("a", "b")
    assert taken(pending) == ["a", "b"]
    pending.mark_done(pairs)
    assert kept(journal) == []
    pending.add(pairs[0])
    assert taken(pending) == []


def test_what_the_journal_could_not_forget_is_forgotten_later(
    pending: PendingRedesigns, journal: Journal, keep: Keep, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: str) -> None:
        raise StorageError("full", "state_folder")

    pairs = keep("a", "b")
    assert taken(pending) == ["a", "b"]
    with monkeypatch.context() as patch, pytest.raises(StorageError):
        patch.setattr(journal, "forget_result", refuse)
        pending.mark_done(pairs)
    assert kept(journal) == ["a", "b"]
    assert taken(pending) == [] and kept(journal) == []


def test_what_could_not_be_queued_is_taken_again(pending: PendingRedesigns, keep: Keep) -> None:
    pairs = keep("a", "b")
    assert taken(pending) == ["a", "b"]
    pending.give_back(pairs)
    assert taken(pending) == ["a", "b"]


def test_what_no_other_try_mends_is_done_with(pending: PendingRedesigns, journal: Journal, keep: Keep) -> None:
    pairs = keep("a")
    taken(pending)
    pending.fail(pairs, REFUSED)
    assert taken(pending) == [] and kept(journal) == []


def test_what_another_try_may_mend_is_taken_again_after_a_while(
    pending: PendingRedesigns, journal: Journal, keep: Keep, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(pending_redesigns, "time", SimpleNamespace(monotonic=lambda: now))
    pairs = keep("a")
    taken(pending)
    pending.fail(pairs, MENDABLE)
    now = 109.0
    assert taken(pending) == [] and kept(journal) == ["a"]
    now = 111.0
    assert taken(pending) == ["a"]


def test_what_is_of_another_design_waits_until_something_changes(
    pending: PendingRedesigns, keep: Keep, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = keep("a")
    taken(pending)
    pending.fail(pairs, MISMATCH)
    monkeypatch.setattr(pending_redesigns, "time", SimpleNamespace(monotonic=lambda: 1e300))
    assert taken(pending) == []
    pending.retry_deferred()
    assert taken(pending) == ["a"]


def test_a_stop_of_the_node_costs_no_redesign(pending: PendingRedesigns, keep: Keep) -> None:
    pairs = keep("a")
    taken(pending)
    pending.fail(pairs, STOPPED)
    assert taken(pending) == ["a"]


def test_without_a_state_folder_the_last_one_outlives_a_stop_and_names_come_again() -> None:
    journal = Journal()
    pending, first, again = PendingRedesigns(lambda: journal, BYTES), pair("a"), pair("a")
    pending.add(first)
    assert taken(pending) == ["a"]
    pending.fail([first], STOPPED)
    assert pending.take() is first
    for end in (lambda: pending.mark_done([first]), lambda: pending.fail([first], MENDABLE)):
        end()
        assert pending.take() is None
        pending.add(again)
        assert pending.take() is again


def test_of_something_else_that_is_printed_nothing_has_been_inspected(
    pending: PendingRedesigns, journal: Journal, keep: Keep
) -> None:
    (collected,) = keep("a")
    assert pending.take() is not None
    pending.collect(collected, 2)
    pending.add(pair("b"))
    pending.forget_prints()
    assert pending.collected == () and taken(pending) == [] and kept(journal) == []
    with pytest.raises(NoInspectionError):
        pending.named([])
