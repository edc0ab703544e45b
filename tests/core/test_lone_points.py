"""What only one point of a scan shows is not shown."""

import numpy as np
import pytest

from mdf_core.lone_points import ShownPlaces

UP, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])


def plate(rng, count=2_000):
    """Points of its upper side."""
    feet = np.column_stack([rng.uniform(0.0, 100.0, size=(count, 2)), np.ones(count)])
    return feet, np.tile(UP, (count, 1))


@pytest.mark.parametrize("count", [300, 2_000, 20_000])
def test_points_among_others_are_not_alone_however_many_there_are(count, rng):
    assert not ShownPlaces(*plate(rng, count)).lone().any()


def test_points_that_occur_several_times_are_not_alone(rng):
    feet, normals = plate(rng)
    assert not ShownPlaces(np.repeat(feet, 5, axis=0), np.repeat(normals, 5, axis=0)).lone().any()


@pytest.mark.parametrize("places", [1, 2, 3])
def test_points_that_all_came_to_a_few_places_are_not_alone(places):
    feet = np.repeat(np.eye(3)[:places], 10, axis=0)
    assert not ShownPlaces(feet, np.tile(UP, (len(feet), 1))).lone().any()


@pytest.mark.parametrize("outliers", [1, 2, 3])
def test_a_few_points_of_a_face_that_is_not_seen_are_alone_though_others_lie_behind_it(outliers, rng):
    feet, normals = plate(rng)
    below = np.column_stack([rng.uniform(0.0, 100.0, size=(outliers, 2)), np.zeros(outliers)])
    shown = ShownPlaces(np.concatenate([feet, below]), np.concatenate([normals, np.tile(DOWN, (outliers, 1))]))
    np.testing.assert_array_equal(np.flatnonzero(shown.lone()), len(feet) + np.arange(outliers))


def test_sparse_regions_are_shown():
    # A twentieth of the points per area of the rest.
    places = np.stack(np.meshgrid(np.arange(0.0, 50.0), np.arange(0.0, 100.0)), axis=-1).reshape(-1, 2)
    sparse = np.stack(np.meshgrid(np.arange(52.0, 100.0, 4.5), np.arange(0.0, 100.0, 4.5)), axis=-1).reshape(-1, 2)
    feet = np.column_stack([np.concatenate([places, sparse]), np.ones(len(places) + len(sparse))])
    assert not ShownPlaces(feet, np.tile(UP, (len(feet), 1))).lone().any()


def test_what_the_points_show_ends_where_they_end(rng):
    feet, normals = plate(rng)
    shown = ShownPlaces(feet, normals)
    places = np.array([[50.0, 50.0, 1.0], [103.0, 50.0, 1.0], [150.0, 50.0, 1.0], [50.0, 50.0, 1.0]])
    assert shown.leave_out(places, np.stack([UP, UP, UP, DOWN])).tolist() == [False, False, True, True]
