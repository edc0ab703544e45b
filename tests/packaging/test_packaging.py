"""The distribution as its users meet it: versions, commands, dependencies, error codes."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import distribution
from pathlib import Path

import pytest

import mdf_core
from mdf_core import errors

ROOT = Path(__file__).resolve().parents[2]
MANIFESTS = sorted([ROOT / "package.xml", *ROOT.glob("ros_ws/src/*/package.xml")])
COMMANDS = sorted(entry.name for entry in distribution("mdf_nodes").entry_points if entry.group == "console_scripts")


def child_environment() -> dict[str, str]:
    """The caller's environment without what one Python's ROS wheels leave for another to trip over."""
    environment = dict(os.environ)
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, env=child_environment(), capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
    )


def setup_arguments() -> dict[str, object]:
    """The literal keyword arguments of setup() in setup.py."""
    call = next(
        node
        for node in ast.walk(ast.parse((ROOT / "setup.py").read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setup"
    )
    arguments = {}
    for keyword in call.keywords:
        try:
            arguments[keyword.arg] = ast.literal_eval(keyword.value)
        except ValueError:  # a name or an f-string
            continue
    return arguments


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda path: path.parent.name)
def test_every_manifest_has_the_library_version(manifest: Path) -> None:
    assert ET.parse(manifest).getroot().findtext("version") == mdf_core.__version__


def test_setup_py_has_the_library_version() -> None:
    assert setup_arguments()["version"] == mdf_core.__version__ == distribution("mdf_nodes").version


def test_setup_py_requires_what_the_requirements_file_names() -> None:
    lines = (ROOT / "requirements/run.in").read_text().splitlines()
    named = {line.split("#")[0].strip() for line in lines} - {""}
    assert set(setup_arguments()["install_requires"]) == named


def test_lock_pins_every_named_requirement_exactly() -> None:
    pins = set(re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements/lock.txt").read_text(), flags=re.MULTILINE))
    for source in ROOT.glob("requirements/*.in"):
        for line in source.read_text().splitlines():
            name = re.match(r"[A-Za-z0-9_-]*", line)[0].lower().replace("_", "-")
            assert not name or name in pins, f"{source.name}: {name}"


def test_no_requirements_file_names_a_registry() -> None:
    for path in [*ROOT.glob("requirements/*"), ROOT / "setup.py", ROOT / "pyproject.toml"]:
        assert "://" not in path.read_text(), path.name


def test_installed_packages_agree_with_each_other() -> None:
    outcome = run(sys.executable, "-m", "pip", "check")
    assert outcome.returncode == 0, outcome.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_command_tells_its_use(command: str) -> None:
    outcome = run(Path(sys.prefix, "bin", command), "--help")
    assert outcome.returncode == 0, outcome.stderr
    assert "usage" in outcome.stdout.lower()


def test_ros2_run_finds_every_node() -> None:
    nodes = set(COMMANDS) - {"mdf"}
    assert {path.name for path in Path(sys.prefix, "lib/mdf_nodes").iterdir() if os.access(path, os.X_OK)} == nodes


def test_library_is_marked_as_typed() -> None:
    assert (Path(mdf_core.__file__).parent / "py.typed").is_file()


BLOCK_ROS = """
import importlib, pkgutil, sys

ROS = {"rclpy", "mdf_interfaces", "mdf_nodes", "ament_index_python", "rosidl_runtime_py"}

class Blocker:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ROS or top.endswith("_msgs"):
            raise ImportError(f"{name} is ROS")

sys.meta_path.insert(0, Blocker())
import mdf_core
for module in pkgutil.iter_modules(mdf_core.__path__, "mdf_core."):
    if module.name != "mdf_core.__main__":
        importlib.import_module(module.name)
"""


def test_every_library_module_imports_without_ros() -> None:
    outcome = run(sys.executable, "-c", BLOCK_ROS)
    assert outcome.returncode == 0, outcome.stderr


def error_classes() -> list[type[errors.MdfError]]:
    return [
        value
        for _, value in inspect.getmembers(errors, inspect.isclass)
        if issubclass(value, errors.MdfError) and value.__module__ == errors.__name__
    ]


def test_error_codes_are_the_constants_of_the_interface() -> None:
    text = (ROOT / "ros_ws/src/mdf_interfaces/msg/ErrorCode.msg").read_text()
    constants = {name: int(code) for name, code in re.findall(r"^uint16 (\w+)=(\d+)", text, flags=re.MULTILINE)}
    ours = {cls.name: cls.code for cls in error_classes()}
    assert len(ours) == len(error_classes()), "two classes share a name"
    assert {"NONE": 0, **ours} == constants


def test_built_interfaces_have_the_constants_of_their_source() -> None:
    message = pytest.importorskip("mdf_interfaces.msg").ErrorCode
    for cls in error_classes():
        assert getattr(message, cls.name) == cls.code


def test_built_interfaces_are_those_of_the_source() -> None:
    share = Path(sys.prefix, "share/mdf_interfaces")
    if not share.is_dir():
        pytest.skip("the interfaces are installed elsewhere")
    for folder in ("msg", "srv", "action"):
        for source in (ROOT / "ros_ws/src/mdf_interfaces" / folder).iterdir():
            assert (share / folder / source.name).read_text() == source.read_text(), "run make setup"
