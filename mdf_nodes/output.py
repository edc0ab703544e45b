"""Where a cell's results lie: one folder for each job, named safely, and never written over."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

_MOST_NAME_BYTES = 200  # of the 255 that file systems take: some are left for a number


def folder_name(text: str) -> str:
    """Text from outside as the name of one folder; of one too long the end, which tells jobs apart."""
    name = re.sub(r"[^\w.+-]+", "_", text).encode()[-_MOST_NAME_BYTES:]
    return name.decode(errors="ignore").lstrip(".")


def free_folder(folder: Path, files: Mapping[str, bytes]) -> Path:
    """`folder`, or one numbered beside it, where these files lie already or overwrite no others."""
    found, number = folder, 1
    while any(_lies_otherwise(found / name, content) for name, content in files.items()):
        number += 1
        found = folder.with_name(f"{folder.name}-{number}")
    return found


def _lies_otherwise(path: Path, content: bytes) -> bool:
    return path.exists() and path.read_bytes() != content
