"""Redesigned meshes as files for others."""

import io

import numpy as np
import pytest
import trimesh

from mdf_core.mesh_export import ply_bytes, threemf_bytes
from mdf_core.mesh_io import load_design
from mdf_core.virtual_cell import build_part


@pytest.fixture(scope="module", params=["bracket", "pair"])
def design(request):
    return build_part(request.param)


def test_a_3mf_file_says_its_unit_and_holds_the_mesh_as_it_is(design, tmp_path):
    path = tmp_path / "part.3mf"
    path.write_bytes(threemf_bytes(design.vertices, design.faces))
    loaded = load_design(path, "mm")
    np.testing.assert_array_equal(loaded.triangles, design.triangles)


def test_the_same_mesh_gives_the_same_bytes_and_another_one_others(design):
    first = threemf_bytes(design.vertices, design.faces)
    assert threemf_bytes(design.vertices, design.faces) == first
    assert threemf_bytes(design.vertices + 1.0, design.faces) != first


def test_a_ply_file_holds_the_fields_in_their_own_types(design, rng):
    fields = {
        "shift_x": rng.normal(size=len(design.vertices)).astype(np.float32),
        "supported": (rng.uniform(size=len(design.vertices)) < 0.5).astype(np.uint8),
    }
    content = ply_bytes(design.vertices, design.faces, fields)
    assert ply_bytes(design.vertices, design.faces, fields) == content
    loaded = trimesh.load_mesh(io.BytesIO(content), file_type="ply", process=False)
    np.testing.assert_array_equal(loaded.faces, design.faces)
    np.testing.assert_array_equal(loaded.vertices, design.vertices.astype(np.float32))
    raw = loaded.metadata["_ply_raw"]["vertex"]["data"]
    for name, values in fields.items():
        np.testing.assert_array_equal(raw[name].reshape(-1), values)
        assert raw[name].dtype == values.dtype
