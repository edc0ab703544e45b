"""`python -m bench.nodes`: what the nodes cost over the library, and how they bear scans of millions of points."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mdf_interfaces.msg import Inspection as InspectionMessage
from mdf_interfaces.srv import Register
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

import mdf_core as mdf
from bench.cases import Case, print_and_scan
from bench.report import command_line, figures_table, machine, markdown_table
from mdf_core.files import write_atomically
from mdf_core.geometry import Design, PointSet
from mdf_core.mesh_io import stl_bytes
from mdf_core.rigid import inverse, rotate, transform
from mdf_core.sampling import prepare
from mdf_nodes.cell import NODES
from mdf_nodes.context import child_environment, tune_dds
from mdf_nodes.conversions import scan_from_message, scan_message
from mdf_nodes.qos import LATCHED, SCAN

_NAMESPACE = "bench"
_KNOWN_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_DEADLINE_SECONDS = 120.0
HEADINGS = ("what", "figure")


@dataclass(frozen=True)
class Cell:
    """A running cell, and the node that talks to it."""

    process: subprocess.Popen[bytes]
    node: Node
    executor: SingleThreadedExecutor
    driver: Publisher
    inspections: list[InspectionMessage]
    numbers: Iterator[int] = field(default_factory=lambda: count(1))

    def wait(self, condition: Any, what: str) -> Any:
        """Run callbacks until the condition is true; its value."""
        deadline = time.monotonic() + _DEADLINE_SECONDS
        while not (value := condition()):
            if time.monotonic() > deadline:
                raise TimeoutError(what)
            self.executor.spin_once(timeout_sec=0.01)
        return value

    def send(self, cloud: PointCloud2, answers: list[Any], what: str) -> float:
        """Publish a cloud as the driver's next one; the seconds until `answers` has the one to it."""
        cloud.header.stamp.sec = next(self.numbers)
        began = time.perf_counter()
        self.driver.publish(cloud)
        self.wait_for(cloud, answers, what)
        return time.perf_counter() - began

    def wait_for(self, cloud: PointCloud2, answers: list[Any], what: str) -> None:
        """Run callbacks until the last of `answers` is the one to the cloud."""
        self.wait(lambda: answers and answers[-1].header.stamp == cloud.header.stamp, what)

    def require_inspected(self) -> None:
        """The last inspection is one of a scan that could be measured."""
        if self.inspections[-1].error_code:
            raise RuntimeError(self.inspections[-1].error_msg)

    def resident_mib(self) -> dict[str, float]:
        """Memory of every node's process."""
        found = {}
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                words, parent = (entry / "cmdline").read_text().split("\0"), (entry / "stat").read_text().split()[3]
            except OSError:
                continue
            modules = [word.removeprefix("mdf_nodes.") for word in words if word.startswith("mdf_nodes.")]
            if modules and int(parent) == self.process.pid:
                pages = int((entry / "statm").read_text().split()[1])
                found[modules[0]] = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
        return found


@contextmanager
def running_cell(design: Design, folder: Path) -> Iterator[Cell]:
    """A cell that starts at the true pose."""
    path, log = folder / "design.stl", folder / "log"
    path.write_bytes(stl_bytes(design.vertices, design.faces))
    pose = f"pose.initial:={list(_KNOWN_POSE)}"
    command = [sys.executable, "-m", "mdf_nodes.cell", "--design", str(path), "--output-folder", str(folder)]
    command += ["--namespace", _NAMESPACE, "--ros-args", "-p", pose, "-p", "compensate_every_inspection:=false"]
    with log.open("wb") as stream:
        process = subprocess.Popen(command, env=child_environment(), stdout=stream, stderr=stream)
    rclpy.init(args=[])
    node = Node("bench", namespace=_NAMESPACE, enable_rosout=False, start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    inspections: list[InspectionMessage] = []
    node.create_subscription(InspectionMessage, "inspection", inspections.append, LATCHED)
    driver = node.create_publisher(PointCloud2, "points", QoSProfile(depth=2))
    try:
        cell = Cell(process, node, executor, driver, inspections)
        cell.wait(lambda: log.read_text().count(": ready\n") == len(NODES), "a ready cell")
        cell.wait(driver.get_subscription_count, "a subscriber")
        yield cell
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
        process.send_signal(signal.SIGINT)
        process.wait(_DEADLINE_SECONDS)


def posed_scan(points: int) -> tuple[Design, PointSet]:
    """A design and a scan of its print that lies where the design does."""
    warp, virtual = print_and_scan(Case(points=points))
    pose, scan = inverse(virtual.pose), virtual.scan
    assert scan.normals is not None
    return warp.design, PointSet(transform(pose, scan.points), rotate(pose, scan.normals), scan.areas)


def overhead(cell: Cell, design: Design, scan: PointSet, repeats: int) -> list[tuple[str, str]]:
    """The service and the whole cell beside the library on the same scan, by turns."""
    cloud = scan_message(scan, Header(frame_id="scanner"))
    same = scan_from_message(cloud)
    settings = mdf.Settings().replace({"pose.initial": _KNOWN_POSE})
    library, service, thinned, topics = [], [], [], []
    register = cell.node.create_client(Register, "register")
    cell.wait(register.service_is_ready, "the cell's service")
    for _ in range(repeats + 1):
        library.append(_seconds(lambda: mdf.inspect(design, same, settings)))
        began = time.perf_counter()
        future = register.call_async(Register.Request(scan=cloud))
        cell.wait(future.done, "an answer")
        service.append(time.perf_counter() - began)
        if future.result().error_code:
            raise RuntimeError(future.result().error_msg)
        thinned.append(_seconds(lambda: mdf.inspect(design, prepare(same, settings), settings)))
        topics.append(cell.send(cloud, cell.inspections, "an inspection"))
        cell.require_inspected()
    points = len(scan)
    return [
        *_beside(f"{points:,} points, `register`", median(service[1:]), median(library[1:])),
        *_beside(f"{points:,} points, `points` to `inspection`", median(topics[1:]), median(thinned[1:])),
    ]


def _seconds(work: Any) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _beside(what: str, nodes: float, library: float) -> list[tuple[str, str]]:
    return [
        (f"{what}: nodes / library, s", f"{nodes:.2f} / {library:.2f}"),
        (f"{what}: overhead", f"{nodes / library - 1.0:+.0%}"),
    ]


def large_scans(cell: Cell, scan: PointSet, scans: int) -> list[tuple[str, str]]:
    """Scans of millions of points one after the other: time to the thinned cloud, timers meanwhile, memory."""
    cloud = scan_message(PointSet(scan.points, scan.normals, None), Header(frame_id="scanner"))
    seconds, memory = [], []
    thin: list[PointCloud2] = []
    cell.node.create_subscription(PointCloud2, "scan", thin.append, SCAN)
    timers = _Timers(cell.node)
    for _ in range(scans):
        seconds.append(cell.send(cloud, thin, "a thinned scan"))
        cell.wait_for(cloud, cell.inspections, "an inspection")
        cell.require_inspected()
        memory.append(cell.resident_mib())
    points = len(scan)
    quarter = memory[len(memory) // 4]
    return [
        (f"{points:,} points ({len(cloud.data) >> 20} MiB), scans", str(scans)),
        ("published to thinned cloud received, median / most, s", f"{median(seconds):.2f} / {max(seconds):.2f}"),
        ("a timer of a node was late by at most, s", f"{timers.latest():.3f}"),
        *(
            (f"memory of {name} after a quarter / all of the scans, MiB", f"{quarter[name]:.0f} / {last:.0f}")
            for name, last in sorted(memory[-1].items())
        ),
    ]


class _Timers:
    """When the nodes' timers of one second ran, as their diagnostics say."""

    def __init__(self, node: Node) -> None:
        self._ran: dict[str, list[float]] = {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._note, QoSProfile(depth=100))

    def _note(self, message: DiagnosticArray) -> None:
        stamp = message.header.stamp
        self._ran.setdefault(message.status[0].name, []).append(stamp.sec + 1e-9 * stamp.nanosec)

    def latest(self) -> float:
        """By how many seconds the latest one was late."""
        return max(later - earlier for ran in self._ran.values() for earlier, later in pairwise(ran)) - 1.0


def page(rows: Sequence[tuple[str, str]], command: str, where: str) -> str:
    return f"""\
# What the nodes cost

A running cell, each node a process of its own, asked through DDS on the same machine; the pose is known. The library
works on the same scans in the benchmark's process, by turns with the cell; medians, the first run left out. What comes
by topic is thinned by scan_ingest and then registered; the library beside it does the same.

{markdown_table(HEADINGS, rows, 1)}
Made by

    {command}

on {where}.
"""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.nodes", description=__doc__)
    parser.add_argument("--points", type=int, default=200_000, help="points of the scans beside the library")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--large", type=int, default=2_000_000, help="points of the large scans")
    parser.add_argument("--scans", type=int, default=20, help="how many large ones")
    parser.add_argument("--out", type=Path, help="write the table as markdown to this file")
    options = parser.parse_args(arguments)
    if min(options.repeats, options.scans) < 1:
        parser.error("--repeats and --scans must be 1 or more")
    command, where = command_line("bench.nodes", arguments), machine()
    tune_dds()
    (design, scan), (_, large) = posed_scan(options.points), posed_scan(options.large)
    with tempfile.TemporaryDirectory() as folder, running_cell(design, Path(folder)) as cell:
        rows = [*overhead(cell, design, scan, options.repeats), *large_scans(cell, large, options.scans)]
    table = figures_table(HEADINGS, 1)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
    if options.out:
        write_atomically(options.out, page(rows, command, where).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
