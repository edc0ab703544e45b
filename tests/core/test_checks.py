"""What a redesign is checked for before it is released: all of it, and nothing else is refused."""

import numpy as np
import pytest
from check_samples import NAMES, NO_LIMITS, checks, distance, failed, unmerged

from mdf_core.check_result import describe_failures
from mdf_core.checks import check_redesign
from mdf_core.errors import DesignMismatchError
from mdf_core.settings import ReleaseSettings
from mdf_core.virtual_cell import PARTS, Warp

# Nothing wrong


@pytest.mark.parametrize("name", PARTS)
def test_a_redesign_that_changes_nothing_passes(build, name):
    design = build(name)
    settings = ReleaseSettings(max_move_mm=1e-6, max_stretch=1e-6, max_thickness_change=1e-6)
    found = checks(design, design.vertices, settings, fixed=range(len(design.vertices)))
    assert failed(found) == []
    assert "+0.000 %" in found["volume"].finding


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("seed", [0, 8])
def test_a_smooth_warp_of_ordinary_size_passes(build, name, seed):
    design = build(name)
    vertices = design.vertices + Warp(design, 2.5, seed=seed)(design.vertices)
    found = checks(design, vertices, ReleaseSettings(max_move_mm=2.5))
    assert describe_failures(list(found.values())) == ""


def test_vertices_that_are_not_shared_between_faces_make_no_difference(build):
    design = unmerged(build("clip"))
    found = checks(design, design.vertices + Warp(design, 2.5)(design.vertices), ReleaseSettings())
    assert failed(found) == []
    assert "encloses no volume" not in found["volume"].finding


def test_the_same_input_gives_the_same_answer(build):
    design = build("pair")
    vertices = design.vertices + [16.5, 0.0, 0.0] * (design.vertices[:, :1] < 45.0)
    first, *others = (checks(design, vertices) for _ in range(5))
    assert not first["self_intersections"].passed
    assert all(other == first for other in others)


# Vertices that are nowhere


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_vertices_that_are_no_place_fail_what_cannot_be_checked(build, value):
    design = build("clip")
    vertices = design.vertices.copy()
    vertices[[300, 400], 1] = value
    found = checks(design, vertices, ReleaseSettings(), fixed=[5, 6])
    assert failed(found) == NAMES[:7]
    for name in NAMES[:7]:
        assert "2 of" in found[name].finding and "NaN or infinite" in found[name].finding
        assert distance(found[name], design.vertices[300]) == 0.0
    assert "not known" in found["volume"].finding
    moved_away = checks(design, vertices, fixed=[5, 400])
    assert failed(moved_away) == NAMES[:8]
    assert "not checked" in moved_away["fixed_regions"].finding
    vertices[5] += 1.0
    assert distance(checks(design, vertices, fixed=[5, 6])["fixed_regions"], design.vertices[5]) == 0.0


@pytest.mark.parametrize("everywhere", [False, True])
def test_vertices_far_away_or_all_on_one_spot_fail_without_an_error(build, everywhere):
    design = build("clip")
    vertices = design.vertices.copy()
    vertices[:] = vertices[0] if everywhere else vertices
    vertices[7] = vertices[0] if everywhere else 3e38
    found = checks(design, vertices, ReleaseSettings(max_move_mm=5.0))
    assert {"stretch", "largest_move"} <= set(failed(found))
    assert found["watertight"].passed is not everywhere


@pytest.mark.parametrize("change", ["vertices", "fixed"])
def test_the_redesign_of_another_design_is_refused(build, change):
    design = build("clip")
    vertices, fixed = design.vertices, np.zeros(len(design.vertices), dtype=bool)
    vertices, fixed = (vertices[1:], fixed) if change == "vertices" else (vertices, fixed[1:])
    with pytest.raises(DesignMismatchError, match=change):
        check_redesign(design, vertices, fixed, NO_LIMITS)
