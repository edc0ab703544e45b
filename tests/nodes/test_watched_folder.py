"""The watched folder of scan_ingest, whatever others do in it meanwhile: nothing is lost, and nothing taken twice."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Graph, set_parameters
from samples import scan_of, write_design
from sensor_msgs.msg import PointCloud2

from mdf_core.errors import OutputFolderError, ScanFileError
from mdf_core.geometry import Design, PointSet
from mdf_core.mesh_io import load_scan
from mdf_nodes import scan_ingest
from mdf_nodes.qos import SCAN
from mdf_nodes.scan_ingest import ScanIngest

FIRST, SECOND = 3000, 2000  # points, which tell the files apart
BROKEN = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"


class Watched:
    """A folder, the node that watches it, in this process, and what becomes of the files."""

    def __init__(self, graph: Graph, node: ScanIngest, design: Design, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self._graph, self._node, self._design, self._folder = graph, node, design, folder
        self._scans = graph.collect(PointCloud2, "scan", SCAN)
        self._report = node.report
        self.errors: list[type[Exception]] = []
        patch.setattr(node, "report", self._note)
        set_parameters(node, watch_folder=str(folder))

    def _note(self, error: Exception, **options: Any) -> Any:
        self.errors.append(type(error))
        return self._report(error, **options)

    def write(self, name: str, points: int = FIRST) -> Path:
        """A complete file appears, or takes the place of another one."""
        path = self._folder / name
        with path.with_suffix(".tmp").open("wb") as file:
            np.save(file, scan_of(self._design, points).points)
        return path.with_suffix(".tmp").rename(path)

    def wait_until(self, condition: Callable[[], Any]) -> None:
        self._graph.wait_until(condition)

    def wait_for_jobs(self, count: int) -> None:
        self.wait_until(lambda: len(self._node.require_active()) == count)

    def wait_for_scans(self, *points: int) -> None:
        """Fails if other scans than these have come."""
        self.wait_until(lambda: len(self._scans) >= len(points))
        assert [scan.width for scan in self._scans] == list(points)

    def goes_on(self) -> None:
        """Another file is taken: nothing that was told has stopped the node."""
        self.write("another.npy")
        self.wait_until((self._folder / "done" / "another.npy").exists)

    def files(self, name: str = ".") -> list[str]:
        return sorted(path.name for path in (self._folder / name).glob("*") if path.is_file())


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    return write_design(tmp_path_factory.mktemp("design"))


@pytest.fixture
def watched(
    graph: Graph, domain: int, design: Design, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Watched]:
    node = ScanIngest()
    node.start()
    yield Watched(graph, node, design, tmp_path, monkeypatch)
    node.stop()


def meanwhile(monkeypatch: pytest.MonkeyPatch, happens: Callable[[Path], object], before: bool = False) -> None:
    """Let something happen once to a file, right after it has been read, or before."""
    due = [happens]

    def load(path: Path, unit: str) -> PointSet:
        if due and before:
            due.pop()(path)
        scan = load_scan(path, unit)
        if due:
            due.pop()(path)
        return scan

    monkeypatch.setattr(scan_ingest, "load_scan", load)


def test_a_file_that_vanishes_before_its_turn_is_no_error(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    meanwhile(monkeypatch, lambda _: go_on.wait(60.0))
    watched.write("long.npy")
    watched.wait_for_jobs(1)
    gone = watched.write("gone.npy")
    watched.wait_for_jobs(2)
    gone.unlink()
    go_on.set()
    watched.goes_on()
    assert not watched.errors
    assert watched.files("done") == ["another.npy", "long.npy"] and not watched.files("failed")


def test_a_file_that_vanishes_while_it_is_read_is_told_and_leaves_no_reason_alone(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    meanwhile(monkeypatch, Path.unlink, before=True)
    watched.write("gone.npy")
    watched.wait_until(lambda: watched.errors)
    watched.goes_on()
    assert watched.errors == [ScanFileError]
    assert not watched.files("failed")


def test_a_file_that_is_taken_away_once_it_has_been_read_is_a_scan_all_the_same(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    meanwhile(monkeypatch, Path.unlink)
    watched.write("gone.npy", SECOND)
    watched.wait_for_scans(SECOND)
    watched.goes_on()
    watched.wait_for_scans(SECOND, FIRST)
    assert not watched.errors and not watched.files("failed")


def test_a_file_that_is_replaced_while_it_is_read_is_read_anew(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    meanwhile(monkeypatch, lambda path: watched.write(path.name, SECOND))
    watched.write("part.npy", FIRST)
    watched.wait_until(lambda: watched.files("done"))
    watched.wait_for_scans(FIRST, SECOND)
    assert not watched.errors and not watched.files()


def test_a_broken_file_that_is_replaced_while_it_is_read_spoils_nothing(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replace(path: Path) -> None:
        watched.write(path.name)
        raise ScanFileError("is broken")

    meanwhile(monkeypatch, replace)
    watched.write("part.npy", SECOND)
    watched.wait_until(lambda: watched.files("done"))
    watched.wait_for_scans(FIRST)
    assert watched.errors == [ScanFileError] and not watched.files("failed")


def test_a_file_that_is_replaced_before_its_turn_is_read_once(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    meanwhile(monkeypatch, lambda _: go_on.wait(60.0))
    watched.write("long.npy")
    watched.wait_for_jobs(1)
    watched.write("part.npy", FIRST)
    watched.wait_for_jobs(2)
    watched.write("part.npy", SECOND)
    go_on.set()
    watched.wait_until(lambda: watched.files("done") == ["long.npy", "part.npy"])
    watched.wait_for_scans(FIRST, SECOND)


def test_a_file_whose_reason_cannot_be_written_stays_and_is_told_of_once(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, content: bytes) -> str:
        raise OutputFolderError(f"cannot write {path.name}: no space", str(path.parent))

    monkeypatch.setattr(scan_ingest, "write_atomically", refuse)
    (tmp_path / "broken.ply").write_bytes(BROKEN)
    watched.wait_until(lambda: len(watched.errors) == 2)
    watched.goes_on()  # two looks at the folder
    assert watched.errors == [ScanFileError, OutputFolderError]
    assert watched.files() == ["broken.ply"] and not watched.files("failed")


def test_no_file_is_written_over(watched: Watched, tmp_path: Path) -> None:
    for name in ("done/part.npy", "done/part-2.npy", "failed/broken.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("before")
    watched.write("part.npy")
    (tmp_path / "broken.ply").write_bytes(BROKEN)
    watched.wait_until(lambda: not watched.files())
    assert watched.files("done") == ["part-2.npy", "part-3.npy", "part.npy"]
    assert watched.files("failed") == ["broken-2.ply", "broken-2.ply.txt", "broken.ply"]
    for name in ("done/part.npy", "done/part-2.npy", "failed/broken.ply"):
        assert (tmp_path / name).read_text() == "before"


def test_a_scan_that_cannot_be_moved_to_done_fails_with_the_reason(watched: Watched, tmp_path: Path) -> None:
    (tmp_path / "done").write_text("in the way")
    watched.write("part.npy")
    watched.wait_until(lambda: len(watched.files("failed")) == 2)
    assert "OUTPUT_FOLDER (501)" in (tmp_path / "failed" / "part.npy.txt").read_text()
    watched.wait_for_scans(FIRST)


def test_a_scan_that_cannot_be_moved_anywhere_stays_and_is_published_once(watched: Watched, tmp_path: Path) -> None:
    for name in ("done", "failed"):
        (tmp_path / name).write_text("in the way")
    watched.write("part.npy", SECOND)
    watched.wait_until(lambda: len(watched.errors) == 2)
    (tmp_path / "done").unlink()
    watched.goes_on()  # two looks at the folder
    watched.wait_for_scans(SECOND, FIRST)
    assert watched.errors == [OutputFolderError, OutputFolderError] and "part.npy" in watched.files()
