"""compensation: from inspections to redesigned meshes on disk, and the design of the cell."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from helpers import CellProcess, Graph, set_parameters
from mdf_interfaces.msg import Cycle as CycleMessage
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.msg import RedesignedMesh
from mdf_interfaces.srv import Compensate, SetDesign
from samples import parameters, write_design
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker

from mdf_core.compensation import compensate
from mdf_core.errors import (
    CompensationRefusedError,
    DesignFileError,
    DesignMismatchError,
    InvalidSettingError,
    NoDesignError,
    NoInspectionError,
    OutputFolderError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.settings import Settings
from mdf_nodes import compensation
from mdf_nodes.cell_design import CellDesign, load_cell_design
from mdf_nodes.compensation import Compensation
from mdf_nodes.conversions import displacement_from_message, displacement_message, marker_message
from mdf_nodes.journal import DesignChoice, Journal
from mdf_nodes.qos import LATCHED

Start = Callable[..., CellProcess]


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


class Registration:
    """Stands in for the registration: publishes the results of one job, in the order that is asked for."""

    def __init__(self, graph: Graph, design: Design) -> None:
        node = graph.node("registration")
        self._publishers = {
            "displacement": node.create_publisher(PointCloud2, "displacement", LATCHED),
            "inspection": node.create_publisher(InspectionMessage, "inspection", LATCHED),
        }
        self._design = design

    def publish(
        self, second: int, order: tuple[str, ...] = ("displacement", "inspection"), **changes: Any
    ) -> PointCloud2:
        """The displacement cloud that was published; `changes` are made to the inspection."""
        header = Header(stamp=Time(sec=second), frame_id="design")
        cloud = displacement_message(self._measured(), header)
        given = {"job_id": f"job-{second}", "part_id": "angle", "design_sha256": self._design.file_sha256} | changes
        messages = {"displacement": cloud, "inspection": InspectionMessage(header=header, **given)}
        for topic in order:
            self._publishers[topic].publish(messages[topic])
        return cloud

    def _measured(self) -> Any:
        count = len(self._design.vertices)
        bend = np.zeros((count, 3))
        bend[:, 2] = 0.5 * (self._design.vertices[:, 0] / 60.0) ** 2
        supported = np.ones(count, dtype=bool)
        return SimpleNamespace(
            design=self._design,
            displacement=bend,
            inverse_displacement=-bend,
            std=np.full(count, 0.01),
            supported=supported,
        )


class Redesigns:
    """What the node publishes."""

    def __init__(self, graph: Graph) -> None:
        self.meshes = graph.collect(RedesignedMesh, "redesigned_mesh", LATCHED)
        self.paths = graph.collect(String, "redesigned_mesh_path", LATCHED)
        self.markers = graph.collect(Marker, "redesign_marker", LATCHED)

    def of(self, job_id: str) -> bool:
        """Whether everything about a job is here."""
        return any(mesh.job_id == job_id for mesh in self.meshes) and len(self.meshes) == len(self.paths)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def node(start: Start, design: Design, folder: Path) -> Iterator[CellProcess]:
    process = start("compensation", "--ros-args", *parameters(design_path=design.path, output_folder=folder))
    yield process
    assert process.running, process.output


@pytest.fixture
def inner(domain: int, design: Design, folder: Path) -> Iterator[Compensation]:
    """A node in this process, whose races a test can bring about."""
    node = Compensation()
    set_parameters(node, design_path=design.path, output_folder=str(folder))
    node.start()
    yield node
    node.stop()


@pytest.fixture
def other(design: Design, tmp_path: Path) -> Design:
    """A design of another part."""
    path = tmp_path / "other.stl"
    path.write_bytes(stl_bytes(1.01 * design.vertices, design.faces))
    return load_design(path, "mm")


@pytest.mark.parametrize("order", [("displacement", "inspection"), ("inspection", "displacement")])
def test_every_inspection_gets_a_redesign_on_disk(
    graph: Graph, node: CellProcess, design: Design, folder: Path, order: tuple[str, ...]
) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    cloud = registration.publish(5, order)
    graph.wait_until(lambda: redesigns.of("job-5"))
    mesh, path = redesigns.meshes[-1], Path(redesigns.paths[-1].data)

    assert path == folder / "angle_job-5" / "redesigned.stl" == Path(mesh.path)
    expected = compensate(design, [displacement_from_message(cloud)], Settings())
    assert path.read_bytes() == expected.stl() == stl_bytes(expected.vertices, design.faces)
    assert mesh.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (mesh.unit, mesh.gain, mesh.lookup, mesh.part_id) == ("mm", 1.0, "spatial", "angle")
    assert mesh.design_sha256 == design.file_sha256
    assert mesh.max_move == pytest.approx(expected.max_move * 1e-3)
    assert mesh.compensated_vertices == expected.compensated.sum()
    assert (mesh.header.stamp.sec, mesh.header.frame_id) == (5, "design")
    np.testing.assert_array_equal(load_design(path, "mm").faces, design.faces)
    assert sorted(each.name for each in path.parent.iterdir()) == ["redesigned.stl"]

    graph.wait_until(lambda: redesigns.markers)
    marker = redesigns.markers[-1]
    assert marker.type == Marker.MESH_RESOURCE and marker.mesh_resource == path.as_uri()
    assert (marker.scale.x, marker.scale.y, marker.scale.z) == (0.001, 0.001, 0.001)


def test_the_service_redesigns_the_latest_inspection_as_asked(graph: Graph, node: CellProcess, design: Design) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    client = graph.nodes[0].create_client(Compensate, "compensate")
    nothing = graph.call(client, Compensate.Request())
    assert nothing.error_code == NoInspectionError.code and "register a scan" in nothing.error_msg

    registration.publish(6)
    graph.wait_until(lambda: redesigns.of("job-6"))
    half = graph.call(client, Compensate.Request(gain=0.5, lookup="material"))
    assert (half.error_code, half.error_msg) == (0, "")
    assert (half.redesigned_mesh.gain, half.redesigned_mesh.lookup) == (0.5, "material")
    assert half.redesigned_mesh.max_move == pytest.approx(redesigns.meshes[0].max_move / 2, rel=0.05)

    for request in (Compensate.Request(gain=1e9), Compensate.Request(lookup="sideways")):
        assert graph.call(client, request).error_code == InvalidSettingError.code
    assert graph.call(client, Compensate.Request()).redesigned_mesh.gain == 1.0


def test_late_subscribers_get_design_and_redesign(graph: Graph, node: CellProcess, design: Design) -> None:
    Registration(graph, design).publish(7)
    graph.wait_until(lambda: "job job-7" in node.output)
    redesigns, designs = Redesigns(graph), graph.collect(DesignMessage, "design", LATCHED)
    graph.wait_until(lambda: redesigns.of("job-7") and designs)
    assert (designs[0].path, designs[0].unit, designs[0].sha256) == (design.path, "mm", design.file_sha256)
    assert designs[0].part_id == "design"


def test_set_design_changes_the_design_of_the_cell(graph: Graph, start: Start, design: Design, folder: Path) -> None:
    node = start("compensation", "--ros-args", *parameters(output_folder=folder))
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    designs = graph.collect(DesignMessage, "design", LATCHED)
    registration.publish(8)
    graph.wait_until(lambda: f"NO_DESIGN ({NoDesignError.code})" in node.output)

    client = graph.nodes[0].create_client(SetDesign, "set_design")
    wrong = graph.call(client, SetDesign.Request(path="nowhere.stl", unit="mm"))
    assert wrong.error_code == DesignFileError.code and "nowhere.stl" in wrong.error_msg
    nothing = graph.call(client, SetDesign.Request(unit="mm"))
    assert nothing.error_code == InvalidSettingError.code and "no path is given" in nothing.error_msg
    unit = graph.call(client, SetDesign.Request(path=design.path, unit="parsec"))
    assert unit.error_code == InvalidSettingError.code
    assert not designs

    answer = graph.call(client, SetDesign.Request(path=design.path, unit="mm", part_id="angle"))
    assert (answer.error_code, answer.design.sha256, answer.design.part_id) == (0, design.file_sha256, "angle")
    graph.wait_until(lambda: designs)
    assert designs[0] == answer.design
    registration.publish(9)
    graph.wait_until(lambda: redesigns.of("job-9"))


def test_an_inspection_of_another_design_is_refused(graph: Graph, node: CellProcess, design: Design) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    registration.publish(10, design_sha256="0" * 64)
    graph.wait_until(lambda: f"DESIGN_MISMATCH ({DesignMismatchError.code})" in node.output)
    client = graph.nodes[0].create_client(Compensate, "compensate")
    assert graph.call(client, Compensate.Request()).error_code == DesignMismatchError.code

    fewer = replace(design, vertices=design.vertices[:-1], faces=design.faces[:1])
    Registration(graph, fewer).publish(11)
    graph.wait_until(lambda: "inspection job-11" in node.output)
    Registration(graph, fewer).publish(13, design_sha256="1" * 64)
    graph.wait_until(lambda: f"sha256 11111111, {len(fewer.vertices)} vertices; " in node.output)
    registration.publish(12)
    graph.wait_until(lambda: redesigns.of("job-12"))
    assert [mesh.job_id for mesh in redesigns.meshes] == ["job-12"]


def test_an_ambiguous_pose_is_redesigned_only_on_request(graph: Graph, node: CellProcess, design: Design) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    registration.publish(13, pose_ambiguous=True)
    graph.wait_until(lambda: f"COMPENSATION_REFUSED ({CompensationRefusedError.code})" in node.output)
    assert not redesigns.meshes
    client = graph.nodes[0].create_client(Compensate, "compensate")
    assert graph.call(client, Compensate.Request()).error_code == 0


def test_an_inspection_that_carries_an_error_is_passed_over(graph: Graph, node: CellProcess, design: Design) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    registration.publish(14, order=("inspection",), error_code=101, error_msg="no points")
    registration.publish(15)
    graph.wait_until(lambda: redesigns.of("job-15"))
    assert "ERROR" not in node.output


def test_an_output_folder_that_cannot_be_written_is_told(
    graph: Graph, node: CellProcess, design: Design, folder: Path
) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    graph.wait_until(lambda: "active" in node.output)
    folder.write_text("in the way")
    registration.publish(16)
    graph.wait_until(lambda: f"OUTPUT_FOLDER ({OutputFolderError.code})" in node.output)
    client = graph.nodes[0].create_client(Compensate, "compensate")
    refused = graph.call(client, Compensate.Request())
    assert refused.error_code == OutputFolderError.code and str(folder) in refused.error_msg
    folder.unlink()
    assert graph.call(client, Compensate.Request()).error_code == 0
    assert [mesh.job_id for mesh in redesigns.meshes] == ["job-16"]


def test_an_output_folder_that_cannot_be_made_is_told_at_the_start(graph: Graph, start: Start, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    node = start("compensation", "--ros-args", *parameters(output_folder=tmp_path / "file" / "out"))
    graph.node("waiting")
    graph.wait_until(lambda: "OUTPUT_FOLDER" in node.output)
    assert "active" not in node.output.replace("not active", "")


def test_names_from_outside_stay_inside_the_output_folder(
    graph: Graph, node: CellProcess, design: Design, folder: Path
) -> None:
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    registration.publish(17, part_id="../../etc/part 7", job_id="job-17")
    graph.wait_until(lambda: redesigns.of("job-17"))
    path = Path(redesigns.paths[-1].data)
    assert path.resolve().is_relative_to(folder.resolve())
    assert path.parent.parent == folder


@pytest.mark.parametrize("step", ["judge_prints", "next_redesigns"])
def test_a_redesign_that_another_design_overtakes_is_not_published(
    graph: Graph,
    inner: Compensation,
    design: Design,
    other: Design,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    step: str,
) -> None:
    begun, go_on, errors = threading.Event(), threading.Event(), []
    usual, report = getattr(compensation, step), inner.report

    def at_length(*arguments: Any, **options: Any) -> Any:
        begun.set()
        assert go_on.wait(60.0)
        return usual(*arguments, **options)

    def note(error: Exception, **options: Any) -> Any:
        errors.append(type(error))
        return report(error, **options)

    monkeypatch.setattr(compensation, step, at_length)
    monkeypatch.setattr(inner, "report", note)
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    printed = graph.collect(CycleMessage, "printed", LATCHED)
    client = graph.nodes[0].create_client(SetDesign, "set_design")
    registration.publish(18)
    graph.wait_until(begun.is_set)
    graph.wait_until(lambda: printed)
    assert graph.call(client, SetDesign.Request(path=other.path, unit="mm")).error_code == 0
    graph.wait_until(lambda: printed[-1].path == other.path)
    go_on.set()
    graph.wait_until(lambda: errors)
    assert errors == [DesignMismatchError]

    Registration(graph, other).publish(19)
    graph.wait_until(lambda: redesigns.of("job-19"))
    assert [mesh.job_id for mesh in redesigns.meshes] == ["job-19"]
    assert [path.data for path in redesigns.paths] == [str(folder / "angle_job-19" / "redesigned.stl")]
    assert [each.name for each in folder.iterdir()] == ["angle_job-19"]
    paths = [message.path for message in printed]
    assert design.path not in paths[paths.index(other.path) :]


def test_another_design_is_set_once_the_redesign_that_is_being_published_is_out(
    graph: Graph, inner: Compensation, design: Design, other: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    publishing, loaded, is_set, comes_first = threading.Event(), threading.Event(), threading.Event(), []

    def publish(*arguments: Any) -> Marker:
        publishing.set()
        assert loaded.wait(60.0)
        comes_first.append(not is_set.wait(0.3))  # time enough to be set too soon
        return marker_message(*arguments)

    def load(node: Any, choice: DesignChoice) -> CellDesign:
        design = load_cell_design(node, choice)
        loaded.set()
        return design

    def choose(journal: Journal, configured: DesignChoice, chosen: DesignChoice) -> None:
        is_set.set()

    monkeypatch.setattr(compensation, "marker_message", publish)
    monkeypatch.setattr(compensation, "load_cell_design", load)
    monkeypatch.setattr(Journal, "set_design", choose)
    registration, redesigns = Registration(graph, design), Redesigns(graph)
    client = graph.nodes[0].create_client(SetDesign, "set_design")
    graph.wait_until(client.service_is_ready)
    registration.publish(20)
    graph.wait_until(publishing.is_set)
    assert graph.call(client, SetDesign.Request(path=other.path, unit="mm")).error_code == 0
    assert comes_first == [True]
    graph.wait_until(lambda: redesigns.of("job-20"))
