"""Where a cell's results lie: one folder for each job, named safely, and never written over."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from mdf_core.errors import OutputFolderError


def require_writable(folder: Path) -> None:
    """Refuse a folder that cannot be made or written to.

    Raises
    ------
    OutputFolderError
    """
    existing = next(each for each in (folder, *folder.parents) if each.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        raise OutputFolderError(f"cannot write to {existing}", f"output_folder {folder}", "choose a writable folder")


def folder_name(text: str) -> str:
    """Text from outside as the name of one folder."""
    return re.sub(r"[^\w.+-]+", "_", text).lstrip(".")


def free_folder(folder: Path, files: Mapping[str, bytes]) -> Path:
    """`folder`, or one numbered beside it, where these files lie already or overwrite no others."""
    found, number = folder, 1
    while any(_lies_otherwise(found / name, content) for name, content in files.items()):
        number += 1
        found = folder.with_name(f"{folder.name}-{number}")
    return found


def _lies_otherwise(path: Path, content: bytes) -> bool:
    return path.exists() and path.read_bytes() != content
