"""``mdf repeat``, as typed."""

import hashlib
import json

import pytest
from command_samples import contents, record_of

from mdf_core import redesign_task

pytestmark = pytest.mark.usefixtures("nothing_drawn")


def test_a_record_makes_the_same_bytes_again(cell, compensated, mdf, tmp_path):
    first = compensated("first", cell.scan()) / "redesigned.stl"
    scans = (cell.scan(first, 1), cell.scan(first, 2))
    out = compensated("out", *scans, "--previous", first, "--gain", 0.5, 1)
    status, text, errors = mdf("repeat", out / "record.json", "--out", tmp_path / "again")
    assert (status, errors) == (0, "") and text.endswith("the same bytes as recorded\n")
    for name in ("redesigned_0.5.stl", "redesigned_1.stl"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()
    scans[0].write_bytes(scans[1].read_bytes())
    status, _, errors = mdf("repeat", out / "record.json", "--out", tmp_path / "changed")
    assert status == 2 and f"{scans[0].name}: is not the file that was recorded" in errors
    assert not (tmp_path / "changed").exists()


@pytest.mark.usefixtures("inspected_once")
def test_a_record_is_not_repeated_in_its_own_folder(cell, compensated, mdf, tmp_path, monkeypatch):
    out = compensated("out", cell.scan())
    before = contents(out)
    (tmp_path / "alias").symlink_to(out)
    (tmp_path / "record.json").symlink_to(out / "record.json")
    monkeypatch.chdir(tmp_path)
    for record, folder in (
        (out / "record.json", out),
        ("out/record.json", "alias/../out"),
        ("alias/record.json", out),
        (out / "record.json", "alias"),
        ("record.json", out),
        ("record.json", tmp_path),
    ):
        status, _, errors = mdf("repeat", record, "--out", folder)
        assert status == 2 and f"{folder}: holds " in errors and "choose another folder for --out" in errors
    assert contents(out) == before


@pytest.mark.usefixtures("inspected_once")
def test_the_record_says_what_was_read_also_of_files_that_change_meanwhile(
    cell, compensated, mdf, tmp_path, monkeypatch
):
    first = compensated("first", cell.scan()) / "redesigned.stl"
    wall = tmp_path / "wall.stl"
    wall.write_bytes(cell.design_path.read_bytes())
    regions = tmp_path / "regions.yaml"
    regions.write_text("- {name: wall, tolerance_mm: 0.2, mesh: wall.stl}\n")
    scans = (cell.scan(first, 1), cell.scan(first, 2))
    files = (cell.design_path, *scans, regions, wall, first)
    read = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    inspect = redesign_task.watched_inspect

    def replace_files_and_inspect(*arguments):
        for path in files:
            path.write_bytes(b"another")
        return inspect(*arguments)

    monkeypatch.setattr(redesign_task, "watched_inspect", replace_files_and_inspect)
    found = record_of(compensated("out", *scans, "--regions", regions, "--previous", first))
    named = (found["design"], *found["scans"], found["regions"], *found["regions"]["meshes"], found["previous"])
    assert [(one["path"], one["sha256"]) for one in named] == [*zip(map(str, files), read, strict=True)]


@pytest.mark.parametrize(
    "content",
    ["", "[]", '{"kind": "mdf redesign record", "version": 1}', '{"kind": "mdf redesign record", "version": 99}'],
)
def test_what_is_no_record_is_refused(mdf, tmp_path, content):
    path = tmp_path / "record.json"
    path.write_text(content)
    status, _, errors = mdf("repeat", path, "--out", tmp_path / "out")
    assert status == 2 and "record.json" in errors


@pytest.mark.usefixtures("inspected_once")
def test_a_record_without_the_bytes_to_compare_with_is_refused_before_the_work(cell, compensated, mdf, tmp_path):
    path = compensated("out", cell.scan()) / "record.json"
    entries = json.loads(path.read_text())
    for redesigns in ([], [{"gain": 1.0, "files": {}}]):
        path.write_text(json.dumps(entries | {"redesigns": redesigns}))
        status, _, errors = mdf("repeat", path, "--out", tmp_path / "again")
        assert status == 2 and "record.json: does not hold what a record holds" in errors
        assert not (tmp_path / "again").exists()
