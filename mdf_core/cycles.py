"""The next step of a part's cycles: the redesigns that follow from its prints, and what the ledger is told of them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mdf_core import __version__
from mdf_core.averages import rms_length, weighted_rms
from mdf_core.check_result import Check, describe_failures
from mdf_core.checks import check_redesign
from mdf_core.compensation import Redesign, compensate
from mdf_core.errors import CompensationRefusedError, CycleStateError, ReleaseRefusedError
from mdf_core.estimate import Estimate
from mdf_core.geometry import Array, Design
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import Cycle, CycleState, Proposal, ScanReference
from mdf_core.mesh_io import stl_coordinates
from mdf_core.printed import Printed, distortion_over_move
from mdf_core.prints import MeasuredField
from mdf_core.regions import Region, fixed_vertices
from mdf_core.settings import Settings

NOTHING_LEFT = "nothing is left that is larger than its standard error"
"""Why no cycle follows."""

_REPRINTED, _MEASURED = 0.5, 1.5  # times the standard error, and that of measuring alone, which a reprint may be off


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
        return describe_failures(self.checks)

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


def redesigns(
    design: Design,
    measured: Sequence[MeasuredField],
    settings: Settings,
    regions: Sequence[Region] = (),
    previous: Array | Estimate | None = None,
    gains: Sequence[float] = (),
    before_each: Callable[[], object] = lambda: None,
) -> tuple[Checked, ...]:
    """A checked redesign for every gain.

    Parameters
    ----------
    design, measured, settings, regions, previous
        As of `compensate`.
    gains : sequence of float, optional
        Without any that of the settings.
    before_each : callable, optional
        Called before each of them; an exception it raises stops the work.

    Raises
    ------
    NoInspectionError, DesignMismatchError, CompensationRefusedError
        As `compensate`.
    """
    fixed = fixed_vertices(regions, len(design.vertices))
    found = []
    for gain in gains or (settings.compensation.gain,):
        before_each()
        with_gain = settings.replace({"compensation.gain": gain})
        redesign = compensate(design, measured, with_gain, regions, previous)
        found.append(Checked(redesign, check_redesign(design, redesign.vertices, fixed, settings.release)))
    return tuple(found)


def next_redesigns(
    printed: Printed,
    measured: Sequence[MeasuredField],
    settings: Settings,
    regions: Sequence[Region] = (),
    gains: Sequence[float] = (),
    before_each: Callable[[], object] = lambda: None,
) -> tuple[Checked, ...]:
    """The redesigns that go on from what was printed, as `redesigns`; none: nothing is left to do."""
    found = redesigns(printed.design, measured, settings, regions, printed.estimate, gains, before_each)
    # A region that was fixed since has to go back to nominal, however little is left.
    fixed = fixed_vertices(regions, len(printed.design.vertices))
    now, nominal = (stl_coordinates(each[fixed]) for each in (printed.estimate.vertices, printed.design.vertices))
    is_settled = np.array_equal(now, nominal) and all(_is_settled(each.redesign, printed.estimate) for each in found)
    return () if is_settled else found


def _is_settled(redesign: Redesign, printed: Estimate) -> bool:
    """Whether what is left to change is below its standard error.

    Once there are prints of a redesign every further one makes it better: then it is half of the standard error, or
    what measuring alone explains.
    """
    design, evidence, prints = redesign.design, redesign.estimate.evidence, redesign.prints
    areas = design.vertex_areas * prints.supported
    change = rms_length(redesign.share[:, None] * (evidence.wanted - printed.vertices), areas)
    limit = redesign.rms_standard_error
    if printed.evidence.is_known.any():
        measuring = weighted_rms(evidence.error**2, areas * evidence.is_known)
        limit = max(_REPRINTED * limit, _MEASURED * measuring)
    return redesign.lasting == 0.0 and bool(change <= np.nan_to_num(limit))


def propose_all(
    ledger: Ledger,
    printed: Printed,
    found: Sequence[Checked],
    settings: Settings,
    scans: Sequence[ScanReference],
    stl_paths: Sequence[str],
) -> tuple[Cycle, ...]:
    """Tell the ledger of redesigns; those that failed a check are rejected at once.

    Parameters
    ----------
    ledger : Ledger
    printed : Printed
    found : sequence of Checked
        Of `next_redesigns`.
    settings : Settings
        What they were made with; the gain is each redesign's own.
    scans : sequence of ScanReference
        What they were made from.
    stl_paths : sequence of str
        Where the STL of each lies; of one that failed a check, would lie.

    Returns
    -------
    tuple of Cycle
        The cycle of an equal redesign that is known already, with the file given here if its own has gone.

    Raises
    ------
    CycleStateError
        Something else is printed by now.
    """
    cycles = []
    for checked, stl_path in zip(found, stl_paths, strict=True):
        cycle = ledger.propose(_proposal(printed, checked, settings, stl_path, scans), checked.failures)
        if checked.passed and not has_its_file(cycle):
            cycle = ledger.note_file(cycle.id, stl_path)
        cycles.append(cycle)
    return tuple(cycles)


def _proposal(
    printed: Printed, checked: Checked, settings: Settings, stl_path: str, inputs: Sequence[ScanReference]
) -> Proposal:
    redesign = checked.redesign
    return Proposal(
        part_id=printed.part_id,
        design_sha256=redesign.design.file_sha256,
        previous=printed.cycle_id,
        gain=redesign.gain,
        lookup=settings.compensation.lookup,
        vertices=stl_coordinates(redesign.vertices),  # as printed
        evidence=redesign.estimate.evidence,
        stl_path=stl_path,
        stl_sha256=hashlib.sha256(redesign.stl()).hexdigest(),
        inputs=inputs,
        settings=settings.replace({"compensation.gain": redesign.gain}),
        software_version=__version__,
        residual_before_mm=redesign.prints.rms_displacement,
        predicted_residual_mm=redesign.predicted_residual,
        distortion_over_move=distortion_over_move(
            redesign.design, redesign.vertices - printed.estimate.vertices, redesign.prints
        ),
        checks=checked.checks,
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
    if cycle.state is CycleState.PROPOSED and not has_its_file(cycle):
        raise CycleStateError(
            "the file is gone, or not the one that was proposed", cycle.stl_path, "make the redesign again"
        )


def has_its_file(cycle: Cycle) -> bool:
    """Whether the file of a redesign is there, and the one that was proposed."""
    try:
        content = Path(cycle.stl_path).read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content).hexdigest() == cycle.stl_sha256
