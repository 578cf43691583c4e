"""Nodes with invalid parameters or messages report clear errors and do not crash."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import NetworkFrame
from mag_tracking_msgs.srv import Calibrate
from sensor_msgs.msg import MagneticField

from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import STREAM_QOS
from support.bundled import NETWORK_FILE
from support.node_processes import MAX_S, call, start, stop

pytestmark = pytest.mark.timeout(600)


@pytest.mark.parametrize('arguments, message', [
    ([], 'network'),
    (['-p', 'network:=/no/such/file.yaml'], 'cannot read /no/such/file.yaml'),
    (['-p', f'network:={NETWORK_FILE}', '-p', 'track.vehicle.momnet:=1.0'],
     'mean track.vehicle.moment'),
    (['-p', f'network:={NETWORK_FILE}', '-p', 'track.iterations:=70'], 'iterations'),
    (['-p', f'network:={NETWORK_FILE}', '-p', 'track.vehicle.arrival_headings_deg:=[0.0]'],
     'expected 3 values'),
    (['-p', f'network:={NETWORK_FILE}', '-p', 'target:=submarine'], 'submarine'),
])
def test_invalid_parameters_end_the_node_with_a_clear_error(arguments, message):
    process = start('tracker_node', *arguments)
    output, _ = process.communicate(timeout=MAX_S)
    assert process.returncode == 1
    assert message in output and 'Traceback' not in output


def publish_readings_and_faults(publish):
    """Publish readings that establish a background, then one message with each fault."""
    rng = np.random.default_rng(0)
    for k in range(150):
        field = np.array([2e-6, 1.5e-5, -4.9e-5]) + 1e-8 * rng.standard_normal(3)
        publish(10 * k, *field.tolist(), covariance=-1.0 if k % 2 else 0.0)
    nan = float('nan')
    publish(1600, nan, nan, nan)
    publish(1610, float('inf'))
    publish(1620, 0.02, 0.15, -0.49)
    publish(1490, 2e-6)
    publish(1495 - 100, 2e-6)
    publish(1700, 2e-6, 1.5e-5, nan)


def test_invalid_messages_are_counted(ros):
    """NaN, infinity, gauss and wrong timestamps are named in the diagnostics."""
    node, spin_until = ros
    diagnostics, calibrated = [], []
    node.create_subscription(DiagnosticArray, '/diagnostics', diagnostics.append, 10)
    node.create_subscription(MagneticField, '/mag_1/imu/mag_calibrated', calibrated.append,
                             STREAM_QOS)
    publisher = node.create_publisher(MagneticField, '/mag_1/imu/mag', STREAM_QOS)
    process = start('calibration_node', '-p', f'network:={NETWORK_FILE}',
                    '-p', 'calibrate.learn_s:=0.5', '-p', 'reliable_input:=true')

    def publish(ms, x, y=1.5e-5, z=-4.9e-5, covariance=0.0):
        publisher.publish(to_message(MagneticField, {
            'header': {'stamp': {'sec': 10 + ms // 1000, 'nanosec': ms % 1000 * 10**6},
                       'frame_id': 'mag_1'},
            'magnetic_field': {'x': x, 'y': y, 'z': z},
            'magnetic_field_covariance': [covariance] + [0.0] * 8}))
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0
                          and node.count_publishers('/mag_1/imu/mag_calibrated'))
        publish_readings_and_faults(publish)

        def values():
            return {v.key: int(v.value) for m in diagnostics for s in m.status for v in s.values
                    if 'calibrate' in s.name}
        assert spin_until(lambda: sum(k.startswith('rejected') for k in values()) >= 5), values()
        causes = ' '.join(values())
        for cause in ('all NaN', 'infinite', 'gauss', 'duplicate timestamp', 'out of order'):
            assert cause in causes
        assert calibrated and np.isnan(calibrated[-1].magnetic_field.z)
        assert calibrated[-1].header.frame_id == 'mag_1'
        service = '/calibration_node/calibrate'
        assert call(ros, Calibrate, service, Calibrate.Request(sensors=['mag_1'])).success
        refused = call(ros, Calibrate, service, Calibrate.Request(sensors=['mag_9']))
        assert not refused.success and 'mag_9' in refused.message
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_invalid_frames_are_counted(ros):
    node, spin_until = ros
    diagnostics = []
    node.create_subscription(DiagnosticArray, '/diagnostics', diagnostics.append, 10)
    publisher = node.create_publisher(NetworkFrame, '/network_frame', STREAM_QOS)
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0)
        publisher.publish(NetworkFrame(sensors=['a', 'b'], field=[0.0] * 6))
        publisher.publish(NetworkFrame(sensors=['mag_1', 'mag_2'], field=[0.0] * 5))
        good = {'sensors': ['mag_1', 'mag_2'], 'field': [0.0] * 6, 'time_offset': [0.0] * 2,
                'covariance': (1e-16 * np.eye(3)).ravel().tolist() * 2, 'n_samples': [8] * 2,
                'target_present': True}
        for bad in ({'time_offset': [float('nan'), 0.0]}, {'time_offset': [0.0, 1e9]},
                    {'field': [float('inf')] + [0.0] * 5}, {'covariance': [0.0] * 18},
                    {'covariance': (1e-16 * np.ones((3, 3))).ravel().tolist() * 2}):
            publisher.publish(NetworkFrame(**{**good, **bad}))
        publisher.publish(NetworkFrame(**good))
        assert spin_until(lambda: any(
            v.key == 'rejected: bad frame' and v.value == '7'
            for m in diagnostics for s in m.status for v in s.values))
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
