"""``mdf compensate``, ``mdf repeat`` and ``mdf ledger``, as typed."""

import contextlib
import hashlib
import json
import sqlite3
from itertools import count
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from mdf_core import cli, redesign_task
from mdf_core.ledger import Ledger
from mdf_core.ledger_entries import CycleState
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.record import remove_former
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, distortion_left, scan_part

# The scans lie where the design lies, and one kernel width is enough for these warps.
POSED = ("--set", "pose.initial=0,0,0,0,0,0,1", "--set", "surface.beta=1.4", "--set", "surface.rank=150")
SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/record.schema.json").read_text())
NUMBERS = count()


class Cell:
    """A design's file, and scans of prints of it or of a redesign."""

    def __init__(self, folder, part="bracket", variation=0.0):
        self.folder = folder
        self.design_path = folder / "part.stl"
        design = build_part(part)
        self.design_path.write_bytes(stl_bytes(design.vertices, design.faces))
        self.design = load_design(self.design_path, "mm")
        self.printer = Printer(Warp(self.design, 1.5, 50.0, 1), variation=variation)

    def vertices(self, path):
        """Of a redesign, in the design's order."""
        vertices = self.design.vertices.copy()
        vertices[self.design.faces.ravel()] = load_design(path, "mm").triangles.reshape(-1, 3)
        return vertices

    def scan(self, redesign=None, seed=0, **scanner):
        """File with a scan of a print."""
        vertices = self.design.vertices if redesign is None else self.vertices(redesign)
        settings = ScannerSettings(points=6_000, **scanner)
        scan = scan_part(self.printer.print_part(vertices, seed), self.design.faces, settings, seed).scan
        path = self.folder / f"scan{next(NUMBERS)}.npy"
        np.save(path, np.hstack([scan.points, scan.normals]))
        return path

    def left(self, redesign):
        """RMS distortion of the mean print of a redesign, over that of the design."""
        before = distortion_left(self.design, self.printer.print_part(self.design.vertices))[0]
        return distortion_left(self.design, self.printer.print_part(self.vertices(redesign)))[0] / before


@pytest.fixture
def cell(tmp_path):
    return Cell(tmp_path)


@pytest.fixture
def mdf(capsys):
    """``mdf("compensate", ...)``: exit status, stdout, stderr."""

    def run(*arguments):
        capsys.readouterr()
        return cli.main([str(argument) for argument in arguments]), *capsys.readouterr()

    return run


@pytest.fixture
def compensated(mdf, cell):
    """``compensated("out", scan, ...)``: the folder, after a run that succeeded."""

    def run(name, *arguments):
        out = cell.folder / name
        status, text, errors = mdf("compensate", cell.design_path, *arguments, "--out", out, *POSED)
        assert (status, errors) == (0, ""), errors
        assert text
        return out

    return run


def record_of(folder):
    """The record, which keeps to its schema."""
    found = json.loads((folder / "record.json").read_text())
    jsonschema.validate(found, SCHEMA)
    return found


def contents(folder):
    """Of every file in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# Redesigns


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


# Again


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


def test_a_record_without_the_bytes_to_compare_with_is_refused_before_the_work(cell, compensated, mdf, tmp_path):
    path = compensated("out", cell.scan()) / "record.json"
    entries = json.loads(path.read_text())
    for redesigns in ([], [{"gain": 1.0, "files": {}}]):
        path.write_text(json.dumps(entries | {"redesigns": redesigns}))
        status, _, errors = mdf("repeat", path, "--out", tmp_path / "again")
        assert status == 2 and "record.json: does not hold what a record holds" in errors
        assert not (tmp_path / "again").exists()


# The ledger


@pytest.fixture
def url(tmp_path):
    return f"sqlite:///{tmp_path}/ledger.sqlite"


def cycles(url):
    with Ledger(url) as ledger:
        return ledger.history()


def test_the_ledger_leads_from_cycle_to_cycle_and_back(cell, compensated, mdf, url):
    first = compensated("first", cell.scan(), "--ledger", url)
    (proposed,) = cycles(url)
    assert (proposed.part_id, proposed.number, proposed.state) == ("part", 1, CycleState.PROPOSED)
    assert mdf("ledger", "release", url, proposed.id, "--by", "an engineer")[0] == 0

    # The print of the redesign comes out well, but not perfectly: the second cycle starts from the first.
    second = compensated("second", cell.scan(first / "redesigned.stl", 5), "--ledger", url, "--gain", 1, 0.5)
    one, *others = cycles(url)
    assert one.state is CycleState.RELEASED
    assert one.measured_residual_mm < 0.1 * one.residual_before_mm
    assert one.measured_residual_mm == pytest.approx(one.predicted_residual_mm, rel=0.6)
    for cycle in others:
        assert (cycle.number, cycle.previous, cycle.state) == (2, one.id, CycleState.PROPOSED)
    assert record_of(second)["previous"]["path"] == str(second / "redesigned_before.ply")
    np.testing.assert_array_equal(cell.vertices(second / "redesigned_before.ply"), cell.vertices(one.stl_path))
    assert mdf("ledger", "release", url, others[0].id, "--by", "an engineer")[0] == 0
    status, text, _ = mdf("ledger", "roll-back", url, others[0].id, "--by", "an engineer", "--reason", "warped more")
    assert status == 0 and f"printed from now on: {one.id}: part, cycle 1" in text
    status, text, _ = mdf("ledger", "show", url)
    assert status == 0 and "rolled_back" in text and "warped more" in text


def test_the_second_cycle_weighs_the_prints_of_the_first_with_and_without_a_ledger(cell, compensated, mdf, url):
    cell.printer = Printer(cell.printer.warp, variation=0.2)
    first = compensated("first", cell.scan(seed=1), "--ledger", url, "--format", "ply")
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0
    reprint = cell.scan(first / "redesigned.stl", 2)
    ledger = compensated("ledger", reprint, "--ledger", url)
    from_ply = compensated("ply", reprint, "--previous", first / "redesigned.ply")
    from_stl = compensated("stl", reprint, "--previous", first / "redesigned.stl")
    redesigned = (ledger / "redesigned.stl").read_bytes()
    assert (from_ply / "redesigned.stl").read_bytes() == redesigned
    # Of the mesh alone nothing is known: the whole change is made, and not half of it.
    moved, alone = (
        cell.vertices(out / "redesigned.stl") - cell.vertices(first / "redesigned.stl") for out in (ledger, from_stl)
    )
    assert (moved * alone).sum() / (alone**2).sum() == pytest.approx(0.5, abs=0.05)
    for out in (ledger, from_ply):
        status, text, errors = mdf("repeat", out / "record.json", "--out", cell.folder / f"{out.name}_again")
        assert (status, errors) == (0, "") and text.endswith("the same bytes as recorded\n")
        assert (cell.folder / f"{out.name}_again" / "redesigned.stl").read_bytes() == redesigned


def test_when_what_is_left_is_what_prints_differ_by_no_cycle_follows(cell, compensated, mdf, url):
    cell.printer = Printer(cell.printer.warp, variation=0.2)
    printed, text, cycle = None, "", 0
    while "keep what is printed" not in text:
        assert cycle < 10
        out = cell.folder / f"cycle_{cycle}"
        status, text, errors = mdf(
            "compensate", cell.design_path, cell.scan(printed, cycle), "--ledger", url, "--out", out, *POSED
        )
        assert (status, errors) == (0, "")
        cycle += 1
        if "keep what is printed" not in text:
            printed = out / "redesigned.stl"
            assert mdf("ledger", "release", url, cycles(url)[-1].id, "--by", "an engineer")[0] == 0
    assert cycle > 3 and cell.left(printed) < 0.15


def test_a_print_of_the_design_is_not_taken_for_one_of_the_redesign(cell, compensated, mdf, url):
    compensated("first", cell.scan(), "--ledger", url)
    mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")
    before = cycles(url)
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(seed=3), "--ledger", url, "--out", cell.folder / "again", *POSED
    )
    assert status == 2 and "of the distortion before cycle 1 is still there" in errors
    assert cycles(url) == before
    assert (cell.folder / "again" / "report.json").exists() and not (cell.folder / "again" / "redesigned.stl").exists()


def test_a_print_of_the_design_is_told_also_where_a_former_version_kept_no_evidence(cell, compensated, mdf, url):
    first = compensated("first", cell.scan(), "--ledger", url) / "redesigned.stl"
    mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")
    with contextlib.closing(sqlite3.connect(url.removeprefix("sqlite:///"))) as database, database:
        database.execute("UPDATE cycles SET evidence = NULL")
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(seed=3), "--ledger", url, "--out", cell.folder / "again", *POSED
    )
    assert status == 2 and "of the distortion before cycle 1 is still there" in errors
    compensated("second", cell.scan(first, 5), "--ledger", url)


def test_a_reprint_that_got_worse_is_noted_and_refused(cell, compensated, mdf, url):
    first = compensated("first", cell.scan(), "--ledger", url, "--gain", -0.8) / "redesigned.stl"
    mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(first), "--ledger", url, "--out", cell.folder / "again", *POSED
    )
    assert status == 2 and "roll the redesign back" in errors and "before cycle 1" in errors
    (cycle,) = cycles(url)
    assert cycle.measured_residual_mm == pytest.approx(1.8 * cycle.residual_before_mm, rel=0.1)


def test_a_scan_of_another_part_leaves_the_ledger_as_it_was(cell, compensated, mdf, url, tmp_path):
    compensated("first", cell.scan(), "--ledger", url)
    before = cycles(url)
    (tmp_path / "clip").mkdir()
    other = Cell(tmp_path / "clip", "clip").scan()
    status, _, _ = mdf("compensate", cell.design_path, other, "--ledger", url, "--out", tmp_path / "out", *POSED)
    assert status == 2
    many = cell.scan(outlier_share=0.1)
    status, _, errors = mdf("compensate", cell.design_path, many, "--ledger", url, "--out", tmp_path / "out", *POSED)
    assert status == 2 and "of the points do not lie on the part" in errors
    assert cycles(url) == before


def test_a_redesign_that_fails_a_check_is_rejected_in_the_ledger(cell, mdf, url, tmp_path):
    limit = ("--set", "release.max_move_mm=0.3")
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(), "--ledger", url, "--out", tmp_path / "out", *POSED, *limit
    )
    assert status == 2 and "largest_move" in errors
    (cycle,) = cycles(url)
    assert cycle.state is CycleState.REJECTED and "largest_move" in cycle.reason
    status, _, errors = mdf("ledger", "release", url, cycle.id, "--by", "an engineer")
    assert status == 2 and "rejected" in errors


def test_when_nothing_is_left_no_cycle_follows(cell, compensated, mdf, url):
    perfect = Printer(Warp(cell.design, 0.0, 50.0, 1))
    cell.printer = perfect
    ledgers = [f"{url}-{seed}" for seed in range(4)]
    for seed, ledger in enumerate(ledgers):
        assert compensated("out", cell.scan(seed=seed), "--ledger", ledger).exists()
    assert sum(len(cycles(ledger)) for ledger in ledgers) <= 1  # a scan in a few is off by more than its standard error


def test_a_redesign_whose_file_has_been_overwritten_is_not_released(cell, compensated, mdf, url):
    compensated("out", cell.scan(), "--ledger", url)
    compensated("out", cell.scan(seed=1), "--ledger", url)
    first, second = cycles(url)
    status, _, errors = mdf("ledger", "release", url, first.id, "--by", "an engineer")
    assert status == 2 and "not the one that was proposed" in errors
    assert mdf("ledger", "release", url, second.id, "--by", "an engineer")[0] == 0


def test_a_redesign_that_is_made_again_elsewhere_can_be_released_from_there(cell, compensated, mdf, url):
    scan = cell.scan()
    first = compensated("first", scan, "--ledger", url) / "redesigned.stl"
    compensated("first", cell.scan(seed=1), "--ledger", url)  # writes over it
    second = first.read_bytes()
    again = compensated("again", scan, "--ledger", url) / "redesigned.stl"
    cycle, _ = cycles(url)
    assert cycle.stl_path == str(again) and first.read_bytes() == second
    again.unlink()
    compensated("third", scan, "--ledger", url)
    assert mdf("ledger", "release", url, cycle.id, "--by", "an engineer")[0] == 0


def test_what_the_ledger_proposes_lies_there_as_stl_whatever_the_format(cell, compensated, mdf, url):
    out = compensated("out", cell.scan(), "--ledger", url, "--format", "3mf")
    assert {path.name for path in out.glob("redesigned*")} == {"redesigned.stl", "redesigned.3mf"}
    assert set(record_of(out)["redesigns"][0]["files"]) == {"redesigned.stl", "redesigned.3mf"}
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0


def test_a_print_of_a_redesign_that_nobody_released_is_not_taken_for_one_of_the_design(cell, compensated, mdf, url):
    first = compensated("first", cell.scan(), "--ledger", url) / "redesigned.stl"
    status, _, errors = mdf(
        "compensate", cell.design_path, cell.scan(first), "--ledger", url, "--out", cell.folder / "again", *POSED
    )
    assert status == 2 and "nobody has released that one" in errors


@pytest.mark.parametrize("gain", [0.3, 0.5])
def test_a_reprint_of_a_small_gain_is_known_as_such(cell, compensated, mdf, url, gain):
    first = compensated("first", cell.scan(), "--ledger", url, "--gain", gain) / "redesigned.stl"
    mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")
    compensated("second", cell.scan(first), "--ledger", url)
    assert [cycle.number for cycle in cycles(url)] == [1, 2]


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


def test_no_mesh_of_an_earlier_run_is_left_beside_another_record(cell, compensated, mdf):
    out = compensated("out", cell.scan(), "--gain", 0.5, 1)
    compensated("out", cell.scan(seed=1))
    assert {path.name for path in out.glob("redesigned*")} == {"redesigned.stl"}
    limit = ("--set", "release.max_move_mm=0.3")
    assert mdf("compensate", cell.design_path, cell.scan(), "--out", out, *POSED, *limit)[0] == 2
    assert not list(out.glob("redesigned*")) and not record_of(out)["redesigns"][0]["released"]


def test_only_redesigns_of_an_earlier_run_are_taken_away(tmp_path):
    names = ("redesigned_0.5.stl", "redesigned_1.3mf", "scan.npy", "record.json")
    for name in names:
        (tmp_path / name).touch()
    one = {"files": dict.fromkeys((*names, "..", ""), "")}
    entries = {"kind": "mdf redesign record", "version": 1, "redesigns": [one]}
    (tmp_path / "record.json").write_text(json.dumps(entries))
    remove_former(tmp_path)
    assert set(contents(tmp_path)) == {"scan.npy"}
