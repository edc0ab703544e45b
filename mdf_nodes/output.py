"""Where a cell's results lie: one folder for each job, named safely, and never written over."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path


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
