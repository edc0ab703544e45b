from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mdf_core.errors import OutputFolderError
from mdf_core.files import require_writable, write_atomically


def test_content_and_hash_arrive_and_nothing_else_is_left(tmp_path: Path) -> None:
    target = tmp_path / "results" / "part 7" / "redesigned.stl"
    digest = write_atomically(target, b"content")
    assert target.read_bytes() == b"content"
    assert digest == hashlib.sha256(b"content").hexdigest()
    assert list(target.parent.iterdir()) == [target]


def test_an_existing_file_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "report.json"
    write_atomically(target, b"a long first version")
    write_atomically(str(target), b"second")
    assert target.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [target]


def test_others_may_read_the_result(tmp_path: Path) -> None:
    write_atomically(tmp_path / "report.json", b"{}")
    assert (tmp_path / "report.json").stat().st_mode & 0o777 == 0o644


def test_a_path_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"untouched")
    with pytest.raises(OutputFolderError, match=r"file: cannot write report\.json: .+; choose a writable folder"):
        write_atomically(tmp_path / "file" / "report.json", b"{}")
    assert (tmp_path / "file").read_bytes() == b"untouched"


def test_a_folder_in_the_place_of_the_file_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    (tmp_path / "report.json").mkdir()
    with pytest.raises(OutputFolderError):
        write_atomically(tmp_path / "report.json", b"{}")
    assert list(tmp_path.iterdir()) == [tmp_path / "report.json"]
    assert list((tmp_path / "report.json").iterdir()) == []


def test_a_disk_that_fills_up_leaves_the_old_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "report.json"
    write_atomically(target, b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputFolderError, match="No space left on device"):
        write_atomically(target, b"new")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("names", [1, 2, 3])
def test_of_files_that_belong_together_a_kill_leaves_the_first_ones_only(tmp_path: Path, names: int) -> None:
    contents = {"record.json": b"{}", "redesigned.stl": b"solid", "redesigned.ply": b"ply"}
    program = f"""
import os, pathlib
from mdf_core.files import write_together
rename, given = pathlib.Path.replace, []
def killed_after(self, target):
    rename(self, target)
    given.append(target)
    if len(given) == {names}:
        os.kill(os.getpid(), 9)
pathlib.Path.replace = killed_after
write_together(pathlib.Path({str(tmp_path)!r}), {contents!r})
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    there = {path.name: path.read_bytes() for path in tmp_path.iterdir() if not path.name.startswith(".")}
    assert there == dict(list(contents.items())[:names])


def test_a_disk_too_small_for_the_last_of_files_that_belong_together_gets_none_of_them(tmp_path: Path) -> None:
    program = f"""
import pathlib, resource, signal
from mdf_core.errors import OutputFolderError
from mdf_core.files import write_together
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_together(pathlib.Path({str(tmp_path)!r}), {{"record.json": b"a" * 900, "redesigned.stl": b"b" * 1100}})
except OutputFolderError as error:
    print(error)
"""
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert "cannot write record.json, redesigned.stl: File too large" in told
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_told_and_one_that_can_is_not_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputFolderError, match="file is no folder; choose a writable folder"):
        require_writable(tmp_path / "file" / "folder")
    require_writable(tmp_path / "new" / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
