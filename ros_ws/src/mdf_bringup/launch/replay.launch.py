"""A recorded bag played into a cell, which stays up when the bag has ended, but not if it could not be played."""

import time

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

# Handed on to the cell; what they mean is told there too.
CELL_ARGUMENTS = {
    "namespace": ("", "Namespace of the cell"),
    "design_path": ("", "Design file of the recorded part: STL, PLY, OBJ or 3MF"),
    "design_unit": ("", "Unit of the design file: mm, cm, m or inch"),
    "output_folder": ("", "Folder for redesigned meshes, one folder in it per job"),
    "is_simulated": ("true", "Results say that they come from a replay"),
    "rviz": ("false", "true: show the results in RViz"),
}


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("mdf_bringup")
    handed_on = {name: LaunchConfiguration(name) for name in (*CELL_ARGUMENTS, "parameters_file", "state_folder")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag_path", description="Folder of the bag, or one MCAP file"),
            DeclareLaunchArgument(
                "points_topic", default_value="/points", description="The bag's scans, which become the cell's points"
            ),
            # A topic that nobody subscribes to would keep the player waiting.
            DeclareLaunchArgument(
                "topics", default_value=LaunchConfiguration("points_topic"), description="Topics to play, with spaces"
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="Times as fast as recorded"),
            DeclareLaunchArgument(
                "parameters_file",
                default_value=PathJoinSubstitution([share, "config", "cell.yaml"]),
                description="YAML file with the nodes' parameters",
            ),
            # Neither the cell's nor the last replay's: what one leaves must not be answered as if it came from the
            # scanner, or from another bag.
            DeclareLaunchArgument(
                "state_folder",
                default_value=f"mdf_output/replay_state/{time.time_ns()}",
                description="Folder of the replay's own journal; by default a new one",
            ),
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in CELL_ARGUMENTS.items()
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "cell.launch.py"])),
                launch_arguments=handed_on.items(),
            ),
            OpaqueFunction(function=_player),
        ]
    )


def _player(context: LaunchContext) -> list[Node]:
    topics = LaunchConfiguration("topics").perform(context).split()
    points_topic = "/" + LaunchConfiguration("points_topic").perform(context).lstrip("/")  # not in the namespace
    return [
        Node(
            package="mdf_nodes",
            executable="bag_player",
            namespace=LaunchConfiguration("namespace"),
            arguments=[
                LaunchConfiguration("bag_path"),
                "--rate",
                LaunchConfiguration("rate"),
                "--topics",
                *topics,
            ],
            remappings=[(points_topic, "points")],
            output="screen",
            on_exit=_ended,
        )
    ]


def _ended(event: ProcessExited, context: LaunchContext) -> None:
    # An exception ends the launch, with an exit status that tells of it; Shutdown would leave 0.
    if event.returncode != 0 and not context.is_shutdown:
        raise RuntimeError(f"the bag was not played to its end: bag_player has ended with {event.returncode}")
