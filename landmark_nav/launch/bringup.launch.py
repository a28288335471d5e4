"""
Launch file of all nodes that learn and localize, for a robot that publishes its sensor data.

``ros2 launch landmark_nav bringup.launch.py robot_file:=robot.yaml``, with
``room_file:=room.yaml`` if the room is measured.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(get_package_share_directory('landmark_nav'))
# Node -> launch arguments that are its parameters.
NODES = {
    'sweep_capture': ('robot_file',),
    'panorama_synthesizer': ('robot_file', 'room_file'),
    'landmark_learner': ('robot_file', 'room_file', 'map_folder', 'load_on_start'),
    'triplet_selector': ('robot_file',),
    'triangulation_localizer': ('robot_file',),
    'odometry_fusion': ('robot_file',),
}
# Argument -> its default, None if it must be given, and its description.
ARGUMENTS = {
    'params_file': (str(SHARE / 'config' / 'landmark_nav.yaml'), 'parameters of all nodes'),
    'robot_file': (None, 'robot.yaml: where the camera sits'),
    'room_file': ('', 'room.yaml: walls and reference area; empty: they are found'),
    'map_folder': ('map', 'folder of the map'),
    'load_on_start': ('false', 'load that map at once'),
    'namespace': ('', 'of all nodes'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'rviz': ('false', 'show all of it in RViz (package rviz2)'),
    'autostart': ('true', 'false: a lifecycle manager starts them'),
    'composed': ('false', 'all nodes in one process'),
}
# Types of those that are not text.
_TYPES = {'load_on_start': bool, 'use_sim_time': bool, 'autostart': bool, 'seed': int}


def declared(arguments: Mapping[str, tuple[str | None, str]]) -> list[DeclareLaunchArgument]:
    """Return the declarations of arguments."""
    return [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in arguments.items()
    ]


def node(executable: str, *names: str, **options: Any) -> Node:
    """Return a node with the parameter file, and with these arguments as parameters."""
    return Node(
        package='landmark_nav',
        executable=executable,
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[LaunchConfiguration('params_file'), values(*names)],
        **options,
    )


def values(*names: str) -> dict[str, ParameterValue]:
    """Return values of arguments as parameters."""
    return {
        name: ParameterValue(LaunchConfiguration(name), value_type=_TYPES.get(name, str))
        for name in names
    }


def generate_launch_description() -> LaunchDescription:
    """Return the nodes with their parameter file and the parameters of launch arguments."""
    composed, common = LaunchConfiguration('composed'), ('use_sim_time', 'autostart')
    apart = [
        node(name, *taken, *common, name=name, condition=UnlessCondition(composed))
        for name, taken in NODES.items()
    ]
    of_any = sorted({name for taken in NODES.values() for name in taken})
    together = node('all_nodes', *of_any, *common, condition=IfCondition(composed))
    # The topics of the layout are relative: RViz resolves them in its namespace.
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', str(SHARE / 'rviz' / 'landmark_nav.rviz')],
        parameters=[values('use_sim_time')],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    return LaunchDescription([*declared(ARGUMENTS), *apart, together, rviz])
