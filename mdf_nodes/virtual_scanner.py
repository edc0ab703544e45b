"""``virtual_scanner``: publishes what a scanner's driver would, of a part printed by a virtual printer."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mdf_core.mesh_io import load_design
from mdf_core.virtual_cell import PARTS, Printer, ScannerSettings, Warp, build_part, scan_part
from mdf_nodes.context import only_ros_arguments, run_node
from mdf_nodes.conversions import scan_message
from mdf_nodes.parameters import declare, declare_choice
from mdf_nodes.qos import SENSOR

_POLL_SECONDS = 0.05
_LARGEST_INTEGER = 2**31 - 1
_SCANNER_SETTINGS = ("points", "noise_mm", "outlier_share", "density_contrast", "hidden_share", "pose", "normals")


class VirtualScanner(Node):
    """Publishes scans on ``points`` while somebody listens."""

    def __init__(self) -> None:
        super().__init__("virtual_scanner")
        self._declare_parameters()
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

    def _declare_parameters(self) -> None:
        declare_choice(self, "part", "bracket", "Part that is printed and scanned", tuple(PARTS), read_only=True)
        declare(self, "design_path", "", "Mesh file of another part to print, mm; empty: `part`", read_only=True)
        declare(
            self,
            "printed_path",
            "",
            "Mesh file of a part as printed, mm, scanned as it is; empty: print one",
            read_only=True,
        )
        declare(
            self,
            "amplitude_mm",
            1.0,
            "Largest distortion of the print",
            unit="mm",
            minimum=0.0,
            maximum=1000.0,
            read_only=True,
        )
        declare(
            self,
            "correlation_length_mm",
            35.0,
            "Length of the distortion's waves",
            unit="mm",
            minimum=0.1,
            maximum=10_000.0,
            read_only=True,
        )
        declare(
            self,
            "seed",
            0,
            "Of the distortion and the first scan; every further scan counts on from it",
            minimum=0,
            maximum=_LARGEST_INTEGER,
            read_only=True,
        )
        declare(self, "points", 20_000, "Points of a scan", minimum=1, maximum=50_000_000, read_only=True)
        declare(
            self,
            "noise_mm",
            0.02,
            "Standard deviation of every coordinate",
            unit="mm",
            minimum=0.0,
            maximum=1000.0,
            read_only=True,
        )
        declare(
            self,
            "outlier_share",
            0.01,
            "Share of points that lie anywhere around the part",
            minimum=0.0,
            maximum=1.0,
            read_only=True,
        )
        declare(
            self,
            "density_contrast",
            1.0,
            "95th over 5th percentile of the density of the points",
            minimum=1.0,
            maximum=1e6,
            read_only=True,
        )
        declare(
            self,
            "hidden_share",
            0.0,
            "Share of the area that the scanner does not see",
            minimum=0.0,
            maximum=0.99,
            read_only=True,
        )
        declare_choice(
            self, "pose", "identity", "How the part lies on the scanner", ("identity", "random"), read_only=True
        )
        declare(self, "normals", True, "Whether points have normals", read_only=True)
        declare(self, "frame_id", "scanner", "Frame of the scanner", read_only=True)
        declare(
            self,
            "reliable",
            True,
            "Publish reliably; false: as sensor data, of which scans of 1 MB and more get lost",
            read_only=True,
        )
        declare(self, "period", 1.0, "Time between scans", unit="s", minimum=0.0, maximum=86_400.0, read_only=True)
        declare(
            self,
            "count",
            0,
            "Scans to publish before the process ends; 0: no end",
            minimum=0,
            maximum=_LARGEST_INTEGER,
            read_only=True,
        )

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
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._get("frame_id"))
        self._publisher.publish(scan_message(scan, header))
        self._published += 1
        self._due = time.monotonic() + self._period
        self.get_logger().info(f"scan {self._published} with {len(scan)} points published")


def _profile(reliable: bool) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if reliable else SENSOR.reliability
    return QoSProfile(history=SENSOR.history, depth=SENSOR.depth, durability=SENSOR.durability, reliability=reliability)


def main(argv: Sequence[str] = sys.argv) -> int:
    """Publish scans until interrupted or `count` is reached; the exit status."""
    only_ros_arguments("Publish scans of a virtual print as a scanner's driver would.", argv)
    return run_node(VirtualScanner, argv, lambda scanner: scanner.done)


if __name__ == "__main__":
    sys.exit(main())
