"""The recorded bags are played in a ROS domain of their own."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "nodes"))

from ros_fixtures import domain, graph, start

__all__ = ["domain", "graph", "start"]
