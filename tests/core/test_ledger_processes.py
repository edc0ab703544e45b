"""A ledger that several threads and processes work with, also when they are killed."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from ledger_samples import (
    DESIGN,
    PART,
    PROPOSED,
    RELEASED,
    REPRINT,
    ROLLED_BACK,
    SUPERSEDED,
    proposal,
    url_of,
    vertices_for,
    without_times,
)
from sqlalchemy import Engine, event
from sqlalchemy.pool import Pool

from mdf_core import ledger_database
from mdf_core.errors import CycleStateError, LedgerError
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import CycleState

CHILDREN = multiprocessing.get_context("fork")  # they need not import everything again
DEADLINE = 60.0


# Several processes and threads


def run_at_once(count: int, work: Callable[[int, Any], object]) -> list[Any]:
    """What `work` returns, or the CycleStateError that it raises, in processes that start together."""
    barrier, answers = CHILDREN.Barrier(count), CHILDREN.SimpleQueue()

    def answer(number: int) -> None:
        try:
            answers.put((number, work(number, barrier)))
        except CycleStateError as error:
            answers.put((number, error.what))

    children = [CHILDREN.Process(target=answer, args=(number,)) for number in range(count)]
    for child in children:
        child.start()
    for child in children:
        child.join(DEADLINE)
        assert child.exitcode == 0
    return [found for _, found in sorted(answers.get() for _ in children)]


def test_of_two_processes_that_release_at_once_one_wins_and_the_other_is_told(tmp_path: Path) -> None:
    parts = [f"part {number}" for number in range(15)]
    with Ledger(url_of(tmp_path)) as ledger:
        rivals = [[ledger.propose(proposal(part_id=part, gain=gain)).id for gain in (0.5, 1.0)] for part in parts]

    def release_all(number: int, barrier: Any) -> list[str]:
        told = []
        with Ledger(url_of(tmp_path)) as ledger:
            for pair in rivals:
                barrier.wait(DEADLINE)
                try:
                    told.append(ledger.release(pair[number], f"process {number}").state.value)
                except CycleStateError as error:
                    told.append(error.what)
        return told

    for part, pair, answers in zip(parts, rivals, zip(*run_at_once(2, release_all), strict=True), strict=True):
        winner = answers.index("released")
        assert answers[1 - winner] == f"the redesign starts from nominal, what is released is cycle {pair[winner]}"
        with Ledger(url_of(tmp_path)) as ledger:
            current = ledger.current(part, DESIGN)
            assert current is not None and (current.id, current.decided_by) == (pair[winner], f"process {winner}")
            assert [cycle.state for cycle in ledger.history(part)].count(RELEASED) == 1


def test_processes_that_open_a_fresh_ledger_at_once_all_work_and_propose_one_cycle(tmp_path: Path) -> None:
    for attempt in range(5):
        url = url_of(tmp_path / f"{attempt}")

        def propose(number: int, barrier: Any, url: str = url) -> int:
            barrier.wait(DEADLINE)
            with Ledger(url) as ledger:
                return ledger.propose(proposal()).id

        assert run_at_once(6, propose) == [1] * 6
        with Ledger(url) as ledger:
            assert len(ledger.history()) == 1


def test_a_fresh_file_that_another_process_is_just_opening_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "ledger.sqlite", isolation_level=None)) as other:
        other.execute("CREATE TABLE something (number INTEGER)")
        other.execute("BEGIN IMMEDIATE")  # SQLite changes no mode now, and does not wait for it
        monkeypatch.setattr(ledger_database.time, "sleep", lambda _: other.execute("ROLLBACK"))
        with Ledger(url_of(tmp_path)) as ledger:
            assert ledger.history() == ()
        assert not other.in_transaction


def test_threads_open_ledgers_of_their_own_at_once() -> None:
    def propose(_: int) -> int:
        with Ledger("sqlite://") as ledger:
            return ledger.propose(proposal()).id

    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(propose, range(40))) == [1] * 40


def test_threads_share_a_ledger_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with Ledger("sqlite://") as ledger, ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda number: ledger.propose(proposal(gain=number / 10)).id, range(40)))
        assert sorted(found) == [cycle.id for cycle in ledger.history()]
        assert len(set(found)) == 40
    assert not list(tmp_path.iterdir())


def test_while_another_program_writes_readers_read_and_writers_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ledger_database, "_BUSY_SECONDS", 0.1)
    with Ledger(url_of(tmp_path)) as ledger, contextlib.closing(sqlite3.connect(tmp_path / "ledger.sqlite")) as other:
        cycle = ledger.propose(proposal())
        other.execute("BEGIN IMMEDIATE")
        assert ledger.current(PART, DESIGN) is None
        with pytest.raises(LedgerError, match=r"database is locked; end the program"):
            ledger.release(cycle.id, "Ada")
        other.rollback()
        assert ledger.release(cycle.id, "Ada").state is RELEASED


# Processes that are killed


STEPS: list[Callable[[Ledger], object]] = [
    lambda ledger: ledger.propose(proposal()),
    lambda ledger: ledger.release(1, "Ada"),
    lambda ledger: ledger.propose(proposal(1)),
    lambda ledger: ledger.release(2, "Ada"),
    lambda ledger: ledger.note_reprint(2, 0.5, 0.1, (REPRINT,)),
    lambda ledger: ledger.roll_back(2, "Ada", "worse"),
]


def test_a_process_killed_around_any_change_leaves_what_it_said_and_the_next_can_go_on(tmp_path: Path) -> None:
    with Ledger("sqlite://") as undisturbed:
        expected = [without_times(undisturbed.history())]
        for step in STEPS:
            step(undisturbed)
            expected.append(without_times(undisturbed.history()))

    def work(url: str, told: Any, last: int) -> None:
        moments = itertools.count()

        def maybe_die(*_: object) -> None:
            if next(moments) == last:
                os.kill(os.getpid(), signal.SIGKILL)

        def maybe_die_before(connection: object, cursor: object, statement: str, *_: object) -> None:
            if not statement.startswith(("SELECT", "PRAGMA")):
                maybe_die()

        event.listen(Engine, "before_cursor_execute", maybe_die_before)
        event.listen(Engine, "commit", maybe_die)
        event.listen(Pool, "checkin", maybe_die)  # after the commit, before the answer
        with Ledger(url) as ledger:
            for step in STEPS:
                step(ledger)
                told.send_bytes(b"done")

    for moment in itertools.count():
        url = url_of(tmp_path / f"{moment}")
        reading, writing = CHILDREN.Pipe(duplex=False)
        child = CHILDREN.Process(target=work, args=(url, writing, moment))
        child.start()
        child.join(DEADLINE)
        done = 0
        while reading.poll():
            reading.recv_bytes()
            done += 1
        with Ledger(url) as ledger:
            # What was under way when it was killed may or may not be there.
            assert without_times(ledger.history()) in expected[done : done + 2]
            for step in STEPS[done:]:
                step(ledger)
            assert without_times(ledger.history()) == expected[-1]
        if child.exitcode == 0:
            break
        assert child.exitcode == -signal.SIGKILL
    assert moment > 5 * len(STEPS)


def write_without_end(url: str, told: Any) -> None:
    with Ledger(url) as ledger:
        while True:
            current = ledger.current(PART, DESIGN)
            gain = float(len(ledger.history()))
            made = proposal(current.id if current else None, gain=gain, vertices=vertices_for(gain))
            cycle = ledger.propose(made)
            told.send((cycle.id, PROPOSED))
            ledger.release(cycle.id, "Ada")
            told.send((cycle.id, RELEASED))
            if cycle.id % 3 == 0:
                ledger.roll_back(cycle.id, "Ada", "worse")
                told.send((cycle.id, ROLLED_BACK))


def test_what_was_said_is_in_the_ledger_whenever_the_process_is_killed(tmp_path: Path) -> None:
    url, said = url_of(tmp_path), dict[int, CycleState]()
    for answers in (1, 2, 3, 5, 8, 13, 4, 7, 6, 9):
        reading, writing = CHILDREN.Pipe(duplex=False)
        child = CHILDREN.Process(target=write_without_end, args=(url, writing))
        child.start()
        for _ in range(answers):
            assert reading.poll(DEADLINE)
            said.update([reading.recv()])
        child.kill()
        child.join(DEADLINE)
        assert child.exitcode == -signal.SIGKILL
        while reading.poll():
            said.update([reading.recv()])
        check_against(url, said)
    with contextlib.closing(sqlite3.connect(tmp_path / "ledger.sqlite")) as database:
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def check_against(url: str, said: dict[int, CycleState]) -> None:
    later = {PROPOSED: {RELEASED}, RELEASED: {SUPERSEDED, ROLLED_BACK}, ROLLED_BACK: set[CycleState]()}
    with Ledger(url) as ledger:
        history = {cycle.id: cycle for cycle in ledger.history()}
        # What was under way when it was killed may or may not be there.
        assert len(history.keys() - said.keys()) <= 1
        assert said.keys() <= history.keys()
        ahead = [id for id, state in said.items() if state is PROPOSED and history[id].state is not PROPOSED]
        assert len(ahead) <= 1
        for id, cycle in history.items():
            assert ledger.vertices(id).tobytes() == vertices_for(cycle.gain).tobytes()
            state = said.get(id, PROPOSED)
            assert cycle.state is state or cycle.state in later[state]
            said[id] = cycle.state  # whether it was told or not, it stays
            assert cycle.number == (history[cycle.previous].number + 1 if cycle.previous else 1)
        current = ledger.current(PART, DESIGN)
        assert [cycle for cycle in history.values() if cycle.state is RELEASED] == ([current] if current else [])
        ancestors, cycle = set(), current
        while cycle is not None and cycle.previous is not None:
            cycle = history[cycle.previous]
            ancestors.add(cycle)
        assert {cycle.id for cycle in history.values() if cycle.state is SUPERSEDED} == {old.id for old in ancestors}
