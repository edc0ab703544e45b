"""Redesigns to propose to a ledger, and what the tests of the ledger ask of it."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import Cycle, CycleState, Proposal, ScanReference
from mdf_core.settings import Settings

PART, DESIGN = "flange 7", "d" * 64
SCAN, REPRINT, OTHER_REPRINT = (ScanReference(letter * 64, f"job {letter}") for letter in "abc")
PROPOSED, RELEASED, REJECTED, SUPERSEDED, ROLLED_BACK = CycleState


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


def states(ledger: Ledger) -> list[CycleState]:
    return [cycle.state for cycle in ledger.history()]


def without_times(cycles: tuple[Cycle, ...]) -> list[Cycle]:
    never = datetime.min.replace(tzinfo=timezone.utc)
    return [replace(cycle, created=never, decided=cycle.decided and never) for cycle in cycles]


def vertices_for(gain: float) -> np.ndarray:
    return np.random.default_rng(int(gain)).normal(size=(20_000, 3))
