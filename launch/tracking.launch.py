"""Calibration, detection and tracking; with recording:=FILE the replay as well.

ros2 launch mag_tracking tracking.launch.py network:=/path/to/network.yaml
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """The nodes with their arguments."""
    network = LaunchConfiguration('network')
    target = LaunchConfiguration('target')
    recording = LaunchConfiguration('recording')
    has_recording = PythonExpression(["'", recording, "' != ''"])
    common = [{'network': network, 'target': target,
               'reliable_input': ParameterValue(has_recording, value_type=bool)},
              LaunchConfiguration('params')]
    return LaunchDescription([
        DeclareLaunchArgument('network', description='path of a network.yaml'),
        DeclareLaunchArgument('target', default_value='vehicle', description='vehicle or magnet'),
        DeclareLaunchArgument(
            'params', description='parameter file',
            default_value=PathJoinSubstitution(
                [FindPackageShare('mag_tracking'), 'config', 'empty.yaml'])),
        DeclareLaunchArgument('recording', default_value='', description='replay this as well'),
        DeclareLaunchArgument('rate', default_value='1.0', description='speed of the replay'),
        Node(package='mag_tracking', executable='calibration_node', parameters=common),
        Node(package='mag_tracking', executable='detection_node', parameters=common),
        Node(package='mag_tracking', executable='tracker_node', parameters=common),
        Node(package='mag_tracking', executable='replay_node', condition=IfCondition(has_recording),
             parameters=[{'recording': recording,
                          'rate': ParameterValue(LaunchConfiguration('rate'),
                                                 value_type=float)}]),
    ])
