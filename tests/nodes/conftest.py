"""Every test module runs in a ROS domain of its own, on this machine only."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from ros_fixtures import domain, graph, start

__all__ = ["domain", "graph", "start"]
