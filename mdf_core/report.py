"""What an inspection and a redesign leave behind: numbers for machines, with all that is needed to repeat them."""

from __future__ import annotations

import hashlib
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mdf_core import __version__
from mdf_core.compensation import Redesign
from mdf_core.files import write_together
from mdf_core.inspection import Inspection

REPORT_FILE = "report.json"
INSPECTION_FILE = "inspection.npz"


def report(inspection: Inspection, redesign: Redesign | None = None, **more: Any) -> dict[str, Any]:
    """Everything about an inspection, and the redesign made from it, except the dense fields.

    Parameters
    ----------
    inspection : Inspection
    redesign : Redesign, optional
    **more
        Further entries, such as where the scan came from; JSON-able.

    Returns
    -------
    dict
        JSON-able: numbers that do not exist are None, never NaN. Keys of lengths end in ``_mm``. The same inputs and
        settings give the same entries but for ``stage_seconds``, which holds wall times.
    """
    verdict, reasons = inspection.verdict
    design = inspection.design
    entries: dict[str, Any] = {
        "software_version": __version__,
        "method": inspection.settings.method,
        "verdict": verdict.value,
        "reasons": list(reasons),
        "rms_displacement_mm": inspection.rms_displacement,
        "p95_displacement_mm": inspection.p95_displacement,
        "max_displacement_mm": inspection.max_displacement,
        "rms_deviation_mm": inspection.deviation.rms,
        "p95_deviation_mm": inspection.deviation.p95,
        "max_deviation_mm": inspection.deviation.max,
        "profile_mm": inspection.deviation.profile,
        "coverage": inspection.coverage,
        "regions": [
            {
                "name": region.name,
                "tolerance_mm": region.tolerance,
                "max_displacement_mm": region.max_displacement,
                "coverage": region.coverage,
                "verdict": region.verdict.value,
                "reasons": list(region.reasons),
            }
            for region in inspection.region_verdicts
        ],
        "residual_scale_mm": inspection.residual_scale,
        "mesh_error_mm": inspection.mesh_error,
        "outlier_share": inspection.outlier_share,
        "points": len(inspection.deviation.points),
        "pose_design_scan_mm": inspection.pose.tolist(),
        "pose_ambiguous": inspection.pose_ambiguous,
        "alternative_poses_design_scan_mm": [pose.tolist() for pose in inspection.alternative_poses],
        "iterations": inspection.iterations,
        "stop_reason": inspection.stop_reason,
        "design": {
            "path": design.path,
            "sha256": design.file_sha256,
            "vertices": len(design.vertices),
            "faces": len(design.faces),
        },
        "scan_sha256": inspection.scan_sha256,
        "settings": inspection.settings.flat(),
        "settings_sha256": inspection.settings.sha256(),
    }
    if redesign is not None:
        entries["redesign"] = {
            "sha256": hashlib.sha256(redesign.stl()).hexdigest(),
            "max_move_mm": redesign.max_move,
            "compensated_share": float(redesign.compensated.mean()),
        }
    entries |= more
    entries["stage_seconds"] = inspection.stage_seconds
    plain = _plain(entries)
    assert isinstance(plain, dict)
    return plain


def save_inspection(folder: str | Path, inspection: Inspection, entries: dict[str, Any]) -> None:
    """Write ``inspection.npz`` and ``report.json`` into `folder`, both complete or none.

    Parameters
    ----------
    folder : path
        Made if missing.
    inspection : Inspection
        Its fields go to ``inspection.npz``: vertices, faces, displacement, inverse_displacement, std, supported
        (mm; the same inputs and settings give the same bytes).
    entries : dict
        Of `report`.

    Raises
    ------
    OutputFolderError
        The folder cannot be made or written.
    """
    fields = io.BytesIO()
    np.savez(
        fields,
        vertices=inspection.design.vertices,
        faces=inspection.design.faces,
        displacement=inspection.displacement,
        inverse_displacement=inspection.inverse_displacement,
        std=inspection.std,
        supported=inspection.supported,
    )
    write_together(Path(folder), {INSPECTION_FILE: fields.getvalue(), REPORT_FILE: json_bytes(entries)})


def json_bytes(entries: dict[str, Any]) -> bytes:
    """Entries as the text of a JSON file; numbers that do not exist are null."""
    return (json.dumps(_plain(entries), indent=2, allow_nan=False) + "\n").encode()


def _plain(value: Any) -> Any:
    """`value` as JSON knows it; NaN and infinities become None."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
