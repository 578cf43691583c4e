"""Launch calibration, detection and tracking, optionally with drivers or a replay as input.

ros2 launch mag_tracking tracking.launch.py network:=/path/to/network.yaml [drivers:=FILE]
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def config(name):
    """Path of a file in the installed folder config/.

    Parameters
    ----------
    name : str

    Returns
    -------
    PathJoinSubstitution
    """
    return PathJoinSubstitution([FindPackageShare('mag_tracking'), 'config', name])


def launch_arguments():
    """Declare the arguments of the launch file.

    Returns
    -------
    list of DeclareLaunchArgument
    """
    return [
        DeclareLaunchArgument('network', description='Path of the network file.'),
        DeclareLaunchArgument('namespace', default_value='', description='Namespace of all nodes.'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='Use the time on /clock, for a replay.'),
        DeclareLaunchArgument('target', default_value='vehicle',
                              description='Kind of target: vehicle or magnet.'),
        DeclareLaunchArgument('params', default_value=config('empty.yaml'),
                              description='Parameter file of the nodes.'),
        DeclareLaunchArgument('drivers', default_value='',
                              description='Path of a drivers file. If set, driver_node is '
                              'started.'),
        DeclareLaunchArgument('batches', default_value='false',
                              description='Publish the readings of many sensors in one '
                              'message.'),
        DeclareLaunchArgument('recording', default_value='',
                              description='Path of a recording. If set, replay_node is '
                              'started.'),
        DeclareLaunchArgument('rate', default_value='1.0',
                              description='Playback rate relative to the recorded rate.'),
    ]


def generate_launch_description():
    """Describe the nodes and their launch arguments.

    Returns
    -------
    LaunchDescription
    """
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
        *launch_arguments(),
        *(Node(package='mag_tracking', executable=name, namespace=namespace, parameters=common)
          for name in ('calibration_node', 'detection_node', 'tracker_node')),
        # Sources are started last, so that their first messages have subscribers.
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
