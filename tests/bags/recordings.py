"""The recorded bags with what is true about them, and a running cell that they are played into."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from helpers import CellProcess, Graph
from mdf_interfaces.msg import Design as DesignMessage
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.msg import RedesignedMesh
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from mdf_core.bag import open_bag
from mdf_core.geometry import Array, Design
from mdf_core.mesh_io import load_design
from mdf_core.virtual_cell import Printer, ScannerSettings, VirtualScan, Warp, scan_part
from mdf_nodes.qos import LATCHED, SCAN

BAGS = Path(__file__).resolve().parents[2] / "bags"
CASES = sorted(path.parent.name for path in BAGS.glob("*/expected.json"))
TOLERANCE_MM = 1.0
RESULTS = {
    "design": (DesignMessage, LATCHED),
    "scan": (PointCloud2, SCAN),
    "displacement": (PointCloud2, LATCHED),
    "deviation": (PointCloud2, LATCHED),
    "inspection": (InspectionMessage, LATCHED),
    "redesign_marker": (Marker, LATCHED),
    "redesigned_mesh": (RedesignedMesh, LATCHED),
    "redesigned_mesh_path": (String, LATCHED),
}
"""What a cell publishes, latched."""

NODES = ("scan_ingest", "registration", "compensation")


@dataclass(frozen=True)
class Recording:
    """One case folder of bags/ and the virtual print that it was recorded from."""

    name: str

    @property
    def folder(self) -> Path:
        return BAGS / self.name

    @cached_property
    def expected(self) -> dict[str, Any]:
        return json.loads((self.folder / "expected.json").read_bytes())

    @cached_property
    def design(self) -> Design:
        return load_design(self.folder / "design.stl", "mm")

    @cached_property
    def printer(self) -> Printer:
        entry = self.expected["printer"]
        warp = Warp(self.design, entry["amplitude_mm"], entry["correlation_length_mm"], entry["seed"])
        return Printer(warp, entry["model"])

    @cached_property
    def printed(self) -> Array:
        """Where the design's vertices really were in the print, (n, 3) mm."""
        return self.printer.print_part(self.design.vertices)

    @cached_property
    def clouds(self) -> list[Any]:
        """The recorded scans, as messages."""
        return [message.message for message in open_bag(self.folder).messages([self.expected["topic"]])]

    @cached_property
    def last_scan(self) -> VirtualScan:
        """The last scan with its truth."""
        settings = ScannerSettings(**self.expected["scanner"])
        return scan_part(self.printed, self.design.faces, settings, self.expected["scans"][-1]["seed"])


@dataclass
class Cell:
    """A running cell with one recording's design, and everything it has published."""

    recording: Recording
    graph: Graph
    output_folder: Path
    processes: list[CellProcess]
    namespace: str
    published: dict[str, list[Any]] = field(default_factory=dict)
    seconds: float = float("nan")
    """From the end of the replay, when the last scan is delivered, to the last redesign."""

    def last(self, topic: str) -> Any:
        return self.published[topic][-1]

    def play(self, folder: Path) -> None:
        """Play the recording and wait until all its scans are answered by redesigns."""
        scans = len(self.recording.clouds)
        renaming = ("--ros-args", "-r", f"{self.recording.expected['topic']}:={self.namespace}/points")
        player = CellProcess("bag_player", (str(self.recording.folder), "--timeout", "60", *renaming), folder)
        self._wait(lambda: not player.running)
        played = time.monotonic()
        assert player.wait() == 0, player.output
        assert f"{scans} messages played" in player.stdout
        self._wait(lambda: len(self.published["redesigned_mesh_path"]) == scans)
        self.seconds = time.monotonic() - played
        self._wait(lambda: all(len(each) == scans for name, each in self.published.items() if name != "design"))

    def _wait(self, condition: Any) -> None:
        def met_or_broken() -> bool:
            for process in self.processes:
                assert process.running, process.output
                assert "[ERROR]" not in process.output, process.output
            return condition()

        self.graph.wait_until(met_or_broken, 120.0, "\n".join(process.output for process in self.processes))


def subscribe(graph: Graph, namespace: str) -> dict[str, list[Any]]:
    """Lists that receive everything a cell publishes."""
    graph.node("observer")
    return {name: graph.collect(type_, f"{namespace}/{name}", qos) for name, (type_, qos) in RESULTS.items()}


@contextmanager
def running_cell(recording: Recording, folder: Path) -> Iterator[Cell]:
    """The three nodes as processes, active."""
    namespace = f"/{recording.name}"
    parameters = {
        "design_path": recording.design.path,
        "output_folder": folder / "redesigns",
        "verdict.tolerance_mm": TOLERANCE_MM,
        "is_simulated": True,
    }
    arguments = ["--ros-args", "-r", f"__ns:={namespace}"]
    arguments += [text for name, value in parameters.items() for text in ("-p", f"{name}:={value}")]
    graph, processes = Graph(), []
    try:
        for name in NODES:
            (folder / name).mkdir()
            processes.append(CellProcess(name, tuple(arguments), folder / name))
        cell = Cell(recording, graph, folder / "redesigns", processes, namespace)
        cell.published = subscribe(graph, namespace)
        graph.wait_until(
            lambda: all("active" in process.output for process in processes),
            60.0,
            "\n".join(process.output for process in processes),
        )
        yield cell
    finally:
        graph.close()
        for process in processes:
            process.terminate()
        for process in processes:
            process.close()


def share_of_area(design: Design, vertices: Any) -> float:
    """Share of the design's surface at these vertices, given as a mask."""
    return float(np.average(vertices, weights=design.vertex_areas))
