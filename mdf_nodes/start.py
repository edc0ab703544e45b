"""The commands of the nodes, each of which is the `main` of a module of this package.

Libraries swallow the KeyboardInterrupt that comes while they are imported, and the node would go on. So Ctrl-C ends the
process outright until the node listens to it.
"""

from __future__ import annotations

import signal
from functools import partial
from importlib import import_module


def _run(module: str) -> int:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    status: int = import_module(f"mdf_nodes.{module}").main()
    return status


scan_ingest = partial(_run, "scan_ingest")
registration = partial(_run, "registration")
compensation = partial(_run, "compensation")
virtual_scanner = partial(_run, "virtual_scanner")
bag_recorder = partial(_run, "bag_recorder")
bag_player = partial(_run, "bag_player")
cell = partial(_run, "cell")
