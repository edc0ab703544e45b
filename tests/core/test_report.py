"""The numbers, fields and pictures that an inspection leaves behind."""

import dataclasses
import io
import json

import matplotlib.image
import numpy as np
import pytest

from mdf_core.compensation import compensate
from mdf_core.deformation import Deformation
from mdf_core.errors import OutputFolderError
from mdf_core.geometry import Design
from mdf_core.inspection import Deviation, Inspection
from mdf_core.kernel import KernelBasis
from mdf_core.picture import PictureRow, draw, inspection_row, reprint_row
from mdf_core.report import report, save_inspection
from mdf_core.settings import Settings
from mdf_core.virtual_cell import Warp, build_part

ROUND = ("rms_displacement_mm", "p95_displacement_mm", "max_displacement_mm")


@pytest.fixture(scope="module")
def design():
    return dataclasses.replace(build_part("plate"), path="plate.stl", file_sha256="ab" * 32)


@pytest.fixture(scope="module")
def inspection(design):
    displacement = Warp(design, 1.0)(design.vertices)
    supported = design.vertices[:, 0] < 80.0
    return Inspection(
        design=design,
        deformation=Deformation(
            np.eye(4), np.eye(4), KernelBasis(np.zeros((1, 3)), 1.0, None), np.zeros((1, 3)), np.zeros((4, 3)),
            np.zeros(3), 1.0,
        ),
        displacement=displacement,
        inverse_displacement=-displacement,
        std=np.where(supported, 0.01, np.nan),
        supported=supported,
        disputed=np.zeros_like(supported),
        unseen=np.zeros_like(supported),
        unexplained=np.zeros(len(design.vertices)),
        face_displacement=np.zeros(len(design.faces)),
        deviation=Deviation(design.vertices, np.zeros(len(design.vertices)), np.zeros(len(design.vertices), bool)),
        residual_scale=0.02,
        pose_ambiguous=True,
        alternative_poses=(np.diag([-1.0, -1.0, 1.0, 1.0]),),
        iterations=5,
        stop_reason="converged",
        settings=Settings().replace({"seed": 3}),
        scan_sha256="cd" * 32,
        stage_seconds={"pose": 0.5, "surface": 0.4},
    )  # fmt: skip


def test_report_tells_everything_needed_to_judge_and_to_repeat(inspection, design):
    entries = json.loads(json.dumps(report(inspection, part_id="plate 7"), allow_nan=False))
    assert entries["verdict"] == "NO DECISION"
    assert any("pose" in reason for reason in entries["reasons"])
    assert entries["method"] == "surface"
    np.testing.assert_allclose(
        [entries[name] for name in ROUND],
        [inspection.rms_displacement, inspection.p95_displacement, inspection.max_displacement],
        rtol=0,
    )
    assert entries["max_deviation_mm"] == inspection.deviation.max
    assert 0.7 < entries["coverage"] == inspection.coverage < 0.9
    assert entries["residual_scale_mm"] == 0.02
    assert entries["outlier_share"] == 0.0
    assert entries["points"] == len(design.vertices)
    assert entries["pose_design_scan_mm"] == np.eye(4).tolist()
    assert entries["pose_ambiguous"] is True
    assert entries["alternative_poses_design_scan_mm"] == [np.diag([-1.0, -1.0, 1.0, 1.0]).tolist()]
    assert (entries["iterations"], entries["stop_reason"]) == (5, "converged")
    assert entries["design"] == {
        "path": "plate.stl",
        "sha256": "ab" * 32,
        "vertices": len(design.vertices),
        "faces": len(design.faces),
    }
    assert entries["scan_sha256"] == "cd" * 32
    assert (
        Settings().replace(entries["settings"]).sha256() == entries["settings_sha256"] == inspection.settings.sha256()
    )
    assert entries["stage_seconds"] == {"pose": 0.5, "surface": 0.4}
    assert entries["part_id"] == "plate 7"
    assert entries["software_version"]


def test_report_of_a_redesign_names_its_file_and_how_far_it_moves(inspection, design, tmp_path):
    redesign = compensate(design, [inspection], inspection.settings)
    entries = report(inspection, redesign)["redesign"]
    assert entries["sha256"] == redesign.save(tmp_path / "redesigned.stl")
    assert entries["max_move_mm"] == redesign.max_move > 0
    assert entries["compensated_share"] == redesign.compensated.mean()


def test_numbers_that_do_not_exist_are_null(inspection):
    blind = dataclasses.replace(inspection, supported=np.zeros_like(inspection.supported))
    entries = report(blind)
    assert [entries[name] for name in ROUND] == [None, None, None]
    json.dumps(entries, allow_nan=False)


def test_inspection_file_has_the_fields_and_the_same_bytes_every_time(inspection, tmp_path):
    for folder in ("first", "second"):
        save_inspection(tmp_path / folder, inspection, report(inspection))
    with np.load(tmp_path / "first/inspection.npz", allow_pickle=False) as fields:
        assert sorted(fields) == [
            "displacement", "faces", "inverse_displacement", "std", "supported", "vertices",
        ]  # fmt: skip
        for name in ("displacement", "inverse_displacement", "std", "supported"):
            np.testing.assert_array_equal(fields[name], getattr(inspection, name))
        np.testing.assert_array_equal(fields["vertices"], inspection.design.vertices)
        np.testing.assert_array_equal(fields["faces"], inspection.design.faces)
    for name in ("inspection.npz", "report.json"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    assert sorted(path.name for path in (tmp_path / "first").iterdir()) == ["inspection.npz", "report.json"]


def test_a_folder_that_cannot_be_made_is_named(inspection, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputFolderError, match="file"):
        save_inspection(tmp_path / "file/below", inspection, report(inspection))


# Pictures


def pixels(png):
    return matplotlib.image.imread(io.BytesIO(png), format="png")[:, :, :3]


def is_red(image):
    return (image[:, :, 0] > image[:, :, 2] + 0.25).mean()


def is_blue(image):
    return (image[:, :, 2] > image[:, :, 0] + 0.25).mean()


def outward(design, length):
    """Every vertex of a box-like part moved away from the centre along z."""
    return np.column_stack([np.zeros((len(design.vertices), 2)), length * np.sign(design.vertices[:, 2] - 1.5)])


def test_red_stands_out_and_blue_lies_inside(design):
    everywhere = np.ones(len(design.vertices), bool)
    grown, shrunk = (pixels(draw(design, [PictureRow("", outward(design, s), everywhere)])) for s in (0.3, -0.3))
    assert is_red(grown) > 5 * is_blue(grown)
    assert is_blue(shrunk) > 5 * is_red(shrunk)


def test_unmeasured_surface_has_no_colour(design):
    nowhere = np.zeros(len(design.vertices), bool)
    image = pixels(draw(design, [PictureRow("", outward(design, 0.3), nowhere)]))
    part = image[:, : int(0.9 * image.shape[1])]  # without the colour bar
    assert is_red(part) == is_blue(part) == 0.0
    assert (np.abs(part - 0.4).max(axis=2) < 0.1).mean() > 0.05


def test_rows_share_one_scale(design):
    everywhere = np.ones(len(design.vertices), bool)
    rows = [PictureRow("", outward(design, s), everywhere) for s in (0.3, 0.003)]
    image = pixels(draw(design, rows))
    upper, lower = np.array_split(image[:, : int(0.9 * image.shape[1])], 2)
    assert is_red(upper) > 0.05
    assert is_red(lower) == 0.0


def test_a_picture_has_the_same_bytes_every_time(inspection, design):
    rows = [inspection_row(inspection), reprint_row(design, design.vertices + 0.05 * inspection.displacement)]
    assert draw(design, rows) == draw(design, rows)


def test_titles_tell_the_numbers(inspection, design):
    row = inspection_row(inspection)
    assert f"RMS {inspection.rms_displacement:.3f} mm" in row.title
    assert f"largest {inspection.max_displacement:.3f} mm" in row.title
    assert f"{inspection.coverage:.0%}" in row.title
    moved = reprint_row(design, design.vertices + np.array([100.0, 0.0, 0.0]))
    assert "RMS 0.000 mm" in moved.title, "where the part lies is no distortion"
    np.testing.assert_allclose(moved.displacement, 0.0, atol=1e-10)


@pytest.mark.parametrize("faces", ["twelve", "many"])
def test_coarse_and_fine_meshes_are_drawn(faces):
    corners = np.array([[x, y, z] for x in (0.0, 50.0) for y in (0.0, 30.0) for z in (0.0, 20.0)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    box = Design(corners, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    if faces == "many":
        import trimesh

        fine = trimesh.remesh.subdivide_loop(box.vertices, box.faces, 6)
        box = Design(*fine)
        assert len(box.faces) > 40_000
    away = 0.1 * (box.vertices - box.centre) / 20.0
    image = pixels(draw(box, [PictureRow("", away, np.ones(len(box.vertices), bool))]))
    assert is_red(image) > 0.1
    assert is_blue(image[:, : int(0.9 * image.shape[1])]) == 0.0
