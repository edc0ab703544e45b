"""The print cell: scan ingest, registration and compensation, each in a process of its own."""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.conditions import IfCondition
from launch.events.process import ProcessExited
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
    "output_folder": "Folder for redesigned meshes, one folder in it per job",
    "state_folder": "Folder of the journal of accepted scans; empty: what the parameters file says, or"
    " state in the output folder, if that is given and the file is the default one",
    "regions_path": "YAML file of regions that must not move or have tolerances of their own",
    "publish_redesign": "checked: a redesign's path is published once it has passed its checks; released: once it is"
    " released",
    "is_simulated": "true: results say that they come from a replay or a simulation",
}
SWITCHES = ("is_simulated",)
BAD_INPUT = 2  # exit status of a node
RESPAWN_SECONDS = 2.0


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("mdf_bringup")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace", default_value="", description="Namespace; two cells on one network need different ones"
            ),
            DeclareLaunchArgument(
                "parameters_file",
                default_value=_parameters_file(),
                description="YAML file with the nodes' parameters",
            ),
            DeclareLaunchArgument(
                "log_level", default_value="info", description="Log level of the nodes: debug, info, warn or error"
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="true: show the results in RViz"),
            *(DeclareLaunchArgument(name, default_value="", description=text) for name, text in PARAMETERS.items()),
            # Before the nodes: where RViz is not installed launch gives up, and would leave behind what has started.
            Node(
                condition=IfCondition(LaunchConfiguration("rviz")),
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", PathJoinSubstitution([share, "rviz", "cell.rviz"])],
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _parameters_file() -> PathJoinSubstitution:
    return PathJoinSubstitution([FindPackageShare("mdf_bringup"), "config", "cell.yaml"])


def _nodes(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    parameters_file = LaunchConfiguration("parameters_file").perform(context)
    if not Path(parameters_file).is_file():  # launch would only warn, and the nodes run without tolerance and journal
        raise RuntimeError(f"parameters_file {parameters_file}: is no file; correct the path")
    own_file = parameters_file != _parameters_file().perform(context)
    if given["output_folder"] and not given["state_folder"] and not own_file:
        given["state_folder"] = f"{given['output_folder']}/state"
    # The type is told: a folder named 2024 is no number. Of a switch launch takes no text but a substitution.
    overrides = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool)
        if name in SWITCHES
        else ParameterValue(value, value_type=str)
        for name, value in given.items()
        if value
    }
    return [
        Node(
            package="mdf_nodes",
            executable=executable,
            name=executable,  # so that the arguments win over what a parameters file says of this node
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("parameters_file"), *([overrides] if overrides else [])],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=True,
            respawn_delay=RESPAWN_SECONDS,
            on_exit=_end_if_refused,
        )
        for executable in NODES
    ]


def _end_if_refused(event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """A node that crashed is started again; one that refused its parameters would refuse them again."""
    return [Shutdown(reason=f"{event.process_name} refused its parameters")] if event.returncode == BAD_INPUT else []
