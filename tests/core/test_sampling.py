from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from mdf_core.errors import DegenerateScanError, InvalidSettingError, TooFewPointsError
from mdf_core.geometry import PointSet
from mdf_core.sampling import areas_from_density, check_scan, crop, estimate_normals, prepare, thin
from mdf_core.settings import CropSettings, Settings, ThinningSettings

RADIUS = 50.0
SPHERE_AREA = 4.0 * np.pi * RADIUS**2


def sphere(count: int, seed: int = 0, contrast: float = 1.0) -> np.ndarray:
    """Points on a sphere; its lower half has `contrast` times fewer."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    return points[(points[:, 2] > 0.0) | (rng.random(count) < 1.0 / contrast)]


def boxes_of(points: np.ndarray, edge: float) -> np.ndarray:
    return np.floor(points / edge).astype(int)


# --- box -----------------------------------------------------------------------------------------------------------


def test_points_outside_the_box_are_left_out_with_their_normals_and_areas() -> None:
    points = sphere(1_000)
    scan = PointSet(points, points / RADIUS, np.arange(1_000.0))
    upper = crop(scan, CropSettings((-60.0, -60.0, 0.0, 60.0, 60.0, 60.0)))
    inside = points[:, 2] >= 0.0
    np.testing.assert_array_equal(upper.points, points[inside])
    np.testing.assert_array_equal(upper.normals, points[inside] / RADIUS)
    np.testing.assert_array_equal(upper.areas, np.flatnonzero(inside))
    assert crop(scan, CropSettings()) is scan


def test_a_box_beside_the_scan_is_told_where_the_scan_is() -> None:
    with pytest.raises(TooFewPointsError, match=r"only 0 of 1000 points .* from \[-\d\d\.\d* .*in mm"):
        crop(PointSet(sphere(1_000)), CropSettings((0.0, 0.0, 1_000.0, 1.0, 1.0, 1_001.0)))


# --- areas ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_areas_follow_a_tenfold_density_contrast(seed: int) -> None:
    points = sphere(20_000, seed, contrast=10.0)
    areas = areas_from_density(points)
    dense, sparse = areas[points[:, 2] > 5.0], areas[points[:, 2] < -5.0]
    assert areas.sum() == pytest.approx(SPHERE_AREA, rel=0.1)
    assert sparse.mean() / dense.mean() == pytest.approx(10.0, rel=0.15)


def test_points_of_a_lattice_stand_for_one_cell_each() -> None:
    lattice = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    inner = ((lattice > 4) & (lattice < 35)).all(axis=1)
    np.testing.assert_allclose(areas_from_density(lattice)[inner], 1.0, rtol=0.1)


def test_copies_of_a_point_share_its_area() -> None:
    points = sphere(2000)
    areas = areas_from_density(points)
    repeated = areas_from_density(np.repeat(points, 20, axis=0))
    np.testing.assert_allclose(repeated, np.repeat(areas / 20, 20), rtol=1e-12)


def test_areas_scale_with_the_square_of_the_size() -> None:
    points = sphere(500)
    np.testing.assert_allclose(areas_from_density(3.0 * points), 9.0 * areas_from_density(points), rtol=1e-12)


def test_fewer_points_than_neighbours_still_have_areas() -> None:
    assert (areas_from_density(np.eye(3)) > 0.0).all()


def test_one_spot_has_no_density() -> None:
    with pytest.raises(DegenerateScanError, match="one spot"):
        areas_from_density(np.ones((10, 3)))


# --- normals -------------------------------------------------------------------------------------------------------


def test_normals_of_a_sphere_point_along_its_radii() -> None:
    points = sphere(20_000)
    normals = estimate_normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    cosines = np.abs((normals * points / RADIUS).sum(axis=1))
    assert np.degrees(np.arccos(cosines.clip(max=1.0))).max() < 4.0


def test_normals_of_a_plane_are_exact() -> None:
    rng = np.random.default_rng(0)
    normal = np.array([2.0, 3.0, 6.0]) / 7.0
    points = rng.normal(size=(500, 3))
    points -= np.outer(points @ normal, normal)
    np.testing.assert_allclose(np.abs(estimate_normals(points) @ normal), 1.0, rtol=1e-12)


def test_normals_of_a_plane_curve_are_plane_vectors() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 2_000, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(np.abs((estimate_normals(circle) * circle).sum(axis=1)), 1.0, atol=1e-3)


def test_normals_of_many_copies_are_finite() -> None:
    normals = estimate_normals(np.repeat(sphere(10), 30, axis=0))
    assert np.isfinite(normals).all()


# --- thinning ------------------------------------------------------------------------------------------------------


def test_one_point_per_box_stays_and_takes_the_areas_of_its_box() -> None:
    points = sphere(5000)
    areas = np.random.default_rng(1).random(len(points))
    thinned = thin(PointSet(points, points / RADIUS, areas), ThinningSettings(box_mm=10.0), seed=0)
    boxes = boxes_of(points, 10.0)
    _, box_of = np.unique(boxes, axis=0, return_inverse=True)
    index_of = {tuple(point): index for index, point in enumerate(points)}
    kept = np.array([index_of[tuple(point)] for point in thinned.points])
    assert sorted(box_of.reshape(-1)[kept]) == list(range(box_of.max() + 1))
    assert (np.diff(kept) > 0).all(), "points keep their order"
    np.testing.assert_array_equal(thinned.normals, points[kept] / RADIUS)
    np.testing.assert_allclose(thinned.areas, np.bincount(box_of.reshape(-1), areas)[box_of.reshape(-1)[kept]])


def test_a_box_edge_applies_to_small_scans_too() -> None:
    assert len(thin(PointSet(sphere(500) + 100.0), ThinningSettings(box_mm=200.0), seed=0)) == 1


def test_a_scan_thinned_twice_with_the_same_boxes_is_thinned_once() -> None:
    settings = ThinningSettings(box_mm=6.0)
    once = thin(PointSet(sphere(20_000)), settings, seed=0)
    assert len(once) < 2_000
    twice = thin(PointSet(once.points.astype(np.float32).astype(np.float64)), settings, seed=1)
    assert len(twice) >= 0.99 * len(once)


def test_the_kept_points_are_points_of_the_scan_picked_without_preference() -> None:
    # 4000 boxes with the same ten offsets in each: a fair pick takes every offset about equally often.
    offsets = np.linspace(0.05, 0.95, 10)
    points = np.stack([np.add.outer(np.arange(4000.0), offsets).ravel(), np.zeros(40_000), np.zeros(40_000)], axis=1)
    points = np.concatenate([[[0.0, 0.0, 0.0]], points])  # anchors the grid at zero
    thinned = thin(PointSet(points), ThinningSettings(box_mm=1.0), seed=0)
    assert {*thinned.points[:, 0]} <= {*points[:, 0]}
    picks = np.bincount(np.rint(thinned.points[1:, 0] % 1.0 * 10.0 - 0.5).astype(int), minlength=10)
    assert picks.sum() == 3999
    assert picks.min() > 330
    assert picks.max() < 470


def test_the_same_seed_picks_the_same_points_and_another_seed_others() -> None:
    scan, settings = PointSet(sphere(5000)), ThinningSettings(box_mm=10.0)
    assert thin(scan, settings, seed=1).sha256() == thin(scan, settings, seed=1).sha256()
    assert thin(scan, settings, seed=1).sha256() != thin(scan, settings, seed=2).sha256()


def test_a_point_that_moves_to_another_box_changes_no_third_box() -> None:
    points = sphere(5000)
    moved = points.copy()
    moved[2500] += [11.0, 0.0, 0.0] if moved[2500, 0] < 0.0 else [-11.0, 0.0, 0.0]
    touched = {tuple(boxes_of(cloud, 10.0)[2500]) for cloud in (points, moved)}
    assert len(touched) == 2
    before, after = (
        {
            tuple(point)
            for point in thin(PointSet(cloud), ThinningSettings(box_mm=10.0), seed=0).points
            if tuple(boxes_of(point, 10.0)) not in touched
        }
        for cloud in (points, moved)
    )
    assert before == after


@pytest.mark.parametrize("target", [100, 1000, 19_000])
@pytest.mark.parametrize("contrast", [1.0, 30.0])
def test_without_a_box_edge_the_target_is_nearly_reached_and_never_exceeded(target: int, contrast: float) -> None:
    points = sphere(40_000, contrast=contrast)
    thinned = thin(PointSet(points, areas=np.ones(len(points))), ThinningSettings(target_points=target), seed=0)
    assert 0.85 * target <= len(thinned) <= target
    assert thinned.areas is not None
    assert 0.99 * len(points) <= thinned.areas.sum() <= len(points)


def test_scattered_outliers_do_not_take_the_places_of_the_surface() -> None:
    surface = sphere(400_000, contrast=10.0)
    outliers = np.random.default_rng(5).uniform(-80.0, 80.0, size=(4_000, 3))
    far = PointSet(np.vstack([surface, outliers[np.abs(np.linalg.norm(outliers, axis=1) - 50.0) > 5.0]]))
    thinned = thin(far, ThinningSettings(target_points=20_000), seed=0)
    off_surface = np.abs(np.linalg.norm(thinned.points, axis=1) - 50.0) > 1.0
    assert off_surface.mean() < 0.01
    assert len(thinned) > 15_000


def test_scans_within_the_target_stay_as_they_are() -> None:
    scan = PointSet(sphere(1000))
    assert thin(scan, ThinningSettings(target_points=len(scan)), seed=0) is scan


def test_many_points_are_thinned_evenly() -> None:
    points = sphere(200_000, contrast=10.0)
    thinned = thin(PointSet(points), ThinningSettings(target_points=5000), seed=0)
    assert 4500 <= len(thinned) <= 5000
    spacing = KDTree(thinned.points).query(points)[0].max()
    assert spacing < 3.0 * np.sqrt(SPHERE_AREA / 5000)


@pytest.mark.parametrize(
    ("points", "distinct"),
    [
        (np.repeat(np.eye(3), 200, axis=0), 3),
        (np.ones((600, 3)), 1),
    ],
    ids=["three spots", "one spot"],
)
def test_copies_are_thinned_to_the_distinct_points(points: np.ndarray, distinct: int) -> None:
    assert len(thin(PointSet(points), ThinningSettings(target_points=100), seed=0)) == distinct


def test_a_lattice_that_no_edge_thins_to_the_target_stays_below_it() -> None:
    side = np.arange(100.0)
    lattice = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    assert 5000 <= len(thin(PointSet(lattice), ThinningSettings(target_points=7000), seed=0)) <= 7000


def test_a_stray_point_far_away_does_not_stop_the_thinning() -> None:
    points = np.concatenate([sphere(40_000), [[1e4, 0.0, 0.0]]])
    assert 1800 <= len(thin(PointSet(points), ThinningSettings(target_points=2000), seed=0)) <= 2000


def test_boxes_too_small_to_number_are_refused() -> None:
    with pytest.raises(InvalidSettingError, match=r"^setting thinning\.box_mm: 1e-06 mm is too small for a scan of"):
        thin(PointSet(sphere(100)), ThinningSettings(box_mm=1e-6), seed=0)


def test_many_more_boxes_than_points_are_no_matter() -> None:
    points = sphere(1000)
    thinned = thin(PointSet(points, areas=np.ones(len(points))), ThinningSettings(box_mm=1e-3), seed=0)
    np.testing.assert_array_equal(thinned.points, points)
    np.testing.assert_array_equal(thinned.areas, 1.0)


def test_plane_sets_are_thinned_too() -> None:
    points = np.random.default_rng(0).random((5000, 2))
    assert 900 <= len(thin(PointSet(points), ThinningSettings(target_points=1000), seed=0)) <= 1000


# --- preparation ---------------------------------------------------------------------------------------------------


def test_a_prepared_scan_has_areas_and_normals_of_the_points_kept() -> None:
    settings = Settings(thinning=ThinningSettings(target_points=3000))
    prepared = prepare(PointSet(sphere(30_000, contrast=10.0)), settings)
    assert 2700 <= len(prepared) <= 3000
    np.testing.assert_array_equal(prepared.areas, areas_from_density(prepared.points))
    np.testing.assert_array_equal(np.abs(prepared.normals), np.abs(estimate_normals(prepared.points)))
    # No side is known, and none seems to be.
    assert ((prepared.normals * prepared.points).sum(axis=1) > 0).mean() == pytest.approx(0.5, abs=0.05)


def test_the_box_is_cut_out_before_anything_is_thinned() -> None:
    # Thinned first, the table's points would take the places of the part's.
    part, table = sphere(4_000), np.random.default_rng(0).uniform(-500.0, 500.0, (40_000, 3)) * [1.0, 1.0, 0.0]
    table[:, 2] = -2.0 * RADIUS
    box = CropSettings((*[-1.5 * RADIUS] * 3, *[1.5 * RADIUS] * 3))
    settings = Settings(crop=box, thinning=ThinningSettings(target_points=3_000))
    prepared = prepare(PointSet(np.concatenate([table, part])), settings)
    assert prepared.sha256() == prepare(PointSet(part), settings).sha256()
    assert 2_700 <= len(prepared) <= 3_000


def test_given_areas_and_normals_are_kept() -> None:
    points = sphere(30_000)
    settings = Settings(thinning=ThinningSettings(target_points=3000))
    prepared = prepare(PointSet(points, points / RADIUS, np.ones(len(points))), settings)
    np.testing.assert_allclose(prepared.normals, prepared.points / RADIUS)
    assert prepared.areas is not None
    assert prepared.areas.sum() == len(points)


def test_preparing_twice_changes_nothing() -> None:
    settings = Settings(thinning=ThinningSettings(target_points=3000))
    once = prepare(PointSet(sphere(30_000)), settings)
    assert prepare(once, settings).sha256() == once.sha256()


@pytest.mark.parametrize(("count", "told"), [(1, "1 point;"), (2, "2 points;"), (49, "49 points;")])
def test_too_few_points_are_refused(count: int, told: str) -> None:
    with pytest.raises(TooFewPointsError, match=f"{told} a registration needs at least 50"):
        prepare(PointSet(sphere(count)), Settings())


def test_fifty_points_are_enough_to_begin_with() -> None:
    check_scan(PointSet(sphere(50)))


SPREAD = np.random.default_rng(0).normal(size=(400, 3))
TILT = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    ("extents", "told"),
    [
        ((0.0, 0.0, 0.0), "one spot"),
        ((30.0, 0.0, 0.0), r"one line \(.*: 58\.8 x \S+ x \S+ mm\)"),
        ((30.0, 0.01, 0.01), "one line"),
        ((30.0, 20.0, 0.0), r"one plane \(.*: 58\.9 x 38\.8 x \S+ mm\)"),
        ((30.0, 20.0, 0.03), "one plane"),
    ],
)
def test_flat_and_thin_clouds_are_refused_wherever_they_lie(extents: tuple[float, ...], told: str) -> None:
    for offset in (0.0, 1e4):
        with pytest.raises(DegenerateScanError, match=told):
            prepare(PointSet(SPREAD * extents @ TILT + offset), Settings())


def test_a_thin_plate_is_no_plane() -> None:
    check_scan(PointSet(SPREAD * [30.0, 20.0, 0.1] @ TILT))


def test_plane_sets_only_need_two_extents() -> None:
    check_scan(PointSet(SPREAD[:, :2]))
    with pytest.raises(DegenerateScanError, match="one line"):
        check_scan(PointSet(SPREAD[:, :2] * [1.0, 0.0]))


@pytest.mark.parametrize("areas", [np.zeros(400), np.r_[-1.0, np.ones(399)]])
def test_areas_that_cannot_be_areas_are_refused(areas: np.ndarray) -> None:
    with pytest.raises(DegenerateScanError, match="areas"):
        check_scan(PointSet(SPREAD, areas=areas))
