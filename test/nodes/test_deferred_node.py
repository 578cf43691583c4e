"""Deferred work: repeated requests cause one call, and the call is neither postponed nor lost."""

import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import FieldReadings

from mag_tracking.messages.schema import readings_dict
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.scheduling import Deferred
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from mag_tracking.records import Readings
from support.bundled import NETWORK_FILE
from support.node_processes import start, stop

EARTH_FIELD = np.array([2e-6, 1.55e-5, -4.9e-5])


def test_repeated_requests_cause_one_call(ros):
    node, spin_until = ros
    call_times, request_times = [], []
    deferred = Deferred(node, 0.05, lambda: call_times.append(time.monotonic()))

    def request():
        request_times.append(time.monotonic())
        deferred.request()
    for n in (1, 2):
        for _ in range(3):
            request()
        assert spin_until(lambda n=n: len(call_times) == n)
        assert call_times[-1] - request_times[-3] > 0.045
        spin_until(lambda: False, 0.2)
        assert len(call_times) == n


def test_continuous_requests_do_not_postpone_the_call(ros):
    node, spin_until = ros
    call_times = []
    deferred = Deferred(node, 0.05, lambda: call_times.append(0))
    node.create_timer(0.01, deferred.request)
    assert spin_until(lambda: len(call_times) >= 5)


def test_every_reading_of_a_message_is_evaluated(ros):
    """The calibration node publishes the readings before it updates their rate and noise."""
    node, spin_until = ros
    received, statuses, rng, stamps = [], {}, np.random.default_rng(0), []
    publisher = node.create_publisher(FieldReadings, RAW_READINGS, STREAM_QOS)
    node.create_subscription(FieldReadings, '/field_readings_calibrated', received.append,
                             STREAM_QOS)
    node.create_subscription(DiagnosticArray, '/diagnostics', lambda m: statuses.update(
        {s.name: {v.key: v.value for v in s.values} for s in m.status}), RESULT_QOS)

    def publish():
        field = EARTH_FIELD + 1.2e-8 * rng.standard_normal((2, 3))
        stamps.append(time.time_ns())
        publisher.publish(to_message(FieldReadings, readings_dict(Readings(
            ('mag_1', 'mag_2'), np.arange(2), np.full(2, stamps[-1]), field))))
    process = start('calibration_node', '-p', f'network:={NETWORK_FILE}')
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0)
        timer = node.create_timer(0.01, publish)

        def values(name):
            return statuses.get(f'calibration_node: {name}', {})
        assert spin_until(lambda: received and all(
            values(name).get('background') == 'ready' for name in ('mag_1', 'mag_2')))
        timer.cancel()
        # If every other reading were missed, the rate would be half this value.
        rate_hz = 1e9 / np.median(np.diff(stamps))
        for name in ('mag_1', 'mag_2'):
            assert 0.75 * rate_hz < float(values(name)['rate [Hz]']) < 1.33 * rate_hz
            assert [5.0 < float(v) < 30.0 for v in values(name)['noise [nT]'].split()] == [True] * 3
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
