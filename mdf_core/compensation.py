"""From measured displacement to a redesign that counters it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.errors import CompensationRefusedError, DesignMismatchError, NoInspectionError
from mdf_core.files import write_atomically
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import stl_bytes
from mdf_core.settings import Settings


class MeasuredField(Protocol):
    """What compensation needs of an inspection; see `Inspection`. All in mm, one entry per design vertex."""

    @property
    def displacement(self) -> Array: ...  # noqa: D102
    @property
    def inverse_displacement(self) -> Array: ...  # noqa: D102
    @property
    def supported(self) -> NDArray[np.bool_]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class Redesign:
    """The design with its vertices moved; faces and vertex order are the design's.

    Attributes
    ----------
    design : Design
    vertices : (n, 3) float64, mm
    compensated : (n,) bool
        False where the vertex stays at nominal because no scan supports it.
    """

    design: Design
    vertices: Array
    compensated: NDArray[np.bool_]

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


def compensate(design: Design, measured: Sequence[MeasuredField], settings: Settings | None = None) -> Redesign:
    """Redesign a part against its measured displacement.

    Parameters
    ----------
    design : Design
    measured : sequence
        Inspections of prints of this design; where several support a vertex their mean counts.
    settings : Settings, optional
        `compensation.lookup` spatial moves vertex X by gain · u(X), u the inverse displacement found at X: exact where
        the distortion is a field in the printer's space. material moves it by -gain · d(X), d the displacement of the
        vertex itself: exact where the distortion sticks to the part.

    Returns
    -------
    Redesign
        Unsupported vertices stay at nominal, with a smooth transition of `compensation.blend_mm`.

    Raises
    ------
    NoInspectionError
        `measured` is empty.
    DesignMismatchError
        A field has another number of vertices than the design.
    CompensationRefusedError
        No vertex is supported.

    Notes
    -----
    Source: paper section 3.3; u = Y' - y already is the inverse, it is added once.
    """
    settings = settings or Settings()
    if not measured:
        raise NoInspectionError("nothing to compensate", "compensation", "inspect a scan first")
    for field in measured:
        if field.displacement.shape != design.vertices.shape:
            raise DesignMismatchError(
                f"a displacement of {len(field.displacement)} vertices for a design of {len(design.vertices)}",
                design.path or "design",
                "inspect a scan of this design",
            )
    supports = np.stack([field.supported for field in measured])
    supported: NDArray[np.bool_] = np.asarray(supports.any(axis=0))
    if not supported.any():
        raise CompensationRefusedError("the scan supports no vertex", "compensation", "scan the part again")
    spatial = settings.compensation.lookup == "spatial"
    moves = np.stack([field.inverse_displacement if spatial else -field.displacement for field in measured])
    # Extrapolations count only where there is nothing better, and only within the blend.
    weights = np.where(supported, supports, True).astype(np.float64)[:, :, None]
    mean = (weights * moves).sum(axis=0) / weights.sum(axis=0)
    share = _evidence_share(design.vertices, supported, settings.compensation.blend_mm)
    vertices = design.vertices + settings.compensation.gain * share[:, None] * mean
    return Redesign(design, vertices, share > 0)


def _evidence_share(vertices: Array, supported: NDArray[np.bool_], blend: float) -> Array:
    """1 at supported vertices, falling smoothly to 0 at `blend` mm from the nearest one."""
    share = supported.astype(np.float64)
    if blend > 0 and not supported.all():
        distances, _ = KDTree(vertices[supported]).query(vertices[~supported], workers=-1)
        rest = np.clip(1.0 - distances / blend, 0.0, 1.0)
        share[~supported] = rest**2 * (3.0 - 2.0 * rest)
    return share
