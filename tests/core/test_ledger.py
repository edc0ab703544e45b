"""The ledger: what was acknowledged is in it, and at most one redesign of a part and design is released."""

from __future__ import annotations

import contextlib
import io
import itertools
import multiprocessing
import os
import signal
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import Engine, create_engine, event
from sqlalchemy.dialects import postgresql
from sqlalchemy.pool import Pool
from sqlalchemy.schema import CreateIndex, CreateTable

from mdf_core import ledger_database
from mdf_core.check_result import Check
from mdf_core.errors import CycleStateError, LedgerError
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import METADATA, Cycle, CycleState, Proposal, ScanReference
from mdf_core.settings import Settings

PART, DESIGN = "flange 7", "d" * 64
SCAN, REPRINT, OTHER_REPRINT = (ScanReference(letter * 64, f"job {letter}") for letter in "abc")
PROPOSED, RELEASED, REJECTED, SUPERSEDED, ROLLED_BACK = CycleState
CHILDREN = multiprocessing.get_context("fork")  # they need not import everything again
DEADLINE = 60.0


def proposal(previous: int | None = None, **changes: Any) -> Proposal:
    gain = changes.get("gain", 1.0)
    made = Proposal(
        part_id=PART,
        design_sha256=DESIGN,
        previous=previous,
        gain=gain,
        lookup="spatial",
        vertices=np.arange(12.0).reshape(4, 3),
        stl_path=f"/cell/redesigned_{gain}.stl",
        stl_sha256=f"{previous}-{gain}",
        inputs=(SCAN,),
        settings=Settings(),
        software_version="0.1.0",
        residual_before_mm=0.4,
        predicted_residual_mm=0.1,
    )
    return replace(made, **changes)


def url_of(folder: Path) -> str:
    return f"sqlite:///{folder}/ledger.sqlite"


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[Ledger]:
    with Ledger(url_of(tmp_path)) as opened:
        yield opened


def states(ledger: Ledger) -> list[CycleState]:
    return [cycle.state for cycle in ledger.history()]


def without_times(cycles: tuple[Cycle, ...]) -> list[Cycle]:
    never = datetime.min.replace(tzinfo=timezone.utc)
    return [replace(cycle, created=never, decided=cycle.decided and never) for cycle in cycles]


# The life of a part


def test_a_part_over_three_cycles_with_a_rollback(ledger: Ledger, tmp_path: Path) -> None:
    assert ledger.current(PART, DESIGN) is None

    first = ledger.propose(proposal())
    assert (first.number, first.previous, first.state, first.decided) == (1, None, PROPOSED, None)
    assert ledger.current(PART, DESIGN) is None, "proposed is not released"
    first = ledger.release(first.id, "Ada")
    assert ledger.current(PART, DESIGN) == first

    second = ledger.propose(proposal(first.id))
    ledger.release(second.id, "Ada")
    third = ledger.propose(proposal(second.id))
    ledger.release(third.id, "Grace")
    assert [cycle.number for cycle in ledger.history()] == [1, 2, 3]
    assert states(ledger) == [SUPERSEDED, SUPERSEDED, RELEASED]

    back = ledger.roll_back(third.id, "Grace", "prints worse")
    assert back == ledger.current(PART, DESIGN)
    assert (back.id, back.decided_by) == (second.id, "Ada")
    assert states(ledger) == [SUPERSEDED, RELEASED, ROLLED_BACK]
    again = ledger.propose(proposal(second.id, gain=0.5))
    assert again.number == 3
    ledger.release(again.id, "Grace")

    with Ledger(url_of(tmp_path)) as reopened:
        assert states(reopened) == [SUPERSEDED, SUPERSEDED, ROLLED_BACK, RELEASED]
        decisions = [(cycle.decided_by, cycle.reason) for cycle in reopened.history()]
        assert decisions == [("Ada", ""), ("Ada", ""), ("Grace", "prints worse"), ("Grace", "")]


def test_the_first_cycle_is_rolled_back_to_the_nominal_design(ledger: Ledger) -> None:
    first = ledger.propose(proposal())
    ledger.release(first.id, "Ada")
    assert ledger.roll_back(first.id, "Ada", "prints worse") is None
    assert ledger.current(PART, DESIGN) is None
    assert ledger.propose(proposal(gain=0.5)).number == 1


def test_of_several_gains_one_is_released_and_after_its_rollback_another_may_be(ledger: Ledger) -> None:
    low, mid, high = (ledger.propose(proposal(gain=gain)) for gain in (0.5, 0.8, 1.0))
    assert [cycle.number for cycle in (low, mid, high)] == [1, 1, 1]
    ledger.release(high.id, "Ada")
    with pytest.raises(CycleStateError, match=f"starts from nominal, what is released is cycle {high.id}"):
        ledger.release(mid.id, "Ada")
    assert states(ledger) == [PROPOSED, PROPOSED, RELEASED]
    ledger.reject(low.id, "Ada", "too little")
    ledger.roll_back(high.id, "Ada", "too much")
    ledger.release(mid.id, "Ada")
    assert states(ledger) == [REJECTED, RELEASED, ROLLED_BACK]


def test_parts_and_designs_do_not_mix(ledger: Ledger) -> None:
    kinds = [(part, design) for part in (PART, "flange 8") for design in (DESIGN, "e" * 64)]
    cycles = {kind: ledger.propose(proposal(part_id=kind[0], design_sha256=kind[1])) for kind in kinds}
    assert len({cycle.id for cycle in cycles.values()}) == 4
    for kind, cycle in cycles.items():
        cycles[kind] = ledger.release(cycle.id, "Ada")
    for kind, cycle in cycles.items():
        assert ledger.current(*kind) == cycle
        assert ledger.history(*kind) == (cycle,)
    ledger.roll_back(cycles[kinds[0]].id, "Ada", "")
    assert [ledger.current(*kind) for kind in kinds] == [None, *list(cycles.values())[1:]]
    assert ledger.history("flange 8") == (cycles[kinds[2]], cycles[kinds[3]])
    assert [cycle.part_id for cycle in ledger.history(design_sha256=DESIGN)] == [PART, "flange 8"]
    with pytest.raises(CycleStateError, match="what is released is nominal"):
        ledger.propose(proposal(cycles[kinds[1]].id))


# What is recorded


def test_everything_proposed_comes_back_as_it_was(ledger: Ledger, tmp_path: Path) -> None:
    settings = Settings().replace({"compensation.gain": 0.1 + 0.2, "surface.beta": "2, 1", "pose.initial": ""})
    checks = (
        Check("stretch", True, "at most 0.01", None),
        Check("thickness", True, "0.2 of 1 mm", (1.0, 2, 0.1)),
    )
    made = proposal(gain=0.1 + 0.2, settings=settings, checks=checks, inputs=(SCAN, REPRINT), residual_before_mm=1 / 3)
    before = datetime.now(timezone.utc)
    cycle = ledger.propose(made)
    for name in ("part_id", "design_sha256", "gain", "lookup", "stl_path", "stl_sha256", "inputs", "checks"):
        assert getattr(cycle, name) == getattr(made, name), name
    assert (cycle.residual_before_mm, cycle.predicted_residual_mm) == (1 / 3, 0.1)
    assert cycle.settings == settings.flat()
    assert Settings().replace(dict(cycle.settings)) == settings
    assert (cycle.settings_sha256, cycle.software_version) == (settings.sha256(), "0.1.0")
    assert before <= cycle.created <= datetime.now(timezone.utc)
    assert cycle.created.utcoffset() == timedelta(0)
    assert (cycle.measured_residual_mm, cycle.measured_residual_std_mm, cycle.reprints) == (None, None, ())
    with Ledger(url_of(tmp_path)) as reopened:
        assert reopened.history() == (cycle,)


def test_vertices_are_exact_to_the_bit(ledger: Ledger, tmp_path: Path) -> None:
    vertices = np.random.default_rng(0).normal(scale=100.0, size=(10_000, 3))
    vertices[:2] = [[-0.0, 5e-324, 1e308], [0.1 + 0.2, np.pi, -1 / 3]]
    contiguous = ledger.propose(proposal(vertices=vertices))
    strided = ledger.propose(proposal(vertices=np.asfortranarray(vertices[::2]), gain=0.5))
    with Ledger(url_of(tmp_path)) as reopened:
        assert reopened.vertices(contiguous.id).tobytes() == vertices.tobytes()
        assert reopened.vertices(strided.id).tobytes() == vertices[::2].tobytes()
        assert reopened.vertices(strided.id).shape == (5_000, 3)
        assert reopened.vertices(strided.id).flags.writeable


def test_a_redesign_that_fails_a_check_is_rejected_at_once(ledger: Ledger) -> None:
    failed = Check("stretch", False, "0.31 is more than 0.2", (1.0, 2.0, 3.0))
    cycle = ledger.propose(proposal(checks=(failed,)), rejection="stretch: 0.31 is more than 0.2")
    assert (cycle.state, cycle.reason, cycle.decided) == (REJECTED, "stretch: 0.31 is more than 0.2", cycle.created)
    assert cycle.checks == (failed,)
    with pytest.raises(CycleStateError, match="rejected and cannot be released"):
        ledger.release(cycle.id, "Ada")


def test_reprints_are_added_and_their_figures_replaced(ledger: Ledger) -> None:
    cycle = ledger.propose(proposal())
    ledger.note_reprint(cycle.id, 0.2, float("nan"), (REPRINT,))
    noted = ledger.note_reprint(cycle.id, 0.15, 0.03, (REPRINT, OTHER_REPRINT))
    assert (noted.measured_residual_mm, noted.measured_residual_std_mm) == (0.15, 0.03)
    assert noted.reprints == (REPRINT, OTHER_REPRINT)
    assert replace(noted, measured_residual_mm=None, measured_residual_std_mm=None, reprints=()) == cycle


def test_the_file_of_a_redesign_may_come_to_lie_elsewhere(ledger: Ledger) -> None:
    cycle = ledger.propose(proposal())
    ledger.note_file(cycle.id, "/elsewhere.stl")
    assert ledger.cycle(cycle.id) == replace(cycle, stl_path="/elsewhere.stl")


def test_numbers_that_are_not_known_are_none(ledger: Ledger) -> None:
    cycle = ledger.propose(proposal(predicted_residual_mm=float("nan")))
    assert cycle.predicted_residual_mm is None
    assert ledger.note_reprint(cycle.id, 0.2, float("nan"), (REPRINT,)).measured_residual_std_mm is None


def test_the_cycle_of_a_file_is_found_by_its_hash(ledger: Ledger) -> None:
    high, low = (ledger.propose(proposal(gain=gain)) for gain in (1.0, 0.5))
    assert ledger.by_redesign(high.stl_sha256) == high
    assert ledger.by_redesign("f" * 64) is None
    same_file = ledger.propose(proposal(part_id="flange 8", stl_sha256=low.stl_sha256))
    assert ledger.by_redesign(low.stl_sha256) == same_file, "the newest"
    low = ledger.release(low.id, "Ada")
    assert ledger.by_redesign(low.stl_sha256) == low, "the released one"


# Steps that are not possible, and steps made twice


def in_every_state(ledger: Ledger) -> dict[CycleState, int]:
    first, other, doubted = (ledger.propose(proposal(gain=gain)).id for gain in (1.0, 0.5, 0.2))
    ledger.reject(doubted, "Ada", "too little")
    ledger.release(first, "Ada")
    second = ledger.propose(proposal(first)).id
    ledger.release(second, "Ada")
    third = ledger.propose(proposal(second)).id
    ledger.release(third, "Ada")
    ledger.roll_back(third, "Ada", "worse")
    found = {PROPOSED: other, RELEASED: second, REJECTED: doubted, SUPERSEDED: first, ROLLED_BACK: third}
    assert all(cycle.state is state for state, id in found.items() for cycle in ledger.history() if cycle.id == id)
    return found


def test_what_a_state_does_not_allow_is_told_and_changes_nothing(ledger: Ledger) -> None:
    ids = in_every_state(ledger)
    before = ledger.history()
    refused: list[tuple[Callable[[int], object], set[CycleState]]] = [
        (lambda id: ledger.release(id, "Eve"), {PROPOSED, REJECTED, SUPERSEDED, ROLLED_BACK}),  # PROPOSED: stale
        (lambda id: ledger.reject(id, "Eve", ""), {RELEASED, SUPERSEDED, ROLLED_BACK}),
        (lambda id: ledger.roll_back(id, "Eve", ""), {PROPOSED, REJECTED, SUPERSEDED}),
        (lambda id: ledger.propose(proposal(id, gain=0.3)), {PROPOSED, REJECTED, SUPERSEDED, ROLLED_BACK}),
    ]
    for step, not_allowed in refused:
        for state in not_allowed:
            with pytest.raises(CycleStateError, match=r"part flange 7: .+; .+"):
                step(ids[state])
    assert ledger.history() == before


@pytest.mark.parametrize(
    "step",
    [
        lambda ledger: ledger.release(99, "Ada"),
        lambda ledger: ledger.reject(99, "Ada", ""),
        lambda ledger: ledger.roll_back(99, "Ada", ""),
        lambda ledger: ledger.note_reprint(99, 0.1, 0.1, ()),
        lambda ledger: ledger.note_file(99, "/elsewhere.stl"),
        lambda ledger: ledger.cycle(99),
        lambda ledger: ledger.vertices(99),
    ],
)
def test_a_cycle_that_does_not_exist_is_told(step: Callable[[Ledger], object], ledger: Ledger) -> None:
    with pytest.raises(CycleStateError, match="cycle 99: there is none"):
        step(ledger)


def test_a_proposal_that_a_release_has_overtaken_is_refused(ledger: Ledger) -> None:
    released = ledger.propose(proposal())
    ledger.release(released.id, "Ada")
    with pytest.raises(CycleStateError, match=f"part {PART}: .* scan a print of cycle {released.id}"):
        ledger.propose(proposal(gain=0.5))
    assert ledger.history() == (ledger.current(PART, DESIGN),)


def test_an_equal_proposal_is_the_same_cycle_whatever_has_become_of_it(ledger: Ledger) -> None:
    cycle = ledger.propose(proposal())
    again = proposal(inputs=(ScanReference(SCAN.sha256, "registered again"),), stl_path="/elsewhere.stl")
    assert ledger.propose(again) == cycle
    released = ledger.release(cycle.id, "Ada")
    assert ledger.propose(proposal()) == released
    assert ledger.history() == (released,)


@pytest.mark.parametrize(
    "change",
    [
        {"gain": 0.5, "stl_sha256": "None-1.0"},
        {"lookup": "material"},
        {"inputs": (SCAN, REPRINT)},
        {"settings": Settings(seed=1)},
        {"stl_sha256": "f" * 64},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_proposal_that_differs_is_another_cycle(change: dict[str, Any], ledger: Ledger) -> None:
    assert ledger.propose(proposal(**change)).id != ledger.propose(proposal()).id


def test_of_what_nobody_decides_about_the_newest_is_kept_and_the_rest_for_ever(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mdf_core.ledger._KEPT_PROPOSALS", 3)
    first = ledger.propose(proposal(gain=0.1))
    ledger.reject(first.id, "Ada", "too little")
    other = ledger.propose(proposal(part_id="other"))
    proposed = [ledger.propose(proposal(gain=0.2 + 0.1 * number)) for number in range(5)]
    assert [cycle.id for cycle in ledger.history()] == [first.id, other.id, *(cycle.id for cycle in proposed[2:])]


def test_a_step_whose_answer_was_lost_may_be_made_again(ledger: Ledger) -> None:
    cycle = ledger.propose(proposal())
    steps: list[Callable[[], object]] = [
        lambda: ledger.release(cycle.id, "Ada"),
        lambda: ledger.note_reprint(cycle.id, 0.2, 0.1, (REPRINT,)),
        lambda: ledger.note_file(cycle.id, "/elsewhere.stl"),
        lambda: ledger.roll_back(cycle.id, "Ada", "worse"),
        lambda: ledger.reject(ledger.propose(proposal(gain=0.5)).id, "Ada", "too little"),
    ]
    for step in steps:
        answer, after = step(), ledger.history()
        assert step() == answer
        assert ledger.history() == after


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


def vertices_for(gain: float) -> np.ndarray:
    return np.random.default_rng(int(gain)).normal(size=(20_000, 3))


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


def schema(path: Path) -> list[tuple[str, ...]]:
    with contextlib.closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY name")
        return [row for row in rows if row[2] != ledger_database._VERSION_TABLE]


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
    for part in (CreateTable(cycles), *(CreateIndex(index) for index in cycles.indexes)):
        assert " ".join(str(part.compile(dialect=postgresql.dialect())).split()) in made
    assert "CREATE UNIQUE INDEX one_released ON cycles (part_id, design_sha256) WHERE state = 'released'" in made
