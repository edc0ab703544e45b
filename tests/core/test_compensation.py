"""From measured displacement to the redesign."""

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from mdf_core.compensation import compensate
from mdf_core.errors import CompensationRefusedError, DesignMismatchError, NoInspectionError, OutputFolderError
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design
from mdf_core.regions import Region
from mdf_core.settings import Settings


@dataclass
class Measured:
    displacement: np.ndarray
    inverse_displacement: np.ndarray
    supported: np.ndarray
    std: np.ndarray | float = 0.0

    def __post_init__(self):
        self.std = np.broadcast_to(self.std, self.supported.shape).astype(float)


@pytest.fixture(scope="module")
def design():
    mesh = trimesh.creation.box((80.0, 20.0, 10.0)).subdivide_to_size(2.5)
    return Design(mesh.vertices, mesh.faces)


@pytest.fixture
def measured(design, rng):
    count = len(design.vertices)
    return Measured(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), np.ones(count, dtype=bool))


def settings(**changes):
    return Settings().replace({f"compensation.{name}": value for name, value in changes.items()})


def moves(redesign):
    return redesign.vertices - redesign.design.vertices


def test_spatial_lookup_adds_the_inverse_displacement_once(design, measured):
    redesign = compensate(design, [measured], settings(lookup="spatial"))
    np.testing.assert_allclose(moves(redesign), measured.inverse_displacement, atol=1e-12)
    assert redesign.compensated.all()


def test_material_lookup_takes_the_displacement_off(design, measured):
    redesign = compensate(design, [measured], settings(lookup="material"))
    np.testing.assert_allclose(moves(redesign), -measured.displacement, atol=1e-12)


def test_spatial_lookup_is_the_default(design, measured):
    np.testing.assert_array_equal(
        compensate(design, [measured]).vertices, compensate(design, [measured], settings(lookup="spatial")).vertices
    )


@pytest.mark.parametrize("gain", [0.0, 0.5, -1.0])
def test_the_gain_scales_every_move(design, measured, gain):
    redesign = compensate(design, [measured], settings(gain=gain))
    np.testing.assert_allclose(moves(redesign), gain * measured.inverse_displacement, atol=1e-12)


def test_faces_and_vertex_order_are_the_designs(design, measured):
    redesign = compensate(design, [measured])
    assert redesign.design is design
    assert redesign.vertices.shape == design.vertices.shape
    assert redesign.max_move == pytest.approx(np.linalg.norm(measured.inverse_displacement, axis=1).max())


def test_several_prints_count_by_their_mean_where_they_support_the_vertex(design, rng):
    count = len(design.vertices)
    prints = [
        Measured(np.zeros((count, 3)), rng.normal(size=(count, 3)), rng.uniform(size=count) < 0.7) for _ in range(3)
    ]
    redesign = compensate(design, prints, settings(blend_mm=0.0, significance=0.0))
    supports = np.stack([one.supported for one in prints])
    inverses = np.stack([one.inverse_displacement for one in prints])
    for vertex in range(count):
        seen = supports[:, vertex]
        expected = inverses[seen, vertex].mean(axis=0) if seen.any() else np.zeros(3)
        np.testing.assert_allclose(moves(redesign)[vertex], expected, atol=1e-12)
    np.testing.assert_array_equal(redesign.compensated, supports.any(axis=0))


# Where the scan did not reach


@pytest.fixture
def half_seen(design):
    """Seen where x < 0; 1 mm up everywhere, so that a move is its share of evidence."""
    up = np.tile([0.0, 0.0, 1.0], (len(design.vertices), 1))
    return Measured(-up, up, design.vertices[:, 0] < 0.0)


def test_vertices_without_evidence_stay_exactly_at_nominal(design, half_seen):
    redesign = compensate(design, [half_seen], settings(blend_mm=10.0))
    edge = design.vertices[half_seen.supported, 0].max()
    beyond = design.vertices[:, 0] > edge + 10.0
    assert beyond.any()
    np.testing.assert_array_equal(redesign.vertices[beyond], design.vertices[beyond])
    assert not redesign.compensated[beyond].any()
    np.testing.assert_allclose(
        moves(redesign)[half_seen.supported], half_seen.inverse_displacement[half_seen.supported]
    )


def test_the_transition_is_smooth(design, half_seen):
    redesign = compensate(design, [half_seen], settings(blend_mm=20.0))
    share = moves(redesign)[:, 2]
    assert ((share >= 0.0) & (share <= 1.0)).all()
    # Along an edge of the box: never rising, and over d mm falling by no more than the steepest slope of the smooth
    # step over 20 mm, 1.5 / 20 mm, allows.
    ridge = np.flatnonzero((design.vertices[:, 1] == 10.0) & (design.vertices[:, 2] == 5.0))
    ridge = ridge[np.argsort(design.vertices[ridge, 0])]
    falls, gaps = -np.diff(share[ridge]), np.diff(design.vertices[ridge, 0])
    assert len(ridge) > 30 and falls.min() >= 0.0
    assert (falls <= 1.5 / 20.0 * gaps + 1e-12).all()
    # No kink at either end: first and last steps are far below a straight ramp's.
    inside = (share[ridge] > 0) & (share[ridge] < 1)
    assert inside.sum() >= 5
    assert share[ridge][inside][-1] < 0.1 and share[ridge][inside][0] > 0.9


def test_without_a_blend_the_evidence_ends_at_the_supported_vertices(design, half_seen):
    redesign = compensate(design, [half_seen], settings(blend_mm=0.0))
    np.testing.assert_array_equal(redesign.compensated, half_seen.supported)
    np.testing.assert_array_equal(redesign.vertices[~half_seen.supported], design.vertices[~half_seen.supported])


# Refusals


def test_nothing_measured_is_refused(design):
    with pytest.raises(NoInspectionError, match="inspect a scan first"):
        compensate(design, [])


def test_the_measure_of_another_design_is_refused(design, measured):
    other = Design(design.vertices[design.faces[0]], np.array([[0, 1, 2]]))
    with pytest.raises(DesignMismatchError, match=rf"{len(design.vertices)} vertices for a design of 3"):
        compensate(other, [measured])


def test_a_scan_that_supports_nothing_is_refused(design, measured):
    measured.supported[:] = False
    with pytest.raises(CompensationRefusedError, match="supports no vertex"):
        compensate(design, [measured])


# The file


def test_the_stl_is_the_redesign_and_the_same_every_time(design, measured, tmp_path):
    redesign, again = (compensate(design, [measured]) for _ in range(2))
    path = tmp_path / "redesign.stl"
    digest = redesign.save(path)
    assert path.read_bytes() == redesign.stl() == again.stl()
    assert again.save(path) == digest
    loaded = load_design(path)
    # An STL holds corners in float32, and no shared vertices.
    np.testing.assert_array_equal(loaded.triangles, redesign.vertices.astype(np.float32)[design.faces])
    assert loaded.file_sha256 == digest


def test_a_folder_that_cannot_be_written_is_named(design, measured, tmp_path):
    (tmp_path / "taken").write_bytes(b"")
    with pytest.raises(OutputFolderError, match=r"taken: cannot write redesign\.stl"):
        compensate(design, [measured]).save(tmp_path / "taken" / "redesign.stl")


# What is known, and what must not move


def test_a_shift_counts_only_as_far_as_it_is_larger_than_its_standard_error(design):
    shift = np.zeros((len(design.vertices), 3))
    shift[:, 2] = np.linspace(0.0, 0.4, len(shift))
    one = Measured(shift, -shift, np.ones(len(shift), dtype=bool), std=0.1)
    redesign = compensate(design, [one], settings(significance=1.0))
    sizes = shift[:, 2]
    np.testing.assert_array_equal(redesign.vertices[sizes <= 0.1], design.vertices[sizes <= 0.1])
    np.testing.assert_allclose(moves(redesign)[sizes >= 0.2], -shift[sizes >= 0.2], atol=1e-12)
    assert (np.diff(redesign.share) >= 0).all()
    assert np.diff(redesign.share).max() < 3.0 * np.diff(sizes).max() / 0.1  # no step
    np.testing.assert_array_equal(redesign.compensated, redesign.share > 0)
    everything = compensate(design, [one], settings(significance=0.0))
    np.testing.assert_allclose(moves(everything), -shift, atol=1e-12)


def test_a_random_part_is_not_compensated(design, rng):
    """Prints that have nothing in common move hardly a vertex, however large each distortion is."""
    prints = []
    for _ in range(8):
        bump = rng.normal(size=(1, 3)) * np.sin(design.vertices[:, :1] / 9.0 + rng.uniform(0, 6))
        prints.append(Measured(bump, -bump, np.ones(len(bump), dtype=bool), std=0.01))
    redesign = compensate(design, prints, settings(significance=2.0))
    assert redesign.compensated.mean() < 0.15
    assert redesign.prints.variation > 0.5


def test_a_fixed_region_stays_exactly_at_nominal(design, measured):
    end = design.vertices[:, 0] == 40.0
    redesign = compensate(design, [measured], regions=[Region("end", end, True, 5.0)])
    assert (redesign.vertices[end] == design.vertices[end]).all() and not redesign.compensated[end].any()
    far = design.vertices[:, 0] < 35.0
    np.testing.assert_allclose(moves(redesign)[far], measured.inverse_displacement[far], atol=1e-12)


def test_a_standard_error_that_is_not_known_is_refused_unless_all_is_wanted(design, measured):
    measured.std[:] = np.nan
    with pytest.raises(CompensationRefusedError, match="significance=0"):
        compensate(design, [measured])
    redesign = compensate(design, [measured], settings(significance=0.0))
    np.testing.assert_allclose(moves(redesign), measured.inverse_displacement, atol=1e-12)


# Cycles


def test_a_further_cycle_adds_to_the_redesign_that_was_printed(design, measured):
    first = compensate(design, [measured])
    again = compensate(design, [measured], settings(gain=0.5), previous=first.vertices)
    np.testing.assert_allclose(moves(again), 1.5 * measured.inverse_displacement, atol=1e-12)


def test_what_the_reprint_does_not_show_stays_as_it_was_redesigned(design, measured):
    first = compensate(design, [measured])
    unseen = design.vertices[:, 0] > 0.0
    reprint = Measured(0.1 * measured.displacement, 0.1 * measured.inverse_displacement, ~unseen)
    again = compensate(design, [reprint], settings(blend_mm=0.0), previous=first.vertices)
    np.testing.assert_array_equal(again.vertices[unseen], first.vertices[unseen])
    assert (again.vertices[~unseen] != first.vertices[~unseen]).any(axis=1).all()


def test_a_region_that_is_fixed_later_goes_back_to_nominal(design, measured):
    first = compensate(design, [measured])
    end = design.vertices[:, 0] == 40.0
    again = compensate(design, [measured], regions=[Region("end", end, True)], previous=first.vertices)
    np.testing.assert_array_equal(again.vertices[end], design.vertices[end])


def test_the_predicted_residual_is_what_is_left_and_what_is_not_known(design):
    up = np.tile([0.0, 0.0, 1.0], (len(design.vertices), 1))
    one = Measured(up, -up, np.ones(len(up), dtype=bool), std=0.1)
    assert compensate(design, [one]).predicted_residual == pytest.approx(0.1)
    assert compensate(design, [one], settings(gain=0.5)).predicted_residual == pytest.approx(np.hypot(0.5, 0.05))


def test_the_redesign_of_another_design_is_no_start(design, measured):
    with pytest.raises(DesignMismatchError, match="a previous redesign of 7 vertices"):
        compensate(design, [measured], previous=np.zeros((7, 3)))
