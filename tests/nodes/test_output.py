"""Folders of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from mdf_nodes.output import folder_name, free_folder


def test_other_results_are_not_written_over_and_equal_ones_not_doubled(tmp_path: Path) -> None:
    folder = tmp_path / "part_job-1"
    assert free_folder(folder, {"a.stl": b"one", "b.stl": b"two"}) == folder
    folder.mkdir()
    (folder / "b.stl").write_bytes(b"other")
    assert free_folder(folder, {"a.stl": b"one"}) == folder
    assert free_folder(folder, {"a.stl": b"one", "b.stl": b"other"}) == folder
    assert free_folder(folder, {"a.stl": b"one", "b.stl": b"two"}) == tmp_path / "part_job-1-2"


@pytest.mark.parametrize("text", ["../../etc/passwd", "/absolute", "a b\n", "..", ".hidden"])
def test_a_name_from_outside_names_one_visible_folder(tmp_path: Path, text: str) -> None:
    name = folder_name(f"{text}_job-1")
    assert (tmp_path / name).resolve().parent == tmp_path.resolve() and not name.startswith(".")


@pytest.mark.parametrize("letter", ["x", "é", "零"])
def test_a_name_too_long_for_a_folder_keeps_its_end(tmp_path: Path, letter: str) -> None:
    name = folder_name(f"{letter * 300}_job-1")
    assert name.startswith(letter) and name.endswith(f"{letter}_job-1")
    (tmp_path / f"{name}-12345").mkdir()
