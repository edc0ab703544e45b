"""The next step of a part's cycles: whether the reprint is better, and the redesigns that follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mdf_core import __version__
from mdf_core.checks import Check, check_redesign, told
from mdf_core.compensation import Redesign, compensate
from mdf_core.errors import CompensationRefusedError, ReleaseRefusedError, WorseReprintError
from mdf_core.geometry import Array, Design
from mdf_core.ledger import Cycle, Ledger, Proposal, ScanReference
from mdf_core.prints import MeasuredField, Prints
from mdf_core.regions import Region, fixed_vertices
from mdf_core.settings import Settings

_WORSE, _WORSE_ERRORS = 1.2, 2.0  # times the residual before, and standard errors: what prints differ by anyway
_SAME = (0.5, 1.5)  # of the distortion before: less is a success, more is worse


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
    """
    cycle = ledger.current(part_id, design.file_sha256)
    if cycle is None:
        return Printed(None, design.vertices, design.vertices)
    before = design.vertices if cycle.previous is None else ledger.vertices(cycle.previous)
    return Printed(cycle, ledger.vertices(cycle.id), before)


def redesigns(
    design: Design,
    measured: Sequence[MeasuredField],
    settings: Settings,
    regions: Sequence[Region] = (),
    previous: Array | None = None,
    gains: Sequence[float] = (),
) -> tuple[Checked, ...]:
    """A checked redesign for every gain.

    Parameters
    ----------
    design, measured, settings, regions, previous
        As of `compensate`.
    gains : sequence of float, optional
        Without any that of the settings.

    Raises
    ------
    NoInspectionError, DesignMismatchError, CompensationRefusedError
        As `compensate`.
    """
    fixed = fixed_vertices(regions, len(design.vertices))
    found = []
    for gain in gains or (settings.compensation.gain,):
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
            "check that the scan shows this part and nothing else",
        )


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
        About as much of it is still there.

    Notes
    -----
    A print of the mesh before shows minus the last move over its gain.
    """
    if printed.cycle is None:
        return
    move = printed.vertices - printed.before
    areas = (design.vertex_areas * prints.supported)[:, None]
    size = float((areas * move**2).sum())
    same = -printed.cycle.gain * float((areas * move * prints.displacement).sum()) / size if size > 0 else 0.0
    if _SAME[0] < same < _SAME[1]:
        raise WorseReprintError(
            f"{same:.0%} of the distortion before cycle {printed.cycle.number} is still there: the redesign was not "
            "printed, or had no effect",
            f"part {printed.cycle.part_id}",
            "check what was printed and scanned, or roll the redesign back",
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
    """What the ledger is told of a redesign."""
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
        settings=settings,
        software_version=__version__,
        residual_before_mm=redesign.prints.rms_displacement,
        predicted_residual_mm=redesign.predicted_residual,
        checks=checked.checks,
    )
