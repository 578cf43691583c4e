"""Rates, gaps and clocks of a recording, as `mag-tracking info` prints them."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader

from mag_tracking.apps.info import Source, time_topics
from mag_tracking.cli import main
from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings

S = 10**9
EPOCH_NS = 1_790_000_000 * S


def write(path, stamps_ns, log_times_ns=None, frame='mag_1', topic='/mag_1/imu/mag'):
    with RecordingWriter(path) as writer:
        for stamp, log_time in zip(stamps_ns, log_times_ns if log_times_ns is not None
                                   else stamps_ns, strict=True):
            (_, content), = magnetic_field_dicts(
                Readings.single('mag_1', int(stamp), np.full(3, 2e-5)), frame)
            writer.write(topic, MAGNETIC_FIELD, content, int(log_time))
    return path


def uniform(n, rate):
    return EPOCH_NS + (np.arange(n) * S / rate).astype(np.int64)


@pytest.mark.parametrize('rate', [0.1, 1.0, 37.0, 400.0])
def test_the_rate_does_not_depend_on_gaps_and_bursts(rate, tmp_path):
    t = uniform(600, rate)
    t[400:] += 60 * S + int(20 * S / rate)
    # The jitter is 3 % of the interval; the recorder receives packets of ten messages.
    t += np.random.default_rng(0).integers(0, int(0.03 * S / rate), 600)
    packets = np.repeat(t[9::10], 10)
    timings, faults, counts = time_topics(Recording(write(tmp_path / 'a.mcap', t, packets)))
    timing, = timings.values()
    text = timing.describe()
    assert not faults and counts == {'/mag_1/imu/mag': 600}
    assert timing.n_messages == 600 and not timing.clocks_disagree
    assert float(text.split(' Hz')[0]) == pytest.approx(rate, rel=0.002)
    gap_s = (t[400] - t[399]) / S
    assert f'1 gap, the longest {gap_s:.4g} s, {(t[399] - t[0]) / S:.4g} s after' in text
    assert timing.span_s == pytest.approx((t[-1] - t[0]) / S)


def test_equal_and_backward_times_are_counted(tmp_path):
    t = uniform(500, 100.0)
    t[200:] -= 1 * S
    t[1::2] = t[::2]
    path = write(tmp_path / 'a.mcap', t, uniform(500, 100.0))
    (timing,) = time_topics(Recording(path))[0].values()
    text = timing.describe()
    assert 'backward once' in text
    assert float(text.split(' Hz')[0]) == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize('log_times', [
    lambda t: np.where(np.arange(len(t)) < 900, t, 2**62),
    lambda t: np.where(np.arange(len(t)) < 10, 0, t),
    lambda t: (t - EPOCH_NS) * 1000])
def test_wrong_log_times_do_not_become_the_duration(log_times, tmp_path, capsys):
    t = uniform(1400, 100.0)
    path = write(tmp_path / 'a.mcap', t, log_times(t))
    assert main(['info', str(path)]) == 0
    out = capsys.readouterr().out
    assert '  13.99 s' in out and 'warning: the log' in out
    assert '1400  100 Hz' in out


def test_a_damaged_chunk_is_a_gap(tmp_path, capsys):
    path = write(tmp_path / 'a.mcap', uniform(30_000, 8000.0))
    data = bytearray(path.read_bytes())
    lost = make_reader(io.BytesIO(data)).get_summary().chunk_indexes[1]
    lost_s = (lost.message_end_time - lost.message_start_time) / S
    assert 0.84 < lost_s < 0.849
    n_kept = 30_000 - round(lost_s * 8000) - 1
    data[lost.chunk_start_offset + lost.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    assert main(['info', str(path)]) == 0
    out = capsys.readouterr().out
    assert f'MB, {n_kept} messages' in out and 'warning: damaged segments' in out
    assert f'{n_kept}  8000 Hz, 1 gap, the longest 0.84' in out


def test_sensors_of_one_topic_are_separate(tmp_path, capsys):
    path = tmp_path / 'a.mcap'
    with RecordingWriter(path) as writer:
        for k in range(300):
            name = 'mag_2' if k % 3 == 0 else 'mag_1'
            (_, content), = magnetic_field_dicts(
                Readings.single(name, EPOCH_NS + k * S // 30, np.full(3, 2e-5)), name)
            writer.write('/imu/mag', MAGNETIC_FIELD, content, EPOCH_NS + k * S // 30)
    timings, *_ = time_topics(Recording(path))
    assert {source: t.n_messages for source, t in timings.items()} == {
        Source('/imu/mag', 'mag_1'): 200, Source('/imu/mag', 'mag_2'): 100}
    assert main(['info', str(path)]) == 0
    assert 'mag_2  100  10 Hz' in capsys.readouterr().out


def test_messages_without_a_timestamp_are_timed_by_their_log_times(tmp_path):
    t = uniform(400, 50.0)
    path = write(tmp_path / 'a.mcap', np.zeros(400), t)
    (timing,) = time_topics(Recording(path))[0].values()
    text = timing.describe()
    assert text.startswith('50 Hz') and 'header.stamp is 0 in 400 messages' in text
    # Messages without a timestamp among others do not disturb the times.
    path = write(tmp_path / 'b' / 'b.mcap', np.where(np.arange(400) % 10 == 3, 0, t), t)
    (timing,) = time_topics(Recording(path))[0].values()
    text = timing.describe()
    assert float(text.split(' Hz')[0]) == pytest.approx(45.0, rel=0.01)
    assert 'header.stamp is 0 in 40 messages' in text
    assert 'gap' not in text and not timing.clocks_disagree
