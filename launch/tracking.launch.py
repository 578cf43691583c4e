"""Calibration, detection and tracking; with drivers:=FILE or recording:=FILE what feeds them.

ros2 launch mag_tracking tracking.launch.py network:=/path/to/network.yaml
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def config(name):
    """Path of a file of config/."""
    return PathJoinSubstitution([FindPackageShare('mag_tracking'), 'config', name])


def generate_launch_description():
    """The nodes with their arguments."""
    network = LaunchConfiguration('network')
    target = LaunchConfiguration('target')
    recording = LaunchConfiguration('recording')
    drivers = LaunchConfiguration('drivers')
    namespace = LaunchConfiguration('namespace')
    has_recording = NotEqualsSubstitution(recording, '')
    has_drivers = NotEqualsSubstitution(drivers, '')
    sim_time = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'),
                                               value_type=bool)}
    common = [{'network': network, 'target': target, **sim_time,
               'reliable_input': ParameterValue(has_recording, value_type=bool)},
              LaunchConfiguration('params')]
    return LaunchDescription([
        DeclareLaunchArgument('network', description='path of a network.yaml'),
        DeclareLaunchArgument('namespace', default_value='', description='of all nodes'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='take the time from /clock'),
        DeclareLaunchArgument('target', default_value='vehicle', description='vehicle or magnet'),
        DeclareLaunchArgument(
            'params', description='parameter file', default_value=config('empty.yaml')),
        DeclareLaunchArgument('drivers', default_value='', description='drivers file'),
        DeclareLaunchArgument('batches', default_value='false',
                              description='readings of many sensors go in one message'),
        DeclareLaunchArgument('recording', default_value='', description='replay this as well'),
        DeclareLaunchArgument('rate', default_value='1.0', description='speed of the replay'),
        *(Node(package='mag_tracking', executable=name, namespace=namespace, parameters=common)
          for name in ('calibration_node', 'detection_node', 'tracker_node')),
        # The last, when there is somebody to hear it.
        Node(package='mag_tracking', executable='driver_node', namespace=namespace,
             condition=IfCondition(has_drivers),
             parameters=[{'drivers': drivers, 'network': network,
                          'batches': ParameterValue(LaunchConfiguration('batches'),
                                                    value_type=bool)}]),
        Node(package='mag_tracking', executable='replay_node', namespace=namespace,
             condition=IfCondition(has_recording),
             parameters=[{'recording': recording,
                          'rate': ParameterValue(LaunchConfiguration('rate'),
                                                 value_type=float)}]),
    ])
