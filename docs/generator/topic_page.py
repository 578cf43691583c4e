"""Reference page of topics, services and messages, from the nodes and the message definitions."""

import os
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = ROOT / 'msg_defs'
FRAMES, EVENT = 'one per frame', 'on event'
RATES = {
    '<sensor>/imu/mag': ('rate of the sensor', 'Readings of a sensor in its own frame, tesla.'),
    '<sensor>/imu/data_raw': ('rate of the sensor', 'Accelerations, if the device reports them.'),
    'field_readings': ('one per batch', 'Readings of many sensors (`batches: true`).'),
    '<sensor>/imu/mag_calibrated': ('rate of the sensor',
                                    'Readings without background, hard and soft iron.'),
    'field_readings_calibrated': ('one per batch', 'Calibrated readings of many sensors.'),
    'calibration_state': ('1 Hz and on change',
                          'Background, noise, orientation and clock offset of each sensor.'),
    'network_frame': (FRAMES, 'Samples of all sensors within one period, with the detection '
    'state.'),
    'detection_node/detections': (EVENT, 'Onset and release of each detection.'),
    'detection_node/events': (EVENT, 'A pass as described by a single sensor.'),
    'tracker_node/pose': (FRAMES + ' and track', 'Published pose of each track.'),
    'tracker_node/odometry': (FRAMES + ' and track',
                              'Pose and velocity; twist in `child_frame_id`.'),
    'tracker_node/tracks': (FRAMES, 'All tracks with flags, doubts, moment and length.'),
    'tracker_node/hypotheses': (FRAMES + ' and track', 'Every hypothesis of the bank.'),
    'tracker_node/detections_3d': (FRAMES, 'Tracks as boxes with class probabilities.'),
    'tracker_node/path': (FRAMES, 'Path of the oldest track.'),
    'tracker_node/markers': (FRAMES, 'Ellipsoid, moment and label of each track.'),
    'tracker_node/sensor_markers': ('on change', 'Positions and names of the sensors.'),
    'tracker_node/smoothed': ('when a track ends', 'The smoothed track with covariances.'),
    'tracker_node/path_smoothed': ('when a track ends', 'The smoothed track as a path.'),
    'tracker_node/pose_smoothed': (FRAMES + ', if `track.smoothing_lag_s` > 0',
                                   'Poses smoothed over a fixed lag.'),
    'tracker_node/disturbances': (EVENT, 'Fields that no target explains.'),
    'tracker_node/passages': (EVENT, 'A vehicle that has crossed a counting line.'),
    'tracker_node/traffic': ('one per interval and line', 'Counts by direction and class.'),
    '/tf': (FRAMES + ' and track, with `publish_tf`', 'Transform to each unambiguous target.'),
    '/tf_static': ('on change', 'Transforms to the sensors.'),
    '/diagnostics': ('1 Hz', 'Rates, losses, rejections, latency and faults, with advice.'),
    '/clock': ('50 to 200 Hz', 'Time of a replay.')}
SERVICES = {
    'calibrate': 'Learn the backgrounds of the named sensors again (empty: of all).',
    'survey': 'Estimate orientations and clock offsets; optionally save the network file.',
    'pause': 'Pause the replay.', 'resume': 'Resume the replay.',
    'seek': 'Continue the replay at an offset from its beginning.'}
STANDARD = re.compile('describe_parameters|get_parameter|list_parameters|set_parameters|'
                      'change_state|'
                      'get_state|get_available|get_transition|type_description')


def topic_page():
    """Markdown."""
    lines = ['# Topics, services and messages', '',
             'Relative names resolve in the namespace of the node; every name can be remapped. '
             '`~/pose` of the tracker is `tracker_node/pose` below. Inputs are subscribed '
             'best-effort '
             '(matches both kinds), or reliable with the parameter `reliable_input`.', '',
             'Publishers are reliable; *latched* is the durability `TRANSIENT_LOCAL`, *depth* the '
             'length of the queue.', '']
    for name, publishers, services in graph():
        lines += [f'## {name}', '', '| publishes | content | rate | QoS |', '|---|---|---|---|']
        lines += [f'| `{topic}`<br>`{kind}` | {RATES[topic][1]} | {RATES[topic][0]} | {qos} |'
                  for topic, kind, qos in publishers]
        if services:
            lines += ['', '| service | type | effect |', '|---|---|---|',
                      *(f'| `~/{s}` | `{kind}` | {SERVICES[s]} |' for s, kind in services)]
        lines.append('')
    lines += ['## Messages of mag_tracking_msgs', '']
    for path in sorted((MESSAGES / 'msg').glob('*.msg')) + sorted((MESSAGES / 'srv').glob('*.srv')):
        lines += [f'### {path.stem}', '', '```text', path.read_text(encoding='utf-8').rstrip(),
                  '```', '']
    return '\n'.join(lines)


def graph():
    """[(node, [(topic, type, QoS)], [(service, type)])]; the nodes are created and inspected."""
    sys.path.insert(0, str(ROOT / 'tools'))
    from generate_policies import SENSORS, nodes

    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    from mag_tracking.nodes.middleware import begin
    begin()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        before = os.environ.get('ROS_HOME')
        os.environ['ROS_HOME'] = folder
        for node in nodes(Path(folder), '/'):
            found.append((node.get_name(), publishers_of(node, SENSORS), services_of(node)))
            node.destroy_node()
        os.environ.pop('ROS_HOME') if before is None else os.environ.update(ROS_HOME=before)
    return found


def publishers_of(node, sensors):
    """[(topic, type, QoS)], one for all sensors; the topics of a recording are left out."""
    rows = {}
    for publisher in node.publishers:
        topic = publisher.topic_name
        for sensor in sensors:
            topic = topic.replace(f'/{sensor}/', '/<sensor>/')
        topic = topic if topic in RATES else topic.removeprefix('/')
        if topic in ('rosout', 'parameter_events') or topic.endswith('/transition_event') \
                or node.get_name() == 'replay_node' and topic not in ('/clock', '/diagnostics'):
            continue
        qos = publisher.qos_profile
        assert qos.reliability.name == 'RELIABLE'
        latched = 'latched, ' if qos.durability.name == 'TRANSIENT_LOCAL' else ''
        rows[topic] = (topic, type_of(publisher.msg_type), f'{latched}depth {qos.depth}')
    return sorted(rows.values())


def services_of(node):
    """[(name, type)] of the services that are the package's own."""
    names = [(s.service_name.rpartition('/')[2], type_of(s.srv_type)) for s in node.services]
    return sorted((n, kind) for n, kind in names if not STANDARD.search(n))


def type_of(message):
    """The ROS name of a message or service class."""
    package, *_ = message.__module__.split('.')
    return f'{package}/{message.__name__}'
