"""Virtual prints with known truth, made and inspected once for all tests that ask for the same one, and a ledger."""

import sys
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from threadpoolctl import threadpool_limits

import mdf_core as mdf
from mdf_core import cli, picture, pipeline
from mdf_core.distortion import fraction_unrecovered
from mdf_core.ledger import Ledger
from mdf_core.rigid import inverse
from mdf_core.subdivision import subdivided
from mdf_core.virtual_cell import ScannerSettings, VirtualScan, Warp, build_part, scan_part

sys.path.insert(0, str(Path(__file__).parent))

from command_samples import POSED, Cell
from ledger_samples import url_of
from poses import pose_numbers

part = cache(build_part)


@pytest.fixture(autouse=True, scope="session")
def one_blas_thread():
    """As in the pipeline: on a busy machine the threads of many small matrix products wait for each other."""
    with threadpool_limits(1, user_api="blas"):
        yield


@dataclass(frozen=True, eq=False)
class Print:
    """A part, how its print is warped, and the scan of it."""

    design: mdf.Design
    warp: Warp
    virtual: VirtualScan
    _inspections: dict = field(default_factory=dict)

    @property
    def scan(self):
        return self.virtual.scan

    @property
    def displacement(self):
        """The true one, at the design's vertices."""
        return self.warp(self.design.vertices)

    @property
    def pose(self):
        """The true T_design_scan."""
        return inverse(self.virtual.pose)

    @property
    def pose_numbers(self):
        """`pose` as x y z qx qy qz qw, for ``pose.initial``."""
        return pose_numbers(self.pose)

    def inspect(self, changes=(), search_pose=False):
        """The inspection with the settings changed; from the true pose unless it is to be searched."""
        changes = dict(changes)
        if not search_pose:
            changes["pose.initial"] = self.pose_numbers
        key = tuple(sorted(changes.items()))
        if key not in self._inspections:
            self._inspections[key] = mdf.inspect(self.design, self.scan, mdf.Settings().replace(changes))
        return self._inspections[key]

    def fraction_unrecovered(self, inspection):
        """Over the supported vertices."""
        return fraction_unrecovered(self.design, self.displacement, inspection.displacement, inspection.supported)


@cache
def _print_and_scan(name, warp_mm, length_mm, warp_seed, scan_seed, scanner):
    design = part(name)
    warp = Warp(design, warp_mm, length_mm, seed=warp_seed)
    printed = design.vertices + warp(design.vertices)
    return Print(design, warp, scan_part(printed, design.faces, ScannerSettings(**dict(scanner)), seed=scan_seed))


@pytest.fixture(scope="session")
def print_and_scan():
    """Function: the print of a part and its scan in any pose; the same object for the same arguments."""

    def make(name="bracket", warp_mm=2.5, length_mm=50.0, warp_seed=0, scan_seed=0, **scanner):
        options = {"pose": "random"} | scanner
        return _print_and_scan(name, warp_mm, length_mm, warp_seed, scan_seed, tuple(sorted(options.items())))

    return make


@pytest.fixture(scope="session")
def build():
    """Function: the virtual cell's part of that name, built once."""
    return part


@pytest.fixture(scope="session")
def sheet():
    """A flat design without thickness, seen from above: nothing tells what happens in its plane but its borders."""
    box = trimesh.creation.box((100.0, 60.0, 1.0))
    box.update_faces(box.face_normals[:, 2] > 0.5)
    box.remove_unreferenced_vertices()
    return subdivided(mdf.Design(box.vertices, box.faces), 4.0)


@pytest.fixture
def measured(request):
    """Function: note a number that the test saw; it is told at the end of the run and in its XML report."""
    return lambda name, value: request.node.user_properties.append((name, float(value)))


def pytest_terminal_summary(terminalreporter):
    reports = [report for key in ("passed", "failed") for report in terminalreporter.stats.get(key, [])]
    numbers = [(report.nodeid, name, value) for report in reports for name, value in report.user_properties]
    if numbers:
        terminalreporter.section("measured")
        for test, name, value in numbers:
            terminalreporter.line(f"{value:10.4g}  {name}  {test.rsplit('::')[-1]}")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def ledger(tmp_path):
    with Ledger(url_of(tmp_path)) as opened:
        yield opened


@pytest.fixture
def cell(tmp_path):
    """A virtual print cell, whose files lie in the test's folder."""
    return Cell(tmp_path)


_INSPECTED = {}


@pytest.fixture
def nothing_drawn(monkeypatch):
    """Commands draw no pictures, which take most of their time: for tests of what else they do."""
    monkeypatch.setattr(picture, "draw", lambda design, rows: b"no picture")


@pytest.fixture
def inspected_once(monkeypatch, nothing_drawn):
    """Commands inspect a scan with the same settings only once, also in other tests, and draw nothing.

    For tests of what is done with inspections: those of inspections are elsewhere.
    """
    inspect = pipeline.inspect

    def inspect_once(design, scan, settings, progress=None, regions=()):
        key = design.file_sha256, scan.sha256(), settings.sha256()
        if key not in _INSPECTED:
            _INSPECTED[key] = inspect(design, scan, settings, progress)
        # Where the file lies and what tolerances hold is all that may differ.
        return replace(_INSPECTED[key], design=design, regions=tuple(regions))

    monkeypatch.setattr(pipeline, "inspect", inspect_once)


@pytest.fixture(name="mdf")
def typed(capsys):
    """``mdf("compensate", ...)``: exit status, stdout, stderr."""

    def run(*arguments):
        capsys.readouterr()
        return cli.main([str(argument) for argument in arguments]), *capsys.readouterr()

    return run


@pytest.fixture
def compensated(mdf, cell):
    """``compensated("out", scan, ...)``: the folder, after a run that succeeded."""

    def run(name, *arguments):
        out = cell.folder / name
        status, text, errors = mdf("compensate", cell.design_path, *arguments, "--out", out, *POSED)
        assert (status, errors) == (0, ""), errors
        assert text
        return out

    return run


@pytest.fixture
def url(tmp_path):
    """Of a ledger in the test's folder, which is still to be made."""
    return url_of(tmp_path)
