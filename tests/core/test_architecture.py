"""The library's modules depend on each other in one direction only, and on no ROS."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import mdf_core

FOLDER = Path(mdf_core.__file__).parent
ORDER = """
    errors units settings files progress threads geometry connectivity averages rigid point_table subdivision mesh_io
    mesh_export point_cloud2 bag sampling kernel deformation check_result welded_mesh edges design_surface lone_points
    outward motion_basis normal_equations scan_size pieces support data_cells mixture em registration surface_fit
    surface facets design_motion prior_choice last_step memory pose pose_choice outliers methods interpolation regions
    inspection coarseness measurement prints estimate compensation estimate_file surface_checks self_intersections
    dimension_checks checks ledger_entries ledger_database ledger pipeline virtual_cell distortion report picture
    redesign_names printed cycles record command redesign_task compensate_command repeat_command ledger_command cli
""".split()  # noqa: SIM905
ENTRY_POINTS = {"__init__", "__main__"}
COMMANDS = {"command", "redesign_task", "compensate_command", "repeat_command", "ledger_command", "cli"}
FRONT_END = {
    "report",
    "picture",
    "printed",
    "cycles",
    "record",
} | COMMANDS  # not loaded by the package, they may use it as users do
TREES = {path.stem: ast.parse(path.read_text(encoding="utf-8"), path.name) for path in sorted(FOLDER.glob("*.py"))}
ROS = ("rclpy", "mdf_nodes", "mdf_interfaces", "ament_index_python", "rosidl_runtime_py", "rosgraph_msgs")


def imported_modules(name):
    """Dotted names of all that a module imports, wherever in its code."""
    found = set()
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}.py, line {node.lineno}: relative import"
            inner = {f"mdf_core.{alias.name}" for alias in node.names if alias.name in TREES}
            found |= inner if node.module == "mdf_core" and inner else {node.module}
    return found


def test_every_module_has_its_place_in_the_order():
    assert sorted(ORDER) == sorted(TREES.keys() - ENTRY_POINTS)


@pytest.mark.parametrize("name", ORDER)
def test_modules_import_only_those_before_them(name):
    before = set(ORDER[: ORDER.index(name)])
    own = {module for module in imported_modules(name) if module.split(".")[0] == "mdf_core"}
    allowed = {f"mdf_core.{module}" for module in before} | ({"mdf_core"} if name in FRONT_END else set())
    assert own <= allowed


def test_the_package_itself_does_not_load_its_front_end():
    assert not imported_modules("__init__") & {f"mdf_core.{module}" for module in FRONT_END}


@pytest.mark.parametrize("name", sorted(TREES))
def test_no_module_imports_ros(name):
    tops = {module.split(".")[0] for module in imported_modules(name)}
    assert not {top for top in tops if top in ROS or top.endswith("_msgs")}


def test_the_library_and_its_command_run_without_ros_loaded():
    code = "import sys, mdf_core, mdf_core.cli; print([m for m in sys.modules if m.startswith(('rclpy', 'mdf_nodes'))])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def public_definitions(tree):
    """Public functions, classes, and the public methods of public classes."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef) and not any(
                isinstance(base, ast.Name) and base.id == "Protocol" for base in node.bases
            ):
                for inner in node.body:
                    if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                        yield inner


@pytest.mark.parametrize("name", sorted(TREES))
def test_what_is_public_is_documented(name):
    assert ast.get_docstring(TREES[name])
    bare = [node.name for node in public_definitions(TREES[name]) if not ast.get_docstring(node)]
    assert bare == []


@pytest.mark.parametrize("name", sorted(set(ORDER) - COMMANDS))
def test_only_the_commands_print_and_nothing_keeps_a_log(name):
    assert "logging" not in imported_modules(name)
    calls = {node.func.id for node in ast.walk(TREES[name]) if isinstance(node, ast.Call) and hasattr(node.func, "id")}
    assert "print" not in calls
