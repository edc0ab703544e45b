"""The benchmark at the paper's scale, on a scale that a test can wait for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from bench import paper_scale
from bench.paper_scale import METHODS, main, refined
from mdf_core.virtual_cell import build_part


def test_a_refined_design_has_the_nodes_asked_for_and_the_same_surface() -> None:
    coarse = build_part("bracket")
    fine = refined(coarse, 9_999)
    assert len(fine.vertices) == 9_999
    assert np.bincount(fine.faces.ravel(), minlength=9_999).min() > 0
    assert fine.face_areas.sum() == pytest.approx(coarse.face_areas.sum(), rel=1e-12)
    mesh = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(trimesh.Trimesh(coarse.vertices, coarse.faces, process=False).volume)


def test_the_page_tells_every_method(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paper_scale, "SCAN_NODES", 15_000)
    monkeypatch.setattr(paper_scale, "DESIGN_NODES", 8_000)
    monkeypatch.setattr(paper_scale, "BOX_MM", 4.0)
    page = tmp_path / "new" / "page.md"
    monkeypatch.setattr(paper_scale, "measure_apart", lambda method, case, timeout: paper_scale.measure(method, case))
    assert main(["--out", str(page)]) == 0
    text = page.read_text()
    assert "15,000 points" in text and "8,000 nodes" in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    assert [row[0] for row in rows[2:]] == [label for label, _ in METHODS.values()]
    missed = {row[0]: float(row[6]) for row in rows[2:]}
    assert missed["surface stage"] < 0.03
    assert missed["MDF"] < 0.8
