"""Designs of several pieces: what does not touch is registered on its own."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import mdf_core as mdf
from mdf_core.distortion import fraction_unrecovered
from mdf_core.geometry import Design
from mdf_core.pieces import split_design
from mdf_core.virtual_cell import ScannerSettings, Warp, build_part, scan_part


def meshed(*meshes):
    whole = trimesh.util.concatenate(list(meshes))
    return Design(np.asarray(whole.vertices), np.asarray(whole.faces))


def box(size=10.0, at=(0.0, 0.0, 0.0), inverted=False):
    mesh = trimesh.creation.box((size,) * 3).subdivide().subdivide()
    mesh.apply_translation(at)
    if inverted:
        mesh.invert()
    return mesh


def where(design, piece):
    """Numbers of the design's vertices that the piece has."""
    known = {tuple(vertex): number for number, vertex in enumerate(design.vertices)}
    return np.array([known[tuple(vertex)] for vertex in piece.vertices])


@pytest.mark.parametrize("name", ["bracket", "clip", "hub", "plate", "housing"])
def test_a_design_in_one_piece_stays_whole(name):
    design = build_part(name)
    assert split_design(design) == [design]


def test_bodies_apart_are_pieces_the_largest_first():
    small, large = box(5.0), box(12.0, (40.0, 0.0, 0.0))
    pieces = split_design(meshed(small, large))
    assert [len(piece.faces) for piece in pieces] == [len(large.faces), len(small.faces)]
    assert pieces[0].vertices[:, 0].min() == pytest.approx(34.0)


def test_every_face_is_in_one_piece():
    design = build_part("pair")
    areas = [piece.face_areas.sum() for piece in split_design(design)]
    assert len(areas) == 2
    assert sum(areas) == pytest.approx(design.face_areas.sum())


@pytest.mark.parametrize(
    "meshes",
    [
        (box(20.0), box(8.0, inverted=True)),  # a cavity
        (box(20.0), box(20.0, (20.0, 0.0, 0.0))),  # face on face
        (box(20.0), box(20.0, (12.0, 3.0, 1.0))),  # overlapping bodies
    ],
    ids=["cavity", "touching", "overlapping"],
)
def test_what_is_joined_is_one_piece(meshes):
    assert len(split_design(meshed(*meshes))) == 1


def test_patches_that_are_not_stitched_together_are_one_piece():
    mesh = box(20.0)
    patches = [mesh.submesh([group], append=True) for group in np.array_split(np.arange(len(mesh.faces)), 6)]
    assert len(split_design(meshed(*patches))) == 1


def test_a_cavity_goes_with_its_body():
    design = meshed(box(20.0), box(8.0, inverted=True), box(10.0, (60.0, 0.0, 0.0)))
    assert sorted(len(piece.faces) for piece in split_design(design)) == [192, 384]


def test_a_soup_of_triangles_has_the_same_pieces():
    design = build_part("pair")
    soup = Design(design.triangles.reshape(-1, 3), np.arange(3 * len(design.faces)).reshape(-1, 3))
    assert [len(piece.faces) for piece in split_design(soup)] == [len(piece.faces) for piece in split_design(design)]


@pytest.fixture(scope="module")
def scattered():
    """Two pieces, each warped and laid down in its own way, and their inspection."""
    design = build_part("pair")
    deformed = design.vertices.copy()
    turn = Rotation.from_rotvec([0.0, 0.0, 0.05]).as_matrix()
    for number, piece in enumerate(split_design(design)):
        moved = piece.vertices + Warp(piece, 1.0, 50.0, seed=number)(piece.vertices)
        if number == 1:
            moved = (moved - moved.mean(axis=0)) @ turn.T + moved.mean(axis=0) + (1.0, 0.5, 0.2)
        deformed[where(design, piece)] = moved
    scan = scan_part(deformed, design.faces, ScannerSettings(points=8_000, pose="random")).scan
    return design, deformed, mdf.inspect(design, scan)


def test_pieces_that_moved_apart_are_both_measured(scattered):
    design, deformed, inspection = scattered
    assert fraction_unrecovered(design, deformed - design.vertices, inspection.displacement) < 0.06
    assert inspection.coverage > 0.99
    assert inspection.outlier_share < 0.03


def test_the_motion_of_each_piece_leads_back_to_the_design(scattered):
    design, _, inspection = scattered
    there = design.vertices + inspection.displacement
    in_scanner = (there - inspection.pose[:3, 3]) @ inspection.pose[:3, :3]
    np.testing.assert_allclose(inspection.deformation.apply(in_scanner), design.vertices, atol=1e-5)


def test_a_piece_that_was_not_scanned_is_not_supported():
    design = build_part("pair")
    scan = scan_part(design.vertices, design.faces, ScannerSettings(points=8_000, outlier_share=0.0)).scan
    missing = split_design(design)[1]
    low, high = missing.vertices.min(axis=0) - 1.0, missing.vertices.max(axis=0) + 1.0
    seen = scan.take(~((scan.points > low) & (scan.points < high)).all(axis=1))
    inspection = mdf.inspect(design, seen, mdf.Settings().replace({"pose.initial": (0, 0, 0, 0, 0, 0, 1)}))
    assert not inspection.supported[where(design, missing)].any()
    assert inspection.coverage > 0.3
