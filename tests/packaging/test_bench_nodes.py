"""The benchmark of the nodes runs a real cell and tells its figures."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_cost_of_the_nodes_is_measured_and_written(tmp_path):
    page = tmp_path / "nodes.md"
    command = [sys.executable, "-m", "bench.nodes", "--points", "1000", "--repeats", "1"]
    command += ["--large", "10000", "--scans", "2", "--out", str(page)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=180, capture_output=True)
    figures = dict(re.findall(r"^\| (.*?) \| (.*?) \|$", page.read_text(), flags=re.MULTILINE))
    nodes, library = map(float, figures["1,000 points, `register`: nodes / library, s"].split(" / "))
    assert nodes > 0 < library
    assert figures["10,000 points (0 MiB), scans"] == "2"
    assert float(figures["a timer of a node was late by at most, s"]) < 60.0
    for name in ("scan_ingest", "registration", "compensation"):
        early, late = figures[f"memory of {name} after a quarter / all of the scans, MiB"].split(" / ")
        assert min(int(early), int(late)) > 20
