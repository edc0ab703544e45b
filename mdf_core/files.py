"""Files that appear complete or not at all, and whether a folder takes them."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from mdf_core.errors import OutputFolderError


def require_writable(folder: Path) -> None:
    """Refuse before the work what could not be written after it; makes nothing.

    Raises
    ------
    OutputFolderError
        The folder cannot be made or written to.
    """
    remedy = "choose a writable folder"
    # Also where one may not look into a folder.
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.access(path, os.F_OK))
    if not existing.is_dir():
        raise OutputFolderError(f"{existing} is no folder", str(folder), remedy)
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputFolderError(f"no permission to write in {existing}", str(folder), remedy)


def write_atomically(path: str | Path, content: bytes) -> str:
    """Write `content` to `path` through a temporary file beside it, fsync and rename; missing folders are made.

    Returns
    -------
    str
        SHA-256 of the content.

    Raises
    ------
    OutputFolderError
        The folder cannot be made or written, or the disk is full; nothing is left behind.
    """
    path = Path(path)
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            # mkstemp makes private files; results are for others to read.
            os.fchmod(file.fileno(), 0o644)
        Path(temporary).replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
        raise OutputFolderError(
            f"cannot write {path.name}: {error.strerror}", str(path.parent), "choose a writable folder with free space"
        ) from error
    return hashlib.sha256(content).hexdigest()


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
