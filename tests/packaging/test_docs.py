"""What README, docs and the launch package say is so."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from mdf_core import errors
from mdf_core.distortion import distortion_left
from mdf_core.geometry import Design
from mdf_core.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "nodes"))

README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BRINGUP = ROOT / "ros_ws" / "src" / "mdf_bringup"
COMMANDS = re.findall(r'^ *"(\w+) = mdf_', (ROOT / "setup.py").read_text(), flags=re.MULTILINE)
MANAGED_NODES = ("scan_ingest", "registration", "compensation")


def clean_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}


# Modules that declare parameters of several nodes, and which.
SHARED = {
    "managed_node": ("all three",),
    "cell_design": ("registration, compensation",),
    "journal": ("all three",),
    "parameters": ("scan_ingest, compensation", "registration, compensation"),
}


def declared_by(module: str) -> dict[str, Any]:
    """Parameters that a module declares in so many words, and their defaults (None: not a literal)."""
    return {
        node.args[1].value: getattr(node.args[2], "value", None)
        for node in ast.walk(ast.parse((ROOT / f"mdf_nodes/{module}.py").read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") in ("declare", "declare_choice")
        and len(node.args) > 2
        and isinstance(node.args[1], ast.Constant)
    }


def node_parameters() -> set[str]:
    """Every parameter of the managed nodes."""
    own = set().union(*(declared_by(module) for module in (*MANAGED_NODES, *SHARED)))
    return own | set(Settings().flat())


# Pages written from the code, or beside it


def test_the_settings_page_is_up_to_date() -> None:
    specification = importlib.util.spec_from_file_location("make_settings", ROOT / "docs/make_settings.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    assert (ROOT / "docs/settings.md").read_text() == module.page(), "run python docs/make_settings.py"


def test_the_errors_page_lists_every_error_with_its_code_and_meaning() -> None:
    told = re.findall(r"^\| (\d+) \| (\w+) \| (.*?) \|", (ROOT / "docs/errors.md").read_text(), flags=re.MULTILINE)
    classes = [value for value in vars(errors).values() if isinstance(value, type) and value is not errors.MdfError]
    raised = [(str(each.code), each.name, each.__doc__) for each in classes if issubclass(each, errors.MdfError)]
    assert told[2:] == raised
    assert [name for _, name, _ in told[:2]] == ["NONE", errors.MdfError.name]


def test_the_nodes_page_lists_every_parameter_with_its_default() -> None:
    text = (ROOT / "docs/ros.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| [^|]*\|$", text, flags=re.MULTILINE)
    for module in (*MANAGED_NODES, *SHARED):
        for name, default in declared_by(module).items():
            matching = [(value, nodes) for told, value, nodes in rows if told == name]
            assert len(matching) == 1, name
            value, nodes = matching[0]
            assert module in nodes or nodes in SHARED[module], name
            if default is not None:
                assert value == (str(default).lower() if isinstance(default, bool) else str(default) or "empty"), name


def test_the_nodes_page_lists_every_parameter_of_the_virtual_scanner() -> None:
    row = next(
        line for line in (ROOT / "docs/ros.md").read_text().splitlines() if line.startswith("| `virtual_scanner`")
    )
    assert re.findall(r"`(\w+)`", row.partition("parameters")[2]) == list(declared_by("virtual_scanner"))


def names_in_the_graph() -> set[str]:
    """The cell's own topics, services and actions: those of the policy, which a test compares with running nodes."""
    policy = ElementTree.parse(BRINGUP / "security/policy.xml")
    names = {entry.text or "" for kind in ("topic", "service", "action") for entry in policy.iter(kind)}
    return {name for name in names if "/" not in name}  # those of every ROS node lie deeper


@pytest.mark.parametrize("page", ["README.md", "docs/ros.md"])
def test_every_topic_service_and_action_is_named(page: str) -> None:
    text, names = (ROOT / page).read_text(), names_in_the_graph()
    assert {"points", "redesign_marker", "roll_back", "register_scan"} <= names
    assert {name for name in names if f"`{name}`" not in text} == set()


def test_the_bags_page_lists_every_recorded_case() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \| .* \| ([\d.]+) mm \| (.*) \|$", (ROOT / "docs/bags.md").read_text(), re.MULTILINE
    )
    cases = {file.parent.name: json.loads(file.read_text()) for file in ROOT.glob("bags/*/expected.json")}
    assert {name for name, _, _ in rows} == cases.keys()
    for name, largest, scan in rows:
        assert float(largest) == cases[name]["printer"]["amplitude_mm"]
        assert f"{cases[name]['scanner']['points']:,} points".replace(",", " ") in scan


# Commands


# Whose options the pages name by themselves.
ALONE = (
    *(("mdf", name) for name in ("inspect", "compensate", "replay", "demo")),
    *((name,) for name in ("cell", "cell_demo", "bag_player", "bag_recorder")),
)
# Each as if it was started by itself; what all of them import is imported once.
ALL_HELP = """
import io, json, runpy, sys
from contextlib import redirect_stdout

told = []
for module, words in json.load(sys.stdin):
    sys.argv, status = [module, *words, "--help"], None
    with redirect_stdout(io.StringIO()) as text:
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            status = end.code
    told.append((status, text.getvalue()))
print(json.dumps(told))
"""


@cache
def all_help() -> dict[tuple[str, ...], tuple[int | None, str]]:
    """Exit status and words of every command in the pages when it is asked for help."""
    commands = sorted({command_of(program, words) for _, (program, *words) in command_lines()} | set(ALONE))
    modules = {"mdf": "mdf_core", "cell_demo": "mdf_nodes.demo"}
    asked = [(modules.get(program, f"mdf_nodes.{program}"), words) for program, *words in commands]
    outcome = subprocess.run(
        [sys.executable, "-c", ALL_HELP],
        input=json.dumps(asked),
        env=clean_environment(),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert outcome.returncode == 0, outcome.stderr
    return dict(zip(commands, map(tuple, json.loads(outcome.stdout)), strict=True))


def help_of(*command: str) -> str:
    """What a command says of its use; a command that has no --help fails."""
    status, text = all_help()[command]
    assert status == 0, f"{command}: {text}"
    return text


def command_of(program: str, words: Sequence[str]) -> tuple[str, ...]:
    """The program, and for mdf the commands below it, without options."""
    steps = 2 if words[0] == "ledger" else 1
    return (program, *words[:steps]) if program == "mdf" and not words[0].startswith("-") else (program,)


def command_lines() -> Iterator[tuple[str, list[str]]]:
    """Page and words of every command of ours in code blocks and code spans."""
    for page in PAGES:
        text = page.read_text()
        blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
        blocks += re.findall(
            r"(?:^    .*\n)+", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE
        )
        spans = re.findall(r"`([^`\n]+)`", text)
        lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
        for line in [*lines, *spans]:
            words = line.split("  #")[0].split()
            if words and words[0].removeprefix(".venv/bin/") in COMMANDS and len(words) > 1:
                yield page.name, [words[0].removeprefix(".venv/bin/"), *words[1:]]


def test_every_option_of_a_command_exists() -> None:
    checked = set()
    for page, (program, *words) in command_lines():
        words = words[: words.index("--ros-args")] if "--ros-args" in words else words
        command = command_of(program, words)
        for option in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert option in re.findall(r"--[\w-]+", help_of(*command)), f"{page}: {' '.join(command)} {option}"
            checked.add((program, option))
    assert {("cell", "--watch-folder"), ("mdf", "--set"), ("bag_recorder", "--topics")} <= checked


def test_every_option_that_is_named_alone_exists() -> None:
    known = {option for command in ALONE for option in re.findall(r"--[\w-]+", help_of(*command))}
    for page in PAGES:
        for option in re.findall(r"`(--[a-z-]+)", page.read_text()):
            assert option in known | {"--ros-args"}, f"{page.name}: {option}"


def test_every_make_target_and_program_exists() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    for page in PAGES:
        text = page.read_text()
        for target in re.findall(r"(?:^|`)\s*make ([a-z]+)", text, flags=re.MULTILINE):
            assert target in targets, f"{page.name}: make {target}"
        for program in re.findall(r"\.venv/bin/([\w.-]+)", text):
            assert program in COMMANDS or program in ("python", "pip"), f"{page.name}: {program}"


def test_the_readme_names_every_command() -> None:
    for command in COMMANDS:
        assert re.search(rf"(`|bin/){command}\b", README), command


def test_every_setting_that_is_named_exists() -> None:
    known = set(Settings().flat())
    branches = "|".join(sorted({name.partition(".")[0] for name in known if "." in name}))
    for page in PAGES:
        # design.stl is a file.
        named = set(re.findall(rf"\b((?:{branches})\.(?!stl\b)[a-z_]+)\b", page.read_text()))
        assert named <= known, f"{page.name}: {named - known}"


# Links and snippets


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        if "://" in path:
            continue
        file = page.parent / path if path else page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), flags=re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings], target


def python_blocks(text: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def test_the_readme_shows_the_example_as_it_is() -> None:
    assert (ROOT / "docs/examples/register_client.py").read_text() in python_blocks(README)


def largest_distortion(design: Design) -> float:
    """Of the part that the scans of `samples` show, bent by 0.5 mm, in mm."""
    bent = design.vertices.copy()
    bent[:, 2] += 0.5 * (bent[:, 0] / 60.0) ** 2
    return distortion_left(design, bent)[1]


def test_the_library_example_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = pytest.importorskip("samples")
    design = samples.write_design(tmp_path)
    (tmp_path / "design.stl").rename(tmp_path / "part.stl")
    scan = samples.scan_of(design)
    np.save(tmp_path / "scan.npy", np.hstack([scan.points, scan.normals]))
    (example,) = (block for block in python_blocks(README) if "mdf.inspect" in block)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example.replace("scan.ply", "scan.npy"), names)
    assert names["inspection"].max_displacement == pytest.approx(largest_distortion(design), rel=0.2)
    assert (tmp_path / "redesigned.stl").stat().st_size > 0


def test_the_client_of_the_readme_talks_to_a_running_registration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    from helpers import CellProcess, reserved_domain
    from samples import QUICK, parameters, scan_of, write_design

    design = write_design(tmp_path)
    scan = scan_of(design)
    np.savetxt(tmp_path / "scan.xyz", np.hstack([scan.points, scan.normals]))
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        node = CellProcess("registration", ("--ros-args", *parameters(design_path=design.path), *QUICK), tmp_path)
        try:
            outcome = subprocess.run(
                [sys.executable, ROOT / "docs/examples/register_client.py", tmp_path / "scan.xyz"],
                env=clean_environment(),
                capture_output=True,
                text=True,
                timeout=100,
            )
        finally:
            node.close()
    assert outcome.returncode == 0, outcome.stderr + node.output
    (largest,) = re.findall(r"largest displacement ([\d.]+) mm", outcome.stdout)
    assert float(largest) == pytest.approx(largest_distortion(design), rel=0.2)
    assert f"of {len(design.vertices)} vertices measured" in outcome.stdout


# What must not be in there


def test_no_page_names_a_machine_path_or_a_registry() -> None:
    files = [*PAGES, ROOT / "CHANGELOG.rst", *(ROOT / "docs/examples").glob("*.py")]
    files += [path for path in BRINGUP.rglob("*") if path.suffix in (".json", ".py", ".rviz", ".txt", ".xml", ".yaml")]
    for file in files:
        text = file.read_text()
        assert not re.search(r"(?<![\w.])/(?:home|root|work|Users)/", text), file
        assert not re.search(r"pypi\.|index-url|://[\w.]*packages", text), file


# The launch package


def flat(tree: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def assigned(file: Path, name: str) -> Any:
    """The literal assigned to `name` in a Python file."""
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name:
            return ast.literal_eval(node.value)
    raise AssertionError(f"{file.name} assigns no {name}")


def test_every_parameter_of_the_launch_package_exists() -> None:
    values = yaml.safe_load((BRINGUP / "config/cell.yaml").read_text())["/**"]["ros__parameters"]
    assert set(flat(values)) <= node_parameters()
    assert set(assigned(BRINGUP / "launch/cell.launch.py", "PARAMETERS")) <= node_parameters()


def test_the_parameters_file_holds_the_defaults() -> None:
    values = yaml.safe_load((BRINGUP / "config/cell.yaml").read_text())["/**"]["ros__parameters"]
    # A cell keeps a journal; a node by itself does not know where.
    defaults = Settings().flat() | {"autostart": True, "state_folder": "mdf_output/state", "disk_floor_mib": 200}

    def given(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
        for name, value in tree.items():
            if isinstance(value, dict):
                yield from given(value, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}", value

    assert all(defaults[name] == value for name, value in given(values))


def test_the_launch_files_start_the_nodes_that_exist_with_declared_arguments() -> None:
    cell = BRINGUP / "launch/cell.launch.py"
    assert set(assigned(cell, "NODES")) == set(MANAGED_NODES) <= set(COMMANDS)
    for file in BRINGUP.glob("launch/*.py"):
        text = file.read_text()
        used = set(re.findall(r'LaunchConfiguration\(\s*"(\w+)"', text))
        table = assigned(file, "PARAMETERS" if file == cell else "CELL_ARGUMENTS")
        declared = set(re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', text)) | set(table)
        assert used <= declared, file.name
    cell_text = cell.read_text()
    handed_on = set(assigned(BRINGUP / "launch/replay.launch.py", "CELL_ARGUMENTS"))
    known = set(assigned(cell, "PARAMETERS")) | set(re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', cell_text))
    assert handed_on <= known


def test_the_launch_arguments_of_the_docs_exist() -> None:
    for page in PAGES:
        for line in re.findall(r"ros2 launch mdf_bringup ([^`\n]*)", page.read_text().replace("\\\n", " ")):
            file, *arguments = shlex.split(line)
            text = (BRINGUP / "launch" / file).read_text()
            for name in (argument.partition(":=")[0] for argument in arguments if ":=" in argument):
                assert f'"{name}"' in text, f"{page.name}: {file} {name}"


def test_the_views_show_topics_of_the_cell() -> None:
    nodes_page = (ROOT / "docs/ros.md").read_text()
    published = set(re.findall(r"^\| `/?(\w+)` \| \w+/\w+ \|", nodes_page, flags=re.MULTILINE))
    view = yaml.safe_load((BRINGUP / "rviz/cell.rviz").read_text())["Visualization Manager"]
    shown = {display["Topic"]["Value"] for display in view["Displays"] if "Topic" in display}
    assert shown == {"displacement", "scan", "deviation", "redesign_marker"} <= published
    layout = json.loads((BRINGUP / "foxglove/cell.json").read_text())["configById"]
    topics = [*layout["3D!cell"]["topics"]]
    topics += [panel[key] for panel in layout.values() for key in ("topicPath", "topicToRender") if key in panel]
    assert {topic.removeprefix("/") for topic in topics} <= published


def test_the_launch_package_installs_its_folders() -> None:
    installed = re.search(r"install\(DIRECTORY ([\w ]+) DESTINATION", (BRINGUP / "CMakeLists.txt").read_text())
    assert installed and set(installed[1].split()) == {path.name for path in BRINGUP.iterdir() if path.is_dir()}
