"""``virtual_scanner``: publishes what a scanner's driver would, of a part printed by a virtual printer."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from mdf_core.geometry import PointSet
from mdf_core.mesh_io import load_design
from mdf_core.point_cloud2 import columns_of_scan, pack_cloud
from mdf_core.virtual_cell import PARTS, Printer, ScannerSettings, Warp, build_part, scan_part
from mdf_nodes.context import only_ros_arguments, run_node
from mdf_nodes.qos import SENSOR

_POLL_SECONDS = 0.05

# Name: default, description, range.
_PARAMETERS: dict[str, tuple[Any, str, tuple[float, float] | None]] = {
    "part": ("bracket", f"Part that is printed and scanned: one of {', '.join(PARTS)}", None),
    "design_path": ("", "Mesh file of another part to print, mm; empty: `part`", None),
    "printed_path": (
        "",
        "Mesh file of a part as printed, mm, scanned as it is; empty: print one",
        None,
    ),
    "amplitude_mm": (1.0, "Largest distortion of the print, mm", (0.0, 1000.0)),
    "correlation_length_mm": (35.0, "Length of the distortion's waves, mm", (0.1, 10_000.0)),
    "seed": (0, "Of the distortion and the first scan; every further scan counts on from it", (0, 2**31 - 1)),
    "points": (20_000, "Points of a scan", (1, 50_000_000)),
    "noise_mm": (0.02, "Standard deviation of every coordinate, mm", (0.0, 1000.0)),
    "outlier_share": (0.01, "Share of points that lie anywhere around the part", (0.0, 1.0)),
    "density_contrast": (1.0, "95th over 5th percentile of the density of the points", (1.0, 1e6)),
    "hidden_share": (0.0, "Share of the area that the scanner does not see", (0.0, 0.99)),
    "pose": ("identity", "How the part lies on the scanner: identity or random", None),
    "normals": (True, "Whether points have normals", None),
    "frame_id": ("scanner", "Frame of the scanner", None),
    "reliable": (True, "Publish reliably; false: as sensor data, of which scans of 1 MB and more get lost", None),
    "period": (1.0, "Time between scans, s", (0.0, 86_400.0)),
    "count": (0, "Scans to publish before the process ends; 0: no end", (0, 2**31 - 1)),
}


_SCANNER_SETTINGS = ("points", "noise_mm", "outlier_share", "density_contrast", "hidden_share", "pose", "normals")


class VirtualScanner(Node):
    """Publishes scans on ``points`` while somebody listens."""

    def __init__(self) -> None:
        super().__init__("virtual_scanner")
        for name, (default, description, limits) in _PARAMETERS.items():
            self.declare_parameter(name, default, _descriptor(description, default, limits))
        self._settings = ScannerSettings(**{name: self._get(name) for name in _SCANNER_SETTINGS})
        self._printed, self._faces = self._print()
        self._period, self._count = self._get("period"), self._get("count")
        self._published, self._due = 0, time.monotonic()
        self._publisher = self.create_publisher(PointCloud2, "points", _profile(self._get("reliable")))
        self.create_timer(_POLL_SECONDS, self._publish_when_due)

    @property
    def done(self) -> bool:
        """All scans are published, and subscribers had one period to take the last."""
        return 0 < self._count <= self._published and time.monotonic() >= self._due

    def _get(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _print(self) -> tuple[Any, Any]:
        if path := self._get("printed_path"):
            printed = load_design(path)
            return printed.vertices, printed.faces
        design = load_design(path) if (path := self._get("design_path")) else build_part(self._get("part"))
        warp = Warp(design, self._get("amplitude_mm"), self._get("correlation_length_mm"), self._get("seed"))
        return Printer(warp).print_part(design.vertices), design.faces

    def _publish_when_due(self) -> None:
        if time.monotonic() < self._due or 0 < self._count <= self._published:
            return
        if self._publisher.get_subscription_count() == 0:
            return
        scan = scan_part(self._printed, self._faces, self._settings, self._get("seed") + self._published).scan
        self._publisher.publish(self._message(scan))
        self._published += 1
        self._due = time.monotonic() + self._period
        self.get_logger().info(f"scan {self._published} with {len(scan)} points published")

    def _message(self, scan: PointSet) -> PointCloud2:
        cloud = pack_cloud(columns_of_scan(scan))
        return PointCloud2(
            header=Header(stamp=self.get_clock().now().to_msg(), frame_id=self._get("frame_id")),
            height=1,
            width=cloud.width,
            fields=[
                PointField(name=name, offset=offset, datatype=datatype, count=count)
                for name, offset, datatype, count in cloud.fields
            ],
            is_bigendian=False,
            point_step=cloud.point_step,
            row_step=cloud.width * cloud.point_step,
            data=cloud.data,
            is_dense=True,
        )


def _profile(reliable: bool) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if reliable else SENSOR.reliability
    return QoSProfile(history=SENSOR.history, depth=SENSOR.depth, durability=SENSOR.durability, reliability=reliability)


def _descriptor(description: str, default: Any, limits: tuple[float, float] | None) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=description, read_only=True)
    if limits and isinstance(default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]))]
    elif limits:
        descriptor.floating_point_range = [FloatingPointRange(from_value=limits[0], to_value=limits[1])]
    return descriptor


def main(argv: Sequence[str] = sys.argv) -> int:
    """Publish scans until interrupted or `count` is reached; the exit status."""
    only_ros_arguments("Publish scans of a virtual print as a scanner's driver would.", argv)
    return run_node(VirtualScanner, argv, lambda scanner: scanner.done)


if __name__ == "__main__":
    sys.exit(main())
