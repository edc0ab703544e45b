"""``mdf repeat``: make a redesign again from its record, and compare it to the byte."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

from mdf_core.errors import CompensationRefusedError, InvalidSettingError, OutputFolderError
from mdf_core.files import require_writable
from mdf_core.redesign_task import RedesignTask, finish, redesign
from mdf_core.settings import Settings


def add_repeat(commands: Any) -> None:
    """The command ``repeat``."""
    repeat = commands.add_parser("repeat", help="make a redesign again from its record, and compare it to the byte")
    repeat.add_argument("record", metavar="RECORD", type=Path, help="record.json that compensate wrote")
    repeat.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    repeat.set_defaults(run=_repeat)


def _repeat(options: argparse.Namespace) -> None:
    from mdf_core.record import read_record, require_entries, require_removable

    require_writable(options.out)
    entries = read_record(options.record)
    _require_elsewhere(options.record, options.out)
    require_removable(options.out)
    with require_entries(options.record):
        task, recorded, software = _recorded_task(entries), _recorded_hashes(entries), entries["software"]
    outcome = redesign(task, options.out)
    finish(options.out, outcome)
    for wanted, checked in zip(recorded, outcome.checked, strict=True):
        found = hashlib.sha256(checked.redesign.stl()).hexdigest()
        if found != wanted:
            raise CompensationRefusedError(
                f"the redesign with gain {checked.redesign.gain:g} has other bytes: sha256 {found[:8]}, recorded "
                f"{wanted[:8]}",
                str(options.record),
                f"compare the versions: recorded {software}",
            )
    print("the same bytes as recorded")


def _require_elsewhere(record: Path, folder: Path) -> None:
    """Refuse the folder of the record: what it has to be compared with would be written over first."""
    # By name and behind links; a folder that is still to be made holds nothing.
    if folder.exists() and any(folder.samefile(path.parent) for path in (record, record.resolve())):
        raise OutputFolderError(
            f"holds {record.name}, whose redesign would be written over",
            str(folder),
            "choose another folder for --out",
        )


def _recorded_hashes(entries: dict[str, Any]) -> list[str]:
    """SHA-256 of the STL of each recorded redesign."""
    hashes = [str(one["stl_sha256"]) for one in entries["redesigns"]]
    if not hashes:
        raise ValueError("no redesign")
    return hashes


def _recorded_task(entries: dict[str, Any]) -> RedesignTask:
    """What a record says was done; files that have been changed since are refused."""
    named = [entries["design"], *entries["scans"]]
    named += [entries[name] for name in ("regions", "previous") if entries[name] is not None]
    named += entries["regions"]["meshes"] if entries["regions"] is not None else []
    for one in named:
        try:
            found = hashlib.sha256(Path(one["path"]).read_bytes()).hexdigest()
        except OSError as error:
            raise InvalidSettingError(f"cannot be read: {error.strerror}", one["path"], "put it back") from error
        if found != one["sha256"]:
            raise InvalidSettingError("is not the file that was recorded", one["path"], "put that one back")
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in entries["settings"].items()}
    return RedesignTask(
        design=Path(entries["design"]["path"]),
        design_unit=entries["design"]["unit"],
        scans=tuple(Path(scan["path"]) for scan in entries["scans"]),
        scan_unit=entries["scans"][0]["unit"],
        settings=Settings().replace(settings),
        regions=None if entries["regions"] is None else Path(entries["regions"]["path"]),
        previous=None if entries["previous"] is None else Path(entries["previous"]["path"]),
        gains=tuple(float(one["gain"]) for one in entries["redesigns"]),
        formats=("stl",),
    )
