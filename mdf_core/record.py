"""The record of a redesign: everything that is needed to judge it later and to make it again, to the byte."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mdf_core import __version__
from mdf_core.check_result import Check
from mdf_core.compensation import Redesign
from mdf_core.errors import InvalidSettingError, OutputFolderError
from mdf_core.estimate_file import estimate_fields
from mdf_core.inspection import Inspection
from mdf_core.mesh_export import ply_bytes, threemf_bytes
from mdf_core.redesign_names import PRINTED_FILE, REDESIGN_FILE, REDESIGN_STEM
from mdf_core.regions import Region
from mdf_core.settings import Settings

RECORD_FILE = "record.json"

_KIND, _VERSION = "mdf redesign record", 1
_LIBRARIES = ("numpy", "scipy", "trimesh", "libigl")
_GIVE_A_RECORD = "give the record.json that compensate wrote"
_CHOOSE_ANOTHER_FOLDER = "move it away, or choose another folder for --out"


@dataclass(frozen=True)
class Source:
    """A file that went into a redesign: where it was, its unit ("" for one that has none) and its SHA-256."""

    path: str
    unit: str
    sha256: str


def source(path: str | Path, sha256: str, unit: str = "") -> Source:
    """The file whose bytes had that SHA-256 when they were read; by now it may be another."""
    return Source(str(Path(path).absolute()), unit, sha256)


@dataclass(frozen=True)
class Sources:
    """The files that a redesign was made from.

    Attributes
    ----------
    design : Source
    scans : tuple of Source
    regions : Source, optional
    previous : Source, optional
        The redesign that was printed, STL or PLY.
    """

    design: Source
    scans: tuple[Source, ...]
    regions: Source | None = None
    previous: Source | None = None


def redesign_files(redesign: Redesign, stem: str, formats: Sequence[str]) -> dict[str, bytes]:
    """Name and content of the files of a redesign.

    Parameters
    ----------
    redesign : Redesign
    stem : str
        Name without its ending.
    formats : sequence of str
        Of `FORMATS`. STL and 3MF hold the mesh; PLY also, at each vertex: shift_x, shift_y, shift_z (mm; systematic
        displacement), standard_error, random (mm; NaN: not known), share (0: stays where it was), supported (0 or 1),
        and the fields of `estimate_fields`.
    """
    design, prints = redesign.design, redesign.prints
    files = {}
    if "stl" in formats:
        files[f"{stem}.stl"] = redesign.stl()
    if "3mf" in formats:
        files[f"{stem}.3mf"] = threemf_bytes(redesign.vertices, design.faces)
    if "ply" in formats:
        columns = dict(zip(("shift_x", "shift_y", "shift_z"), prints.displacement.T, strict=True))
        columns |= {"standard_error": prints.standard_error, "random": prints.random, "share": redesign.share}
        fields: dict[str, Any] = {name: values.astype(np.float32) for name, values in columns.items()}
        fields["supported"] = prints.supported.astype(np.uint8)
        fields |= estimate_fields(redesign.estimate)
        files[f"{stem}.ply"] = ply_bytes(redesign.vertices, design.faces, fields)
    return files


def redesign_entries(redesign: Redesign, checks: Sequence[Check], files: Mapping[str, bytes]) -> dict[str, Any]:
    """What the record says of one redesign; `files` are empty where a check failed."""
    return {
        "gain": redesign.gain,
        "released": all(check.passed for check in checks),
        "checks": [
            {"name": check.name, "passed": check.passed, "finding": check.finding, "place_mm": check.place}
            for check in checks
        ],
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
        "stl_sha256": hashlib.sha256(redesign.stl()).hexdigest(),
        "max_move_mm": redesign.max_move,
        "compensated_share": float(redesign.compensated.mean()),
        "predicted_residual_mm": redesign.predicted_residual,
    }


def record(
    sources: Sources,
    inspections: Sequence[Inspection],
    redesigns: Sequence[dict[str, Any]],
    redesign: Redesign,
    regions: Sequence[Region],
    settings: Settings,
) -> dict[str, Any]:
    """The record of redesigns that were made together, with different gains.

    Parameters
    ----------
    sources : Sources
    inspections : sequence of Inspection
        One for each scan.
    redesigns : sequence of dict
        Of `redesign_entries`, one for each gain.
    redesign : Redesign
        Any of them; what was measured is the same in all.
    regions : sequence of Region
    settings : Settings

    Returns
    -------
    dict
        JSON-able; its schema is docs/schema/record.schema.json. The same inputs and settings give the same record.
    """
    design, prints, evidence = redesign.design, redesign.prints, redesign.estimate.evidence
    areas = design.vertex_areas
    return {
        "kind": _KIND,
        "version": _VERSION,
        "software": {
            "mdf": __version__,
            "python": platform.python_version(),
            **{library: version(library) for library in _LIBRARIES},
        },
        "design": {**vars(sources.design), "vertices": len(design.vertices), "faces": len(design.faces)},
        "scans": [
            {
                **vars(scan),
                "verdict": inspection.verdict[0].value,
                "reasons": list(inspection.verdict[1]),
                "coverage": inspection.coverage,
                "residual_scale_mm": inspection.residual_scale,
            }
            for scan, inspection in zip(sources.scans, inspections, strict=True)
        ],
        "regions": None
        if sources.regions is None
        else {
            **vars(sources.regions),
            "meshes": [vars(source(region.mesh_path, region.mesh_sha256)) for region in regions if region.mesh_path],
            "regions": [
                {
                    "name": region.name,
                    "vertices": int(region.vertices.sum()),
                    "fixed": region.is_fixed,
                    "blend_mm": region.blend_mm,
                    "tolerance_mm": region.tolerance_mm,
                }
                for region in regions
            ],
        },
        "previous": None if sources.previous is None else vars(sources.previous),
        "settings": settings.flat(),
        "settings_sha256": settings.sha256(),
        "prints": {
            "count": prints.count,
            "rms_systematic_mm": prints.rms_displacement,
            "rms_standard_error_mm": prints.rms_standard_error,
            "rms_random_mm": prints.rms_random,
            "variation_mm": prints.variation,
            "supported_share": float(areas[prints.supported].sum() / areas.sum()),
        },
        "evidence": {
            "prints": round(evidence.most_prints, 3),
            "rms_standard_error_mm": redesign.rms_standard_error,
            "variation_mm": evidence.variation,
            "lasting_mm": redesign.lasting,
        },
        "redesigns": list(redesigns),
    }


def read_record(path: Path, remedy: str = _GIVE_A_RECORD) -> dict[str, Any]:
    """The entries of a record; what they hold is not looked at yet, see `require_entries`.

    Parameters
    ----------
    path : Path
    remedy : str, optional
        What the error says to do about it.

    Raises
    ------
    InvalidSettingError
        The file cannot be read, or is no record.
    """
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidSettingError(f"cannot be read: {error}", str(path), remedy) from error
    if not isinstance(entries, dict) or (entries.get("kind"), entries.get("version")) != (_KIND, _VERSION):
        raise InvalidSettingError("is no record of a redesign", str(path), remedy)
    return entries


@contextmanager
def require_entries(path: Path, remedy: str = _GIVE_A_RECORD) -> Iterator[None]:
    """Within it entries of a record are looked up; those that are not there, or are something else, are refused.

    Parameters
    ----------
    path : Path
        Of the record.
    remedy : str, optional
        What the error says to do about it.

    Raises
    ------
    InvalidSettingError
    """
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InvalidSettingError(f"does not hold what a record holds: {error!r}", str(path), remedy) from error


def require_removable(folder: Path) -> None:
    """Refuse before the work a folder from which `remove_former` could not take an earlier record after it.

    Raises
    ------
    InvalidSettingError
        What is called as a record there cannot be read, or is none.
    """
    _former_names(folder)


def remove_former(folder: Path) -> None:
    """Remove the redesigns of an earlier run and their record: beside other results they would mislead.

    Raises
    ------
    InvalidSettingError
        As `require_removable`.
    OutputFolderError
        One of them cannot be removed.
    """
    for name in (*_former_names(folder), RECORD_FILE):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputFolderError(
                f"cannot remove {name} of an earlier run: {error.strerror}", str(folder), "choose another folder"
            ) from error


def _former_names(folder: Path) -> set[str]:
    """Names of the redesigns that an earlier run may have left in a folder."""
    path = folder / RECORD_FILE
    if not path.exists():
        return {REDESIGN_FILE, PRINTED_FILE}
    entries = read_record(path, _CHOOSE_ANOTHER_FOLDER)
    with require_entries(path, _CHOOSE_ANOTHER_FOLDER):
        names = {Path(name).name for one in entries["redesigns"] for name in one["files"]}
    # Whatever a record names, only redesigns are removed.
    return {REDESIGN_FILE, PRINTED_FILE} | {name for name in names if name.startswith(REDESIGN_STEM)}
