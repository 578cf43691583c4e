"""Resolution of topic names in namespaces, and recordings with namespaces."""

import dataclasses

import pytest

from mag_tracking.errors import NetworkError, RecordingError
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.sensor_network import absolute, checked_namespace, namespaces_of
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from support.networks import line_network
from support.samples import MagSample, recorded, sample_dict

RELATIVE_TOPICS = ('mag_1/imu/mag', 'mag_2/imu/mag')


def recording_of(path, *namespaces):
    """Create a recording with one reading of mag_1 per namespace: 1 T, 2 T, ..."""
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path) as writer:
        for k, namespace in enumerate(namespaces):
            sample = MagSample(10**9 + k, 'mag_1', [float(k + 1), 0.0, 0.0])
            writer.write(f'{namespace}/mag_1/imu/mag', MAGNETIC_FIELD,
                         sample_dict(sample, 'mag_1'), sample.stamp_ns)
    return Recording(path)


def read_fields(recording, namespace=None):
    """Read a recording with relative topics; return (x components, missing topics)."""
    network = dataclasses.replace(line_network(2), topics=RELATIVE_TOPICS, namespace=namespace)
    reader = SampleReader(recording, network)
    return [s.field[0] for s in recorded(reader)], reader.missing_topics()


@pytest.mark.parametrize('namespaces, expected', [
    (('',), (1.0, '/mag_2/imu/mag')), (('/robot1',), (1.0, '/robot1/mag_2/imu/mag')),
    (('/a/b',), (1.0, '/a/b/mag_2/imu/mag')), (('/sim', ''), (2.0, '/mag_2/imu/mag'))])
def test_relative_topics_are_found_in_their_namespace(tmp_path, namespaces, expected):
    assert read_fields(recording_of(tmp_path / 'a.mcap', *namespaces)) == (
        [expected[0]], [expected[1]])


def test_several_namespaces_require_a_choice(tmp_path):
    recording = recording_of(tmp_path / 'a.mcap', '/north', '/south')
    with pytest.raises(RecordingError, match='the namespaces /north, /south: choose .*--namespace'):
        read_fields(recording)
    assert read_fields(recording, '/south') == ([2.0], ['/south/mag_2/imu/mag'])
    with pytest.raises(RecordingError, match='/west/mag_1/imu/mag'):
        read_fields(recording, '/west')


def test_names_are_resolved_and_namespaces_are_validated():
    assert absolute('a/b') == '/a/b' and absolute('a', '/n/m') == '/n/m/a'
    assert absolute('/a', '/n') == '/a'
    # A topic does not match the end of a longer name.
    assert namespaces_of(['mag'], ['/imag', '/x/mag']) == ['/x']
    assert namespaces_of(['/mag'], ['/x/mag']) == []
    assert checked_namespace('/') == '/' and checked_namespace('/a/b_1') == '/a/b_1'
    for name in ('', 'a', '/a/', '//', '/1a', '/a b', '/a//b', '/ä'):
        with pytest.raises(NetworkError, match='namespace'):
            checked_namespace(name)
