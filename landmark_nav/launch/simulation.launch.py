"""
The simulated robot with everything that learns and localizes.

``ros2 launch landmark_nav simulation.launch.py robot_file:=robot.yaml``, and
``room_file:=room.yaml`` for that room instead of one that a seed draws.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return the simulator beside what bringup.launch.py starts."""
    share = Path(get_package_share_directory('landmark_nav'))
    arguments = [
        DeclareLaunchArgument(
            'params_file',
            default_value=str(share / 'config' / 'landmark_nav.yaml'),
            description='parameters of all nodes',
        ),
        DeclareLaunchArgument('seed', default_value='1', description='draws the room'),
        DeclareLaunchArgument('robot_file', description='robot.yaml: where the camera sits'),
        DeclareLaunchArgument(
            'room_file',
            default_value='',
            description='room.yaml: walls and reference area; empty: drawn, and not given',
        ),
        DeclareLaunchArgument('map_folder', default_value='map', description='folder of the map'),
        DeclareLaunchArgument(
            'load_on_start', default_value='false', description='load that map at once'
        ),
        DeclareLaunchArgument('namespace', default_value='', description='of all nodes'),
        DeclareLaunchArgument(
            'use_sim_time',
            default_value='false',
            description='take the time from /clock, which the simulator does not publish',
        ),
        DeclareLaunchArgument(
            'rviz', default_value='false', description='show all of it in RViz (package rviz2)'
        ),
        DeclareLaunchArgument(
            'autostart', default_value='true', description='false: a lifecycle manager starts them'
        ),
        DeclareLaunchArgument(
            'composed', default_value='false', description='all nodes in one process'
        ),
    ]
    # launch refuses an include that does not hand on what has no default.
    bringup = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'bringup.launch.py')),
        launch_arguments={
            argument.name: LaunchConfiguration(argument.name)
            for argument in arguments
            if argument.name != 'seed'
        }.items(),
    )
    types = {'seed': int, 'robot_file': str, 'room_file': str}
    simulator = Node(
        package='landmark_nav',
        executable='room_simulator',
        name='room_simulator',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            LaunchConfiguration('params_file'),
            {
                key: ParameterValue(LaunchConfiguration(key), value_type=kind)
                for key, kind in types.items()
            },
        ],
    )
    return LaunchDescription([*arguments, bringup, simulator])
