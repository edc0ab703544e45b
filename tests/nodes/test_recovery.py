"""No accepted scan is lost: whatever ends the nodes, the next start answers what is left, once."""

from __future__ import annotations

import re
import shutil
import signal
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import CellProcess, Graph
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import IngestScan, Register, SetDesign
from samples import QUICK, cloud_of, parameters, scan_of, write_design
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from mdf_core.errors import (
    DesignFileError,
    DesignMismatchError,
    OutputFolderError,
    RegistrationFailedError,
    StorageFullError,
)
from mdf_core.geometry import Design
from mdf_core.mesh_io import stl_bytes
from mdf_nodes.journal import DesignChoice, Journal
from mdf_nodes.qos import LATCHED, SCAN

Start = Callable[..., CellProcess]
ENDLESS = parameters(method="mdf", mixture__tolerance=0.0, mixture__max_iterations=100_000)


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


class Cell:
    """Nodes that share a journal, and what they publish."""

    def __init__(self, graph: Graph, start: Start, design: Design, folder: Path) -> None:
        self.graph, self._start, self._design, self.state = graph, start, design, folder / "state"
        self.node = graph.node("client")
        self.inspections: list[Any] = graph.collect(InspectionMessage, "inspection", LATCHED)

    def registration(self, *arguments: str) -> CellProcess:
        own = parameters(design_path=self._design.path, state_folder=self.state)
        process = self._start("registration", "--ros-args", *own, *QUICK, *arguments)
        process.wait_for("active")
        return process

    def scan_ingest(self, watched: Path) -> CellProcess:
        own = parameters(watch_folder=watched, state_folder=self.state)
        process = self._start("scan_ingest", "--ros-args", *own)
        process.wait_for("active")
        return process

    def compensation(self, results: Path, *arguments: str) -> CellProcess:
        own = parameters(design_path=self._design.path, state_folder=self.state, output_folder=results)
        process = self._start("compensation", "--ros-args", *own, *arguments)
        process.wait_for("active")
        return process

    def rows(self, where: str = "TRUE", table: str = "jobs") -> int:
        """How many jobs of the journal are so."""
        with sqlite3.connect(self.state / "journal.sqlite") as database:
            return int(database.execute(f"SELECT COUNT(*) FROM {table} WHERE {where}").fetchone()[0])

    def wait_for_rows(self, count: int, where: str) -> None:
        self.graph.wait_until(lambda: self.rows(where) == count, 40.0, f"{count} jobs {where}")

    def seconds_answered(self) -> list[int]:
        """The stamps of the scans that have been answered, in order, one for each answer."""
        return sorted(message.header.stamp.sec for message in {m.job_id: m for m in self.inspections}.values())


@pytest.fixture
def cell(graph: Graph, start: Start, design: Design, tmp_path: Path) -> Cell:
    return Cell(graph, start, design, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_scans_by_topic_are_answered_after_the_restart_once(cell: Cell, design: Design, number: int) -> None:
    scanner = cell.node.create_publisher(PointCloud2, "scan", SCAN)
    first = cell.registration(*ENDLESS)
    for second in (1, 2):
        scanner.publish(cloud_of(scan_of(design, seed=second), second))
        cell.wait_for_rows(second, "answered IS NULL")
    first.send(number)
    first.wait()
    assert cell.inspections == []

    second_process = cell.registration()
    cell.wait_for_rows(2, "answered IS NOT NULL")
    second_process.send(signal.SIGKILL)
    second_process.wait()
    # The scanner's last scans come once more to whoever is new: only what is new is answered.
    cell.registration()
    scanner.publish(cloud_of(scan_of(design, seed=3), 3))
    cell.wait_for_rows(3, "answered IS NOT NULL AND error_code = 0")
    cell.graph.wait_until(lambda: 3 in cell.seconds_answered())
    assert cell.seconds_answered() == [1, 2, 3]


def test_a_request_whose_client_waits_is_finished_after_a_kill_and_told_to_all(cell: Cell, design: Design) -> None:
    first = cell.registration(*ENDLESS)
    client = cell.node.create_client(Register, "register")
    cell.graph.wait_until(client.service_is_ready)
    client.call_async(Register.Request(scan=cloud_of(scan_of(design), 5), part_id="flange", method="surface"))
    cell.wait_for_rows(1, "answered IS NULL")
    first.send(signal.SIGKILL)
    first.wait()
    cell.registration()
    cell.graph.wait_until(lambda: cell.inspections)
    assert (cell.inspections[0].part_id, cell.inspections[0].method, cell.inspections[0].error_code) == (
        "flange",
        "surface",
        0,
    )
    cell.wait_for_rows(1, "answered IS NOT NULL")


def test_files_taken_while_nobody_registers_are_answered_later(cell: Cell, tmp_path: Path) -> None:
    watched = tmp_path / "watched"
    watched.mkdir()
    ingest = cell.scan_ingest(watched)
    for number in range(4):
        shutil.copy(write_scan(tmp_path, number), watched)
    cell.wait_for_rows(4, "source IS NOT NULL")
    cell.graph.wait_until(lambda: len(list((watched / "done").glob("*.npy"))) == 4)
    # With their sender their copies on the topic are gone; those on disk are not.
    ingest.send(signal.SIGKILL)
    ingest.wait()
    cell.registration()
    cell.wait_for_rows(4, "answered IS NOT NULL AND error_code = 0")
    cell.graph.wait_until(lambda: len(cell.seconds_answered()) == 4)


def test_more_files_than_the_queue_takes_wait_on_disk(cell: Cell, tmp_path: Path) -> None:
    watched = tmp_path / "watched"
    watched.mkdir()
    cell.registration(*parameters(queue_size=1))
    for number in range(8):
        shutil.copy(write_scan(tmp_path, number), watched)
    cell.scan_ingest(watched)
    cell.wait_for_rows(8, "answered IS NOT NULL AND error_code = 0")
    assert cell.rows("1") == 8


def test_on_a_disk_that_is_nearly_full_nothing_is_accepted_and_everybody_is_told(
    cell: Cell, design: Design, tmp_path: Path
) -> None:
    cell.registration(*parameters(disk_floor_mib=1_000_000))
    client = cell.node.create_client(Register, "register")
    answer = cell.graph.call(client, Register.Request(scan=cloud_of(scan_of(design))))
    assert answer.error_code == StorageFullError.code
    scanner = cell.node.create_publisher(PointCloud2, "scan", SCAN)
    scanner.publish(cloud_of(scan_of(design), 6))
    cell.graph.wait_until(lambda: cell.inspections)
    assert cell.inspections[0].error_code == StorageFullError.code

    own = parameters(state_folder=cell.state, disk_floor_mib=1_000_000)
    cell._start("scan_ingest", "--ros-args", *own)
    ingest = cell.node.create_client(IngestScan, "ingest_scan")
    refused = cell.graph.call(ingest, IngestScan.Request(path=str(write_scan(tmp_path, 0)), unit="mm"))
    assert refused.error_code == StorageFullError.code
    assert "disk_floor_mib" in refused.error_msg
    assert cell.rows("1") == 0


def write_scan(folder: Path, number: int) -> Path:
    """A scan file of its own for every number."""
    path = folder / f"scan{number}.npy"
    scan = scan_of(write_design(folder), seed=number)
    np.save(path, np.hstack([scan.points, scan.normals]))
    return path


def test_a_scan_that_takes_the_process_with_it_is_given_up(cell: Cell, design: Design) -> None:
    scanner = cell.node.create_publisher(PointCloud2, "scan", SCAN)
    process = cell.registration(*ENDLESS)
    scanner.publish(cloud_of(scan_of(design), 1))
    for attempt in range(1, 5):
        cell.wait_for_rows(1, f"begun = {attempt}")
        process.send(signal.SIGKILL)
        process.wait()
        process = cell.registration(*ENDLESS)
    cell.graph.wait_until(lambda: cell.inspections)
    assert cell.inspections[0].error_code == RegistrationFailedError.code
    assert "ended 4 times" in cell.inspections[0].error_msg
    cell.wait_for_rows(1, "answered IS NOT NULL")


def test_every_scan_is_redesigned_against_though_compensation_was_away_the_last_one_last(
    cell: Cell, design: Design, tmp_path: Path
) -> None:
    paths = cell.graph.collect(String, "redesigned_mesh_path", LATCHED)
    scanner = cell.node.create_publisher(PointCloud2, "scan", SCAN)
    cell.registration()
    away = cell.compensation(tmp_path)
    away.send(signal.SIGKILL)
    away.wait()
    for second in (1, 2, 3):
        scanner.publish(cloud_of(scan_of(design, seed=second), second))
        cell.wait_for_rows(second, "error_code = 0")
    assert cell.rows(table="results") == 3

    back = cell.compensation(tmp_path)
    cell.graph.wait_until(lambda: cell.rows(table="results") == 0, what="three redesigns")
    told = re.findall(r"(\S*_(\d)\.0+-\S*/redesigned\.stl)", back.output)
    assert [second for _, second in told] == ["1", "2", "3"]
    assert all(Path(path).stat().st_size > 84 for path, _ in told)
    cell.graph.wait_until(lambda: paths and paths[-1].data == told[-1][0])

    back.send(signal.SIGKILL)
    back.wait()
    before = {path: path.read_bytes() for path in tmp_path.glob("*/redesigned.stl")}
    cell.compensation(tmp_path)  # tells late subscribers of the last one again, and does nothing twice
    paths.clear()
    cell.graph.wait_until(lambda: paths and paths[-1].data == told[-1][0])
    assert {path: path.read_bytes() for path in tmp_path.glob("*/redesigned.stl")} == before


def test_a_redesign_that_finds_no_place_is_tried_again(cell: Cell, design: Design, tmp_path: Path) -> None:
    results = tmp_path / "results"
    compensation = cell.compensation(results)
    results.write_text("in the way")
    cell.registration()
    cell.node.create_publisher(PointCloud2, "scan", SCAN).publish(cloud_of(scan_of(design)))
    cell.graph.wait_until(lambda: f"({OutputFolderError.code})" in compensation.output)
    assert cell.rows(table="results") == 1
    results.unlink()
    cell.graph.wait_until(lambda: cell.rows(table="results") == 0)
    assert len(list(results.glob("*/redesigned.stl"))) == 1


def test_results_of_another_design_wait_until_it_is_set(cell: Cell, design: Design, tmp_path: Path) -> None:
    other = tmp_path / "other.stl"
    other.write_bytes(stl_bytes(1.01 * design.vertices, design.faces))
    results = tmp_path / "results"
    cell.compensation(results).close()
    cell.registration()
    cell.node.create_publisher(PointCloud2, "scan", SCAN).publish(cloud_of(scan_of(design)))
    cell.wait_for_rows(1, "error_code = 0")

    back = cell.compensation(results, "-p", f"design_path:={other}")
    cell.graph.wait_until(lambda: f"({DesignMismatchError.code})" in back.output)
    assert cell.rows(table="results") == 1
    client = cell.node.create_client(SetDesign, "set_design")
    assert cell.graph.call(client, SetDesign.Request(path=design.path, unit="mm")).error_code == 0
    cell.graph.wait_until(lambda: cell.rows(table="results") == 0)
    assert len(list(results.glob("*/redesigned.stl"))) == 1


def test_the_design_that_was_set_by_service_outlives_the_nodes(cell: Cell, design: Design, tmp_path: Path) -> None:
    other = tmp_path / "other.stl"
    other.write_bytes(stl_bytes(1.01 * design.vertices, design.faces))
    results = tmp_path / "results"
    nodes = [cell.registration(), cell.compensation(results)]
    client = cell.node.create_client(SetDesign, "set_design")
    answer = cell.graph.call(client, SetDesign.Request(path=str(other), unit="mm", part_id="larger"))
    assert answer.error_code == 0
    for node in nodes:
        node.send(signal.SIGKILL)
        node.wait()

    # Each by itself: a scan must not be registered to the design before while compensation starts.
    registration = cell.registration()
    cell.node.create_publisher(PointCloud2, "scan", SCAN).publish(cloud_of(scan_of(design)))
    cell.graph.wait_until(lambda: cell.inspections)
    assert (cell.inspections[0].design_path, cell.inspections[0].part_id) == (str(other), "larger")
    compensation = cell.compensation(results)
    designs = cell.graph.collect(DesignMessage, "design", LATCHED)
    cell.graph.wait_until(lambda: designs)
    assert (designs[0].path, designs[0].part_id, designs[0].sha256) == (str(other), "larger", answer.design.sha256)
    for node in (registration, compensation):
        assert node.stop() == 0

    other.unlink()
    gone = cell.compensation(results)
    assert f"({DesignFileError.code})" in gone.output and str(other) in gone.output
    assert gone.stop() == 0
    cell.compensation(results, "-p", "part_id:=another")  # the parameters have been changed since: they count
    cell.graph.wait_until(lambda: len(designs) == 2)
    assert (designs[1].path, designs[1].part_id) == (design.path, "another")


def test_scans_are_registered_to_the_design_that_was_set_when_they_were_accepted(
    cell: Cell, design: Design, tmp_path: Path
) -> None:
    other = tmp_path / "other.stl"
    other.write_bytes(stl_bytes(1.01 * design.vertices, design.faces))
    journal, configured = Journal(cell.state), DesignChoice(design.path, "mm", "")
    for second, path in ((1, None), (2, other), (3, Path(design.path))):
        if path is not None:
            journal.set_design(configured, DesignChoice(str(path), "mm", f"part {second}"))
        assert journal.hand_over(f"file {second}", cloud_of(scan_of(design, seed=second), second=second))
    journal.close()
    cell.registration()
    cell.wait_for_rows(3, "error_code = 0")
    cell.graph.wait_until(lambda: len(cell.inspections) == 3)
    told = {one.header.stamp.sec: (one.design_path, one.part_id) for one in cell.inspections}
    assert told == {1: (design.path, Path(design.path).stem), 2: (str(other), "part 2"), 3: (design.path, "part 3")}


def test_results_are_kept_only_for_a_cell_that_redesigns(cell: Cell, design: Design) -> None:
    scanner = cell.node.create_publisher(PointCloud2, "scan", SCAN)
    cell.registration()
    scanner.publish(cloud_of(scan_of(design)))
    cell.wait_for_rows(1, "error_code = 0")
    assert cell.rows(table="results") == 0
