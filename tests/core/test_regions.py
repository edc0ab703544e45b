"""Regions of a design: which vertices they hold, and that what is fixed does not move."""

import numpy as np
import pytest
import trimesh

from mdf_core.design_surface import DesignSurface
from mdf_core.errors import DesignFileError, InvalidSettingError
from mdf_core.geometry import Design
from mdf_core.mesh_io import stl_bytes
from mdf_core.regions import Region, fixed_vertices, free_share, load_regions
from mdf_core.subdivision import subdivided


@pytest.fixture(scope="module")
def design():
    mesh = trimesh.creation.box((80.0, 20.0, 10.0)).subdivide_to_size(2.5)
    return Design(mesh.vertices, mesh.faces)


@pytest.fixture
def regions(design, tmp_path):
    """``regions("text")``: what a YAML file of that text names."""

    def load(text):
        path = tmp_path / "regions.yaml"
        path.write_text(text)
        return load_regions(path, design)

    return load


def test_a_box_holds_the_vertices_in_it_whichever_corners_are_given(design, regions):
    for corners in ("[0, -10, -5, 40, 10, 5]", "[40, 10, 5, 0, -10, -5]"):
        (region,) = regions(f"- {{name: right half, fixed: true, box: {corners}}}")
        np.testing.assert_array_equal(region.vertices, design.vertices[:, 0] >= -0.05)
    assert (region.name, region.is_fixed, region.tolerance_mm) == ("right half", True, 0.0)
    (wide,) = regions("- {name: right half, fixed: true, box: [0, -10, -5, 40, 10, 5], within_mm: 3}")
    np.testing.assert_array_equal(wide.vertices, design.vertices[:, 0] >= -3.0)


def test_a_plane_holds_the_face_on_it(design, regions):
    (region,) = regions("- {name: top, tolerance_mm: 0.1, plane: [0, 0, 5, 0, 0, 7]}")
    np.testing.assert_array_equal(region.vertices, design.vertices[:, 2] == 5.0)
    assert (region.is_fixed, region.tolerance_mm) == (False, 0.1)
    (thick,) = regions("- {name: top, tolerance_mm: 0.1, plane: [0, 0, 5, 0, 0, 1], within_mm: 3}")
    assert thick.vertices.sum() > region.vertices.sum()


def test_the_build_plate_is_what_lies_lowest(design, regions):
    (region,) = regions("- {name: plate, fixed: true, build_plate: true}")
    np.testing.assert_array_equal(region.vertices, design.vertices[:, 2] == -5.0)


def test_faces_hold_their_corners(design, regions):
    (region,) = regions("- {name: these, fixed: true, faces: [3, 17]}")
    np.testing.assert_array_equal(np.flatnonzero(region.vertices), np.unique(design.faces[[3, 17]]))


def test_faces_are_those_of_the_file_however_fine_the_design_is_made(design, tmp_path):
    path, text = tmp_path / "regions.yaml", "- {name: these, fixed: true, faces: [3, 17]}"
    path.write_text(text)
    fine = subdivided(subdivided(design, 1.5), 0.7)
    (region,) = load_regions(path, fine)
    feet = DesignSurface(Design(design.vertices, design.faces[[3, 17]])).closest(fine.vertices).points
    np.testing.assert_array_equal(region.vertices, np.linalg.norm(fine.vertices - feet, axis=1) < 1e-9)
    assert region.vertices.sum() > 6
    path.write_text(f"- {{name: these, fixed: true, faces: [{len(design.faces)}]}}")
    with pytest.raises(InvalidSettingError, match=f"numbers from 0 to {len(design.faces) - 1}"):
        load_regions(path, fine)


def test_vertices_that_no_face_uses_are_in_no_region(design, tmp_path):
    path = tmp_path / "regions.yaml"
    path.write_text("- {name: plate, fixed: true, build_plate: true}")
    loose = Design(np.vstack([design.vertices, [0.0, 0.0, -9.0]]), design.faces)
    (region,) = load_regions(path, loose)
    np.testing.assert_array_equal(region.vertices, loose.vertices[:, 2] == -5.0)
    path.write_text("- {name: there, fixed: true, box: [-1, -1, -10, 1, 1, -8]}")
    with pytest.raises(InvalidSettingError, match="no vertex of the design lies in it"):
        load_regions(path, loose)


@pytest.mark.parametrize("unit, factor", [("mm", 1.0), ("cm", 0.1)])
def test_a_mesh_holds_what_is_in_it_or_on_it(design, regions, tmp_path, unit, factor):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=12.0)
    ball.apply_translation((40.0, 0.0, 0.0))
    (tmp_path / "ball.stl").write_bytes(stl_bytes(factor * ball.vertices, ball.faces))
    (region,) = regions(f"- {{name: seat, fixed: true, mesh: ball.stl, unit: {unit}}}")
    distances = np.linalg.norm(design.vertices - (40.0, 0.0, 0.0), axis=1)
    assert region.vertices[distances < 11.8].all() and not region.vertices[distances > 12.1].any()


def test_several_regions_keep_their_order_and_what_is_fixed_adds_up(design, regions):
    found = regions(
        "- {name: plate, fixed: true, build_plate: true}\n"
        "- {name: top, tolerance_mm: 0.1, plane: [0, 0, 5, 0, 0, 1]}\n"
        "- {name: end, fixed: true, blend_mm: 2, box: [39, -10, -5, 40, 10, 5]}\n"
    )
    assert [region.name for region in found] == ["plate", "top", "end"]
    fixed = fixed_vertices(found, len(design.vertices))
    np.testing.assert_array_equal(fixed, found[0].vertices | found[2].vertices)
    np.testing.assert_array_equal(free_share(found, design.vertices) == 0.0, fixed)


def test_beside_a_fixed_region_the_share_rises_smoothly_over_the_blend(design):
    end = design.vertices[:, 0] == 40.0
    share = free_share([Region("end", end, True, blend_mm=20.0)], design.vertices)
    distance = 40.0 - design.vertices[:, 0]
    np.testing.assert_allclose(share[distance >= 20.0], 1.0)
    inside = distance < 20.0
    expected = (distance / 20.0) ** 2 * (3.0 - 2.0 * distance / 20.0)
    np.testing.assert_allclose(share[inside], expected[inside], atol=0.02)  # distances are to the nearest fixed vertex
    np.testing.assert_array_equal(free_share([Region("end", end, True, 0.0)], design.vertices), ~end)


def test_a_region_that_is_not_fixed_holds_nothing_back(design):
    region = Region("end", design.vertices[:, 0] == 40.0, tolerance_mm=0.1)
    assert (free_share([region], design.vertices) == 1.0).all()
    assert not fixed_vertices([region], len(design.vertices)).any()


@pytest.mark.parametrize(
    "text, told",
    [
        ("name: plate", "no list of regions"),
        ("- [1, 2]", "no list of regions"),
        ("- {name: a, fixed: true", "cannot be read"),
        ("- {fixed: true, build_plate: true}", "no name"),
        ("- {name: a, fixed: true}", "0 of box, plane, mesh, faces, build_plate"),
        ("- {name: a, fixed: true, build_plate: true, faces: [1]}", "2 of box"),
        ("- {name: a, build_plate: true}", "neither fixed nor with a tolerance"),
        ("- {name: a, fixed: 1, build_plate: true}", "fixed is 1"),
        ("- {name: a, fixed: true, build_plate: false}", "build_plate is False"),
        ("- {name: a, fixd: true, build_plate: true}", "unknown entry 'fixd'"),
        ("- {name: a, fixed: true, box: [1, 2, 3]}", "are not six numbers"),
        ("- {name: a, fixed: true, box: [1, 2, 3, 4, 5, .nan]}", "are not six numbers"),
        ("- {name: a, fixed: true, plane: [0, 0, 5, 0, 0, 0]}", "a normal without direction"),
        ("- {name: a, fixed: true, box: [500, 500, 500, 600, 600, 600]}", "no vertex of the design lies in it"),
        ("- {name: a, fixed: true, faces: [99999]}", "no list of faces"),
        ("- {name: a, fixed: true, faces: []}", "no list of faces"),
        ("- {name: a, tolerance_mm: -1, build_plate: true}", "tolerance_mm is -1"),
        ("- {name: a, tolerance_mm: .nan, build_plate: true}", "tolerance_mm is nan"),
        ("- {name: a, fixed: true, build_plate: true, blend_mm: wide}", "blend_mm is 'wide'"),
        ("- {name: a, fixed: true, unit: inch, box: [0, 0, 0, 1, 1, 1]}", "unit says nothing without mesh"),
        ("- {name: a, tolerance_mm: 1, blend_mm: 5, build_plate: true}", "blend_mm says nothing without fixed: true"),
        ("- {name: a, fixed: true, within_mm: 1, faces: [1]}", "within_mm says nothing with faces"),
        (
            "- {name: a, fixed: true, build_plate: true}\n- {name: a, fixed: true, faces: [1]}",
            "two regions of the same",
        ),
    ],
)
def test_what_is_not_understood_is_told_with_its_place(regions, text, told):
    with pytest.raises(InvalidSettingError, match=r"regions\.yaml") as caught:
        regions(text)
    assert told in str(caught.value) and caught.value.remedy


def test_files_that_are_not_there_are_told(regions, design, tmp_path):
    with pytest.raises(InvalidSettingError, match=r"nowhere\.yaml"):
        load_regions(tmp_path / "nowhere.yaml", design)
    with pytest.raises(DesignFileError, match=r"nowhere\.stl"):
        regions("- {name: a, fixed: true, mesh: nowhere.stl}")
