"""The next step of a part's cycles: whether the reprint is better, and the redesigns that follow from it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mdf_core import __version__
from mdf_core.checks import Check, check_redesign, told
from mdf_core.compensation import Redesign, compensate
from mdf_core.errors import (
    CompensationRefusedError,
    CycleStateError,
    DesignMismatchError,
    ReleaseRefusedError,
    WorseReprintError,
)
from mdf_core.geometry import Array, Design
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import Cycle, CycleState, Proposal, ScanReference
from mdf_core.prints import MeasuredField, Prints
from mdf_core.regions import Region, fixed_vertices
from mdf_core.settings import Settings

_WORSE, _WORSE_ERRORS = 1.2, 2.0  # times the residual before, and standard errors: what prints differ by anyway
_BETTER = 0.5  # of the residual before: no print of the same mesh is so much better by itself


@dataclass(frozen=True, eq=False)
class Printed:
    """The mesh that was printed.

    Attributes
    ----------
    cycle : Cycle or None
        Of the redesign; None: the design itself.
    vertices : (n, 3) float64, mm
    before : (n, 3) float64, mm
        Of what was printed in the cycle before; of the design itself, the same.
    """

    cycle: Cycle | None
    vertices: Array
    before: Array


@dataclass(frozen=True, eq=False)
class Checked:
    """A redesign and what its checks found."""

    redesign: Redesign
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether it may be released."""
        return not self.failures

    @property
    def failures(self) -> str:
        """Which checks failed and where; empty: none."""
        return told(self.checks)

    def require_passed(self) -> Redesign:
        """The redesign, if it may be released.

        Raises
        ------
        ReleaseRefusedError
            A check failed; which and where.
        """
        if self.failures:
            raise ReleaseRefusedError(
                self.failures,
                f"redesign with gain {self.redesign.gain:g}",
                "look at the places named; fix a region there, refine the design's mesh, or widen a limit (release.*)",
            )
        return self.redesign


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
        return Printed(None, design.vertices, design.vertices)
    before = design.vertices if cycle.previous is None else ledger.vertices(cycle.previous)
    vertices = ledger.vertices(cycle.id)
    if not vertices.shape == before.shape == design.vertices.shape:
        raise DesignMismatchError(
            f"cycle {cycle.number} has {len(vertices)} vertices, the design {len(design.vertices)}",
            f"part {part_id}",
            "set design.longest_edge_mm as it was when the cycle was made, or roll it back",
        )
    return Printed(cycle, vertices, before)


def redesigns(
    design: Design,
    measured: Sequence[MeasuredField],
    settings: Settings,
    regions: Sequence[Region] = (),
    previous: Array | None = None,
    gains: Sequence[float] = (),
    check: Callable[[], object] = lambda: None,
) -> tuple[Checked, ...]:
    """A checked redesign for every gain.

    Parameters
    ----------
    design, measured, settings, regions, previous
        As of `compensate`.
    gains : sequence of float, optional
        Without any that of the settings.
    check : callable, optional
        Called before each of them; an exception it raises stops the work.

    Raises
    ------
    NoInspectionError, DesignMismatchError, CompensationRefusedError
        As `compensate`.
    """
    fixed = fixed_vertices(regions, len(design.vertices))
    found = []
    for gain in gains or (settings.compensation.gain,):
        check()
        with_gain = settings.replace({"compensation.gain": gain})
        redesign = compensate(design, measured, with_gain, regions, previous)
        found.append(Checked(redesign, check_redesign(design, redesign.vertices, fixed, settings.release)))
    return tuple(found)


def require_usable(scan: str, pose_ambiguous: bool, outlier_share: float, settings: Settings) -> None:
    """Refuse an inspection that no redesign must be made from unseen; `scan` names it in the error.

    Raises
    ------
    CompensationRefusedError
        Its pose is ambiguous, or much of the scan is no part of the design.
    """
    if pose_ambiguous:
        raise CompensationRefusedError("the pose is ambiguous", scan, "give pose.initial or datum points")
    if outlier_share > settings.verdict.max_outlier_share:
        raise CompensationRefusedError(
            f"{outlier_share:.0%} of the points do not lie on the part",
            scan,
            "check that the scan shows this part and nothing else, or crop it (crop.box_mm)",
        )


def require_distinct(hashes: Sequence[str]) -> None:
    """Refuse to count one scan as several prints, by the scans' SHA-256.

    Raises
    ------
    CompensationRefusedError
    """
    if len(set(hashes)) < len(hashes):
        raise CompensationRefusedError("two of the scans are the same", "scans", "give one scan for each print")


def require_reprint(design: Design, printed: Printed, prints: Prints) -> None:
    """Refuse prints that show the distortion that the redesign was to take away: they are not prints of it.

    Parameters
    ----------
    design : Design
    printed : Printed
        What they should be prints of.
    prints : Prints

    Raises
    ------
    WorseReprintError
        They look like prints of the mesh before.

    Notes
    -----
    Printed, the move shows as displacement in full. So the share of it that the distortion shows falls by one.
    """
    cycle = printed.cycle
    if cycle is None or cycle.distortion_over_move is None:
        return
    found = _over_move(design, printed.vertices - printed.before, prints)
    if abs(found - cycle.distortion_over_move) < 0.5:
        raise WorseReprintError(
            f"{found / cycle.distortion_over_move:.0%} of the distortion before cycle {cycle.number} is still there: "
            "the redesign was not printed, or had no effect",
            f"part {cycle.part_id}",
            "check what was printed and scanned, or roll the redesign back",
        )


def _over_move(design: Design, move: Array, prints: Prints) -> float:
    """Share of `move` (n, 3) mm that the displacement shows, backwards; NaN: nothing moved."""
    areas = (design.vertex_areas * prints.supported)[:, None]
    size = float((areas * move**2).sum())
    return -float((areas * move * prints.displacement).sum()) / size if size > 0 else float("nan")


def require_not_better(ledger: Ledger, part_id: str, design: Design, printed: Printed, prints: Prints) -> None:
    """Refuse prints that are far better than what led to a redesign that nobody has released: they may be of that one.

    Raises
    ------
    CompensationRefusedError
        Half the distortion is gone.
    """
    waiting = [
        cycle
        for cycle in ledger.history(part_id, design.file_sha256)
        if cycle.state is CycleState.PROPOSED and cycle.previous == (printed.cycle.id if printed.cycle else None)
    ]
    if waiting and prints.rms_displacement < _BETTER * waiting[-1].residual_before_mm:
        last = waiting[-1]
        raise CompensationRefusedError(
            f"the distortion is {prints.rms_displacement:.3f} mm RMS, before redesign {last.id} it was "
            f"{last.residual_before_mm:.3f} mm, and nobody has released that one",
            f"part {part_id}",
            f"if this is a print of it, release redesign {last.id}; if not, reject it",
        )


def require_open(cycle: Cycle) -> None:
    """Refuse a redesign that has been decided against; the ledger knows equal ones again.

    Raises
    ------
    CycleStateError
        It was rejected, rolled back or superseded.
    """
    if cycle.state not in (CycleState.PROPOSED, CycleState.RELEASED):
        raise CycleStateError(
            f"the same redesign, {cycle.id}, was {cycle.state.value.replace('_', ' ')}"
            + (f" by {cycle.decided_by}: {cycle.reason}" if cycle.reason else ""),
            f"part {cycle.part_id}",
            "scan another print, or change the settings",
        )


def require_file(cycle: Cycle) -> None:
    """Refuse to release a proposed redesign whose file is not the one that was proposed.

    Raises
    ------
    CycleStateError
        The file is gone or has been changed.
    """
    path = Path(cycle.stl_path)
    if cycle.state is not CycleState.PROPOSED:
        return
    if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != cycle.stl_sha256:
        raise CycleStateError(
            "the file is gone, or not the one that was proposed", cycle.stl_path, "make the redesign again"
        )


def require_better(printed: Printed, prints: Prints) -> None:
    """Refuse to go on from a redesign whose prints are more distorted than those before.

    Raises
    ------
    WorseReprintError
        By more than a fifth, and than two standard errors: so much prints differ by themselves.
    """
    if printed.cycle is None:
        return
    residual, error = prints.rms_displacement, np.nan_to_num(prints.rms_standard_error)
    before = printed.cycle.residual_before_mm
    if residual > max(_WORSE * before, before + _WORSE_ERRORS * error):
        raise WorseReprintError(
            f"the distortion is {residual:.3f} mm RMS, before cycle {printed.cycle.number} it was {before:.3f} mm",
            f"part {printed.cycle.part_id}",
            "roll the redesign back",
        )


def is_settled(redesign: Redesign, previous: Array) -> bool:
    """Whether the redesign changes what was printed by less than the standard error: there is nothing left to do."""
    areas = redesign.design.vertex_areas * redesign.prints.supported
    change = np.sqrt(np.average(((redesign.vertices - previous) ** 2).sum(axis=1), weights=areas))
    return bool(change <= np.nan_to_num(redesign.prints.rms_standard_error))


def proposal(
    part_id: str,
    printed: Printed,
    checked: Checked,
    settings: Settings,
    stl_path: str,
    stl_sha256: str,
    inputs: Sequence[ScanReference],
) -> Proposal:
    """What the ledger is told of a redesign; its settings are those given, with the redesign's own gain."""
    redesign = checked.redesign
    return Proposal(
        part_id=part_id,
        design_sha256=redesign.design.file_sha256,
        previous=None if printed.cycle is None else printed.cycle.id,
        gain=redesign.gain,
        lookup=settings.compensation.lookup,
        vertices=redesign.vertices.astype(np.float32).astype(np.float64),  # as in the STL, which is what is printed
        stl_path=stl_path,
        stl_sha256=stl_sha256,
        inputs=inputs,
        settings=settings.replace({"compensation.gain": redesign.gain}),
        software_version=__version__,
        residual_before_mm=redesign.prints.rms_displacement,
        predicted_residual_mm=redesign.predicted_residual,
        distortion_over_move=_over_move(redesign.design, redesign.vertices - printed.vertices, redesign.prints),
        checks=checked.checks,
    )
