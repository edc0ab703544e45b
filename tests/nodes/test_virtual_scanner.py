"""The virtual scanner publishes clouds as a driver does, and they are those of the virtual cell."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import CellProcess, Graph
from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.point_cloud2 import scan_from_cloud, unpack_cloud
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, scan_part
from mdf_nodes.qos import SENSOR

Start = Callable[..., CellProcess]

RELIABLE = QoSProfile(depth=5)


def parameters(**values: object) -> list[str]:
    return ["--ros-args", *(text for name, value in values.items() for text in ("-p", f"{name}:={value}"))]


def test_scans_are_those_of_the_virtual_cell_in_metres(graph: Graph, start: Start) -> None:
    received = graph.collect(PointCloud2, "points", RELIABLE)
    before = graph.nodes[0].get_clock().now().nanoseconds
    scanner = start(
        "virtual_scanner",
        *parameters(part="clip", amplitude_mm=2.0, points=3000, seed=5, pose="random", count=2, period=0.1),
    )
    assert scanner.wait() == 0, scanner.output
    graph.wait_until(lambda: len(received) == 2)

    design = build_part("clip")
    printed = Printer(Warp(design, 2.0, seed=5)).print_part(design.vertices)
    for number, message in enumerate(received):
        expected = scan_part(printed, design.faces, ScannerSettings(points=3000, pose="random"), 5 + number).scan
        scan = scan_from_cloud(message)
        np.testing.assert_allclose(scan.points, expected.points, rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(scan.normals, expected.normals, atol=1e-6)
        assert message.header.frame_id == "scanner"
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert before <= stamp <= graph.nodes[0].get_clock().now().nanoseconds
    assert list(unpack_cloud(received[0])) == ["x", "y", "z", "normal_x", "normal_y", "normal_z"]


def test_nothing_is_published_until_somebody_listens(graph: Graph, start: Start) -> None:
    scanner = start("virtual_scanner", *parameters(points=100, count=1, period=0.0))
    node = graph.node("subscriber")
    graph.wait_until(lambda: node.count_publishers("points"), what="the scanner is up")
    received = graph.collect(PointCloud2, "points", RELIABLE)
    assert scanner.wait() == 0, scanner.output
    graph.wait_until(lambda: len(received) == 1)


def test_a_printed_mesh_is_scanned_as_it_is(graph: Graph, start: Start, tmp_path: Path) -> None:
    design = build_part("plate")
    path = tmp_path / "printed.stl"
    path.write_bytes(stl_bytes(design.vertices * 1.01, design.faces))
    received = graph.collect(PointCloud2, "points", RELIABLE)
    start("virtual_scanner", *parameters(printed_path=path, points=500, noise_mm=0.0, outlier_share=0.0, count=1))
    graph.wait_until(lambda: received)
    printed = load_design(path)
    expected = scan_part(printed.vertices, printed.faces, ScannerSettings(500, noise_mm=0.0, outlier_share=0.0)).scan
    np.testing.assert_allclose(scan_from_cloud(received[0]).points, expected.points, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("reliable", [True, False])
def test_sensor_data_subscribers_are_served_either_way(graph: Graph, start: Start, reliable: bool) -> None:
    received = graph.collect(PointCloud2, "points", SENSOR)
    scanner = start("virtual_scanner", *parameters(points=100, period=0.05, reliable=str(reliable).lower()))
    graph.wait_until(lambda: received)
    (offered,) = graph.nodes[0].get_publishers_info_by_topic("/points")
    assert (offered.qos_profile.reliability == ReliabilityPolicy.RELIABLE) is reliable
    assert scanner.stop() == 0


def test_every_parameter_tells_what_it_is_and_its_range(graph: Graph, start: Start) -> None:
    start("virtual_scanner")
    node = graph.node("client")
    listed = graph.call(
        node.create_client(ListParameters, "/virtual_scanner/list_parameters"), ListParameters.Request()
    )
    names = sorted(set(listed.result.names) - {"use_sim_time", "start_type_description_service"})
    described = graph.call(
        node.create_client(DescribeParameters, "/virtual_scanner/describe_parameters"),
        DescribeParameters.Request(names=names),
    )
    assert {"part", "amplitude_mm", "points", "pose", "seed", "printed_path"} <= set(names)
    assert all(descriptor.description for descriptor in described.descriptors)
    ranges = {each.name: (each.integer_range, each.floating_point_range) for each in described.descriptors}
    assert ranges["points"][0][0].from_value == 1
    assert ranges["outlier_share"][1][0].to_value == 1.0


def test_a_wrong_parameter_is_one_line_and_status_2(start: Start) -> None:
    reasons = {
        "part:=teapot": "part: unknown value 'teapot'; use one of bracket",
        "pose:=upside_down": "pose: unknown value 'upside_down'; use one of identity, random",
        "noise_mm:=-1.0": "noise_mm out of range",
        "points:=many": "points",
        "design_path:=/missing.stl": "/missing.stl",
    }
    scanners = {text: start("virtual_scanner", "--ros-args", "-p", text) for text in reasons}
    for text, scanner in scanners.items():
        assert scanner.wait() == 2
        assert scanner.stderr.startswith("error: ")
        assert reasons[text] in scanner.stderr
        assert scanner.stderr.count("\n") == 1
