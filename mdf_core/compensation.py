"""From measured displacement to a redesign that counters it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.averages import weighted_rms
from mdf_core.errors import CompensationRefusedError, DesignMismatchError
from mdf_core.estimate import Estimate, update
from mdf_core.files import write_atomically
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import stl_bytes
from mdf_core.prints import MeasuredField, Prints, combine_prints
from mdf_core.regions import Region, free_share, smooth_step
from mdf_core.settings import Settings


@dataclass(frozen=True, eq=False)
class Redesign:
    """The design with its vertices moved; faces and vertex order are the design's.

    Attributes
    ----------
    design : Design
    estimate : Estimate
        Its vertices, and what all prints so far say of them, for the cycle after it.
    share : (n,) float64
        How much of its shift each vertex was given: 1 in full; less where the shift is hardly larger than its standard
        error, the scans do not reach, or a fixed region is near; 0: it stays where it was.
    prints : Prints
        The systematic and the random part of what was measured.
    gain : float
        Share of the shift that was compensated.
    rms_standard_error : float, mm
        Of the shift from nominal that all prints together ask for, over the supported surface; NaN: not known.
    lasting : float, mm
        RMS length of what the prints show that chance does not explain: the last move fell short, or the printer has
        changed; 0: nothing.
    predicted_residual : float, mm
        RMS displacement that the next print is expected to have: what is left uncompensated and the standard error,
        over the supported surface; without the variation from print to print. NaN where that is not known.
    """

    design: Design
    estimate: Estimate
    share: Array
    prints: Prints
    gain: float
    rms_standard_error: float
    lasting: float
    predicted_residual: float

    @property
    def vertices(self) -> Array:
        """Where they were moved to, (n, 3) float64, mm."""
        return self.estimate.vertices

    @property
    def compensated(self) -> NDArray[np.bool_]:
        """Whether the vertex was given some of its shift, (n,)."""
        return self.share > 0

    @property
    def max_move(self) -> float:
        """Largest move of a vertex, mm."""
        return float(np.linalg.norm(self.vertices - self.design.vertices, axis=1).max())

    def stl(self) -> bytes:
        """Binary STL in mm; the same redesign gives the same bytes."""
        return stl_bytes(self.vertices, self.design.faces)

    def save(self, path: str | Path) -> str:
        """Write the STL, complete or not at all.

        Returns
        -------
        str
            SHA-256 of the file.

        Raises
        ------
        OutputFolderError
            The folder cannot be written.
        """
        return write_atomically(path, self.stl())


def compensate(
    design: Design,
    measured: Sequence[MeasuredField],
    settings: Settings | None = None,
    regions: Sequence[Region] = (),
    previous: Array | Estimate | None = None,
) -> Redesign:
    """Redesign a part against the measured displacement of its prints.

    Parameters
    ----------
    design : Design
    measured : sequence
        Inspections against this design, of prints of one and the same mesh: the design, or `previous`.
    settings : Settings, optional
        `compensation.lookup` spatial moves vertex X by gain · u(X), u the inverse displacement found at X: exact where
        the distortion is a field in the printer's space. material moves it by -gain · d(X), d the displacement of the
        vertex itself: exact where the distortion sticks to the part. The systematic part of all prints counts, and at
        each vertex only as far as it is larger than its standard error (`compensation.significance`).
    regions : sequence of Region, optional
        Fixed ones stay exactly at nominal.
    previous : Estimate or (n, 3) float64, mm, optional
        `Redesign.estimate` of the redesign that was printed; without it the design was. Of its vertices alone nothing
        else is known: then the new prints count in full, and those before them not at all.

    Returns
    -------
    Redesign
        Unsupported vertices stay where they were, with a smooth transition of `compensation.blend_mm`. A vertex leaves
        nominal only by a significant shift; where nothing is known of `previous`, so it leaves where that was.

    Raises
    ------
    NoInspectionError
        `measured` is empty.
    DesignMismatchError
        A field, or `previous`, has another number of vertices than the design.
    CompensationRefusedError
        No vertex is supported, or no shift is known to be larger than its standard error.

    Notes
    -----
    Source: paper section 3.3; u = Y' - y already is the inverse, it is added once. A further cycle adds what the print
    of the redesign lacks: C_(k+1) = C_k + gain · shift, to where the prints of all cycles together want the vertices
    (`estimate.update`).
    """
    settings = settings or Settings()
    prints = combine_prints(design, measured)
    previous = design.vertices if previous is None else previous
    printed = previous if isinstance(previous, Estimate) else Estimate.unknown(previous)
    if printed.vertices.shape != design.vertices.shape:
        raise DesignMismatchError(
            f"a previous redesign of {len(printed.vertices)} vertices for a design of {len(design.vertices)}",
            design.path or "design",
            "give the redesign of this design that was printed",
        )
    if not prints.supported.any():
        raise CompensationRefusedError("the scan supports no vertex", "compensation", "scan the part again")
    wanted = settings.compensation
    shift = prints.inverse_displacement if wanted.lookup == "spatial" else -prints.displacement
    found = update(printed, prints, printed.vertices + shift, design)
    shift = found.evidence.wanted - printed.vertices
    known = printed.evidence.is_known
    moved_before = np.where(known[:, None], printed.vertices - design.vertices, 0.0)
    share = _evidence_share(design.vertices, prints.supported, wanted.blend_mm)
    share *= _significant_share(moved_before, shift, found.standard_error, prints, wanted.significance)
    free = free_share(regions, design.vertices)
    moves = (printed.vertices - design.vertices) + wanted.gain * share[:, None] * shift
    vertices = np.where(free[:, None] > 0, design.vertices + free[:, None] * moves, design.vertices)
    areas = design.vertex_areas * prints.supported
    left = ((found.evidence.wanted - vertices) ** 2).sum(axis=1)
    rests_on_prints = np.where(known, 1.0, wanted.gain * share) * free
    return Redesign(
        design=design,
        estimate=Estimate(vertices, printed.vertices, found.evidence),
        share=share * free,
        prints=prints,
        gain=wanted.gain,
        rms_standard_error=weighted_rms(found.standard_error**2, areas * np.isfinite(found.standard_error)),
        lasting=found.lasting,
        predicted_residual=weighted_rms(left + (rests_on_prints * found.standard_error) ** 2, areas),
    )


def _evidence_share(vertices: Array, supported: NDArray[np.bool_], blend: float) -> Array:
    """1 at supported vertices, falling smoothly to 0 at `blend` mm from the nearest one."""
    share = supported.astype(np.float64)
    if blend > 0 and not supported.all():
        distances, _ = KDTree(vertices[supported]).query(vertices[~supported], workers=-1)
        share[~supported] = smooth_step(1.0 - np.asarray(distances) / blend)
    return share


def _significant_share(
    moved_before: Array, shift: Array, standard_error: Array, prints: Prints, significance: float
) -> Array:
    """0 where a vertex was not moved, nor should be, by its standard error; 1 from twice that on.

    All that at a `significance` of 1.
    """
    sizes = np.maximum(*(np.linalg.norm(moves, axis=1) for moves in (moved_before, moved_before + shift)))
    errors = significance * standard_error
    if significance == 0:
        return np.ones(len(sizes))
    if np.isnan(errors[prints.supported]).all():
        raise CompensationRefusedError(
            "the standard error of the displacement is not known",
            "compensation",
            "inspect with method surface, give several prints, or set compensation.significance=0",
        )
    ratios = np.divide(sizes, errors, out=np.full(len(sizes), np.inf), where=errors > 0)
    return np.where(np.isnan(errors), 0.0, smooth_step(ratios - 1.0))
