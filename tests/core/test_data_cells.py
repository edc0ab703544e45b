"""Data points in cells and blocks."""

import numpy as np
import pytest

from mdf_core.data_cells import gather


@pytest.fixture
def points(rng):
    return rng.normal(size=(1500, 3)) + 40.0


def leaves(block):
    return [leaf for half in block.halves for leaf in leaves(half)] or [block]


def test_with_no_width_every_point_is_its_own_cell(points):
    cells = gather(points, 0.0)
    means = cells.means + cells.origin
    order, wanted = np.lexsort(means.T), np.lexsort(points.T)
    np.testing.assert_allclose(means[order], points[wanted], rtol=0.0, atol=1e-13)
    assert (cells.counts == 1.0).all()
    assert len(cells.means) == len(points)


@pytest.mark.parametrize("width", [0.0, 0.3, 2.0, 1e3])
def test_cells_keep_the_number_the_mean_and_the_square_of_the_points(points, width):
    cells = gather(points, width)
    counts, local = cells.counts, points - cells.origin
    assert counts.sum() == len(points)
    np.testing.assert_allclose(counts @ cells.means, local.sum(axis=0), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(counts @ cells.squares, (local**2).sum(), rtol=1e-12)


@pytest.mark.parametrize("width", [0.3, 2.0])
def test_no_cell_is_wider_than_asked(points, width):
    cells = gather(points, width)
    within = cells.squares - (cells.means**2).sum(axis=1)
    assert len(cells.counts) < len(points)
    assert within.min() > -1e-12
    assert within.max() <= 3.0 * (0.5 * width) ** 2 + 1e-12


def test_one_cell_holds_all_where_it_is_wide_enough(points):
    cells = gather(points, 1e3)
    assert cells.counts.tolist() == [1500.0]


def test_blocks_are_small_hold_every_cell_and_their_radius_covers_them(points):
    cells = gather(points, 0.0)
    ends = [0]
    for block in leaves(cells.blocks):
        inside = cells.means[block.begin : block.end]
        assert 100 <= len(inside) <= 256
        assert np.linalg.norm(inside - block.centre, axis=1).max() <= block.radius < 0.9 * cells.blocks.radius
        assert block.begin == ends[-1]
        ends.append(block.end)
    assert ends[-1] == len(points)


@pytest.mark.parametrize("width", [0.0, 1e-3])
def test_copies_and_far_points_are_no_trouble(width):
    points = np.vstack([np.zeros((1000, 3)), [[1e9, 0.0, 0.0]]])
    cells = gather(points, width)
    assert cells.counts.sum() == 1001.0
    assert max(block.end - block.begin for block in leaves(cells.blocks)) <= 256
