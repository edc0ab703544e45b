"""Two cells on one machine, each in a namespace of its own; what one publishes the other does not get."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare
from rclpy.validate_namespace import validate_namespace

CELLS = ("cell1", "cell2")

# Handed on to each cell under its own name, such as cell1_design_path.
CELL_ARGUMENTS = {
    "namespace": "Namespace of the cell",
    "design_path": "Design file of the cell's part: STL, PLY, OBJ or 3MF",
    "design_unit": "Unit of the design file: mm, cm, m or inch",
    "watch_folder": "Folder whose new scan files the cell inspects",
    "scan_unit": "Unit of scan files: mm, cm, m or inch",
    "output_folder": "Folder for redesigned meshes and the cell's journal",
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(argument for cell in CELLS for argument in _arguments(cell)),
            # Before the cells: launch would give up at the second one, and leave the first one behind.
            OpaqueFunction(function=_require_namespaces),
            *map(_cell, CELLS),
        ]
    )


def _arguments(cell: str) -> list[DeclareLaunchArgument]:
    defaults = {"namespace": cell, "output_folder": f"mdf_output/{cell}"}
    return [
        DeclareLaunchArgument(f"{cell}_{name}", default_value=defaults.get(name, ""), description=text)
        for name, text in CELL_ARGUMENTS.items()
    ]


def _require_namespaces(context: LaunchContext) -> None:
    """Each cell has one, and they differ."""
    names = [f"{cell}_namespace" for cell in CELLS]
    given = [LaunchConfiguration(name).perform(context).strip("/") for name in names]
    for name, namespace in zip(names, given, strict=True):
        validate_namespace(f"/{namespace}")
        if not namespace:
            raise RuntimeError(f"{name} is empty; give the cell a namespace of its own")
    if len(set(given)) < len(given):
        raise RuntimeError(f"{' and '.join(names)} are both {given[0]}; give each cell one of its own")


def _cell(cell: str) -> GroupAction:
    launch_file = PathJoinSubstitution([FindPackageShare("mdf_bringup"), "launch", "cell.launch.py"])
    handed_on = {name: LaunchConfiguration(f"{cell}_{name}") for name in CELL_ARGUMENTS}
    # A group of its own: arguments of an included file would reach the next one.
    return GroupAction(
        [IncludeLaunchDescription(PythonLaunchDescriptionSource(launch_file), launch_arguments=handed_on.items())]
    )
