"""Survey over the middleware: service, latched state, file and network of the tracker."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import CalibrationState, TrackArray
from mag_tracking_msgs.srv import Survey

from mag_tracking.apps.calibrate import calibrate
from mag_tracking.network.file import read_network
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.stage_node import LATCHED_QOS, RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import call, start, stop

RECORDING_NAME = 'junction_left_turns_to_rear'


def offline(road_network):
    """Network calibrated offline, without passes."""
    return calibrate(Recording(vehicle_path(RECORDING_NAME)), road_network,
                     settings_for('vehicle'), 'now', passes=False).network


def test_a_survey_changes_the_network_of_the_next_track(ros, tmp_path, road_network):
    node, spin_until = ros
    states, tracks = [], []
    node.create_subscription(CalibrationState, '/calibration_state', states.append,
                             LATCHED_QOS)
    node.create_subscription(TrackArray, '/tracker_node/tracks', tracks.append, STREAM_QOS)
    # The result is saved next to the network file.
    saved, network_file = tmp_path / 'surveyed.yaml', tmp_path / 'network.yaml'
    network_file.write_text(NETWORK_FILE.read_text())
    network = ['-p', f'network:={network_file}', '-p', 'reliable_input:=true']
    processes = [start('calibration_node', *network, '-p', 'save_as:=surveyed.yaml'),
                 start('detection_node', *network), start('tracker_node', *network)]
    try:
        assert spin_until(lambda: node.count_publishers('/tracker_node/tracks')
                          and node.count_publishers('/mag_1/imu/mag_calibrated')
                          and node.count_subscribers('/network_frame'))
        response = call(ros, Survey, '/calibration_node/survey', Survey.Request(save=True))
        assert not response.success and 'no background' in response.message
        assert not saved.exists()
        processes.append(start('replay_node', '-p', f'recording:={vehicle_path(RECORDING_NAME)}',
                               '-p', 'rate:=1.0', '-p', 'start_delay:=1.0',
                               '-p', 'wait_for_subscribers:=300.0'))
        assert spin_until(lambda: states and all(s.ready for s in states[-1].sensors))
        # The knocks are over, and the car is seconds away.
        response = call(ros, Survey, '/calibration_node/survey', Survey.Request(save=True))
        assert response.success and not response.warnings, response
        assert spin_until(lambda: states[-1].sensors[1].clock_offset != 0.0)
        assert spin_until(lambda: any(t.status == t.ENDED for m in tracks for t in m.tracks))
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0] * 4, outputs
    surveyed, expected = read_network(saved), offline(road_network)
    state = states[-1].sensors
    for j in range(2):
        np.testing.assert_allclose(surveyed.R_ws[j], expected.R_ws[j], atol=np.deg2rad(0.05))
        np.testing.assert_allclose(surveyed.orientation_std[j], expected.orientation_std[j],
                                   rtol=0.05)
        assert abs(surveyed.clock_offset[j] - expected.clock_offset[j]) < 1e-6
        assert state[j].clock_offset == surveyed.clock_offset[j]
        assert state[j].calibrated_by == surveyed.calibrated[j].by != ''
    # With the old network, a track would begin with an uncertainty of five degrees per axis.
    assert 'orientations received' in outputs[2]
    first = next(track_of(t) for m in tracks for t in m.tracks if t.status == t.ACTIVE)
    assert (first.mounting_std.min(axis=1) < np.deg2rad(0.4)).all()


def test_a_calibration_of_other_sensors_is_refused(ros):
    node, spin_until = ros
    diagnostics = []
    node.create_subscription(DiagnosticArray, '/diagnostics', diagnostics.append, RESULT_QOS)
    publisher = node.create_publisher(CalibrationState, '/calibration_state', LATCHED_QOS)
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0)
        publisher.publish(CalibrationState())
        assert spin_until(lambda: any(
            v.key == 'rejected: bad calibration' and v.value == '1'
            for m in diagnostics for s in m.status for v in s.values))
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0] and 'mag_1, mag_2' in outputs[0], outputs
