"""Disturbances in the nodes: the tracker publishes the same message as a replay."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import Disturbance as DisturbanceMessage
from mag_tracking_msgs.msg import FieldReadings, NetworkFrame

from mag_tracking.event_records import Disturbance
from mag_tracking.messages.schema import disturbance_dict, readings_dict, stamp_ns
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import PUBLISHER_QOS, RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.units import NS
from support.bundled import NETWORK_FILE
from support.node_processes import start, stop
from support.situations import simulated_world

pytestmark = pytest.mark.timeout(600)
NODE_NAMES = ('calibration_node', 'detection_node', 'tracker_node')


def test_the_tracker_publishes_the_disturbance_of_a_replay(ros):
    node, spin_until = ros
    world = simulated_world('a temperature step', 'boxes', 0)
    readings = world.readings.part(world.readings.stamp_ns < 14 * NS)
    pipeline = Pipeline(world.network, settings_for('vehicle'))
    expected = [r for r in pipeline.feed(readings) if isinstance(r, Disturbance)]
    assert len(expected) == 1 and not expected[0].ended
    messages, frames, discovered = [], [], set()
    # A node whose diagnostics arrive has also discovered the subscriptions of this node.
    node.create_subscription(DiagnosticArray, '/diagnostics', lambda m: discovered.update(
        s.name.split(':')[0].strip('/') for s in m.status), RESULT_QOS)
    node.create_subscription(DisturbanceMessage, '/tracker_node/disturbances', messages.append,
                             PUBLISHER_QOS)
    node.create_subscription(NetworkFrame, '/network_frame', frames.append, STREAM_QOS)
    publisher = node.create_publisher(FieldReadings, RAW_READINGS, PUBLISHER_QOS)
    processes = [start(name, '-p', f'network:={NETWORK_FILE}') for name in NODE_NAMES]
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0
                          and node.count_subscribers('/field_readings_calibrated')
                          and node.count_subscribers('/network_frame') > 1
                          and node.count_publishers('/network_frame')
                          and node.count_publishers('/tracker_node/disturbances')
                          and discovered.issuperset(NODE_NAMES))
        for i in range(0, len(readings), 40):
            part = readings.part(slice(i, i + 40))
            publisher.publish(to_message(FieldReadings, readings_dict(part)))
            # Wait for all frames except the incomplete one, so that no queue overflows.
            complete_ns = int(part.stamp_ns[0]) - NS // 2
            assert spin_until(lambda complete_ns=complete_ns: complete_ns < 4 * NS or frames
                              and stamp_ns(frames[-1].header.stamp) >= complete_ns)
        assert spin_until(lambda: messages)
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0] * 3, outputs
    offline = to_message(DisturbanceMessage, disturbance_dict(expected[0], 'map'))
    assert (np.isclose(messages[0].largest, offline.largest)
            and np.isclose(messages[0].uniform, offline.uniform))
    for name in ('header', 'id', 'ended', 'begin', 'sensors', 'track_id'):
        assert getattr(messages[0], name) == getattr(offline, name), name
