"""The paper's experiments: what the page claims of them, and that it says what was computed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.paper import errata, line, square
from bench.paper.__main__ import main
from bench.paper.meshes import refined_mesh, uniform_mesh
from bench.paper.page import square_evenness
from bench.paper.printed import CORRECT, Parameters, register
from mdf_core.mixture import area_weights

ROOT = Path(__file__).resolve().parents[2]
COMMITTED = ROOT / "docs/experiments"
LARGEST_FIGURE = 150 * 1024


@pytest.fixture(scope="module")
def families():
    """One case per level of the two refinements, and none of the others."""
    return [square.solve_family(refinement, 1) for refinement in (square.MILD, square.STRONG)]


@pytest.fixture(scope="module")
def written(tmp_path_factory, families):
    """The folder that the command writes, with the square's cases as the tests know them."""
    folder = tmp_path_factory.mktemp("experiments")
    known = {family.refinement: family for family in families}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(square, "solve_family", lambda refinement, count: known[refinement])
        patch.setattr(square, "OTHERS", ())
        patch.setattr("bench.paper.page._RANDOM_LINES", 3)
        assert main(["--only", "line", "square", "--cases", "1", "--out", str(folder)]) == 0
    return folder


def rows_of(page, first_cell):
    """The numbers of the table rows that begin with a cell, as they are written."""
    lines = [line for line in page.splitlines() if line.startswith(f"| {first_cell} |")]
    return [[cell.strip() for cell in line.strip("|").split("|")][1:] for line in lines]


# The claims


@pytest.mark.parametrize("level", square.LEVELS)
def test_area_weights_beat_equal_weights_at_the_corners_and_more_the_stronger_the_refinement(families, level):
    mild, strong = families
    assert 12.0 < mild.meshes[0].contrast < 16.0
    assert mild.ratio(level) >= 2.5
    assert strong.meshes[0].contrast > 35.0
    assert strong.ratio(level) >= 10.0
    assert max(family.error(level, "mdf", "corners") for family in families) < 0.008


def test_area_weights_even_out_the_density_of_a_refined_mesh(families):
    equal, weighted, uniform = square_evenness(families[0].meshes[0]).values()
    assert equal > 5.0
    assert weighted < 2.0
    assert uniform < 1.05


def test_an_even_stretch_is_found_between_points_that_do_not_correspond():
    found = line.solve(line.PAPERS_PLACES, in_plane=False)
    assert found.errors["mdf"] < 0.05
    assert found.errors["cpd"] > 2.5 * found.errors["mdf"]


def test_the_program_of_the_printed_formulas_agrees_with_the_library_where_they_are_corrected():
    mesh = refined_mesh(replace(square.MILD, finest=0.028, coarsest=0.15), 0)
    scan = square.deformed(mesh.nodes, 0.10, 0)
    areas = mesh.nodal_areas(scan)
    parameters = Parameters(square.PARAMETERS.outlier_share, iterations=1000, tolerance=1e-7)
    design = square.DESIGN.nodes
    moved = square.SCALE * register(scan / square.SCALE, design / square.SCALE, area_weights(areas), parameters)
    exact = replace(square.PARAMETERS, tolerance=1e-7)
    np.testing.assert_allclose(square.register(scan, areas, True, exact).apply(scan), moved, atol=1e-4)


def test_the_printed_outlier_constant_does_not_do_its_work():
    values = {row.formula: row.values[0] for row in errata.outlier_constant(1)}
    assert values["corrected"] < 0.01
    assert all(value > 0.2 for formula, value in values.items() if formula.startswith("constant"))


def test_the_printed_traces_cancel():
    exact, traces = errata.three_traces()
    assert exact == pytest.approx(errata.SMALL_SIGMA**2, rel=0.1)
    assert abs(traces - exact) > 10.0 * exact


def test_refined_meshes_fill_the_square_without_gaps():
    for mesh in (refined_mesh(square.MILD, 3), uniform_mesh(7)):
        assert mesh.nodal_areas(mesh.nodes).sum() == pytest.approx(1.0, abs=1e-9)
        assert mesh.nodal_areas(mesh.nodes).min() > 0.0
    assert CORRECT.filled_dimension is None


# The page


def test_the_numbers_of_the_page_are_those_computed(written, families):
    page = (written / "README.md").read_text()
    for family in families:
        rows = rows_of(page, f"{family.meshes[0].contrast:.0f}")
        expected = [
            [f"{level:.2f}"]
            + [f"{family.error(level, method, region):.4f}" for region in square.REGIONS for method in ("cpd", "mdf")]
            + [f"{family.ratio(level):.1f}"]
            for level in square.LEVELS
        ]
        assert rows == expected
    example = line.solve(line.PAPERS_PLACES, in_plane=False).errors
    assert rows_of(page, "4, the figure's")[0][1:3] == [f"{example['cpd']:.4f}", f"{example['mdf']:.4f}"]


@pytest.mark.parametrize("folder", ["written", "committed"])
def test_every_figure_of_the_page_exists_and_is_small(folder, request):
    folder = COMMITTED if folder == "committed" else request.getfixturevalue("written")
    page = (folder / "README.md").read_text()
    named = set(re.findall(r"!\[[^]]+\]\(([\w.]+)\)", page))
    assert named == {path.name for path in folder.iterdir()} - {"README.md"}
    for name in named:
        content = (folder / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) < LARGEST_FIGURE
    assert "nan" not in page.replace("nanometre", "")
    assert not re.search(r"(?<![\w.])/(?:home|root|work|Users)/", page)


def test_the_committed_page_comes_from_the_whole_command():
    page = (COMMITTED / "README.md").read_text()
    assert "Written by `python -m bench.paper` " in page
    assert re.findall(r"^## (\d)\.", page, flags=re.MULTILINE) == ["1", "2", "3", "4"]
    anchors = set(re.findall(r"\]\(\.\./algorithm\.md#([\w-]+)\)", page))
    headings = re.findall(r"^#+ (.*)$", (ROOT / "docs/algorithm.md").read_text(), flags=re.MULTILINE)
    assert anchors <= {heading.lower().replace(" ", "-") for heading in headings}
