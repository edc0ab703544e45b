"""The command cell_demo: a recorded scan through the whole cell."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest

from mdf_core.mesh_io import load_design


def number_after(text, label):
    """The last number of the table row that starts with `label`, and those before it."""
    row = next(line for line in text.splitlines() if line.startswith(f"│ {label}"))
    return [float(cell) for cell in row.strip("│ ").split("│")[1:]]


def test_the_demo_shows_that_the_redesign_prints_right(start, processes_naming, tmp_path):
    process = start("demo", "--out", tmp_path)
    assert process.wait(140) == 0, process.output
    assert processes_naming(tmp_path) == {}

    text = process.stdout
    before, left = (number_after(text, f"printed from the {what}")[0] for what in ("design", "redesign"))
    assert left < 0.1 * before
    assert number_after(text, "measured on the scan")[0] == pytest.approx(before, rel=0.1)
    assert number_after(text, "last scan message to redesigned_mesh_path")[0] < 60.0

    paths = dict(
        line.split(":", 1) for line in text.splitlines() if line.startswith(("redesigned part", "report", "pic"))
    )
    paths = {name: Path(path.strip()) for name, path in paths.items()}
    assert all(path.is_relative_to(tmp_path) for path in paths.values())
    assert paths["picture"].read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    report = json.loads(paths["report"].read_text())
    design = load_design(report["inspection"]["design_path"])
    np.testing.assert_array_equal(load_design(paths["redesigned part"]).faces, design.faces)


def test_an_interrupt_leaves_no_process(start, wait_until, processes_naming, tmp_path):
    process = start("demo", "--out", tmp_path)
    log = tmp_path / "cell.log"
    wait_until(lambda: log.exists() and "ready" in log.read_text(), 30, lambda: process.output)
    process.send(signal.SIGINT)
    assert process.wait(15) == 130, process.output
    assert processes_naming(tmp_path) == {}
    assert "Traceback" not in process.output


def test_a_bag_that_is_not_there_is_refused(start, tmp_path):
    process = start("demo", "--bag", tmp_path / "none", "--out", tmp_path / "out")
    assert process.wait() == 2
    assert process.stderr.startswith("error: ") and process.stderr.count("\n") == 1
    assert str(tmp_path / "none") in process.stderr
