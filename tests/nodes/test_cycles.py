"""The cycles of a part in a running cell: released, measured again, gone on from, rolled back, and kept."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from helpers import CellProcess, Graph
from lifecycle_msgs.msg import Transition
from mdf_interfaces.msg import Cycle, RedesignedMesh
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import Compensate, RejectRedesign, ReleaseRedesign, RollBack, SetDesign
from samples import parameters, write_design
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String

from mdf_core.errors import (
    CompensationRefusedError,
    CycleStateError,
    InvalidSettingError,
    LedgerError,
    NoInspectionError,
    ReleaseRefusedError,
    WorseReprintError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design
from mdf_core.rigid import best_rigid_fit, transform
from mdf_nodes.conversions import displacement_message
from mdf_nodes.journal import Journal
from mdf_nodes.qos import LATCHED

Start = Callable[..., CellProcess]
MANUAL = parameters(publish_redesign="released")


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


class Cell:
    """A compensation node, whose inspections the test publishes."""

    def __init__(self, graph: Graph, start: Start, design: Design, folder: Path) -> None:
        self._start, self._design, self._folder = start, design, folder
        self.graph, self.client = graph, graph.node("client")
        registration = graph.node("registration")
        self._displacement = registration.create_publisher(PointCloud2, "displacement", LATCHED)
        self._inspection = registration.create_publisher(InspectionMessage, "inspection", LATCHED)
        self.meshes: list[RedesignedMesh] = graph.collect(RedesignedMesh, "redesigned_mesh", LATCHED)
        self.paths: list[String] = graph.collect(String, "redesigned_mesh_path", LATCHED)
        self.printed: list[Cycle] = graph.collect(Cycle, "printed", LATCHED)
        self.diagnostics: list[DiagnosticArray] = graph.collect(DiagnosticArray, "/diagnostics", 10)
        self.process: Any = None

    def run(self, *arguments: str) -> CellProcess:
        own = parameters(design_path=self._design.path, output_folder=self._folder, state_folder=self._folder / "state")
        self.process = self._start("compensation", "--ros-args", *own, *arguments)
        self.process.wait_for("active")
        return self.process

    @property
    def bend(self) -> np.ndarray:
        bend = np.zeros((len(self._design.vertices), 3))
        bend[:, 2] = 0.5 * (self._design.vertices[:, 0] / 60.0) ** 2
        return bend

    def inspected(self, second: int, share: float, more: np.ndarray | float = 0.0, **changes: Any) -> None:
        """Publish the inspection of a print that shows `share` of the distortion, and `more`."""
        count, header = len(self._design.vertices), Header(stamp=Time(sec=second), frame_id="design")
        measured: Any = SimpleNamespace(
            design=self._design,
            displacement=share * self.bend + more,
            inverse_displacement=-share * self.bend - more,
            std=np.full(count, 0.002),
            supported=np.ones(count, dtype=bool),
        )
        given = {"job_id": f"job-{second}", "design_sha256": self._design.file_sha256, "scan_sha256": f"{second:064}"}
        self._displacement.publish(displacement_message(measured, header))
        self._inspection.publish(InspectionMessage(header=header, **(given | changes)))

    def redesigned(self, second: int, share: float, more: np.ndarray | float = 0.0, **changes: Any) -> RedesignedMesh:
        self.inspected(second, share, more, **changes)
        self.graph.wait_until(lambda: any(mesh.job_id == f"job-{second}" for mesh in self.meshes))
        return next(mesh for mesh in self.meshes if mesh.job_id == f"job-{second}")

    def gathered(self, count: int, wanted: int) -> bool:
        """Whether the node has said that it has so many prints of the cycle."""
        told = KeyValue(key="prints of this cycle", value=f"{count} of {wanted}")
        return any(told in array.status[0].values for array in self.diagnostics)

    def refused(self, code: int, count: int = 1) -> None:
        self.graph.wait_until(lambda: self.process.output.count(f"({code})") == count)

    def call(self, type_: Any, name: str, **request: Any) -> Any:
        return self.graph.call(self.client.create_client(type_, name), type_.Request(**request))

    def compensate(self, **request: Any) -> Any:
        return self.call(Compensate, "compensate", **request)

    def release(self, **request: Any) -> Any:
        return self.call(ReleaseRedesign, "release_redesign", **({"by": "an engineer"} | request))

    def roll_back(self, **request: Any) -> Any:
        return self.call(RollBack, "roll_back", **({"by": "an engineer"} | request))

    def files(self) -> set[str]:
        """Names of all redesigns on disk."""
        return {path.name for path in self._folder.glob("*/redesigned*")}

    def moves(self, mesh: RedesignedMesh) -> np.ndarray:
        vertices = self._design.vertices.copy()
        vertices[self._design.faces.ravel()] = load_design(mesh.path, "mm").triangles.reshape(-1, 3)
        return vertices - self._design.vertices

    def require_shape(self, mesh: RedesignedMesh, moves: np.ndarray, atol: float, at: Any = slice(None)) -> None:
        """The redesign is the design moved so; where it lies does not matter."""
        wanted, found = self._design.vertices + moves, self._design.vertices + self.moves(mesh)
        motion = best_rigid_fit(found[at], wanted[at], self._design.vertex_areas[at])
        np.testing.assert_allclose(transform(motion, found[at]), wanted[at], atol=atol)


@pytest.fixture
def cell(graph: Graph, start: Start, design: Design, tmp_path: Path) -> Cell:
    return Cell(graph, start, design, tmp_path)


def test_the_path_can_wait_for_somebody_to_release_the_redesign(cell: Cell, design: Design) -> None:
    cell.run(*MANUAL)
    cell.graph.wait_until(lambda: cell.printed)
    assert (cell.printed[0].cycle_id, cell.printed[0].path, cell.printed[0].state) == (0, design.path, "")
    mesh = cell.redesigned(1, 1.0)
    assert (mesh.state, mesh.cycle, mesh.prints) == ("proposed", 1, 1)
    assert mesh.predicted_residual == pytest.approx(2e-6, rel=0.2)
    assert "self_intersections" in mesh.checks and len(mesh.findings) == len(mesh.checks)
    assert not cell.paths

    nobody = cell.release(by="")
    assert nobody.error_code == InvalidSettingError.code
    answer = cell.release(cycle_id=mesh.cycle_id)
    assert (answer.error_code, answer.cycle.state, answer.cycle.path) == (0, "released", mesh.path)
    cell.graph.wait_until(lambda: cell.paths and cell.printed[-1].cycle_id == mesh.cycle_id)
    assert cell.paths[0].data == mesh.path
    assert math.isnan(cell.printed[-1].measured_residual)


def test_after_a_release_the_next_redesign_goes_on_from_what_was_printed(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    again = cell.redesigned(2, 1.0)  # nothing is released: this, too, is a print of the design
    assert (first.cycle, again.cycle) == (1, 1)
    assert cell.release(cycle_id=first.cycle_id).error_code == 0

    second = cell.redesigned(3, 0.1)
    assert second.cycle == 2
    cell.require_shape(second, -1.1 * cell.bend, 0.01)
    cell.graph.wait_until(lambda: not math.isnan(cell.printed[-1].measured_residual))
    told = cell.printed[-1]
    assert told.measured_residual == pytest.approx(0.1 * told.residual_before, rel=1e-3)


def test_prints_of_the_mesh_before_and_worse_reprints_are_not_redesigned_against(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    cell.release()
    cell.inspected(2, 0.97)
    cell.refused(WorseReprintError.code)
    assert "is still there" in cell.process.output
    cell.inspected(3, -1.4)
    cell.refused(WorseReprintError.code, 2)
    assert "roll the redesign back" in cell.process.output
    assert [mesh.cycle_id for mesh in cell.meshes] == [first.cycle_id]
    answer = cell.roll_back(reason="it got worse")
    assert (answer.error_code, answer.cycle.cycle_id) == (0, 0)
    cell.graph.wait_until(lambda: cell.paths[-1].data == cell._design.path)
    # What was inspected before is no print of what is printed now.
    assert cell.compensate().error_code == NoInspectionError.code
    assert cell.redesigned(4, 1.0).cycle == 1


def test_the_scan_that_a_redesign_was_made_from_is_no_print_of_it(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    cell.release(cycle_id=first.cycle_id)
    cell.inspected(2, 0.1, scan_sha256=f"{1:064}")
    cell.refused(WorseReprintError.code)
    assert f"redesign {first.cycle_id} was made from one of these scans" in cell.process.output
    assert cell.redesigned(3, 0.1).cycle == 2
    assert [mesh.job_id for mesh in cell.meshes] == ["job-1", "job-3"]


def test_a_roll_back_that_is_asked_for_twice_takes_back_one_redesign(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    cell.release(cycle_id=first.cycle_id)
    second = cell.redesigned(2, 0.1)
    cell.release(cycle_id=second.cycle_id)
    for _ in range(2):
        answer = cell.roll_back(cycle_id=second.cycle_id)
        assert (answer.error_code, answer.cycle.cycle_id, answer.cycle.path) == (0, first.cycle_id, first.path)


@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_bytes(b"another")], ids=["removed", "replaced"])
def test_only_the_file_that_was_released_is_named_for_printing(cell: Cell, spoil: Callable[[Path], object]) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    cell.release(cycle_id=first.cycle_id)
    second = cell.redesigned(2, 0.1)
    cell.release(cycle_id=second.cycle_id)
    cell.graph.wait_until(lambda: cell.paths and cell.paths[-1].data == second.path)
    spoil(Path(first.path))
    answer = cell.roll_back(cycle_id=second.cycle_id)
    assert (answer.error_code, answer.cycle.cycle_id) == (0, first.cycle_id)
    cell.graph.wait_until(lambda: cell.paths[-1].data == "")
    assert "the file is gone, or not the one that was released" in cell.process.output

    told = len(cell.paths)
    cell.process.terminate()
    cell.run()
    third = cell.redesigned(3, 0.2)
    cell.graph.wait_until(lambda: cell.paths[-1].data == third.path)
    assert [path.data for path in cell.paths[told:]] == [third.path]


def test_prints_of_a_design_are_none_of_the_same_file_in_another_unit(cell: Cell, design: Design) -> None:
    cell.run(*parameters(prints_per_cycle=2))
    cell.inspected(1, 1.0)
    cell.graph.wait_until(lambda: cell.gathered(1, 2))
    answer = cell.call(SetDesign, "set_design", path=design.path, unit="cm", part_id="design")
    assert (answer.error_code, answer.design.sha256) == (0, design.file_sha256)
    assert cell.compensate().error_code == NoInspectionError.code
    assert not cell.files()


def test_a_refused_request_is_no_error_of_the_cell(cell: Cell) -> None:
    cell.run()
    assert cell.release().error_code == CycleStateError.code
    unharmed = KeyValue(key="errors", value="0")
    cell.graph.wait_until(lambda: cell.diagnostics and unharmed not in cell.diagnostics[-1].status[0].values)
    assert cell.diagnostics[-1].status[0].level == DiagnosticStatus.OK

    cell.inspected(1, 1.0, outlier_share=0.5)
    cell.graph.wait_until(lambda: cell.diagnostics[-1].status[0].level == DiagnosticStatus.ERROR)
    told = cell.diagnostics[-1].status[0].message
    assert f"({CompensationRefusedError.code})" in told
    assert cell.release().error_code == CycleStateError.code
    before = len(cell.diagnostics)
    cell.graph.wait_until(lambda: len(cell.diagnostics) > before + 1)
    assert cell.diagnostics[-1].status[0].message == told, "what the cell has to be mended of"


def test_a_node_that_is_cleaned_up_lets_go_of_its_databases(cell: Cell, tmp_path: Path) -> None:
    cell.run()
    mesh = cell.redesigned(1, 1.0)
    steps = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
    assert cell.graph.change_state("compensation", *steps)
    (state,) = tmp_path.glob("**/journal.sqlite")
    Journal(state.parent, owner="compensation").close()
    steps = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    assert cell.graph.change_state("compensation", *steps)
    assert cell.release().cycle.cycle_id == mesh.cycle_id


def test_what_is_printed_outlives_the_node(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    cell.release()
    told, paths = len(cell.printed), len(cell.paths)
    cell.process.terminate()
    cell.run()
    cell.graph.wait_until(lambda: len(cell.printed) > told and len(cell.paths) > paths)
    assert cell.printed[-1].cycle_id == first.cycle_id and cell.printed[-1].decided_by == "an engineer"
    assert cell.paths[-1].data == first.path
    second = cell.redesigned(2, 0.1)
    assert second.cycle == 2
    cell.release()
    answer = cell.roll_back(reason="warped more")
    assert answer.cycle.cycle_id == first.cycle_id
    cell.graph.wait_until(lambda: cell.paths[-1].data == first.path)


def test_a_print_is_weighed_against_those_of_the_cycles_before_also_after_a_restart(cell: Cell, design: Design) -> None:
    # Two prints that differ by a twist: the mean of both is redesigned against, not the last one.
    offset = design.vertices - design.vertices.mean(axis=0)
    twist = 0.0002 * np.column_stack([0.0 * offset[:, 0], -offset[:, 0] * offset[:, 2], offset[:, 0] * offset[:, 1]])
    cell.run()
    cell.redesigned(1, 1.0)
    cell.release()
    cell.process.send(signal.SIGKILL)
    cell.run()
    second = cell.redesigned(2, 0.0, twist)
    assert second.cycle == 2
    cell.require_shape(second, -cell.bend - 0.5 * twist, 0.1 * np.abs(twist).max(), cell.bend[:, 2] > 0.2)
    assert second.predicted_residual > 1e-5  # the prints have shown how much they differ


def test_what_the_state_does_not_allow_is_told(cell: Cell) -> None:
    cell.run()
    for type_, name in ((ReleaseRedesign, "release_redesign"), (RollBack, "roll_back")):
        answer = cell.call(type_, name, by="an engineer")
        assert answer.error_code == CycleStateError.code and answer.error_msg
    mesh = cell.redesigned(1, 1.0)
    assert cell.call(RejectRedesign, "reject_redesign", by="an engineer", reason="too thin").error_code == 0
    assert cell.release(cycle_id=mesh.cycle_id).error_code == CycleStateError.code


def test_a_cycle_may_take_several_prints(cell: Cell) -> None:
    cell.run(*parameters(prints_per_cycle=3))
    for second, share in ((1, 0.9), (2, 1.0)):
        cell.inspected(second, share)
        cell.graph.wait_until(lambda second=second: cell.gathered(second, 3))
    mesh = cell.redesigned(3, 1.1)
    assert mesh.prints == 3 and len(cell.meshes) == 1
    np.testing.assert_allclose(cell.moves(mesh)[cell.bend[:, 2] > 0.3], -cell.bend[cell.bend[:, 2] > 0.3], atol=0.01)


def test_the_service_redesigns_against_the_prints_that_are_named(cell: Cell) -> None:
    cell.run(*parameters(compensate_every_inspection=False))
    for second, share in ((1, 0.9), (2, 5.0), (3, 1.1)):
        cell.inspected(second, share)
        cell.graph.wait_until(lambda job_id=f"job-{second}": not cell.compensate(job_ids=[job_id]).error_code)
    mesh = cell.compensate(job_ids=["job-1", "job-3"]).redesigned_mesh
    assert (mesh.prints, mesh.job_id) == (2, "job-3")
    bent = cell.bend[:, 2] > 0.3
    np.testing.assert_allclose(cell.moves(mesh)[bent], -cell.bend[bent], atol=0.01)

    unknown = cell.compensate(job_ids=["job-1", "job-7"])
    assert unknown.error_code == NoInspectionError.code
    assert "no inspection job-7" in unknown.error_msg and "job-1, job-2, job-3" in unknown.error_msg
    twice = cell.compensate(job_ids=["job-1", "job-1"])
    assert twice.error_code == CompensationRefusedError.code
    cell.release(cycle_id=mesh.cycle_id)  # the prints before are no prints of it
    assert cell.compensate(job_ids=["job-1"]).error_code == NoInspectionError.code


def test_the_service_makes_a_redesign_for_every_gain(cell: Cell) -> None:
    cell.run(*parameters(redesign_formats="stl,3mf,ply"))
    cell.redesigned(1, 1.0)
    answer = cell.compensate(gains=[0.8, 1.2])
    assert answer.error_code == 0 and answer.redesigned_mesh == answer.redesigned_meshes[1]
    cell.graph.wait_until(lambda: cell.meshes[-1] == answer.redesigned_mesh)
    assert all(mesh.gain != 0.8 for mesh in cell.meshes)  # the topics keep one: the last
    assert [mesh.gain for mesh in answer.redesigned_meshes] == [0.8, 1.2]
    low, high = (Path(mesh.path) for mesh in answer.redesigned_meshes)
    assert (low.name, high.name) == ("redesigned_0.8.stl", "redesigned_1.2.stl") and low.parent == high.parent
    assert {path.suffix for path in low.parent.glob("redesigned_1.2.*")} == {".stl", ".3mf", ".ply"}
    np.testing.assert_allclose(
        1.5 * cell.moves(answer.redesigned_meshes[0]), cell.moves(answer.redesigned_meshes[1]), atol=1e-4
    )
    for request in (
        {"gain": 1.0, "gains": [0.5]},
        {"gains": [0.5, 0.5]},
        {"gains": [math.nan]},
        {"gains": list(range(21))},
    ):
        assert cell.compensate(**request).error_code == InvalidSettingError.code, request
    released = cell.release(cycle_id=answer.redesigned_meshes[1].cycle_id)
    assert (released.error_code, released.cycle.path) == (0, str(high))


def test_a_rejected_redesign_does_not_come_back_however_it_is_asked_for(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    mesh = cell.compensate(gain=0.8).redesigned_mesh
    cell.graph.wait_until(lambda: cell.paths[-1].data == mesh.path)
    assert cell.call(RejectRedesign, "reject_redesign", cycle_id=mesh.cycle_id, by="an engineer").error_code == 0
    cell.graph.wait_until(lambda: cell.paths[-1].data == first.path)
    for request in ({"gain": 0.8}, {"gains": [0.8]}, {"gains": [0.8], "job_ids": ["job-1"]}):
        assert cell.compensate(**request).error_code == CycleStateError.code, request


def test_a_redesign_whose_file_has_gone_is_written_again(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    content = Path(first.path).read_bytes()
    Path(first.path).unlink()
    again = cell.compensate(gains=[0.5, 1.0]).redesigned_mesh
    assert again.cycle_id == first.cycle_id
    assert Path(again.path).read_bytes() == content
    assert cell.release(cycle_id=first.cycle_id).error_code == 0


def test_a_gain_that_fails_a_check_does_not_spoil_the_others(cell: Cell) -> None:
    cell.run(*parameters(release__max_move_mm=0.45, compensate_every_inspection=False))
    cell.inspected(1, 1.0)
    cell.graph.wait_until(lambda: cell.compensate(gain=0.5).error_code == 0)
    answer = cell.compensate(gains=[0.8, 1.0])
    assert answer.error_code == ReleaseRefusedError.code and "gain 1" in answer.error_msg
    assert [mesh.gain for mesh in answer.redesigned_meshes] == [0.8]
    cell.graph.wait_until(lambda: any(mesh.gain == 0.8 for mesh in cell.meshes))
    assert cell.release().cycle.gain == 0.8
    assert cell.files() == {"redesigned.stl", "redesigned_0.8.stl"}


def test_regions_are_kept_and_a_redesign_that_fails_a_check_is_not_published(cell: Cell, tmp_path: Path) -> None:
    regions = tmp_path / "regions.yaml"
    regions.write_text("- {name: end, fixed: true, blend_mm: 20, box: [59, 0, 0, 61, 31, 41]}\n")
    cell.run(*parameters(regions_path=regions, release__max_move_mm=0.45))
    mesh = cell.redesigned(1, 1.0)
    end = cell._design.vertices[:, 0] > 59.0
    moves = cell.moves(mesh)
    assert (moves[end] == 0.0).all() and np.abs(moves[~end]).max() > 0.1

    regions.write_text("[]")
    cell.inspected(2, 1.0)
    cell.refused(ReleaseRefusedError.code)
    assert "largest_move" in cell.process.output and " near (" in cell.process.output
    answer = cell.compensate()
    assert answer.error_code == ReleaseRefusedError.code
    regions.unlink()
    assert cell.compensate().error_code == InvalidSettingError.code
    assert len(cell.meshes) == 1


def test_a_print_of_a_redesign_that_nobody_released_is_not_redesigned_against_by_itself(cell: Cell) -> None:
    cell.run()
    cell.redesigned(1, 1.0)
    cell.inspected(2, 0.1)
    cell.refused(CompensationRefusedError.code)
    assert "nobody has released that one" in cell.process.output and len(cell.meshes) == 1
    assert cell.compensate().error_code == 0


def test_when_nothing_is_left_no_cycle_follows(cell: Cell) -> None:
    cell.run()
    cell.redesigned(1, 1.0)
    cell.release()
    cell.inspected(2, 0.0)
    cell.graph.wait_until(lambda: "nothing is left" in cell.process.output)
    assert len(cell.meshes) == 1 and "ERROR" not in cell.process.output
    assert cell.compensate().error_code == CompensationRefusedError.code


def test_of_a_first_print_that_came_out_right_no_redesign_is_made(cell: Cell) -> None:
    cell.run()
    cell.inspected(1, 0.0)
    cell.graph.wait_until(lambda: "nothing is left" in cell.process.output)
    assert not cell.meshes and not cell.files() and "ERROR" not in cell.process.output


def test_another_redesign_of_the_same_job_does_not_overwrite_the_first(cell: Cell) -> None:
    cell.run()
    first = cell.redesigned(1, 1.0)
    other = cell.compensate(gain=0.5).redesigned_mesh
    assert other.path != first.path
    np.testing.assert_allclose(2.0 * cell.moves(other), cell.moves(first), atol=1e-4)
    Path(first.path).unlink()
    assert cell.release(cycle_id=first.cycle_id).error_code == CycleStateError.code
    assert cell.release(cycle_id=other.cycle_id).error_code == 0


def test_a_bad_print_does_not_spoil_the_others_of_its_cycle(cell: Cell) -> None:
    cell.run(*parameters(prints_per_cycle=2))
    cell.inspected(1, 1.0)
    cell.graph.wait_until(lambda: cell.gathered(1, 2))
    cell.inspected(2, 1.0, outlier_share=0.3)
    cell.refused(CompensationRefusedError.code)
    assert cell.redesigned(3, 1.0).prints == 2


def test_a_scan_of_much_else_is_not_redesigned_against(cell: Cell) -> None:
    cell.run()
    cell.inspected(1, 1.0, outlier_share=0.2)
    cell.refused(CompensationRefusedError.code)
    assert cell.compensate().error_code == CompensationRefusedError.code
    assert "20% of the points do not lie on the part" in cell.process.output
    assert not cell.meshes


def test_a_ledger_that_cannot_be_read_keeps_the_node_from_working(
    graph: Graph, start: Start, design: Design, tmp_path: Path
) -> None:
    garbage = tmp_path / "ledger.sqlite"
    garbage.write_bytes(b"no database" * 1000)
    node = start(
        "compensation",
        "--ros-args",
        *parameters(design_path=design.path, output_folder=tmp_path / "out", ledger_url=f"sqlite:///{garbage}"),
    )
    graph.node("waiting")
    graph.wait_until(lambda: f"LEDGER ({LedgerError.code})" in node.output)
    assert garbage.read_bytes() == b"no database" * 1000
