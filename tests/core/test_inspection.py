"""What an inspection says: its numbers and its verdict. Missing data never reads as PASS."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mdf_core.deformation import Deformation
from mdf_core.geometry import Design
from mdf_core.inspection import Deviation, Inspection, Verdict
from mdf_core.kernel import KernelBasis
from mdf_core.regions import Region
from mdf_core.settings import Settings

LONGEST = 0.3


@pytest.fixture(scope="module")
def inspection():
    """Everything seen, moved by up to 0.3 mm along x, known to 0.01 mm."""
    mesh = trimesh.creation.box((60.0, 40.0, 20.0)).subdivide_to_size(5.0)
    design = Design(mesh.vertices, mesh.faces)
    count = len(design.vertices)
    displacement = np.zeros((count, 3))
    displacement[:, 0] = np.linspace(0.0, LONGEST, count)
    return Inspection(
        design=design,
        deformation=Deformation(
            start=np.diag([-1.0, -1.0, 1.0, 1.0]),
            datum=np.eye(4),
            basis=KernelBasis(np.zeros((1, 3)), 10.0, None),
            coefficients=np.zeros((1, 3)),
            affine=np.zeros((4, 3)),
            origin=np.zeros(3),
            scale=10.0,
        ),
        displacement=displacement,
        inverse_displacement=-displacement,
        std=np.full(count, 0.01),
        supported=np.ones(count, dtype=bool),
        disputed=np.zeros(count, dtype=bool),
        unseen=np.zeros(count, dtype=bool),
        unexplained=np.zeros(count),
        face_displacement=np.zeros(len(design.faces)),
        deviation=Deviation(np.zeros((1000, 3)), np.zeros(1000), np.arange(1000) < 30),
        residual_scale=0.02,
        pose_ambiguous=False,
        alternative_poses=(),
        iterations=5,
        stop_reason="converged",
        settings=Settings(),
        scan_sha256="",
    )


def judged(inspection, tolerance=0.5, **changes):
    settings = Settings().replace({"verdict.tolerance_mm": tolerance})
    verdict, reasons = replace(inspection, **{"settings": settings} | changes).verdict
    return verdict, " | ".join(reasons)


def seen(inspection, share):
    """Supported vertices that hold about `share` of the area."""
    areas = inspection.design.vertex_areas
    return np.cumsum(areas) <= share * areas.sum()


def test_small_enough_and_known_well_enough_passes_without_a_reason(inspection):
    assert judged(inspection, tolerance=0.5) == (Verdict.PASS, "")
    assert judged(inspection, tolerance=LONGEST + 0.021) == (Verdict.PASS, "")


def test_what_may_be_too_large_by_its_standard_deviation_is_no_decision(inspection):
    verdict, reason = judged(inspection, tolerance=LONGEST + 0.019)
    assert verdict is Verdict.NO_DECISION
    assert "with 2 standard deviations it reaches 0.32 mm" in reason
    # What counts is each place by itself: one that has hardly moved may be known less well.
    std = inspection.std.copy()
    std[np.linalg.norm(inspection.displacement, axis=1).argmin()] = 0.1
    assert judged(inspection, tolerance=0.35, std=std)[0] is Verdict.PASS


def test_too_large_fails_and_says_by_how_much(inspection):
    verdict, reason = judged(inspection, tolerance=0.25)
    assert verdict is Verdict.FAIL
    assert "0.300 mm above tolerance 0.250 mm" in reason


def test_without_a_tolerance_there_is_no_decision(inspection):
    verdict, reason = judged(inspection, tolerance=0.0)
    assert verdict is Verdict.NO_DECISION
    assert "verdict.tolerance_mm" in reason


def test_too_little_seen_is_no_decision(inspection):
    verdict, reason = judged(inspection, supported=seen(inspection, 0.5))
    assert verdict is Verdict.NO_DECISION
    assert "supports 50% of the surface, 70% are needed" in reason


@pytest.mark.parametrize("tolerance", [0.0, 0.1, 10.0])
def test_nothing_seen_is_no_decision_whatever_the_tolerance(inspection, tolerance):
    nothing = np.zeros_like(inspection.supported)
    assert judged(inspection, tolerance, supported=nothing)[0] is Verdict.NO_DECISION
    lenient = Settings().replace({"verdict.tolerance_mm": tolerance, "verdict.min_coverage": 0.0})
    verdict, _ = replace(inspection, supported=nothing, settings=lenient).verdict
    assert verdict is Verdict.NO_DECISION


def test_an_ambiguous_pose_is_no_decision_and_says_what_to_give(inspection):
    verdict, reason = judged(inspection, pose_ambiguous=True, alternative_poses=(np.eye(4),))
    assert verdict is Verdict.NO_DECISION
    assert "pose.initial" in reason


def test_a_registration_that_was_stopped_before_it_came_to_rest_is_no_decision(inspection):
    verdict, reason = judged(inspection, stop_reason="max_steps")
    assert verdict is Verdict.NO_DECISION
    assert "max_steps" in reason


def test_too_uncertain_is_no_decision(inspection):
    std = inspection.std.copy()
    std[17] = 0.6
    verdict, reason = judged(inspection, std=std)
    assert verdict is Verdict.NO_DECISION
    assert "0.6 mm" in reason


def test_uncertainty_where_nothing_was_seen_does_not_count(inspection):
    supported = seen(inspection, 0.9)
    std = np.where(supported, 0.01, 5.0)
    assert judged(inspection, supported=supported, std=std)[0] is Verdict.PASS


@pytest.mark.parametrize("tolerance", [0.1, 0.5])
def test_an_unknown_uncertainty_is_no_decision(inspection, tolerance):
    std = inspection.std.copy()
    std[3] = np.nan
    verdict, reason = judged(inspection, tolerance, std=std)
    assert verdict is Verdict.NO_DECISION
    assert "standard deviation" in reason


def test_an_unknown_displacement_never_passes(inspection):
    displacement = inspection.displacement.copy()
    displacement[5] = np.nan
    assert judged(inspection, displacement=displacement)[0] is not Verdict.PASS


def test_all_that_stands_in_the_way_is_told_at_once(inspection):
    _, reason = judged(inspection, 0.0, supported=seen(inspection, 0.3), pose_ambiguous=True)
    assert all(word in reason for word in ("tolerance_mm", "30%", "pose.initial"))


# Numbers


def test_summaries_are_over_the_supported_vertices(inspection):
    supported = seen(inspection, 0.6)
    part = replace(inspection, supported=supported)
    areas = inspection.design.vertex_areas[supported]
    lengths = inspection.displacement[supported, 0]
    assert part.coverage == pytest.approx(areas.sum() / inspection.design.face_areas.sum())
    assert part.rms_displacement == pytest.approx(np.sqrt((areas * lengths**2).sum() / areas.sum()))
    assert part.p95_displacement == pytest.approx(np.percentile(lengths, 95))
    assert part.max_displacement == pytest.approx(lengths.max()) != inspection.max_displacement
    assert part.outlier_share == pytest.approx(0.03)
    np.testing.assert_array_equal(part.pose, np.diag([-1.0, -1.0, 1.0, 1.0]))


def test_the_deviation_is_summed_up_over_points_that_are_no_outliers():
    distances = np.array([-0.3, 0.1, 0.2, 9.0])
    deviation = Deviation(np.zeros((4, 3)), distances, distances > 1.0)
    assert deviation.rms == pytest.approx(np.sqrt((0.09 + 0.01 + 0.04) / 3))
    assert deviation.p95 == pytest.approx(np.percentile([0.1, 0.2, 0.3], 95))
    assert deviation.max == pytest.approx(0.3)
    nothing = replace(deviation, is_outlier=np.ones(4, dtype=bool))
    assert np.isnan([nothing.rms, nothing.p95, nothing.max]).all()


def test_without_support_there_are_no_numbers(inspection):
    nothing = replace(inspection, supported=np.zeros_like(inspection.supported))
    assert nothing.coverage == 0.0
    assert np.isnan([nothing.rms_displacement, nothing.p95_displacement, nothing.max_displacement]).all()


def test_too_many_outliers_leave_it_undecided_and_are_told(inspection):
    deviation = replace(inspection.deviation, is_outlier=np.arange(1000) < 280)
    verdict, reasons = judged(inspection, deviation=deviation)
    assert verdict is Verdict.NO_DECISION
    assert "28.0% of the scan are outliers" in reasons


def test_what_lies_between_the_vertices_of_a_coarse_design_is_no_pass(inspection):
    between = inspection.face_displacement.copy()
    between[7] = 0.6
    verdict, reason = judged(inspection, tolerance=0.5, face_displacement=between)
    assert verdict is Verdict.NO_DECISION and "reaches 0.6 mm" in reason and "design.longest_edge_mm" in reason
    assert judged(inspection, tolerance=0.65, face_displacement=between)[0] is Verdict.PASS
    assert judged(inspection, tolerance=0.25, face_displacement=between)[0] is Verdict.FAIL
    between[7] = np.nan
    assert judged(inspection, tolerance=0.5, face_displacement=between)[0] is Verdict.NO_DECISION
    unsupported = np.ones_like(inspection.supported)
    unsupported[inspection.design.faces[7]] = False
    assert judged(inspection, face_displacement=between, supported=unsupported)[0] is Verdict.PASS


def test_a_patch_without_scan_points_is_no_pass_unless_it_is_allowed(inspection):
    unseen = inspection.design.vertices[:, 2] > 9.9
    share = inspection.design.vertex_areas[unseen].sum() / inspection.design.face_areas.sum()
    gap = {"unseen": unseen, "supported": ~unseen}
    verdict, reason = judged(inspection, **gap)
    assert verdict is Verdict.NO_DECISION
    assert "no scan point on" in reason and "10.0) mm" in reason and "verdict.max_unseen_share" in reason
    for allowed, wanted in ((0.9 * share, Verdict.NO_DECISION), (1.1 * share, Verdict.PASS)):
        allowing = Settings().replace({"verdict.tolerance_mm": 0.5, "verdict.max_unseen_share": allowed})
        assert replace(inspection, settings=allowing, **gap).verdict[0] is wanted
    assert judged(inspection, 0.25, **gap)[0] is Verdict.FAIL


def test_a_patch_without_scan_points_matters_to_its_own_region_only(inspection):
    unseen = inspection.design.vertices[:, 2] > 9.9
    region = Region("base", inspection.design.vertices[:, 2] < -9.9, tolerance_mm=0.5)
    assert judged(inspection, 0.5, unseen=unseen, supported=~unseen, regions=(region,))[0] is Verdict.NO_DECISION
    names = {one.name: one.verdict for one in replace(inspection, unseen=unseen, regions=(region,)).region_verdicts}
    assert names == {"base": Verdict.PASS}


def test_where_the_scan_lies_off_what_the_displacement_explains_is_no_pass(inspection):
    off = np.zeros(len(inspection.supported))
    off[-1] = 0.25
    verdict, reason = judged(inspection, tolerance=0.5, unexplained=off)
    assert verdict is Verdict.NO_DECISION and "0.25 mm off" in reason
    assert judged(inspection, tolerance=0.58, unexplained=off)[0] is Verdict.PASS
    off = off[::-1].copy()  # where the vertex itself has not moved
    assert judged(inspection, tolerance=0.5, unexplained=off)[0] is Verdict.PASS


@pytest.mark.parametrize(
    ("tolerance", "wanted"), [(LONGEST - 0.019, Verdict.NO_DECISION), (LONGEST - 0.021, Verdict.FAIL)]
)
def test_what_may_be_small_enough_by_its_standard_deviation_does_not_fail(inspection, tolerance, wanted):
    verdict, reason = judged(inspection, tolerance=tolerance)
    assert verdict is wanted
    assert ("may be within the tolerance" in reason) == (wanted is Verdict.NO_DECISION)


def test_of_few_points_no_standard_deviation_is_believed(inspection):
    few = Deviation(np.zeros((199, 3)), np.zeros(199), np.zeros(199, dtype=bool))
    for tolerance in (0.1, 0.5):
        verdict, reason = judged(inspection, tolerance, deviation=few)
        assert verdict is Verdict.NO_DECISION and "199 points" in reason


# Regions with tolerances of their own


@pytest.fixture
def ends(inspection):
    """The first vertices, which hardly moved, and the last, which moved by up to 0.3 mm."""
    count = len(inspection.supported)
    first, last = (np.zeros(count, dtype=bool) for _ in range(2))
    first[: count // 4], last[-count // 4 :] = True, True
    return Region("seat", first, tolerance_mm=0.1), Region("edge", last, tolerance_mm=0.25)


def test_a_region_is_judged_by_its_own_tolerance_and_the_rest_by_that_of_the_part(inspection, ends):
    seat, edge = ends
    assert judged(inspection, 0.5, regions=(seat,)) == (Verdict.PASS, "")
    verdict, reason = judged(inspection, 0.5, regions=(seat, edge))
    assert verdict is Verdict.FAIL
    assert reason == "edge: displacement 0.300 mm above tolerance 0.250 mm"
    # A region may be held less tightly than the part.
    wide = replace(edge, tolerance_mm=0.4)
    assert judged(inspection, 0.25, regions=(wide,))[0] is Verdict.PASS
    assert judged(inspection, 0.1, regions=(wide,))[0] is Verdict.FAIL


def test_each_region_is_told(inspection, ends):
    settings = Settings().replace({"verdict.tolerance_mm": 0.5})
    part, seat, edge = replace(inspection, settings=settings, regions=ends).region_verdicts
    assert (part.name, part.tolerance, part.verdict) == ("", 0.5, Verdict.PASS)
    assert (seat.name, seat.verdict, seat.coverage) == ("seat", Verdict.PASS, 1.0)
    assert (edge.name, edge.verdict, edge.max_displacement) == ("edge", Verdict.FAIL, pytest.approx(LONGEST))


def test_what_has_no_tolerance_is_no_decision_beside_regions_that_have_one(inspection, ends):
    verdict, reason = judged(inspection, 0.0, regions=ends[:1])
    assert verdict is Verdict.NO_DECISION and "no tolerance is set" in reason
    everything = Region("all", np.ones_like(inspection.supported), tolerance_mm=0.5)
    assert judged(inspection, 0.0, regions=[everything])[0] is Verdict.PASS


def test_a_region_that_was_not_seen_or_is_not_known_is_no_decision(inspection, ends):
    seat = ends[0]
    for coverage in (0.0, 0.5):
        settings = Settings().replace({"verdict.tolerance_mm": 0.5, "verdict.min_coverage": coverage})
        unseen = replace(inspection, supported=~seat.vertices, regions=(seat,), settings=settings)
        verdict, reasons = unseen.verdict
        assert verdict is Verdict.NO_DECISION and any(reason.startswith("seat: ") for reason in reasons)
    std = np.where(seat.vertices, 0.2, 0.01)
    verdict, reason = judged(inspection, 0.5, regions=(seat,), std=std)
    assert verdict is Verdict.NO_DECISION and "seat: the standard deviation reaches 0.2 mm" in reason
    assert judged(inspection, 0.5, std=std)[0] is Verdict.PASS


def test_the_part_beside_its_regions_must_be_seen_too(inspection, ends):
    rest = np.zeros_like(inspection.supported)
    rest[-1] = True
    everything_else = Region("all but one vertex", ~rest, tolerance_mm=0.5)
    settings = Settings().replace({"verdict.tolerance_mm": 0.5, "verdict.min_coverage": 0.0})
    judged_part = replace(inspection, supported=~rest, regions=(everything_else,), settings=settings)
    assert judged_part.verdict[0] is Verdict.NO_DECISION


def test_the_profile_is_the_zone_that_holds_all_but_outliers():
    deviation = Deviation(np.zeros((4, 3)), np.array([0.1, -0.3, 0.2, 5.0]), np.array([False, False, False, True]))
    assert deviation.profile == pytest.approx(0.6)
