"""Shared memory that DDS leaves behind when its process is killed: half a MiB each time, for ever."""

from __future__ import annotations

import fcntl
import os
import re
import time
from contextlib import suppress
from pathlib import Path

_FOLDER = Path("/dev/shm")
_LOCK_FILE = re.compile(r"fastrtps_[0-9a-f]{16}_el")
_YOUNG_SECONDS = 10.0  # its owner may be about to lock it


def discard_abandoned_segments() -> None:
    """Remove the segments of Fast DDS whose owner is gone: nobody holds the lock beside them any more.

    What belongs to other users stays.
    """
    if not _FOLDER.is_dir():
        return
    for path in _FOLDER.iterdir():
        if _LOCK_FILE.fullmatch(path.name):
            with suppress(OSError):  # in use, or somebody else's, or just gone
                _discard(path)


def _discard(lock_file: Path) -> None:
    if time.time() - lock_file.stat().st_mtime < _YOUNG_SECONDS:
        return
    descriptor = os.open(lock_file, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        lock_file.with_name(lock_file.name.removesuffix("_el")).unlink(missing_ok=True)
        lock_file.unlink()
    finally:
        os.close(descriptor)
