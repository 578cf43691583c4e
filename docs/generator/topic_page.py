"""Reference page of topics, services and messages, from the nodes and the message definitions."""

import html
import json
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
MESSAGES = DOCS.parent / 'msg_defs'
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

TOPICS = """# Nodes: topics, services, parameters, messages

Relative names resolve in the namespace of the node; every name can be remapped. `~/pose` of the
tracker is `tracker_node/pose` below. Inputs are subscribed best-effort (matches both kinds), or
reliable with the parameter `reliable_input`.

Publishers are reliable; *latched* is the durability `TRANSIENT_LOCAL`, *depth* the length of the
queue. The settings of the stages ({doc}`parameters`) are parameters of the
nodes as well.
"""


def topic_page():
    """Markdown: topics, services and parameters of each node, and all message definitions."""
    lines = [TOPICS]
    for name, publishers, services, parameters in graph():
        lines += [f'## {name}', '', '| publishes | content | rate | QoS |', '|---|---|---|---|']
        lines += [f'| `{topic}`<br>`{kind}` | {RATES[topic][1]} | {RATES[topic][0]} | {qos} |'
                  for topic, kind, qos in publishers]
        if services:
            lines += ['', '| service | type | effect |', '|---|---|---|',
                      *(f'| `~/{s}` | `{kind}` | {SERVICES[s]} |' for s, kind in services)]
        lines += ['', '| parameter | default | meaning |', '|---|---|---|',
                  *(f'| `{p}` | `{default!r}` | {html.escape(text, quote=False)} |'
                    for p, default, text in parameters)]
        lines.append('')
    lines += ['## Messages of mag_tracking_msgs', '']
    for path in sorted((MESSAGES / 'msg').glob('*.msg')) + sorted((MESSAGES / 'srv').glob('*.srv')):
        lines += [f'### {path.stem}', '', '```text', path.read_text(encoding='utf-8').rstrip(),
                  '```', '']
    return '\n'.join(lines)


def graph():
    """Describe the nodes, from a process that creates them; see `generator.node_graph`.

    Returns
    -------
    list of (name, publishers, services, parameters)

    Raises
    ------
    RuntimeError
        If the nodes cannot be created.
    """
    command = [sys.executable, '-m', 'generator.node_graph']
    run = subprocess.run(command, cwd=DOCS, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(f'{" ".join(command)} failed:\n{run.stderr}')
    return json.loads(run.stdout)
