"""What is printed of a part, as the ledger says, and what its prints show of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mdf_core.errors import CompensationRefusedError, DesignMismatchError, WorseReprintError
from mdf_core.estimate import Estimate, largest_residual
from mdf_core.geometry import Array, Design
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import Cycle, CycleState, ScanReference
from mdf_core.mesh_io import stl_coordinates
from mdf_core.prints import MeasuredField, Prints, combine_prints

_WORSE, _WORSE_ERRORS = 1.2, 2.0  # times the residual before, and standard errors
_BETTER = 0.5  # of the residual before: no print of the same mesh is so much better by itself


@dataclass(frozen=True, eq=False)
class Printed:
    """The mesh of a part that was printed.

    Attributes
    ----------
    part_id : str
    design : Design
    cycle : Cycle or None
        Of the redesign; None: the design itself.
    estimate : Estimate
        Its vertices, and what is known of them.
    """

    part_id: str
    design: Design
    cycle: Cycle | None
    estimate: Estimate

    @property
    def cycle_id(self) -> int | None:
        """Of the redesign; None: the design itself."""
        return None if self.cycle is None else self.cycle.id


def current_print(ledger: Ledger, part_id: str, design: Design) -> Printed:
    """What is printed of a part, as the ledger says: its released redesign, or the design.

    Raises
    ------
    LedgerError
        The ledger cannot be read.
    DesignMismatchError
        The design was refined otherwise when the redesign was made.
    """
    cycle = ledger.current(part_id, design.file_sha256)
    if cycle is None:
        return Printed(part_id, design, None, Estimate.unknown(design.vertices))
    before = stl_coordinates(design.vertices) if cycle.previous is None else ledger.vertices(cycle.previous)
    vertices = ledger.vertices(cycle.id)
    if not vertices.shape == before.shape == design.vertices.shape:
        raise DesignMismatchError(
            f"cycle {cycle.number} has {len(vertices)} vertices, the design {len(design.vertices)}",
            f"part {part_id}",
            "set design.longest_edge_mm as it was when the cycle was made, or roll it back",
        )
    # Of a cycle of a former version no evidence is kept, but the move, which a print of it must show.
    evidence = ledger.evidence(cycle.id) or Estimate.unknown(vertices).evidence
    return Printed(part_id, design, cycle, Estimate(vertices, before, evidence))


def doubts_of_beginning(ledger: Ledger, part_id: str, design: Design) -> tuple[str, ...]:
    """Why a part of which no redesign is released may be one in truth: other names of it have released ones."""
    own = part_id, design.file_sha256
    same = {cycle.id: cycle for cycle in (*ledger.history(part_id), *ledger.history(design_sha256=design.file_sha256))}
    return tuple(
        f"redesign {cycle.id} is released of part {cycle.part_id}, design {cycle.design_sha256[:8]}, and none of part "
        f"{part_id}, design {design.file_sha256[:8]}: this begins anew. If both are one part, go on with that name and "
        "that file, and not with one that was exported again"
        for cycle in same.values()
        if cycle.state is CycleState.RELEASED and (cycle.part_id, cycle.design_sha256) != own
    )


def judge_prints(
    ledger: Ledger,
    printed: Printed,
    measured: Sequence[MeasuredField],
    scans: Sequence[ScanReference],
    may_be_better: bool = False,
) -> None:
    """Note in the ledger what prints show, and refuse those that no redesign may follow from.

    Parameters
    ----------
    ledger : Ledger
    printed : Printed
        What they should be prints of.
    measured : sequence
        As of `compensate`, one for each print.
    scans : sequence of ScanReference
        One for each print.
    may_be_better : bool
        Prints that are far better than what led to a redesign that nobody has released are not refused.

    Raises
    ------
    WorseReprintError
        They are prints of the mesh before, or of another one, which is not noted, or more distorted than those.
    CompensationRefusedError
        They may be prints of a redesign that nobody has released, which is not noted.
    NoInspectionError, DesignMismatchError
        As `compensate`.
    """
    prints = combine_prints(printed.design, measured)
    _require_no_known_scan(ledger, printed, scans)
    _require_reprint(printed, prints)
    if not may_be_better:
        _require_not_better(ledger, printed, prints)
    if printed.cycle is not None:
        ledger.note_reprint(printed.cycle.id, prints.rms_displacement, prints.rms_standard_error, scans)
    _require_not_worse(printed, prints)


def distortion_over_move(design: Design, move: Array, prints: Prints) -> float:
    """Share of `move` (n, 3) mm that the displacement shows, backwards; NaN: nothing moved."""
    areas = (design.vertex_areas * prints.supported)[:, None]
    size = float((areas * move**2).sum())
    return -float((areas * move * prints.displacement).sum()) / size if size > 0 else float("nan")


def _require_no_known_scan(ledger: Ledger, printed: Printed, scans: Sequence[ScanReference]) -> None:
    """Refuse scans that a redesign was made from as those of prints of another mesh."""
    hashes = {scan.sha256 for scan in scans if scan.sha256}
    for cycle in ledger.history(printed.part_id, printed.design.file_sha256):
        is_open = cycle.state is not CycleState.REJECTED
        if is_open and cycle.previous != printed.cycle_id and hashes & {scan.sha256 for scan in cycle.inputs}:
            of, now = _mesh_of(cycle.previous), _mesh_of(printed.cycle_id)
            otherwise = f", or reject redesign {cycle.id}" if cycle.state is CycleState.PROPOSED else ""
            raise WorseReprintError(
                f"redesign {cycle.id} was made from one of these scans, taken for that of a print of {of}; "
                f"what is printed now is {now}",
                f"part {printed.part_id}",
                f"scan a print of {now}{otherwise}",
            )


def _mesh_of(cycle_id: int | None) -> str:
    return "the design" if cycle_id is None else f"redesign {cycle_id}"


def _require_reprint(printed: Printed, prints: Prints) -> None:
    """Refuse prints that show the distortion that the redesign was to take away: they are not prints of it.

    Printed, the move shows as displacement in full. So the share of it that the distortion shows falls by one.
    """
    cycle = printed.cycle
    if cycle is None or cycle.distortion_over_move is None:
        return
    found = distortion_over_move(printed.design, printed.estimate.vertices - printed.estimate.before, prints)
    if abs(found - cycle.distortion_over_move) < 0.5:
        raise WorseReprintError(
            f"{found / cycle.distortion_over_move:.0%} of the distortion before cycle {cycle.number} is still there: "
            "the redesign was not printed, or had no effect",
            f"part {cycle.part_id}",
            "check what was printed and scanned, or roll the redesign back",
        )


def _require_not_worse(printed: Printed, prints: Prints) -> None:
    """Refuse prints that are worse by more than a fifth, two standard errors, and what they differ by anyway."""
    if printed.cycle is None:
        return
    residual, error = prints.rms_displacement, np.nan_to_num(prints.rms_standard_error)
    before, anyway = printed.cycle.residual_before_mm, largest_residual(printed.estimate, prints, printed.design)
    if residual > max(_WORSE * before, before + _WORSE_ERRORS * error, np.nan_to_num(anyway)):
        raise WorseReprintError(
            f"the distortion is {residual:.3f} mm RMS, before cycle {printed.cycle.number} it was {before:.3f} mm",
            f"part {printed.part_id}",
            "roll the redesign back; if it is the printer that has changed, back to the design, and begin anew",
        )


def _require_not_better(ledger: Ledger, printed: Printed, prints: Prints) -> None:
    """Refuse prints far better than what led to a redesign that nobody has released: they may be of that one."""
    waiting = ledger.waiting(printed.part_id, printed.design.file_sha256, printed.cycle_id)
    if waiting and prints.rms_displacement < _BETTER * waiting[-1].residual_before_mm:
        last = waiting[-1]
        raise CompensationRefusedError(
            f"the distortion is {prints.rms_displacement:.3f} mm RMS, before redesign {last.id} it was "
            f"{last.residual_before_mm:.3f} mm, and nobody has released that one",
            f"part {printed.part_id}",
            f"if this is a print of it, release redesign {last.id}; if not, reject it",
        )
