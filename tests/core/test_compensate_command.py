"""``mdf compensate``, as typed."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from command_samples import POSED, Cell, contents, cycles, record_of

from mdf_core.errors import OutputFolderError
from mdf_core.mesh_io import stl_bytes
from mdf_core.record import remove_former
from mdf_core.virtual_cell import build_part

pytestmark = pytest.mark.usefixtures("inspected_once")


def test_a_second_cycle_from_the_file_that_was_printed_is_better(cell, compensated):
    first = compensated("first", cell.scan()) / "redesigned.stl"
    second = compensated("second", cell.scan(first, seed=7), "--previous", first) / "redesigned.stl"
    assert cell.left(first) < 0.03
    assert cell.left(second) < cell.left(first) + 0.002


def test_every_gain_gets_files_of_its_own(cell, compensated):
    out = compensated("out", cell.scan(), "--gain", 0.5, 1, "--format", "stl", "3mf", "ply")
    names = {f"redesigned_{gain}.{ending}" for gain in ("0.5", "1") for ending in ("stl", "3mf", "ply")}
    assert names <= {path.name for path in out.iterdir()} and not (out / "redesigned.stl").exists()
    half, full = (cell.vertices(out / f"redesigned_{gain}.stl") - cell.design.vertices for gain in ("0.5", "1"))
    np.testing.assert_allclose(2.0 * half, full, atol=1e-4)
    for entry in record_of(out)["redesigns"]:
        assert entry["released"] and set(entry["files"]) <= names and len(entry["files"]) == 3


def test_fixed_regions_stay_and_what_fails_a_check_is_not_written(cell, compensated, mdf, tmp_path):
    regions = tmp_path / "regions.yaml"
    regions.write_text("- {name: end, fixed: true, blend_mm: 30, box: [95, 0, 0, 100, 50, 5]}\n")
    out = compensated("fixed", cell.scan(), "--regions", regions)
    end = cell.design.vertices[:, 0] >= 95.0
    moved = cell.vertices(out / "redesigned.stl") != cell.design.vertices
    assert not moved[end].any() and moved[~end].any(axis=1).mean() > 0.9
    assert record_of(out)["regions"]["regions"][0]["vertices"] == end.sum()

    out = tmp_path / "refused"
    limit = ("--set", "release.max_move_mm=0.3")
    status, _, errors = mdf("compensate", cell.design_path, cell.scan(), "--out", out, *POSED, *limit)
    assert status == 2 and "largest_move" in errors and " near (" in errors
    assert (out / "report.json").exists() and not (out / "redesigned.stl").exists()
    (entry,) = record_of(out)["redesigns"]
    failed = [check["name"] for check in entry["checks"] if not check["passed"]]
    assert (entry["released"], entry["files"], failed) == (False, {}, ["largest_move"])
    assert "redesign" not in json.loads((out / "report.json").read_text())


def test_a_tolerance_of_a_region_reaches_the_verdict(cell, compensated, tmp_path):
    regions = tmp_path / "regions.yaml"
    regions.write_text("- {name: wall, tolerance_mm: 0.2, plane: [0, 0, 0, 1, 0, 0]}\n")
    out = compensated("out", cell.scan(), "--regions", regions, "--set", "verdict.tolerance_mm=5")
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "FAIL" and report["reasons"][0].startswith("wall: ")
    assert [region["verdict"] for region in report["regions"]] == ["PASS", "FAIL"]


def test_several_prints_are_split_into_what_they_share_and_what_varies(tmp_path, mdf):
    cell = Cell(tmp_path, variation=0.2)
    scans = [cell.scan(seed=seed) for seed in range(3)]
    status, text, _ = mdf("compensate", cell.design_path, *scans, "--out", tmp_path / "out", *POSED)
    assert status == 0 and "3 prints: systematic" in text
    prints = record_of(tmp_path / "out")["prints"]
    assert prints["variation_mm"] == pytest.approx(0.2 * cell.printer.warp.rms_mm, rel=0.4)
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"scan_2", "scan_3"}


def test_the_redesign_that_was_printed_is_not_written_over(cell, compensated, mdf, url):
    first = compensated("out", cell.scan(), "--ledger", url) / "redesigned.stl"
    content = first.read_bytes()
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0
    for printed in (("--ledger", url), ("--previous", first)):
        again = mdf("compensate", cell.design_path, cell.scan(first), *printed, "--out", first.parent, *POSED)
        assert again[0] == 2 and "redesigned.stl, which is needed, may be written over" in again[2]
    assert first.read_bytes() == content


def test_what_a_redesign_is_made_from_is_not_written_over(cell, mdf, tmp_path):
    design = tmp_path / "out" / "redesigned.stl"
    design.parent.mkdir()
    content = cell.design_path.read_bytes()
    design.write_bytes(content)
    link = tmp_path / "design.stl"
    link.symlink_to(design)
    for given in (design, link):
        status, _, errors = mdf("compensate", given, cell.scan(), "--out", design.parent, *POSED)
        assert status == 2 and "redesigned.stl, which is needed, may be written over" in errors
    assert design.read_bytes() == content


def test_an_stl_that_is_no_redesign_of_the_design_is_refused(cell, mdf, tmp_path):
    other = build_part("clip")
    path = tmp_path / "other.stl"
    path.write_bytes(stl_bytes(other.vertices, other.faces))
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(), "--previous", path, "--out", tmp_path / "out", *POSED
    )
    assert status == 2 and "other.stl: is no redesign of this design" in errors


def test_one_scan_is_not_several_prints(cell, mdf, tmp_path):
    scan = cell.scan()
    status, _, errors = mdf("compensate", cell.design_path, scan, scan, "--out", tmp_path / "out", *POSED)
    assert status == 2 and "two of the scans are the same" in errors


@pytest.mark.parametrize(
    "options, told",
    [
        (("--gain", 9), "compensation.gain"),
        (("--gain", 0.5, 0.5), "equal gains"),
        (("--part-id", "bracket"), "without --ledger"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_the_work(cell, mdf, tmp_path, options, told):
    status, _, errors = mdf("compensate", cell.design_path, cell.scan(), "--out", tmp_path / "out", *POSED, *options)
    assert status == 2 and told in errors
    assert not (tmp_path / "out").exists()


def test_no_redesign_is_there_before_its_record(cell, compensated, mdf, monkeypatch):
    class Killed(BaseException):
        pass

    rename, out, scan = Path.replace, cell.folder / "out", cell.scan()

    def killed_after(path, target):
        rename(path, target)
        if target.name == "record.json":
            raise Killed

    with monkeypatch.context() as while_killed:
        while_killed.setattr(Path, "replace", killed_after)
        with pytest.raises(Killed):
            mdf("compensate", cell.design_path, scan, "--out", out, *POSED)
    (entry,) = record_of(out)["redesigns"]
    assert set(entry["files"]) == {"redesigned.stl"} and not (out / "redesigned.stl").exists()
    again = compensated("out", scan)
    assert hashlib.sha256((again / "redesigned.stl").read_bytes()).hexdigest() == entry["stl_sha256"]


def test_no_mesh_of_an_earlier_run_is_left_beside_another_record(cell, compensated, mdf):
    out = compensated("out", cell.scan(), "--gain", 0.5, 1)
    compensated("out", cell.scan(seed=1))
    assert {path.name for path in out.glob("redesigned*")} == {"redesigned.stl"}
    limit = ("--set", "release.max_move_mm=0.3")
    assert mdf("compensate", cell.design_path, cell.scan(), "--out", out, *POSED, *limit)[0] == 2
    assert not list(out.glob("redesigned*")) and not record_of(out)["redesigns"][0]["released"]
    compensated("out", cell.scan())
    too_many = ("--set", "verdict.max_outlier_share=0")
    assert mdf("compensate", cell.design_path, cell.scan(), "--out", out, *POSED, *too_many)[0] == 2
    assert not list(out.glob("redesigned*")) and not (out / "record.json").exists()


def test_a_redesign_of_an_earlier_run_that_cannot_be_taken_away_is_named(tmp_path):
    (tmp_path / "redesigned.stl").mkdir()
    with pytest.raises(OutputFolderError, match=r"cannot remove redesigned\.stl of an earlier run"):
        remove_former(tmp_path)


def test_only_redesigns_of_an_earlier_run_are_taken_away(tmp_path):
    names = ("redesigned_0.5.stl", "redesigned_1.3mf", "scan.npy", "record.json")
    for name in names:
        (tmp_path / name).touch()
    one = {"files": dict.fromkeys((*names, "..", ""), "")}
    entries = {"kind": "mdf redesign record", "version": 1, "redesigns": [one]}
    (tmp_path / "record.json").write_text(json.dumps(entries))
    remove_former(tmp_path)
    assert set(contents(tmp_path)) == {"scan.npy"}
