"""``mdf ledger``, and ``mdf compensate`` with a ledger, as typed."""

import contextlib
import sqlite3

import numpy as np
import pytest
from command_samples import POSED, Cell, cycles, record_of

from mdf_core.ledger_entries import CycleState
from mdf_core.mesh_io import stl_bytes
from mdf_core.virtual_cell import Printer, Warp

pytestmark = pytest.mark.usefixtures("inspected_once")


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


def test_a_scan_that_led_to_a_redesign_is_no_print_of_another_mesh(cell, compensated, mdf, url):
    scan = cell.scan()
    first = compensated("first", scan, "--ledger", url)
    reprint = cell.scan(first / "redesigned.stl", 5)
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0
    compensated("second", reprint, "--ledger", url, "--gain", 0.5)
    before = cycles(url)
    refused = mdf("compensate", cell.design_path, scan, "--ledger", url, "--out", cell.folder / "third", *POSED)
    assert refused[0] == 2 and "redesign 1 was made from one of these scans" in refused[2]
    assert cycles(url) == before
    # Back to the design, the scan of the redesign is none of the design.
    assert mdf("ledger", "roll-back", url, 1, "--by", "an engineer", "--reason", "warped")[0] == 0
    before = cycles(url)
    refused = mdf("compensate", cell.design_path, reprint, "--ledger", url, "--out", cell.folder / "third", *POSED)
    assert refused[0] == 2 and "taken for that of a print of redesign 1" in refused[2]
    assert cycles(url) == before
    assert "reject redesign 2" in refused[2]
    assert mdf("compensate", cell.design_path, scan, "--ledger", url, "--out", cell.folder / "third", *POSED)[0] == 2


def test_a_region_that_is_fixed_later_goes_back_to_nominal(cell, compensated, mdf, url, tmp_path):
    first = compensated("first", cell.scan(), "--ledger", url)
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0
    second = compensated("second", cell.scan(first / "redesigned.stl", 5), "--ledger", url)
    assert mdf("ledger", "release", url, cycles(url)[-1].id, "--by", "an engineer")[0] == 0
    reprint = cell.scan(second / "redesigned.stl", 6)
    settled = mdf("compensate", cell.design_path, reprint, "--ledger", url, "--out", tmp_path / "none", *POSED)
    assert settled[0] == 0 and "nothing is left" in settled[1]
    regions = tmp_path / "regions.yaml"
    regions.write_text("- {name: plate, fixed: true, build_plate: true, blend_mm: 40}")
    third = compensated("third", reprint, "--ledger", url, "--regions", regions)
    plate = cell.design.vertices[:, 2] == cell.design.vertices[:, 2].min()
    before, after = (cell.vertices(out / "redesigned.stl")[plate] for out in (second, third))
    nominal = cell.design.vertices[plate].astype(np.float32)
    np.testing.assert_array_equal(after, nominal)
    assert np.abs(before - nominal).max() > 0.1


def test_a_redesign_that_may_be_gone_back_to_is_not_written_over_and_its_file_is_looked_at(cell, compensated, mdf, url):
    first = compensated("first", cell.scan(), "--ledger", url)
    assert mdf("ledger", "release", url, cycles(url)[0].id, "--by", "an engineer")[0] == 0
    reprint = cell.scan(first / "redesigned.stl", 5)
    compensated("second", reprint, "--ledger", url)
    assert mdf("ledger", "release", url, cycles(url)[-1].id, "--by", "an engineer")[0] == 0
    kept = mdf("compensate", cell.design_path, cell.scan(), "--ledger", url, "--out", first, *POSED)
    assert kept[0] == 2 and "redesigned.stl, which is needed, may be written over" in kept[2]
    (first / "redesigned.stl").write_bytes(b"another one")
    status, text, errors = mdf("ledger", "roll-back", url, 2, "--by", "an engineer", "--reason", "warped more")
    assert status == 0 and f"printed from now on: 1: part, cycle 1, gain 1, released, {first}" in text
    assert f"{first / 'redesigned.stl'} is gone, or not the redesign that was released" in errors


@pytest.mark.parametrize("change", ["exported again", "renamed"])
def test_a_design_under_another_name_begins_anew_but_says_so(cell, compensated, mdf, url, tmp_path, change):
    compensated("first", cell.scan(), "--ledger", url)
    assert mdf("ledger", "release", url, 1, "--by", "an engineer")[0] == 0
    other = tmp_path / ("other.stl" if change == "renamed" else "part.stl")
    faces = cell.design.faces if change == "renamed" else cell.design.faces[::-1]
    other.write_bytes(stl_bytes(cell.design.vertices, faces))
    out = ("--ledger", url, "--out", tmp_path / "second", *POSED)
    status, _, errors = mdf("compensate", other, cell.scan(seed=7), *out)
    assert status == 0 and "warning: redesign 1 is released of part part, design" in errors
    assert [cycle.number for cycle in cycles(url)] == [1, 1]
    shown = mdf("ledger", "show", url)[1]
    for cycle in cycles(url):
        assert cycle.design_sha256[:8] in shown


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
