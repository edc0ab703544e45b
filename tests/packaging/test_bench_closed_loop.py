"""The benchmark of the closed loop, on a small scale: what the methods leave, and the page that tells it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bench.closed_loop.__main__ import main
from bench.closed_loop.loops import METHODS, OURS, PAPER, Loop, close
from bench.closed_loop.plan import HIDDEN

SMALL = ["--parts", "clip", "--prints", "1", "3", "--cycles", "1", "--variations", "0.3", "--points", "500"]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "closed_loop.md"
    assert main([*SMALL, "--seeds", "1", "--out", str(path)]) == 0
    return path


def table(page: Path, heading: str) -> list[list[str]]:
    """The rows of the first table below a heading."""
    text = page.read_text().partition(f"# {heading}\n")[2]
    lines = re.findall(r"^\|.*\|$", text.partition("\n#")[0], flags=re.MULTILINE)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len({len(row) for row in rows}) == 1
    return rows[2:]


# What is left


def test_ours_leaves_far_less_than_the_papers_pipeline(page: Path) -> None:
    left = {(printer, method): float(first) for _, printer, method, first, _ in table(page, "Which method")}
    assert len(left) == 1 + 2 * len(METHODS)
    for printer in ("spatial", "material"):
        assert left[printer, OURS] < 0.1 < 0.3 < left[printer, PAPER]


def test_more_prints_leave_less_of_what_varies_and_tell_how_much_it_does(page: Path) -> None:
    one, three = table(page, "How many prints, how many cycles")
    assert float(three[3]) < 0.8 * float(one[3])
    one, three = table(page, "What the library says itself")
    assert one[4] == ""
    assert float(three[4]) == pytest.approx(0.3, rel=0.3)


def test_a_second_cycle_leaves_no_more_than_the_first() -> None:
    first, second = close(Loop(OURS, "clip", points=1000, cycles=2, seed=0))
    assert second.left <= first.left < 0.05


def test_what_no_scan_sees_does_not_move() -> None:
    (cycle,) = close(Loop(OURS, "bracket", points=1000, cycles=1, seed=0, hidden=HIDDEN))
    assert cycle.left_seen < 0.05 < cycle.left
    assert cycle.beyond > 0 == cycle.moved


# The page


def test_another_part_and_another_unit_are_refused(page: Path) -> None:
    fates = dict(table(page, "What must not get through"))
    assert fates["of another part"] == "REGISTRATION_FAILED"
    assert fates["in inches"] == fates["in metres"] == "UNIT_MISMATCH"


def test_every_question_has_its_table(page: Path) -> None:
    assert len(table(page, "How dense a scan")) == 2 * len(METHODS)
    assert [row[0] for row in table(page, "Noise of the scanner")] == ["0", "20", "100"]
    assert [row[:2] for row in table(page, "A hidden side")] == [["clip", "0"], ["clip", f"{HIDDEN:g}"]]


def test_the_page_shows_its_picture_and_how_it_was_made(page: Path) -> None:
    text = page.read_text()
    assert re.search(r"^    python -m bench\.closed_loop --parts clip .*\n\nin \d+ min on ", text, flags=re.MULTILINE)
    assert "](closed_loop.png)" in text
    picture = page.with_suffix(".png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) < 150_000
