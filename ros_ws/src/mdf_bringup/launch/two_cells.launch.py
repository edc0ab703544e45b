"""Two cells on one machine, each in a namespace of its own; what one publishes the other does not get."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

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
    return LaunchDescription([action for cell in CELLS for action in _cell(cell)])


def _cell(cell: str) -> list[DeclareLaunchArgument | GroupAction]:
    launch_file = PathJoinSubstitution([FindPackageShare("mdf_bringup"), "launch", "cell.launch.py"])
    handed_on = {name: LaunchConfiguration(f"{cell}_{name}") for name in CELL_ARGUMENTS}
    defaults = {"namespace": cell, "output_folder": f"mdf_output/{cell}"}
    return [
        *(
            DeclareLaunchArgument(f"{cell}_{name}", default_value=defaults.get(name, ""), description=text)
            for name, text in CELL_ARGUMENTS.items()
        ),
        # A group of its own: arguments of an included file would reach the next one.
        GroupAction(
            [IncludeLaunchDescription(PythonLaunchDescriptionSource(launch_file), launch_arguments=handed_on.items())]
        ),
    ]
