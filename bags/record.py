"""Records the bags of this folder from the running virtual scanner: ``python bags/record.py [CASE ...]``.

Scanner and recorder are processes of their own that talk through DDS. What was recorded is compared with the virtual
cell before it replaces an older recording. Sourcing nothing is needed; a ROS domain of its own is used.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mdf_core.bag import open_bag
from mdf_core.distortion import distortion_left
from mdf_core.files import write_atomically
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.point_cloud2 import scan_from_cloud
from mdf_core.virtual_cell import Printer, ScannerSettings, VirtualScan, Warp, build_part, scan_part
from mdf_nodes.context import child_environment

DOMAIN = "97"
TIMEOUT_SECONDS = 60
TOPIC = "/points"
_SCANNER_PARAMETERS = ("points", "noise_mm", "outlier_share", "density_contrast", "hidden_share", "pose", "normals")


@dataclass(frozen=True)
class Case:
    """One bag: how the part was printed and scanned, and what an inspection of it must reach.

    Attributes
    ----------
    scans : int
        Scans of the same print; the seed counts on from scan to scan.
    largest_fraction : float
        Of the distortion, that may be unrecovered at supported vertices.
    largest_fraction_left : float
        Of the RMS distortion of those vertices, that may be left after one redesign and print.
    least_coverage, most_coverage : float
        Share of the surface that must, and may, be supported.
    """

    part: str
    amplitude_mm: float
    correlation_length_mm: float
    seed: int
    scanner: ScannerSettings
    scans: int
    largest_fraction: float
    largest_fraction_left: float
    least_coverage: float
    most_coverage: float = 1.0


CASES = {
    "bracket": Case(
        part="bracket",
        amplitude_mm=1.5,
        correlation_length_mm=50.0,
        seed=12,
        scanner=ScannerSettings(points=20_000, noise_mm=0.02, outlier_share=0.0),
        scans=2,
        largest_fraction=0.02,
        largest_fraction_left=0.02,
        least_coverage=0.99,
    ),
    "bracket_rough": Case(
        part="bracket",
        amplitude_mm=2.5,
        correlation_length_mm=50.0,
        seed=25,
        scanner=ScannerSettings(points=40_000, noise_mm=0.05, outlier_share=0.02, density_contrast=10.0, pose="random"),
        scans=1,
        largest_fraction=0.04,
        largest_fraction_left=0.05,
        least_coverage=0.99,
    ),
    "housing_hidden": Case(
        part="housing",
        amplitude_mm=1.5,
        correlation_length_mm=50.0,
        seed=38,
        scanner=ScannerSettings(points=20_000, noise_mm=0.02, outlier_share=0.01, hidden_share=0.2, pose="random"),
        scans=1,
        largest_fraction=0.05,
        largest_fraction_left=0.05,
        least_coverage=0.75,
        most_coverage=0.9,
    ),
}


def record(name: str, out: Path) -> None:
    """Record the case `name` into the folder ``out/name``."""
    case = CASES[name]
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=f".{name}.") as temporary:
        folder = Path(temporary) / name
        design_path = Path(temporary) / "design.stl"
        design = build_part(case.part)
        write_atomically(design_path, stl_bytes(design.vertices, design.faces))
        _run_cell(case, design_path, folder)
        scans = _true_scans(case, design_path)
        _compare(folder, scans)
        design_path.rename(folder / "design.stl")
        expected = json.dumps(_expected(case, folder / "design.stl", scans), indent=2) + "\n"
        write_atomically(folder / "expected.json", expected.encode())
        shutil.rmtree(out / name, ignore_errors=True)
        folder.rename(out / name)


def _run_cell(case: Case, design_path: Path, folder: Path) -> None:
    """Run recorder and scanner until all scans are recorded."""
    settings = {key: value for key, value in asdict(case.scanner).items() if key in _SCANNER_PARAMETERS}
    parameters = settings | {
        "design_path": design_path,
        "amplitude_mm": case.amplitude_mm,
        "correlation_length_mm": case.correlation_length_mm,
        "seed": case.seed,
        "count": case.scans,
    }
    environment = child_environment(ROS_DOMAIN_ID=DOMAIN, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")

    def start(module: str, *arguments: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"mdf_nodes.{module}", *map(str, arguments)]
        return subprocess.Popen(command, env=environment)

    options = [text for key, value in parameters.items() for text in ("-p", f"{key}:={value}")]
    recorder = start("bag_recorder", folder, "--topics", TOPIC, "--count", case.scans)
    scanner = start("virtual_scanner", "--ros-args", *options)
    try:
        for process in (recorder, scanner):
            if status := process.wait(TIMEOUT_SECONDS):
                raise SystemExit(f"{process.args} ended with status {status}")
    finally:
        for process in (scanner, recorder):
            process.kill()
            process.wait()


def _true_scans(case: Case, design_path: Path) -> list[VirtualScan]:
    """The scans as the virtual cell makes them, with their truth."""
    design = load_design(design_path)
    warp = Warp(design, case.amplitude_mm, case.correlation_length_mm, case.seed)
    printed = Printer(warp).print_part(design.vertices)
    return [scan_part(printed, design.faces, case.scanner, case.seed + number) for number in range(case.scans)]


def _compare(folder: Path, scans: list[VirtualScan]) -> None:
    """Make sure that the bag holds these scans."""
    messages = list(open_bag(folder).messages([TOPIC]))
    for message, truth in zip(messages, scans, strict=True):
        np.testing.assert_allclose(scan_from_cloud(message.message).points, truth.scan.points, rtol=1e-6, atol=1e-4)


def _expected(case: Case, design_path: Path, scans: list[VirtualScan]) -> dict[str, Any]:
    design = load_design(design_path)
    warp = Warp(design, case.amplitude_mm, case.correlation_length_mm, case.seed)
    rms, largest = distortion_left(design, Printer(warp).print_part(design.vertices))
    return {
        "part": case.part,
        "topic": TOPIC,
        "design": {"path": design_path.name, "unit": "mm", "sha256": design.file_sha256},
        "printer": {
            "model": "spatial",
            "amplitude_mm": case.amplitude_mm,
            "correlation_length_mm": case.correlation_length_mm,
            "seed": case.seed,
        },
        "scanner": {key: value for key, value in asdict(case.scanner).items() if key in _SCANNER_PARAMETERS},
        "scans": [
            {
                "seed": case.seed + number,
                "T_scan_design_mm": scan.pose.tolist(),
                "outliers": int(scan.is_outlier.sum()),
                "seen_area_share": float(design.vertex_areas[scan.seen_vertices].sum() / design.vertex_areas.sum()),
            }
            for number, scan in enumerate(scans)
        ],
        "truth": {"rms_distortion_mm": rms, "max_distortion_mm": largest},
        "tolerances": {
            "largest_fraction": case.largest_fraction,
            "largest_fraction_left": case.largest_fraction_left,
            "least_coverage": case.least_coverage,
            "most_coverage": case.most_coverage,
        },
    }


def main() -> None:
    """Record the chosen cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; default: all")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent, help="default: this folder")
    arguments = parser.parse_args()
    if unknown := set(arguments.cases) - set(CASES):
        parser.error(f"unknown case {', '.join(sorted(unknown))}")
    for name in arguments.cases or CASES:
        record(name, arguments.out)
        print(f"{arguments.out / name}: {(arguments.out / name / f'{name}_0.mcap').stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
