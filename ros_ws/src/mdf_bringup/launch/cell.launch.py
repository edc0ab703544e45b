"""The print cell: scan ingest, registration and compensation, each in a process of its own."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

NODES = ("scan_ingest", "registration", "compensation")

# Arguments that become parameters; left empty, the parameters file or the node's default holds.
PARAMETERS = {
    "design_path": "Design file: STL, PLY, OBJ or 3MF; without one the cell waits for the service set_design",
    "design_unit": "Unit of the design file: mm, cm, m or inch",
    "scan_unit": "Unit of scan files: mm, cm, m or inch",
    "watch_folder": "Folder whose new scan files are inspected",
    "output_folder": "Folder for redesigned meshes and reports",
}


def generate_launch_description() -> LaunchDescription:
    parameters_file = PathJoinSubstitution([FindPackageShare("mdf_bringup"), "config", "cell.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace", default_value="", description="Namespace; two cells on one network need different ones"
            ),
            DeclareLaunchArgument(
                "parameters_file", default_value=parameters_file, description="YAML file with the nodes' parameters"
            ),
            DeclareLaunchArgument(
                "log_level", default_value="info", description="Log level of the nodes: debug, info, warn or error"
            ),
            *(DeclareLaunchArgument(name, default_value="", description=text) for name, text in PARAMETERS.items()),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    # Always text: a folder named 2024 is no number.
    overrides = {name: ParameterValue(value, value_type=str) for name, value in given.items() if value}
    return [
        # No name: launch would give it to the inner nodes of the process too.
        Node(
            package="mdf_nodes",
            executable=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("parameters_file"), *([overrides] if overrides else [])],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
        for executable in NODES
    ]
