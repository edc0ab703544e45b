"""The ledger: what was acknowledged is in it, and at most one redesign of a part and design is released."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ledger_samples import (
    DESIGN,
    OTHER_REPRINT,
    PART,
    PROPOSED,
    REJECTED,
    RELEASED,
    REPRINT,
    ROLLED_BACK,
    SCAN,
    SUPERSEDED,
    proposal,
    states,
    url_of,
)

from mdf_core.check_result import Check
from mdf_core.errors import CycleStateError
from mdf_core.estimate import Evidence
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import CycleState, ScanReference
from mdf_core.settings import Settings

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


def test_what_a_redesign_rests_on_is_kept_in_float32(ledger: Ledger, tmp_path: Path) -> None:
    wanted = np.float32(np.arange(12.0).reshape(4, 3) / 7.0)
    error, prints = np.float32([0.01, np.inf, 0.0, 0.3]), np.float32([1.0, 0.0, 2.9, 3.0])
    known = ledger.propose(proposal(evidence=Evidence(wanted, error, prints, float("nan"))))
    unknown = ledger.propose(proposal(gain=0.5))
    with Ledger(url_of(tmp_path)) as reopened:
        found = reopened.evidence(known.id)
        assert reopened.evidence(unknown.id) is None
    assert found is not None
    np.testing.assert_array_equal(found.wanted, wanted)
    np.testing.assert_array_equal(found.error, error)
    np.testing.assert_array_equal(found.prints, prints)
    assert np.isnan(found.variation)


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
        lambda ledger: ledger.evidence(99),
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
