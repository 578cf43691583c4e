"""Readings of many sensors in one message: to it and back, and out of a recording."""

from array import array
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import readings_dict, readings_of
from mag_tracking.messages.types import FIELD_READINGS, MAGNETIC_FIELD, RAW_READINGS
from mag_tracking.network.topics import absolute
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from support.networks import line_network
from support.samples import MagSample, batch, recorded, sample_dict, samples_of

TOGETHER = absolute(RAW_READINGS)
START = 1_700_000_000_123_456_789


def message(content):
    """As a decoder gives it."""
    return SimpleNamespace(**content)


def some(n, known, rng, names=('mag_2', 'mag_1', 'sensor three')):
    """`n` samples; fields with axes missing, covariances that are not symmetric, to tell them."""
    out = []
    for k in range(n):
        field = rng.standard_normal(3) * 1e-5
        field[rng.random(3) < 0.2] = np.nan
        out.append(MagSample(START + int(rng.integers(-10**9, 10**9)) + k, str(rng.choice(names)),
                             field, rng.standard_normal((3, 3)) * 1e-16 if known else None))
    return out


def same(a, b):
    """Whether two lists of samples are alike to the last bit."""
    return len(a) == len(b) and all(
        (x.stamp_ns, x.sensor) == (y.stamp_ns, y.sensor)
        and x.field.tobytes() == y.field.tobytes()
        and (x.covariance is None) == (y.covariance is None)
        and (x.covariance is None or np.array_equal(x.covariance, y.covariance))
        for x, y in zip(a, b, strict=True))


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(1, 40), st.booleans(), st.integers(0, 1000))
def test_there_and_back_in_the_order_in_which_they_came(n, known, seed):
    samples = some(n, known, np.random.default_rng(seed))
    content = readings_dict(batch(samples))
    back = samples_of(readings_of(message(content)))
    assert same(back, samples)
    assert all(isinstance(s.stamp_ns, int) for s in back)
    assert sorted(content['sensors']) == sorted({s.sensor for s in samples})
    latest = max(s.stamp_ns for s in samples)
    assert content['header'] == {
        'stamp': {'sec': latest // 10**9, 'nanosec': latest % 10**9}, 'frame_id': ''}


def test_the_arrays_are_those_of_the_definition():
    """Row by row; numbers that come as integers or as single precision are numbers all the same."""
    samples = [MagSample(7, 'b', np.array([1, 2, 3]), np.diag([1, 2, 3])),
               MagSample(5, 'a', np.array([0.5, 1.5, 2.5], dtype=np.float32),
                         np.arange(9, dtype=np.float32).reshape(3, 3)),
               MagSample(6, 'b', np.array([4.0, 5.0, 6.0]), np.eye(3))]
    content = readings_dict(batch(samples))
    assert (content['sensors'], content['sensor']) == (['b', 'a'], array('H', [0, 1, 0]))
    assert content['stamp'] == array('q', [7, 5, 6])
    assert content['field'] == array('d', [1, 2, 3, 0.5, 1.5, 2.5, 4, 5, 6])
    assert content['covariance'].tolist() == [
        1, 0, 0, 0, 2, 0, 0, 0, 3, *range(9), 1, 0, 0, 0, 1, 0, 0, 0, 1]
    whole = [MagSample(7, 'b', np.ones(3), np.eye(3, dtype=int))]
    assert readings_dict(batch(whole))['covariance'].tolist() == np.eye(3).ravel().tolist()
    single = [MagSample(7, 'b', np.ones(3, dtype=np.float32), np.eye(3, dtype=np.float32))]
    assert same(samples_of(readings_of(message(readings_dict(batch(single))))),
                [MagSample(7, 'b', np.ones(3), np.eye(3))])


def test_some_covariances_known_or_no_sample_is_no_message():
    rng = np.random.default_rng(0)
    for samples in ([], some(2, True, rng) + some(1, False, rng),
                    some(1, False, rng) + some(2, True, rng)):
        with pytest.raises(RecordingError, match='covariances of all readings or of none'):
            readings_dict(batch(samples))


@pytest.mark.parametrize('changes, said', [
    ({'stamp': array('q', [1])}, 'of 2 readings: got 1 timestamps, 6 field values'),
    ({'sensor': array('H', [0])}, 'of 1 readings: got 2 timestamps'),
    ({'field': array('d', range(5))}, '5 field values'),
    ({'covariance': array('d', range(9))}, '9 covariance values'),
    ({'sensor': array('H', [0, 1])}, 'sensor index 1 is out of range; there are 1'),
    ({'sensors': []}, 'sensor index 0 is out of range; there are 0'),
    ({'stamp': array('q', [0, 2**63 - 1])}, 'timestamps 0 to 9223372036854775807 ns'),
    ({'stamp': array('q', [-2**63, 0])}, 'timestamps -9223372036854775808')])
def test_what_does_not_fit_is_told(changes, said):
    content = readings_dict(batch(
        [MagSample(k, 'a', np.ones(3), np.eye(3)) for k in range(2)]))
    assert len(readings_of(message(content))) == 2
    with pytest.raises(RecordingError, match=said):
        readings_of(message(content | changes))


def test_a_message_of_nothing_is_no_reading():
    empty = {'sensors': [], 'sensor': [], 'stamp': [], 'field': [], 'covariance': []}
    assert len(readings_of(message(empty))) == 0


def recording(path, messages):
    """A recording of [(topic, type, content)], a second apart."""
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path) as writer:
        for k, (topic, kind, content) in enumerate(messages):
            writer.write(topic, kind, content, START + k * 10**9)
    return Recording(path)


@pytest.mark.parametrize('known', [True, False])
def test_a_recording_gives_the_same_samples(tmp_path, known):
    rng = np.random.default_rng(1)
    groups = [some(n, known, rng, ('mag_1', 'mag_2')) for n in (5, 1, 100)]
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        (TOGETHER, FIELD_READINGS, readings_dict(batch(g))) for g in groups]),
                          line_network(2))
    assert reader.missing_topics() == []
    got = list(reader.readings_as_received())
    assert same(samples_of(*(r for r, _ in got)), [s for g in groups for s in g])
    assert [t for _, t in got] == [START + k * 10**9 for k, g in enumerate(groups)]
    assert same(samples_of(*reader.readings_and_accelerations()), recorded(reader))
    assert reader.rejected == Counter()


def test_readings_of_others_and_messages_that_are_none_are_counted(tmp_path):
    rng = np.random.default_rng(2)
    mine, other = some(3, False, rng, ('mag_1',)), some(4, False, rng, ('elsewhere',))
    broken = readings_dict(batch(mine))
    broken['stamp'] = broken['stamp'][:2]
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        (TOGETHER, FIELD_READINGS, readings_dict(batch(other + mine))),
        (TOGETHER, FIELD_READINGS, broken)]), line_network(2))
    assert same(recorded(reader), mine)
    assert reader.rejected == {'reading of elsewhere, which is not in the network': 4,
                               f'undecodable message on {TOGETHER}': 1}


def test_both_kinds_of_topics_are_read(tmp_path):
    rng = np.random.default_rng(3)
    (one,), many = some(1, True, rng, ('mag_2',)), some(3, True, rng, ('mag_1',))
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        ('/mag_2/imu/mag', MAGNETIC_FIELD, sample_dict(one, 'mag_2')),
        (TOGETHER, FIELD_READINGS, readings_dict(batch(many)))]), line_network(2))
    assert same(recorded(reader), [one, *many])


def test_a_topic_of_that_name_with_another_type_is_left_alone(tmp_path):
    (one,) = some(1, True, np.random.default_rng(4), ('mag_1',))
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        ('/mag_1/imu/mag', MAGNETIC_FIELD, sample_dict(one, 'mag_1')),
        (TOGETHER, MAGNETIC_FIELD, sample_dict(one, 'mag_1'))]), line_network(2))
    assert same(recorded(reader), [one])
    assert reader.missing_topics() == ['/mag_2/imu/mag']
    with pytest.raises(RecordingError, match="none of the network's topics"):
        SampleReader(recording(tmp_path / 'b' / 'b.mcap', [
            (TOGETHER, MAGNETIC_FIELD, sample_dict(one, 'mag_1'))]), line_network(2))
