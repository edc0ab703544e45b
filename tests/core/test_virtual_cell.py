import io
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from mdf_core.distortion import distortion_left, fraction_unrecovered
from mdf_core.errors import InvalidSettingError
from mdf_core.rigid import best_rigid_fit, inverse, rotate, transform
from mdf_core.virtual_cell import PARTS, Printer, ScannerSettings, Warp, build_part, scan_part

part = cache(build_part)


def scan(name="bracket", seed=0, **settings):
    return scan_part(part(name).vertices, part(name).faces, ScannerSettings(**settings), seed)


def source_points(virtual, design):
    return np.einsum("nc,ncd->nd", virtual.barycentric, design.triangles[virtual.source_faces])


# Parts


@pytest.mark.parametrize("name", PARTS)
def test_every_body_of_a_part_is_watertight_outward_and_without_flat_triangles(name):
    design = part(name)
    bodies = trimesh.Trimesh(design.vertices, design.faces, process=False).split(only_watertight=False)
    assert len(bodies) == (2 if name == "pair" else 1)
    assert all(body.is_watertight and body.is_winding_consistent and body.volume > 0 for body in bodies)
    assert design.face_areas.min() > 0


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_dense_enough_to_carry_a_warp(name):
    design = part(name)
    edges = np.linalg.norm(design.triangles - np.roll(design.triangles, 1, axis=1), axis=2)
    assert edges.max() < 4.0 + 1e-4
    assert 3_000 < len(design.vertices) < 20_000
    assert 79 < np.ptp(design.vertices, axis=0).max() < 110


@pytest.mark.parametrize("name", PARTS)
def test_a_part_survives_a_binary_stl_unchanged(name):
    design = part(name)
    stl = trimesh.Trimesh(design.vertices, design.faces, process=False).export(file_type="stl")
    again = trimesh.load_mesh(io.BytesIO(stl), file_type="stl")
    assert again.is_watertight
    np.testing.assert_array_equal(np.unique(again.vertices, axis=0), np.unique(design.vertices, axis=0))
    assert len(again.vertices) == len(design.vertices)


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_the_same_bytes_every_time(name):
    again = build_part(name)
    assert again.vertices.tobytes() == part(name).vertices.tobytes()
    assert again.faces.tobytes() == part(name).faces.tobytes()


def test_an_unknown_part_is_refused_with_the_known_ones():
    with pytest.raises(InvalidSettingError, match="bracket, clip"):
        build_part("teapot")


# Warp


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("amplitude", [0.5, 9.0])
def test_a_warp_has_exactly_its_amplitude_and_no_rigid_part(name, amplitude):
    design = part(name)
    displacement = Warp(design, amplitude, seed=4)(design.vertices)
    assert np.linalg.norm(displacement, axis=1).max() == pytest.approx(amplitude, rel=1e-12)
    fit = best_rigid_fit(design.vertices, design.vertices + displacement, design.vertex_areas)
    np.testing.assert_allclose(fit, np.eye(4), atol=1e-10)


def test_a_warp_is_determined_by_its_seed():
    design = part("bracket")
    first, again, other = (Warp(design, 1.0, seed=seed)(design.vertices) for seed in (1, 1, 2))
    assert first.tobytes() == again.tobytes()
    assert np.corrcoef(first.ravel(), other.ravel())[0, 1] < 0.9


def test_a_warp_is_smooth_and_defined_away_from_the_part():
    warp = Warp(part("bracket"), 1.0, 35.0)
    points = np.random.default_rng(0).uniform(-50, 150, size=(500, 3))
    assert np.isfinite(warp(points)).all()
    steps = warp(points + np.array([1e-3, 0, 0])) - warp(points)
    assert np.linalg.norm(steps, axis=1).max() < 2e-4


@pytest.mark.parametrize("length", [4.0, 8.0])
def test_waves_have_the_asked_correlation_length(length):
    # The variation of prints is the waves alone; so short against the part, they lose little with their rigid part.
    design = part("clip")
    printer = Printer(Warp(design, 1.0, length), variation=1.0)
    rng = np.random.default_rng(0)
    here = design.vertices[:: len(design.vertices) // 30]
    directions = rng.normal(size=here.shape)
    there = here + length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    pairs = np.vstack([here, there])
    waves = np.array([printer.print_part(pairs, seed) for seed in range(60)]) - printer.print_part(pairs)
    a, b = waves[:, : len(here)].ravel(), waves[:, len(here) :].ravel()
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(np.exp(-0.5), abs=0.06)


def test_the_warps_rms_is_that_of_its_displacement():
    design = part("clip")
    warp = Warp(design, 3.0)
    squares = (warp(design.vertices) ** 2).sum(axis=1)
    assert warp.rms_mm == pytest.approx(np.sqrt(np.average(squares, weights=design.vertex_areas)))


# Printer


def test_a_spatial_printer_distorts_by_place():
    design = part("bracket")
    warp = Warp(design, 2.0)
    redesign = design.vertices + np.array([3.0, -1.0, 2.0])
    np.testing.assert_array_equal(Printer(warp).print_part(redesign), redesign + warp(redesign))


def test_a_material_printer_distorts_every_vertex_alike_wherever_the_redesign_puts_it():
    design = part("bracket")
    warp = Warp(design, 2.0)
    redesign = design.vertices + np.array([3.0, -1.0, 2.0])
    printer = Printer(warp, "material")
    np.testing.assert_array_equal(printer.print_part(redesign), redesign + warp(design.vertices))
    some = slice(0, 50)
    printed = printer.print_part(redesign[some], material_vertices=design.vertices[some])
    np.testing.assert_allclose(printed, printer.print_part(redesign)[some], rtol=0, atol=1e-12)
    with pytest.raises(InvalidSettingError, match="material_vertices"):
        printer.print_part(redesign[some])


@pytest.mark.parametrize("model", ["spatial", "material"])
def test_prints_vary_by_the_asked_share_around_the_mean_print(model):
    design = part("clip")
    warp = Warp(design, 2.0)
    printer = Printer(warp, model, variation=0.1)
    mean = printer.print_part(design.vertices)
    np.testing.assert_array_equal(mean, design.vertices + warp(design.vertices))
    deviations = np.array([printer.print_part(design.vertices, seed) - mean for seed in range(16)])
    rms = np.sqrt(np.average((deviations**2).sum(axis=2), axis=1, weights=design.vertex_areas))
    np.testing.assert_allclose(rms, 0.1 * warp.rms_mm, rtol=1e-10)
    averaged = np.sqrt(np.average((deviations.mean(axis=0) ** 2).sum(axis=1), weights=design.vertex_areas))
    assert averaged < 0.1 * warp.rms_mm * 2 / np.sqrt(16)
    assert printer.print_part(design.vertices, 7).tobytes() == printer.print_part(design.vertices, 7).tobytes()


def test_the_variation_of_print_n_is_not_the_warp_of_seed_n():
    design = part("bracket")
    warp = Warp(design, 2.0, seed=5)
    printer = Printer(warp, variation=1.0)
    variation = printer.print_part(design.vertices, seed=5) - printer.print_part(design.vertices)
    assert abs(np.corrcoef(variation.ravel(), warp(design.vertices).ravel())[0, 1]) < 0.7


# Scanner


def test_a_scan_is_determined_by_its_seed():
    options = {"points": 500, "pose": "random", "density_contrast": 5.0, "hidden_share": 0.2}
    assert scan(seed=1, **options).scan.sha256() == scan(seed=1, **options).scan.sha256()
    assert scan(seed=1, **options).scan.sha256() != scan(seed=2, **options).scan.sha256()


def test_points_lie_on_their_source_up_to_the_noise():
    design = part("bracket")
    virtual = scan(points=20_000, noise_mm=0.05, outlier_share=0.02, pose="random")
    good = ~virtual.is_outlier
    placed = transform(inverse(virtual.pose), virtual.scan.points)
    errors = (placed - source_points(virtual, design))[good]
    np.testing.assert_allclose(errors.std(axis=0), 0.05, rtol=0.03)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=0.002)
    np.testing.assert_allclose(virtual.barycentric[good].sum(axis=1), 1.0)


def test_a_ripple_lies_along_the_normals_and_is_shared_by_neighbours():
    plain, rippled = (
        scan(points=20_000, outlier_share=0.0, noise_mm=0.0, ripple_mm=ripple, ripple_length_mm=15.0)
        for ripple in (0.0, 0.03)
    )
    offsets, normals = rippled.scan.points - plain.scan.points, part("bracket").face_normals[plain.source_faces]
    heights = np.einsum("ij,ij->i", offsets, normals)
    np.testing.assert_allclose(offsets, heights[:, None] * normals, atol=1e-12)
    assert heights.std() == pytest.approx(0.03, rel=0.2)
    near = KDTree(plain.scan.points).query_pairs(15.0, output_type="ndarray")
    apart = np.linalg.norm(plain.scan.points[near[:, 0]] - plain.scan.points[near[:, 1]], axis=1)
    for distance, correlation in ((1.0, 1.0), (14.5, np.exp(-0.5 * (14.5 / 15.0) ** 2))):
        first, second = heights[near[np.abs(apart - distance) < 0.5]].T
        assert np.mean(first * second) / heights.var() == pytest.approx(correlation, abs=0.15)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2])
def test_the_share_of_outliers_is_exact_and_they_have_no_source(share):
    virtual = scan(points=2_000, outlier_share=share)
    assert len(virtual.scan) == 2_000
    assert virtual.is_outlier.sum() == round(2_000 * share)
    np.testing.assert_array_equal(virtual.is_outlier, virtual.source_faces == -1)


def test_outliers_fill_the_padded_box():
    design = part("bracket")
    virtual = scan(points=4_000, outlier_share=0.5)
    outliers = virtual.scan.points[virtual.is_outlier]
    low, high = design.vertices.min(axis=0), design.vertices.max(axis=0)
    margin = 0.1 * np.linalg.norm(high - low)
    assert (outliers >= low - margin).all() and (outliers <= high + margin).all()
    np.testing.assert_allclose(np.ptp(outliers, axis=0), high - low + 2 * margin, rtol=0.02)


def test_normals_point_outward_and_turn_with_the_pose():
    design = part("hub")
    virtual = scan("hub", points=5_000, pose="random", normal_noise=0.03)
    good = ~virtual.is_outlier
    np.testing.assert_allclose(np.linalg.norm(virtual.scan.normals, axis=1), 1.0)
    normals = rotate(inverse(virtual.pose), virtual.scan.normals)[good]
    cosines = (normals * design.face_normals[virtual.source_faces[good]]).sum(axis=1)
    angles = np.arccos(np.clip(cosines, -1, 1))
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.03 * np.sqrt(2), rel=0.05)
    assert scan(points=100, normals=False).scan.normals is None
    assert virtual.scan.areas is None


def test_a_random_pose_is_rigid_and_within_200_mm_and_a_given_one_is_taken():
    poses = np.array([scan(seed=seed, points=10, pose="random").pose for seed in range(40)])
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    distances = np.linalg.norm(poses[:, :3, 3], axis=1)
    assert distances.max() <= 200 and distances.max() > 150
    # Haar: the mean rotation is zero.
    assert np.abs(rotations.mean(axis=0)).max() < 0.35
    np.testing.assert_array_equal(scan(points=10, pose=poses[0]).pose, poses[0])
    np.testing.assert_array_equal(scan(points=10).pose, np.eye(4))


def test_the_pose_and_the_noise_do_not_change_which_points_are_taken():
    plain, moved = scan(points=500), scan(points=500, pose="random", noise_mm=0.04)
    np.testing.assert_array_equal(plain.source_faces, moved.source_faces)
    np.testing.assert_array_equal(plain.barycentric, moved.barycentric)


def test_points_are_spread_evenly_unless_a_contrast_is_asked():
    design = part("bracket")
    virtual = scan(points=100_000, outlier_share=0.0)
    counts = np.bincount(virtual.source_faces, minlength=len(design.faces))
    expected = 100_000 * design.face_areas / design.face_areas.sum()
    large = expected > 5
    assert ((counts - expected)[large] ** 2 / expected[large]).mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("contrast", [3.0, 10.0, 40.0])
@pytest.mark.parametrize("name", ["bracket", "plate"])
def test_the_density_varies_by_the_asked_contrast(name, contrast):
    design = part(name)
    virtual = scan(name, points=100_000, outlier_share=0.0, density_contrast=contrast)
    blocks = np.round(np.hstack([design.triangles.mean(axis=1) / 8.0, 3 * design.face_normals]))
    _, block = np.unique(blocks, axis=0, return_inverse=True)
    areas = np.bincount(block.ravel(), design.face_areas)
    points = np.bincount(block.ravel()[virtual.source_faces], minlength=len(areas))
    density = (points / areas)[block.ravel()[virtual.source_faces]]
    low, high = np.percentile(density, (5, 95))
    assert high / low == pytest.approx(contrast, rel=0.2)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("direction", [None, (0.0, 0.0, 1.0), (-1.0, 2.0, 0.0)])
def test_the_hidden_share_of_the_area_is_met(share, direction):
    design = part("bracket")
    virtual = scan(points=300_000, outlier_share=0.0, hidden_share=share, hidden_direction=direction)
    hit = np.unique(virtual.source_faces)
    assert design.face_areas[hit].sum() / design.face_areas.sum() == pytest.approx(1 - share, abs=0.02)
    assert virtual.seen_vertices[design.faces[hit]].all()
    hidden_vertices = np.setdiff1d(np.arange(len(design.vertices)), design.faces[hit])
    assert (
        design.vertex_areas[virtual.seen_vertices[hidden_vertices].nonzero()[0]].sum() < 0.01 * design.face_areas.sum()
    )


def test_the_hidden_side_faces_the_hidden_direction():
    virtual = scan(points=20_000, outlier_share=0.0, hidden_share=0.3, hidden_direction=(0.0, 0.0, -1.0))
    whole = scan(points=20_000, outlier_share=0.0)
    assert (whole.scan.normals[:, 2] < -0.9).mean() > 0.2
    assert (virtual.scan.normals[:, 2] < -0.9).mean() < 0.02


def test_without_a_hidden_share_every_vertex_is_seen():
    assert scan(points=10).seen_vertices.all()


# How much was recovered


def test_the_exact_truth_leaves_nothing_whatever_the_pose_on_the_scanner():
    design = part("bracket")
    true = Warp(design, 2.5)(design.vertices)
    moved = transform(scan(points=1, pose="random").pose, design.vertices + true) - design.vertices
    assert fraction_unrecovered(design, true, true) < 1e-9
    assert fraction_unrecovered(design, true, moved) < 1e-9
    assert fraction_unrecovered(design, moved, true) < 1e-9


def test_estimating_nothing_leaves_everything():
    design = part("bracket")
    true = Warp(design, 2.5)(design.vertices)
    assert fraction_unrecovered(design, true, 0 * true) == pytest.approx(1.0, rel=1e-12)


def test_a_wrong_share_of_the_distortion_is_the_fraction():
    design = part("bracket")
    true = Warp(design, 0.01)(design.vertices)
    assert fraction_unrecovered(design, true, 0.9 * true) == pytest.approx(0.1, rel=1e-3)
    assert fraction_unrecovered(design, true, 3 * true) == pytest.approx(2.0, rel=1e-3)


def test_only_the_vertices_of_the_mask_are_judged():
    design = part("bracket")
    true = Warp(design, 2.5)(design.vertices)
    mask = design.vertices[:, 0] > 30
    estimate = np.where(mask[:, None], true, 0.0)
    assert fraction_unrecovered(design, true, estimate, mask) < 1e-9
    assert fraction_unrecovered(design, true, estimate) > 0.3


def test_a_fraction_of_nothing_is_refused():
    design = part("bracket")
    true = Warp(design, 2.5)(design.vertices)
    with pytest.raises(InvalidSettingError, match="mask"):
        fraction_unrecovered(design, true, true, np.zeros(len(true), dtype=bool))
    with pytest.raises(InvalidSettingError, match="true_displacement"):
        fraction_unrecovered(design, 0 * true, true)


def test_the_distortion_of_the_first_print_is_the_warp_and_its_pose_is_none():
    design = part("bracket")
    warp = Warp(design, 2.5)
    printed = Printer(warp).print_part(design.vertices)
    for motion in (np.eye(4), scan(points=1, pose="random").pose):
        rms, largest = distortion_left(design, transform(motion, printed))
        assert rms == pytest.approx(warp.rms_mm, rel=1e-9)
        assert largest == pytest.approx(2.5, rel=1e-9)


@pytest.mark.parametrize("model", ["spatial", "material"])
def test_the_exact_redesign_prints_without_distortion(model):
    design = part("bracket")
    printer = Printer(Warp(design, 2.5), model)
    redesign = design.vertices
    for _ in range(12):
        redesign = redesign + design.vertices - printer.print_part(redesign)
    assert distortion_left(design, printer.print_part(redesign))[1] < 1e-6


# Settings


@pytest.mark.parametrize(
    "setting",
    [
        {"points": 0},
        {"noise_mm": -0.1},
        {"ripple_mm": -0.01},
        {"ripple_length_mm": 0.0},
        {"outlier_share": 1.1},
        {"density_contrast": 0.5},
        {"pose": "sideways"},
        {"pose": np.eye(3)},
        {"hidden_share": 1.0},
        {"hidden_direction": (0.0, 0.0, 0.0)},
        {"normal_noise": -1.0},
    ],
    ids=lambda setting: next(iter(setting)),
)
def test_scanner_settings_out_of_range_are_refused_by_name(setting):
    with pytest.raises(InvalidSettingError, match=next(iter(setting))):
        ScannerSettings(**setting)


def test_printers_and_warps_out_of_range_are_refused_by_name():
    design = part("clip")
    with pytest.raises(InvalidSettingError, match="amplitude_mm"):
        Warp(design, -1.0)
    with pytest.raises(InvalidSettingError, match="correlation_length_mm"):
        Warp(design, 1.0, 0.0)
    with pytest.raises(InvalidSettingError, match="model"):
        Printer(Warp(design, 1.0), "magic")
    with pytest.raises(InvalidSettingError, match="variation"):
        Printer(Warp(design, 1.0), variation=-0.1)
