"""The benchmarks measure what they say, with and without the peers, and write pages that read."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from bench import methods
from bench.__main__ import main
from bench.cases import Case, quality_cases
from bench.measure import Measurement, measure, measure_apart
from bench.methods import METHODS
from bench.poses import HEADINGS, Trial, page, summary
from bench.report import Row, write

SMALL = Case(points=1_000)
BY_NAME = {method.name: method for method in METHODS}
PEERS = [method.name for method in METHODS if method.needs]
GOOD = Measurement(1.25, 2.5, 300.0, 150.0, 0.0123, 1.02, 0.0101)


def assert_tables_are_whole(text: str, tables: int) -> None:
    """Every table has a line under its heading and as many cells in every line."""
    blocks = re.findall(r"(?:^\|.*\|\n)+", text, flags=re.MULTILINE)
    assert len(blocks) == tables
    for block in blocks:
        lines = block.splitlines()
        assert len({line.count("|") for line in lines}) == 1
        assert re.fullmatch(r"\|( -{3}:? \|)+", lines[1])


# Measurements


@pytest.mark.parametrize("method", ["surface", "surface_search"])
def test_the_product_recovers_the_distortion_and_knows_its_error(method: str) -> None:
    found = measure(method, SMALL)
    assert not found.error
    assert found.unrecovered < 0.05
    assert 0.5 < found.std_ratio < 2.0
    assert found.seconds > 0.0
    assert found.cpu_seconds > 0.0
    assert found.peak_mib > 0.9 * found.before_mib > 0.0


@pytest.mark.parametrize("noise_mm", [0.0, 0.02])
def test_what_is_possible_is_little_less_than_what_is_found(noise_mm: float) -> None:
    found = measure("surface", Case(points=2_000, noise_mm=noise_mm))
    assert 0.1 * found.unrecovered < found.possible < 1.5 * found.unrecovered


@pytest.mark.parametrize("method", [name for name in PEERS if BY_NAME[name].is_available])
def test_a_peer_that_is_installed_recovers_some_of_it(method: str) -> None:
    found = measure_apart(method, SMALL, timeout=60.0)
    assert found.error or found.unrecovered < 1.0


def test_what_fails_or_takes_too_long_is_a_result() -> None:
    assert measure_apart("surface", Case(part="teapot", points=1_000), 60.0).error.endswith("plate, housing, pair")
    late = measure_apart("surface", SMALL, timeout=0.01)
    assert late.ran_out_of_time and late.error == "longer than 0.01 s"


def test_peers_that_are_not_installed_are_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(methods.importlib.util, "find_spec", lambda name: None)
    assert main(["--only", "scaling", "--sizes", "1000", "--methods", *PEERS, "--out", str(tmp_path)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "left out, not installed: biocpd, open3d, pycpd, rustcpd, small_gicp" in told

    assert not (tmp_path / "scaling.png").exists()


def test_every_part_meets_every_warp_length_and_noise_and_a_ripple() -> None:
    cases = list(quality_cases(20_000))
    assert len(cases) == len(set(cases)) == 3 * 4 * 3 + 3 * 2


# Pages


def test_the_page_the_figures_and_the_picture_are_written(tmp_path: Path) -> None:
    late = Measurement(error="longer than 60 s", ran_out_of_time=True)
    scaling = [Row(BY_NAME[name], Case(points=n), GOOD) for n in (1_000, 20_000) for name in ("surface", "rustcpd")]
    scaling.append(Row(BY_NAME["pycpd"], Case(points=5_000), late))
    quality = [Row(METHODS[0], case, GOOD) for case in quality_cases(20_000)]
    write(tmp_path, scaling, quality, "python -m bench", "a machine")

    text = (tmp_path / "README.md").read_text()
    assert_tables_are_whole(text, tables=3)
    assert "    python -m bench\n\non a machine." in text
    assert "| surface stage | known | 20,000 | 1.25 | 2.50 | 300 | 0.0123 | 0.0101 | 1.02 |" in text
    assert "| pycpd | known | 5,000 |  |  |  | longer than 60 s |  |" in text
    assert "| clip | 12 | 100 | 0 | 1.25 | 2.50 | 300 | 0.0123 | 0.0101 | 1.02 |" in text
    for link in re.findall(r"\]\((\S+)\)", text):
        assert (tmp_path / link).exists()

    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(scaling) + len(quality)
    assert rows[0]["method"] == "surface" and float(rows[0]["unrecovered"]) == GOOD.unrecovered

    picture = (tmp_path / "scaling.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) < 150_000


def test_the_poses_page_counts_right_flagged_and_silently_wrong() -> None:
    trials = [
        Trial(1.0, is_right=True, unrecovered=0.01),
        Trial(2.0, is_flagged=True, unrecovered=2.0),
        Trial(3.0, unrecovered=2.0),
        Trial(4.0, is_refused=True),
    ]
    assert summary("clip", trials) == ("clip", "4", "1", "1", "1", "1", "1", "2.50")
    assert summary("cylinder", trials) == ("cylinder (symmetric)", "4", "", "1", "2", "", "1", "2.50")
    text = page([summary("clip", trials), summary("cylinder", trials)], "python -m bench.poses", "a machine", "Small.")
    assert_tables_are_whole(text, tables=1)
    assert "| " + " | ".join(HEADINGS) + " |" in text
