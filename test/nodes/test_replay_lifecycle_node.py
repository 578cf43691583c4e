"""Replay node as a lifecycle node, and both formats of parameter files."""

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from mag_tracking_msgs.srv import Seek
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import MagneticField

from mag_tracking.messages.schema import stamp_ns
from mag_tracking.nodes.stage_node import STREAM_QOS
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import call, start, stop, until_quiet

RECORDING = vehicle_path('straight_car_right')
PLAIN_PARAMETERS = ('detect:\n  onset_frames: 4\n'
                    'track:\n  vehicle:\n    arrival_names: [east, west, "no"]\n')
ROS_PARAMETERS = ('/**:\n  ros__parameters:\n    detect:\n      onset_frames: 4\n'
                  '    track.vehicle.arrival_names: [east, west, "no"]\n')


def test_lifecycle_transitions_start_and_stop_playback(ros):
    node, spin_until = ros
    fields = []
    node.create_subscription(MagneticField, '/mag_1/imu/mag', fields.append, STREAM_QOS)
    process = start('replay_node', '-p', 'autostart:=false', '-p', f'recording:={RECORDING}',
                    '-p', 'start_delay:=0.0')

    def change(transition):
        return call(ros, ChangeState, '/replay_node/change_state',
                    ChangeState.Request(transition=Transition(id=transition))).success

    try:
        state = call(ros, GetState, '/replay_node/get_state', GetState.Request()).current_state.id
        assert state == State.PRIMARY_STATE_UNCONFIGURED
        response = call(ros, Seek, '/replay_node/seek', Seek.Request(offset=1.0))
        assert not response.success and 'configure' in response.message
        assert change(Transition.TRANSITION_CONFIGURE)
        assert spin_until(lambda: node.count_publishers('/mag_1/imu/mag') == 1)
        assert not spin_until(lambda: fields, 0.5)
        assert change(Transition.TRANSITION_ACTIVATE)
        assert spin_until(lambda: len(fields) > 10)
        assert change(Transition.TRANSITION_DEACTIVATE)
        n = until_quiet(spin_until, fields)
        assert change(Transition.TRANSITION_ACTIVATE)
        assert spin_until(lambda: len(fields) > n)
        # Playback continues where it stopped.
        assert 0 < stamp_ns(fields[n].header.stamp) - stamp_ns(fields[n - 1].header.stamp) < 1e8
        assert change(Transition.TRANSITION_DEACTIVATE)
        assert change(Transition.TRANSITION_CLEANUP)
        assert spin_until(lambda: node.count_publishers('/mag_1/imu/mag') == 0)
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_an_unreadable_recording_leaves_the_node_unconfigured(ros, tmp_path):
    process = start('replay_node', '-p', 'autostart:=false', '-p', f'recording:={tmp_path}/no.mcap')
    try:
        response = call(ros, ChangeState, '/replay_node/change_state', ChangeState.Request(
            transition=Transition(id=Transition.TRANSITION_CONFIGURE)))
        assert not response.success
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0] and 'no.mcap' in outputs[0]


@pytest.mark.parametrize('content', [PLAIN_PARAMETERS, ROS_PARAMETERS])
def test_nodes_accept_both_formats_of_parameter_files(ros, tmp_path, content):
    path = tmp_path / 'mine.yaml'
    path.write_text(content)
    nodes = {'detection_node': 'detect.onset_frames', 'tracker_node': 'track.vehicle.arrival_names'}
    processes = [start(name, '--params-file', str(path), '-p', f'network:={NETWORK_FILE}')
                 for name in nodes]
    try:
        values = [call(ros, GetParameters, f'/{name}/get_parameters',
                       GetParameters.Request(names=[parameter])).values[0]
                  for name, parameter in nodes.items()]
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0, 0], outputs
    assert values[0].integer_value == 4
    assert list(values[1].string_array_value) == ['east', 'west', 'no']


def test_an_invalid_parameter_file_is_named(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('detect: [\n')
    process = start('detection_node', '--params-file', str(path), '-p', f'network:={NETWORK_FILE}')
    output = process.communicate(timeout=120.0)[0]
    assert process.returncode == 1 and 'mine.yaml' in output and 'Traceback' not in output
