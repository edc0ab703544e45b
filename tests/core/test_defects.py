"""What a smooth displacement does not show, such as a dent or a feature that was not printed, is no PASS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from poses import IN_PLACE
from scipy.spatial import KDTree

import mdf_core as mdf
from mdf_core.virtual_cell import PARTS, ScannerSettings, scan_part

TOLERANCE_MM = 0.2
BASE = (((120, 80, 4), (0, 0, 0)), ((4, 80, 20), (0, 0, 0)), ((120, 4, 14), (0, 0, 0)))
FEATURES = {
    "rib": ((1.2, 40, 14), (70, 20, 0)),
    "pin": ((3, 3, 16), (70, 40, 0)),
    "low rib": ((2, 40, 10), (70, 20, 0)),
}


def design_of(*boxes, longest_edge=3.0):
    solids = [
        trimesh.creation.box(size).apply_translation(np.add(corner, np.divide(size, 2))) for size, corner in boxes
    ]
    mesh = trimesh.boolean.union(solids, engine="manifold") if len(solids) > 1 else solids[0]
    mesh = mesh.subdivide_to_size(longest_edge)
    mesh.merge_vertices()
    return mdf.Design(mesh.vertices, mesh.faces)


def inspected(design, vertices, points, faces=None, seed=0, contrast=1.0, **changes):
    """Of a scan of a print with these vertices, and the faces of the design or others, in its own frame."""
    scanner = ScannerSettings(points=points, density_contrast=contrast)
    scan = scan_part(vertices, design.faces if faces is None else faces, scanner, seed).scan
    settings = {"verdict.tolerance_mm": TOLERANCE_MM, "pose.initial": IN_PLACE}
    return mdf.inspect(design, scan, mdf.Settings().replace(settings | changes))


def judged_by(inspection, tolerance_mm):
    """The same inspection with another tolerance, which only the verdict depends on."""
    return replace(inspection, settings=inspection.settings.replace({"verdict.tolerance_mm": tolerance_mm}))


def flattest(design, reach):
    """The vertex with the most neighbours on the same face, within `reach` mm."""
    neighbours = KDTree(design.vertices).query_ball_point(design.vertices, reach)
    normals = design.vertex_normals
    return int(
        np.argmax([(normals[near] @ normal > 0.99).sum() for near, normal in zip(neighbours, normals, strict=True)])
    )


def bump(design, middle, height, width):
    apart = np.linalg.norm(design.vertices - design.vertices[middle], axis=1)
    return height * np.exp(-0.5 * (apart / width) ** 2)[:, None] * design.vertex_normals[middle]


@pytest.mark.parametrize("points", [5_000, 20_000])
@pytest.mark.parametrize("name", ["rib", "pin"])
def test_a_feature_that_was_not_printed_is_no_pass_and_its_place_is_told(name, points):
    design, printed = design_of(*BASE, FEATURES[name]), design_of(*BASE)
    found = inspected(design, printed.vertices, points, printed.faces)
    verdict, reasons = found.verdict
    assert verdict is mdf.Verdict.NO_DECISION and "no scan point on" in " ".join(reasons)
    (size, corner), missed = FEATURES[name], design.vertices[found.unseen]
    assert (missed >= np.subtract(corner, 1e-6)).all() and (missed <= np.add(corner, size) + 1e-6).all()
    assert not found.supported[found.unseen].any()


def test_a_feature_that_was_printed_too_low_is_no_pass():
    design, printed = design_of(*BASE, FEATURES["rib"]), design_of(*BASE, FEATURES["low rib"])
    assert inspected(design, printed.vertices, 20_000, printed.faces).verdict[0] is not mdf.Verdict.PASS


def test_a_piece_that_was_not_printed_is_no_pass():
    pieces = [((30, 20, 10), (corner, 0, 0)) for corner in (0, 50, 100)]
    design, printed = design_of(*pieces), design_of(*pieces[:2])
    found = inspected(design, printed.vertices, 5_000, printed.faces, **{"verdict.min_coverage": 0.5})
    assert found.verdict[0] is mdf.Verdict.NO_DECISION
    assert (found.unseen == (design.vertices[:, 0] > 90.0)).all()


@pytest.mark.parametrize("contrast", [1.0, 5.0])
@pytest.mark.parametrize("name", PARTS)
def test_of_a_part_that_is_as_designed_nothing_is_missing_and_nothing_is_off(name, contrast, build):
    design = build(name)
    found = inspected(design, design.vertices, 8_000, seed=1, contrast=contrast)
    assert found.verdict == (mdf.Verdict.PASS, ())
    assert not found.unseen.any()
    assert np.linalg.norm(found.displacement, axis=1).max() + found.unexplained.max() < 0.1


def test_triangles_without_an_area_are_no_hindrance(build):
    design = build("bracket")
    corner, other, _ = design.faces[0]
    with_flat = mdf.Design(design.vertices, np.vstack([design.faces, [[corner, other, other]]]))
    found = inspected(with_flat, design.vertices, 5_000, design.faces)
    assert found.verdict == (mdf.Verdict.PASS, ())


@pytest.mark.parametrize("depth_mm", [0.6, 1.2])
def test_a_dent_that_the_motion_cannot_follow_is_no_pass(depth_mm, build):
    design = build("bracket")
    middle = flattest(design, 8.0)
    found = inspected(design, design.vertices + bump(design, middle, -depth_mm, 4.0), 9_000)
    assert found.verdict[0] is not mdf.Verdict.PASS
    assert not found.supported[middle] or np.linalg.norm(found.displacement[middle]) > 0.4
    assert found.coverage > 0.95


@pytest.mark.parametrize("width_mm", [3.0, 5.0])
@pytest.mark.parametrize("height_mm", [0.09, -0.09])
def test_a_bump_too_shallow_for_its_points_to_be_outliers_is_no_pass(height_mm, width_mm, build):
    design = build("bracket")
    middle = flattest(design, 8.0)
    vertices = design.vertices + bump(design, middle, height_mm, width_mm)
    inspection = inspected(design, vertices, 20_000)
    for share, wanted in ((0.6, False), (2.0, True)):
        found = judged_by(inspection, share * abs(height_mm))
        assert (found.verdict[0] is mdf.Verdict.PASS) == wanted, found.verdict


def test_walls_that_are_too_thick_everywhere_are_no_pass(build):
    design = build("bracket")
    scan = scan_part(design.vertices, design.faces, ScannerSettings(points=9_000)).scan
    thick = mdf.PointSet(scan.points + 0.15 * scan.normals, scan.normals)
    inspection = mdf.inspect(design, thick, mdf.Settings().replace({"pose.initial": IN_PLACE}))
    for tolerance, wanted in ((0.1, False), (0.25, True)):
        found = judged_by(inspection, tolerance)
        assert (found.verdict[0] is mdf.Verdict.PASS) == wanted, found.verdict
        assert ("a coating, or walls of another thickness" in str(found.verdict[1])) != wanted


def test_a_bump_within_a_large_triangle_is_no_pass():
    corners = design_of(((100, 60, 20), (0, 0, 0)), longest_edge=60.0)
    fine = design_of(((100, 60, 20), (0, 0, 0)), longest_edge=2.0)
    middle = int(np.argmin(np.linalg.norm(fine.vertices - [45.0, 25.0, 20.0], axis=1)))
    printed = fine.vertices + bump(fine, middle, 0.9, 12.0)
    found = inspected(corners, printed, 15_000, fine.faces, **{"verdict.tolerance_mm": 0.6})
    assert found.verdict[0] is not mdf.Verdict.PASS
