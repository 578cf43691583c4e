"""FieldReadings messages: conversion to and from `Readings`, and recordings."""

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
from mag_tracking.network.sensor_network import absolute
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from support.counters import assert_counts, count_of
from support.networks import line_network
from support.samples import MagSample, batch, recorded, sample_dict, samples_of

BATCH_TOPIC = absolute(RAW_READINGS)
START = 1_700_000_000_123_456_789


def message(content):
    """Message with the fields `content` as attributes, like a decoded message."""
    return SimpleNamespace(**content)


def random_samples(n, known, rng, names=('mag_2', 'mag_1', 'sensor three')):
    """Create `n` samples, some with missing axes.

    The covariances are asymmetric, so that a transposition would be detected.
    """
    out = []
    for k in range(n):
        field = rng.standard_normal(3) * 1e-5
        field[rng.random(3) < 0.2] = np.nan
        out.append(MagSample(START + int(rng.integers(-10**9, 10**9)) + k, str(rng.choice(names)),
                             field, rng.standard_normal((3, 3)) * 1e-16 if known else None))
    return out


def identical(a, b):
    """Whether two lists of samples are identical to the last bit."""
    return len(a) == len(b) and all(
        (x.stamp_ns, x.sensor) == (y.stamp_ns, y.sensor)
        and x.field.tobytes() == y.field.tobytes()
        and (x.covariance is None) == (y.covariance is None)
        and (x.covariance is None or np.array_equal(x.covariance, y.covariance))
        for x, y in zip(a, b, strict=True))


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(1, 40), st.booleans(), st.integers(0, 1000))
def test_a_round_trip_keeps_samples_and_their_order(n, known, seed):
    samples = random_samples(n, known, np.random.default_rng(seed))
    content = readings_dict(batch(samples))
    back = samples_of(readings_of(message(content)))
    assert identical(back, samples)
    assert all(isinstance(s.stamp_ns, int) for s in back)
    assert sorted(content['sensors']) == sorted({s.sensor for s in samples})
    latest = max(s.stamp_ns for s in samples)
    assert content['header'] == {
        'stamp': {'sec': latest // 10**9, 'nanosec': latest % 10**9}, 'frame_id': ''}


def test_arrays_follow_the_message_definition():
    """Arrays are in row-major order; integers and single-precision numbers are accepted."""
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
    integer = [MagSample(7, 'b', np.ones(3), np.eye(3, dtype=int))]
    assert readings_dict(batch(integer))['covariance'].tolist() == np.eye(3).ravel().tolist()
    single_precision = [MagSample(7, 'b', np.ones(3, dtype=np.float32),
                                  np.eye(3, dtype=np.float32))]
    assert identical(samples_of(readings_of(message(readings_dict(batch(single_precision))))),
                     [MagSample(7, 'b', np.ones(3), np.eye(3))])


def test_partial_covariances_and_empty_batches_are_refused():
    rng = np.random.default_rng(0)
    for samples in ([], random_samples(2, True, rng) + random_samples(1, False, rng),
                    random_samples(1, False, rng) + random_samples(2, True, rng)):
        with pytest.raises(RecordingError, match='covariances'):
            readings_dict(batch(samples))


@pytest.mark.parametrize('changes, error', [
    ({'stamp': array('q', [1])}, 'of 2 readings: got 1 timestamps, 6 field values'),
    ({'sensor': array('H', [0])}, 'of 1 readings: got 2 timestamps'),
    ({'field': array('d', range(5))}, '5 field values'),
    ({'covariance': array('d', range(9))}, '9 covariance values'),
    ({'sensor': array('H', [0, 1])}, 'index 1 .*1'),
    ({'sensors': []}, 'index 0 .*0'),
    ({'stamp': array('q', [0, 2**63 - 1])}, 'timestamps 0 to 9223372036854775807 ns'),
    ({'stamp': array('q', [-2**63, 0])}, 'timestamps -9223372036854775808')])
def test_inconsistent_messages_are_refused(changes, error):
    content = readings_dict(batch(
        [MagSample(k, 'a', np.ones(3), np.eye(3)) for k in range(2)]))
    assert len(readings_of(message(content))) == 2
    with pytest.raises(RecordingError, match=error):
        readings_of(message(content | changes))


def test_an_empty_message_has_no_readings():
    empty = {'sensors': [], 'sensor': [], 'stamp': [], 'field': [], 'covariance': []}
    assert len(readings_of(message(empty))) == 0


def recording(path, messages):
    """Write a recording of [(topic, type, content)] at intervals of one second."""
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path) as writer:
        for k, (topic, kind, content) in enumerate(messages):
            writer.write(topic, kind, content, START + k * 10**9)
    return Recording(path)


@pytest.mark.parametrize('known', [True, False])
def test_a_recording_returns_the_same_samples(tmp_path, known):
    rng = np.random.default_rng(1)
    groups = [random_samples(n, known, rng, ('mag_1', 'mag_2')) for n in (5, 1, 100)]
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        (BATCH_TOPIC, FIELD_READINGS, readings_dict(batch(g))) for g in groups]),
                          line_network(2))
    assert reader.missing_topics() == []
    batches = list(reader.readings_as_received())
    assert identical(samples_of(*(r for r, _ in batches)), [s for g in groups for s in g])
    assert [t for _, t in batches] == [START + k * 10**9 for k, g in enumerate(groups)]
    assert identical(samples_of(*reader.readings_and_accelerations()), recorded(reader))
    assert reader.rejected == Counter()


def test_unknown_sensors_and_undecodable_messages_are_counted(tmp_path):
    rng = np.random.default_rng(2)
    known_samples = random_samples(3, False, rng, ('mag_1',))
    other = random_samples(4, False, rng, ('elsewhere',))
    broken = readings_dict(batch(known_samples))
    broken['stamp'] = broken['stamp'][:2]
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        (BATCH_TOPIC, FIELD_READINGS, readings_dict(batch(other + known_samples))),
        (BATCH_TOPIC, FIELD_READINGS, broken)]), line_network(2))
    assert identical(recorded(reader), known_samples)
    assert_counts(reader.rejected, {'elsewhere': 4, BATCH_TOPIC: 1})


def test_many_unknown_sensors_are_counted_together(tmp_path):
    rng = np.random.default_rng(2)
    known = random_samples(3, False, rng, ('mag_1',))
    others = [random_samples(1, False, rng, (f'x{k}',))[0] for k in range(300)]
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        (BATCH_TOPIC, FIELD_READINGS, readings_dict(batch(part)))
        for part in (others[:100], others[100:] + known + others[:1])]), line_network(2))
    assert identical(recorded(reader), known)
    assert len(reader.rejected) < 30 and sum(reader.rejected.values()) == 301
    assert count_of(reader.rejected, ' x0') == 2


def test_single_and_batch_topics_are_read(tmp_path):
    rng = np.random.default_rng(3)
    (one,) = random_samples(1, True, rng, ('mag_2',))
    many = random_samples(3, True, rng, ('mag_1',))
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        ('/mag_2/imu/mag', MAGNETIC_FIELD, sample_dict(one, 'mag_2')),
        (BATCH_TOPIC, FIELD_READINGS, readings_dict(batch(many)))]), line_network(2))
    assert identical(recorded(reader), [one, *many])


def test_a_batch_topic_of_another_type_is_ignored(tmp_path):
    (one,) = random_samples(1, True, np.random.default_rng(4), ('mag_1',))
    reader = SampleReader(recording(tmp_path / 'a.mcap', [
        ('/mag_1/imu/mag', MAGNETIC_FIELD, sample_dict(one, 'mag_1')),
        (BATCH_TOPIC, MAGNETIC_FIELD, sample_dict(one, 'mag_1'))]), line_network(2))
    assert identical(recorded(reader), [one])
    assert reader.missing_topics() == ['/mag_2/imu/mag']
    with pytest.raises(RecordingError, match='/mag_1/'):
        SampleReader(recording(tmp_path / 'b' / 'b.mcap', [
            (BATCH_TOPIC, MAGNETIC_FIELD, sample_dict(one, 'mag_1'))]), line_network(2))
