"""Layouts of viewers: all topics, fields and frames exist in a running demo."""

import importlib.util
import json
import re
from xml.etree import ElementTree

import pytest
import yaml
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from mag_tracking.network.file import read_network
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.runner import run
from mag_tracking.nodes.stage_node import LATCHED_QOS
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE, ROOT, vehicle_path

VIEWERS = ROOT / 'config' / 'viewers'


def layout_entries():
    """Read all layouts; return [(topic, field path)] and {frame}. PlotJuggler's topics are None."""
    content = yaml.safe_load((VIEWERS / 'mag_tracking.rviz').read_text())['Visualization Manager']
    entries = [(d['Topic']['Value'], '') for d in content['Displays'] if 'Topic' in d]
    frames = {content['Global Options']['Fixed Frame']}
    layout = json.loads((VIEWERS / 'foxglove.json').read_text())
    for panel in layout['configById'].values():
        entries += [(topic, '') for topic in panel.get('topics', ())]
        frames |= {panel['followTf']} if 'followTf' in panel else set()
        for path in panel.get('paths', ()):
            topic, _, fields = path['value'].partition('.')
            entries.append((topic, fields))
    for curve in ElementTree.parse(VIEWERS / 'plotjuggler.xml').iter('curve'):
        entries.append((None, curve.get('name')))
    return entries, frames


class GraphObserver(Node):
    """Records the topics and frames of the graph."""

    def __init__(self):
        super().__init__('witness')
        self.types, self.frames = {}, set()
        self.create_subscription(TFMessage, '/tf_static', self._add_frames, LATCHED_QOS)
        self.create_timer(0.5, self._add_topics)

    def _add_frames(self, message):
        self.frames |= {f for t in message.transforms
                        for f in (t.header.frame_id, t.child_frame_id)}

    def _add_topics(self):
        for topic, (kind, *_) in self.get_topic_names_and_types():
            if self.count_publishers(topic):
                self.types[topic] = kind


@pytest.fixture(scope='module')
def demo():
    """`GraphObserver` of a recording that is played through the nodes."""
    graph_observers = []
    run(NETWORK_FILE, settings_for('vehicle', {'align.max_wait_s': 5.0}),
        vehicle_path('straight_car_fast_left'), 6.0,
        observers=[lambda: graph_observers.append(GraphObserver()) or graph_observers[-1]])
    return graph_observers[0]


def type_of(kind, fields):
    """Type of a nested field, given by the field names on its path; fails for an unknown field."""
    for name in fields:
        name, index = re.fullmatch(r'(\w+)(\[\d+\])?', name).groups()
        kinds = message_class(kind).get_fields_and_field_types()
        assert name in kinds, f'{kind} has no field {name}'
        kind = kinds[name]
        if index:
            assert kind.endswith(']') or kind.startswith('sequence<'), f'{name} is not an array'
            kind = re.sub(r'sequence<(.*)>|\[\d+\]', r'\1', kind)
        package, _, leaf = kind.partition('/')
        kind = f'{package}/msg/{leaf}' if leaf else kind
    return kind


def test_topics_fields_and_frames_of_the_layouts_exist(demo):
    entries, frames = layout_entries()
    assert len(entries) > 20 and frames <= demo.frames
    for topic, path in entries:
        if topic is None:
            # PlotJuggler separates the topic from the fields with a slash, as within a topic name.
            topic = max((t for t in demo.types if path.startswith(f'{t}/')), key=len, default=path)
            path = path.removeprefix(f'{topic}/').replace('/', '.')
        assert topic in demo.types, topic
        if path:
            assert type_of(demo.types[topic], path.split('.')) in ('double', 'float'), path


def test_layouts_are_up_to_date():
    spec = importlib.util.spec_from_file_location('viewers', ROOT / 'tools/generate_viewers.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, text in module.layouts(read_network(NETWORK_FILE)).items():
        assert (VIEWERS / name).read_text() == text, f'{name}: run tools/generate_viewers.py'
