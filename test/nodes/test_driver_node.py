"""Driver node: published readings, diagnostics and lifecycle."""

import socket
import time
from contextlib import closing

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from mag_tracking_msgs.msg import FieldReadings, NetworkFrame
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.messages.schema import readings_of, stamp_ns
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from support.bundled import NETWORK_FILE
from support.mqtt_broker import free_port
from support.node_processes import MAX_S, call, start, stop, until_quiet
from support.samples import samples_of
from support.serial_line import SerialLine

BOARD_DRIVERS = """
board:
  transport: serial
  serial: {port: PORT}
  framing: text
  text:
    fields: [sensor, sequence, ticks, x, y, z, ax, ay, az]
    checksum: nmea
  clock: {tick_s: 1.0e-6}
  unit: nT
  acceleration_unit: g
  sensors: {A: mag_1, B: mag_2}
"""


def line_of(sensor, k, tick):
    """Line `k` of a horizontal sensor at clock tick `tick` (10 ms); x is 2000 + `tick` [nT]."""
    body = f'{sensor},{k},{10_000 * tick},{2000 + tick},15500,-49000,0,0,1'
    checksum = 0
    for c in body.encode():
        checksum ^= c
    return f'{body}*{checksum:02X}\n'.encode()


@pytest.fixture
def board(ros, tmp_path):
    """(node, spin_until, serial line, drivers file, state) of a board that sends at 100 Hz.

    `state` contains the counters of the board and the faults to simulate. The clock of the board
    continues while the process of the test is delayed.
    """
    node, spin_until = ros
    line = SerialLine(tmp_path / 'port')
    line.plug_in()
    drivers = tmp_path / 'drivers.yaml'
    drivers.write_text(BOARD_DRIVERS.replace('PORT', str(line.path)))
    state = {'k': 0, 'tick': 0, 'plugged': True, 'garbage': b'', 'skip': 0}
    begin = time.monotonic()

    def send():
        tick = int((time.monotonic() - begin) / 0.01)
        if tick == state['tick']:
            return
        state['k'] += 1 + state['skip']
        state['tick'], state['skip'] = tick, 0
        if state['plugged']:
            line.send(state['garbage'] + b''.join(
                line_of(s, state['k'], tick) for s in 'AB'))
            state['garbage'] = b''

    node.create_timer(0.01, send)
    yield node, spin_until, line, drivers, state
    if state['plugged']:
        line.pull_out()


def listen(node, kind, topic, qos=STREAM_QOS):
    """Subscribe to a topic; return a list of (arrival [ns], message) that `node` fills."""
    received = []
    node.create_subscription(kind, topic, lambda m: received.append((time.time_ns(), m)), qos)
    return received


def status_of(received):
    """Latest status of the board; None before the first status."""
    for _, array in reversed(received):
        for status in array.status:
            if status.hardware_id == 'board':
                return status
    return None


def values_of(status):
    """{key: value} of a status."""
    return {v.key: v.value for v in status.values}


def test_a_serial_board_is_published_and_reconnected(board):
    node, spin_until, line, drivers, state = board
    fields = listen(node, MagneticField, '/mag_1/imu/mag')
    accelerations = listen(node, Imu, '/mag_2/imu/data_raw')
    diagnostics = listen(node, DiagnosticArray, '/diagnostics', RESULT_QOS)
    process = start('driver_node', '-p', f'drivers:={drivers}', '-p', f'network:={NETWORK_FILE}')
    try:
        # Lines that were sent before the port was opened arrive together when it is opened.
        assert spin_until(lambda: len(fields) > 100 and len(accelerations) > 100
                          and fields[-100][0] > fields[0][0] + 200_000_000)
        _, message = fields[-1]
        np.testing.assert_allclose(message.magnetic_field.y, 1.55e-5, rtol=1e-12)
        assert message.header.frame_id == 'mag_1'
        assert not any(message.magnetic_field_covariance)
        _, imu = accelerations[-1]
        assert imu.linear_acceleration.z == pytest.approx(9.80665)
        assert imu.orientation_covariance[0] == -1.0
        # Timestamps follow the board's clock: they are regular even if readings arrive late, and
        # close to the arrival. The minimum delay is tested, because this process may be delayed.
        stamps = np.array([stamp_ns(m.header.stamp) for _, m in fields[-80:]])
        steps = np.array([round(1e9 * m.magnetic_field.x) for _, m in fields[-80:]])
        delays_ns = np.array([arrival_ns for arrival_ns, _ in fields[-80:]]) - stamps
        assert np.abs(np.diff(stamps) / np.diff(steps) - 1e7).max() < 1e6
        assert 0 <= delays_ns.min() < 50_000_000

        # Lost and garbled lines are counted and reported.
        state['skip'], state['garbage'] = 7, b'A,1,2,3*00\nA,half a li'
        assert spin_until(lambda: status_of(diagnostics) is not None
                          and 'lost: mag_1' in values_of(status_of(diagnostics)))
        values = values_of(status_of(diagnostics))
        # Seven lines were skipped, and the incomplete line corrupted the next line.
        assert (values['lost: mag_1'], values['lost: mag_2']) == ('8', '7')
        assert any('checksum' in key for key in values)
        assert status_of(diagnostics).level == DiagnosticStatus.WARN

        # A missing port is reported by name. Fields are received again after its return.
        line.pull_out()
        state['plugged'] = False
        assert spin_until(lambda: status_of(diagnostics).level == DiagnosticStatus.ERROR)
        assert str(line.path) in status_of(diagnostics).message
        n = until_quiet(spin_until, fields)
        line.plug_in()
        state['plugged'] = True
        assert spin_until(lambda: len(fields) > n)
        # At first, the lost readings cause a warning.
        assert spin_until(lambda: status_of(diagnostics).level == DiagnosticStatus.OK)
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
    assert 'open again' in outputs[0]


def test_lifecycle_transitions_start_and_stop_publishing(board):
    node, spin_until, line, drivers, _ = board
    fields = listen(node, MagneticField, '/mag_2/imu/mag')
    process = start('driver_node', '-p', 'autostart:=false', '-p', f'drivers:={drivers}')

    def change(transition):
        return call((node, spin_until), ChangeState, '/driver_node/change_state',
                    ChangeState.Request(transition=Transition(id=transition))).success

    def state():
        return call((node, spin_until), GetState, '/driver_node/get_state',
                    GetState.Request()).current_state.id

    try:
        assert state() == State.PRIMARY_STATE_UNCONFIGURED
        drivers.write_text(drivers.read_text().replace('unit: nT', 'unit: furlong'))
        assert not change(Transition.TRANSITION_CONFIGURE)
        drivers.write_text(drivers.read_text().replace('unit: furlong', 'unit: nT'))
        assert change(Transition.TRANSITION_CONFIGURE)
        assert not spin_until(lambda: fields, 0.5)
        for _ in range(2):
            assert change(Transition.TRANSITION_ACTIVATE)
            assert spin_until(lambda: len(fields) > 10)
            assert change(Transition.TRANSITION_DEACTIVATE)
            until_quiet(spin_until, fields)
            fields.clear()
        assert change(Transition.TRANSITION_CLEANUP)
        assert state() == State.PRIMARY_STATE_UNCONFIGURED
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
    assert 'furlong' in outputs[0]


def test_readings_are_published_in_batches(board):
    node, spin_until, _, drivers, _ = board
    drivers.write_text(drivers.read_text().replace('  unit: nT', '  unit: nT\n  batch_s: 0.05'))
    batches = listen(node, FieldReadings, '/field_readings')
    fields = listen(node, MagneticField, '/mag_2/imu/mag')
    process = start('driver_node', '-p', f'drivers:={drivers}', '-p', 'batches:=true')
    try:
        assert spin_until(lambda: len(batches) > 20)
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
    assert not fields
    samples = [samples_of(readings_of(m)) for _, m in batches[5:15]]
    assert np.mean([len(s) for s in samples]) > 8
    for sensor in ('mag_1', 'mag_2'):
        stamps = [s.stamp_ns for batch in samples for s in batch if s.sensor == sensor]
        assert (np.diff(stamps) > 5e6).all()
    assert samples[0][0].covariance is None
    np.testing.assert_allclose(samples[0][0].field[1:], [1.55e-5, -4.9e-5])


def test_readings_in_batches_reach_the_frames(ros, tmp_path):
    """Simulated readings pass through the nodes in batches, and no sensor lacks readings."""
    node, spin_until = ros
    network, drivers = tmp_path / 'network.yaml', tmp_path / 'drivers.yaml'
    rows = ''.join(f'  mag_{k}: {{position: [{9 * k}, 0, 0], noise_std: 1.2e-8, '
                   'background: [2.0e-6, 1.55e-5, -4.9e-5]}\n' for k in range(20))
    network.write_text(f'earth_field: [2.0e-6, 1.55e-5, -4.9e-5]\nsensors:\n{rows}')
    drivers.write_text(
        f'road:\n  device: simulator\n  simulator: {{network: {network}, moment: 0.0}}\n'
        '  sensors: {' + ', '.join(f'mag_{k}: mag_{k}' for k in range(20)) + '}\n')
    frames = listen(node, NetworkFrame, '/network_frame')
    processes = [start(name, '-p', f'network:={network}')
                 for name in ('calibration_node', 'detection_node')]
    try:
        assert spin_until(lambda: node.count_subscribers('/field_readings')
                          and node.count_subscribers('/field_readings_calibrated'))
        processes.append(start('driver_node', '-p', f'drivers:={drivers}', '-p',
                               f'network:={network}', '-p', 'batches:=true'))
        assert spin_until(lambda: len(frames) > 30)
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0] * 3, outputs
    n = np.array([m.n_samples for _, m in frames[5:30]])
    # When the clock estimate of the device changes, a reading may fall into the adjacent frame.
    # This affects all sensors, because they share the clock.
    assert n.shape == (25, 20) and n.min() >= 7 and np.ptp(n, axis=1).max() <= 1
    assert abs(n.mean() - 8.0) < 0.25
    assert np.nanmax(np.abs([m.field for _, m in frames[5:30]])) < 1e-7


@pytest.mark.parametrize('content, error', [
    (BOARD_DRIVERS.replace('PORT', '/dev/null').replace('B: mag_2', 'B: mag_9'),
     'sensor mag_9'),
    (BOARD_DRIVERS.replace('PORT', '/dev/null').replace('B: mag_2', 'B: mag_1'),
     'sensor mag_1'),
    (BOARD_DRIVERS.replace('PORT', '/dev/null').replace('  framing: text\n', ''),
     'framing is missing'),
    ('', 'of devices')])
def test_an_invalid_drivers_file_ends_the_node(ros, tmp_path, content, error):
    drivers = tmp_path / 'drivers.yaml'
    drivers.write_text(content)
    process = start('driver_node', '-p', f'drivers:={drivers}', '-p', f'network:={NETWORK_FILE}')
    output = process.communicate(timeout=MAX_S)[0]
    assert process.returncode == 1
    assert error in output and 'Traceback' not in output


def test_a_missing_port_is_reported_until_it_appears(board):
    node, spin_until, line, drivers, state = board
    line.pull_out()
    state['plugged'] = False
    fields = listen(node, MagneticField, '/mag_1/imu/mag')
    diagnostics = listen(node, DiagnosticArray, '/diagnostics', RESULT_QOS)
    process = start('driver_node', '-p', f'drivers:={drivers}')
    try:
        assert spin_until(lambda: status_of(diagnostics) is not None
                          and str(line.path) in status_of(diagnostics).message)
        assert status_of(diagnostics).level == DiagnosticStatus.ERROR
        line.plug_in()
        state['plugged'] = True
        assert spin_until(lambda: fields)
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_two_senders_of_one_sensor_are_named(ros, tmp_path):
    node, spin_until = ros
    port = free_port(socket.SOCK_DGRAM)
    drivers = tmp_path / 'drivers.yaml'
    drivers.write_text(f'board:\n  transport: udp\n  udp: {{port: {port}}}\n  framing: text\n'
                       '  text: {fields: [x, y, z]}\n  unit: uT\n  sensor: mag_1\n')
    diagnostics = listen(node, DiagnosticArray, '/diagnostics', RESULT_QOS)
    fields = listen(node, MagneticField, '/mag_1/imu/mag')
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as device, \
            closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as stray:
        device.bind(('127.0.0.2', 0))
        node.create_timer(0.02, lambda: device.sendto(b'20,3,-45\n', ('127.0.0.1', port)))
        node.create_timer(1.5, lambda: stray.sendto(b'1,2,3\n', ('127.0.0.1', port)))
        process = start('driver_node', '-p', f'drivers:={drivers}')
        try:
            assert spin_until(lambda: (s := status_of(diagnostics))
                              and s.level == DiagnosticStatus.ERROR
                              and '127.0.0.1' in s.message and '127.0.0.2' in s.message)
            n = len(fields)
            assert spin_until(lambda: len(fields) > n + 100)
            assert {m.magnetic_field.y for _, m in fields[-100:]} == {3e-6}
        finally:
            exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
