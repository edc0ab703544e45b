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
    vertices : (n, 3) float64, mm
    share : (n,) float64
        How much of its shift each vertex was given: 1 in full; less where the shift is hardly larger than its standard
        error, the scans do not reach, or a fixed region is near; 0: it stays where it was.
    prints : Prints
        The systematic and the random part of what was measured.
    gain : float
        Share of the shift that was compensated.
    predicted_residual : float, mm
        RMS displacement that the next print is expected to have: what is left uncompensated and the standard error,
        over the supported surface; without the variation from print to print. NaN where that is not known.
    """

    design: Design
    vertices: Array
    share: Array
    prints: Prints
    gain: float
    predicted_residual: float

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
    previous: Array | None = None,
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
    previous : (n, 3) float64, mm, optional
        Vertices of the redesign that was printed; without it the design was.

    Returns
    -------
    Redesign
        Unsupported vertices stay where they were, with a smooth transition of `compensation.blend_mm`.

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
    of the redesign lacks: C_(k+1) = C_k + gain · shift.
    """
    settings = settings or Settings()
    prints = combine_prints(design, measured)
    start = design.vertices if previous is None else previous
    if start.shape != design.vertices.shape:
        raise DesignMismatchError(
            f"a previous redesign of {len(start)} vertices for a design of {len(design.vertices)}",
            design.path or "design",
            "give the redesign of this design that was printed",
        )
    if not prints.supported.any():
        raise CompensationRefusedError("the scan supports no vertex", "compensation", "scan the part again")
    wanted = settings.compensation
    shift = prints.inverse_displacement if wanted.lookup == "spatial" else -prints.displacement
    share = _evidence_share(design.vertices, prints.supported, wanted.blend_mm)
    share *= _significant_share(prints, wanted.significance)
    free = free_share(regions, design.vertices)
    moves = (start - design.vertices) + wanted.gain * share[:, None] * shift
    vertices = np.where(free[:, None] > 0, design.vertices + free[:, None] * moves, design.vertices)
    share *= free
    residual = _predicted_residual(design, prints, wanted.gain * share)
    return Redesign(design, vertices, share, prints, wanted.gain, residual)


def _evidence_share(vertices: Array, supported: NDArray[np.bool_], blend: float) -> Array:
    """1 at supported vertices, falling smoothly to 0 at `blend` mm from the nearest one."""
    share = supported.astype(np.float64)
    if blend > 0 and not supported.all():
        distances, _ = KDTree(vertices[supported]).query(vertices[~supported], workers=-1)
        share[~supported] = smooth_step(1.0 - np.asarray(distances) / blend)
    return share


def _significant_share(prints: Prints, significance: float) -> Array:
    """0 where the systematic part is below its standard error, 1 from twice that on; at a `significance` of 1."""
    sizes, errors = np.linalg.norm(prints.displacement, axis=1), significance * prints.standard_error
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


def _predicted_residual(design: Design, prints: Prints, compensated: Array) -> float:
    left = ((1.0 - compensated) ** 2) * (prints.displacement**2).sum(axis=1)
    squares = left + (compensated * prints.standard_error) ** 2
    return weighted_rms(squares, design.vertex_areas * prints.supported)
