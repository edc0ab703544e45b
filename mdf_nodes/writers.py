"""Whether a file is complete as far as the kernel knows."""

from __future__ import annotations

import fcntl
import os
import signal
from pathlib import Path


def is_being_written(path: Path) -> bool:
    """Whether a process of this machine has the file open for writing; false also where the kernel cannot tell.

    It cannot on some network file systems, nor of files that belong to another user, unless this one is root.

    Notes
    -----
    A read lease (fcntl, F_SETLEASE) is refused while there is a writer.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        # A writer that comes in this moment is told of by a signal, and that of the default would end the process.
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False
