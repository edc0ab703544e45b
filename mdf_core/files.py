"""Files that appear complete or not at all, and whether a folder takes them."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping
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
    """Write `content` to `path`, complete or not at all; missing folders are made.

    Returns
    -------
    str
        SHA-256 of the content.

    Raises
    ------
    OutputFolderError
        As `write_together`.
    """
    path = Path(path)
    write_together(path.parent, {path.name: content})
    return hashlib.sha256(content).hexdigest()


def write_together(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files that belong together into a folder, which is made if missing.

    Each gets its name only when all of them are on the disk, in the order given: what says what the others are goes
    first, and nothing is ever without it.

    Parameters
    ----------
    folder : Path
    contents : mapping of str to bytes
        By name.

    Raises
    ------
    OutputFolderError
        The folder cannot be made or written, or the disk is full; what is not complete is not left behind.
    """
    temporary: dict[str, Path] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            descriptor, path = tempfile.mkstemp(prefix=f".{name}.", dir=folder)
            temporary[name] = Path(path)
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
                # mkstemp makes private files; results are for others to read.
                os.fchmod(file.fileno(), 0o644)
        for name, written in temporary.items():
            written.replace(folder / name)
            # Each by itself, so that a power cut keeps the order as well.
            _sync_folder(folder)
    except OSError as error:
        for written in temporary.values():
            written.unlink(missing_ok=True)
        told = f"cannot write {', '.join(contents)}: {error.strerror}"
        raise OutputFolderError(told, str(folder), "choose a writable folder with free space") from error


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
