"""
Launch file of all nodes that learn and localize, for a robot that publishes its sensor data.

``ros2 launch landmark_nav bringup.launch.py robot_file:=robot.yaml``, with
``room_file:=room.yaml`` if the room is measured.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# Node -> launch arguments that are its parameters.
NODES = {
    'sweep_capture': ('robot_file',),
    'panorama_synthesizer': ('robot_file', 'room_file'),
    'landmark_learner': ('robot_file', 'room_file', 'map_folder', 'load_on_start'),
    'triplet_selector': ('robot_file',),
    'triangulation_localizer': ('robot_file',),
    'odometry_fusion': ('robot_file',),
}


def generate_launch_description() -> LaunchDescription:
    """Return the nodes with their parameter file and the parameters of launch arguments."""
    share = Path(get_package_share_directory('landmark_nav'))
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, default, text in (
            (
                'params_file',
                str(share / 'config' / 'landmark_nav.yaml'),
                'parameters of all nodes',
            ),
            ('robot_file', None, 'robot.yaml: where the camera sits'),
            ('room_file', '', 'room.yaml: walls and reference area; empty: they are found'),
            ('map_folder', 'map', 'folder of the map'),
            ('load_on_start', 'false', 'load that map at once'),
            ('namespace', '', 'of all nodes'),
            ('use_sim_time', 'false', 'take the time from /clock'),
            ('rviz', 'false', 'show all of it in RViz (package rviz2)'),
            ('autostart', 'true', 'false: a lifecycle manager starts them'),
            ('composed', 'false', 'all nodes in one process'),
        )
    ]
    composed = LaunchConfiguration('composed')
    types = {'load_on_start': bool, 'use_sim_time': bool, 'autostart': bool}
    common = ('use_sim_time', 'autostart')

    def given(*names: str) -> dict[str, ParameterValue]:
        return {
            name: ParameterValue(LaunchConfiguration(name), value_type=types.get(name, str))
            for name in (*names, *common)
        }

    nodes = [
        Node(
            package='landmark_nav',
            executable=name,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            parameters=[LaunchConfiguration('params_file'), given(*taken)],
            condition=UnlessCondition(composed),
        )
        for name, taken in NODES.items()
    ]
    together = Node(
        package='landmark_nav',
        executable='all_nodes',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            LaunchConfiguration('params_file'),
            given(*sorted({name for taken in NODES.values() for name in taken})),
        ],
        condition=IfCondition(composed),
    )
    # The topics of the layout are relative: RViz resolves them in its namespace.
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', str(share / 'rviz' / 'landmark_nav.rviz')],
        parameters=[
            {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
        ],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    return LaunchDescription([*arguments, *nodes, together, rviz])
