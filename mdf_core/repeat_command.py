"""``mdf repeat``: make a redesign again from its record, and compare it to the byte."""

# Imports that take long are made where they are needed, so that `mdf --help` and a wrong argument answer at once.

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

from mdf_core.errors import CompensationRefusedError, InvalidSettingError
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
    from mdf_core.record import read_record

    require_writable(options.out)
    entries = read_record(options.record)
    outcome = redesign(_task_of(entries, options.record), options.out)
    finish(options.out, outcome)
    for wanted, checked in zip(entries["redesigns"], outcome.checked, strict=True):
        found = hashlib.sha256(checked.redesign.stl()).hexdigest()
        if found != wanted["stl_sha256"]:
            raise CompensationRefusedError(
                f"the redesign with gain {wanted['gain']:g} has other bytes: sha256 {found[:8]}, recorded "
                f"{wanted['stl_sha256'][:8]}",
                str(options.record),
                f"compare the versions: recorded {entries['software']}",
            )
    print("the same bytes as recorded")


def _task_of(entries: dict[str, Any], path: Path) -> RedesignTask:
    """What a record says was done; files that have been changed since are refused."""
    try:
        return _recorded_task(entries)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InvalidSettingError(
            f"does not hold what a record holds: {error!r}", str(path), "give the record.json that compensate wrote"
        ) from error


def _recorded_task(entries: dict[str, Any]) -> RedesignTask:
    from mdf_core.record import source

    named = [entries["design"], *entries["scans"]]
    named += [entries[name] for name in ("regions", "previous") if entries[name] is not None]
    named += entries["regions"]["meshes"] if entries["regions"] is not None else []
    for one in named:
        try:
            found = source(one["path"]).sha256
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
