"""
The simulated robot with everything that learns and localizes.

``ros2 launch landmark_nav simulation.launch.py robot_file:=robot.yaml room_file:=room.yaml``
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
    types = {'seed': int, 'robot_file': str, 'room_file': str}
    simulator = Node(
        package='landmark_nav',
        executable='room_simulator',
        name='room_simulator',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            str(share / 'config' / 'room_simulator.yaml'),
            {
                key: ParameterValue(LaunchConfiguration(key), value_type=kind)
                for key, kind in types.items()
            },
        ],
    )
    bringup = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'bringup.launch.py'))
    )
    seed = DeclareLaunchArgument('seed', default_value='1', description='draws the room')
    return LaunchDescription([seed, bringup, simulator])
