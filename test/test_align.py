"""Alignment: the frames do not depend on how the samples arrive, and nobody waits for the dead."""

import numpy as np
import pytest
from conftest import line_network
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.records import MagSample
from mag_tracking.settings import replace
from mag_tracking.stages.align import Align, AlignSettings
from mag_tracking.stages.stage import rejected

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')
C = 1.44e-16 * np.eye(3)


def sample(ms, j, value=1.0):
    return MagSample(int(ms * 1_000_000), f'mag_{j + 1}', np.full(3, float(value)), C)


def stage(n=2, **changes):
    return Align(line_network(n), replace(AlignSettings(), changes))


def feed(align, samples, flush=True):
    out = [f for s in samples for f in align.feed(s)]
    return out + (align.flush() if flush else [])


def stream(n, duration_ms, step=10.0, offset=3.0):
    samples = [sample(k * step + offset * j, j, k) for j in range(n)
               for k in range(int(duration_ms / step))]
    return sorted(samples, key=lambda s: s.stamp_ns)


def key(frames):
    return [(f.stamp_ns, f.field.tobytes(), f.covariance.tobytes(), f.n_samples.tobytes())
            for f in frames]


def test_frames_average_and_their_noise_falls():
    frames = feed(stage(), stream(2, 800))
    assert len(frames) == 10
    assert frames[0].n_samples.tolist() == [8, 8]
    np.testing.assert_allclose(frames[0].field, np.mean(range(8)))
    np.testing.assert_allclose(frames[0].covariance[0], C / 8)


def test_a_frame_says_when_each_sensor_was_read():
    """Steps of 10 ms, the second sensor 3 ms later; then it reads only every 30 ms."""
    frames = feed(stage(), stream(2, 800))
    np.testing.assert_allclose(frames[0].time_offset, [-1.5e-3, 1.5e-3])
    assert frames[0].stamp_ns == 36_500_000
    slow = [s for s in stream(2, 800)
            if s.sensor == 'mag_1' or s.stamp_ns % 30_000_000 == 3_000_000]
    first = feed(stage(), slow)[0]
    # 0, 10 .. 70 and 3, 33, 63: the mean is that of all samples.
    mean = (280 + 99) / 11 * 1e-3
    np.testing.assert_allclose(first.time_offset, [0.035 - mean, 0.033 - mean], atol=1e-9)
    alone = feed(stage(), [s for s in stream(2, 800) if s.sensor == 'mag_1'])
    assert alone[0].time_offset.tolist() == [0.0, 0.0]


@given(st.data())
def test_frames_do_not_depend_on_the_interleaving_of_the_sensors(data):
    """Each sensor's samples in order, the sensors mixed anyhow within the waiting time."""
    queues = [[s for s in stream(3, 600) if s.sensor == f'mag_{j + 1}'] for j in range(3)]
    mixed = []
    while any(queues):
        j = data.draw(st.sampled_from([j for j in range(3) if queues[j]]))
        mixed.append(queues[j].pop(0))
    assert key(feed(stage(3, max_wait_s=5.0), mixed)) == \
        key(feed(stage(3, max_wait_s=5.0), stream(3, 600)))


def test_different_rates_and_a_missing_axis():
    a = stream(1, 800)
    b = [MagSample(int(k * 40e6 + 1e6), 'mag_2', np.array([1.0, np.nan, 2.0]), C)
         for k in range(20)]
    frames = feed(stage(), sorted(a + b, key=lambda s: s.stamp_ns))
    assert {tuple(f.n_samples) for f in frames} == {(8, 2)}
    assert np.isnan(frames[0].field[1, 1]) and np.isfinite(frames[0].field[1, [0, 2]]).all()


def test_a_sensor_that_stops_becomes_a_nan_row_and_delays_nobody():
    samples = [s for s in stream(2, 4000) if s.sensor == 'mag_1' or s.stamp_ns < 1e9]
    align = stage(max_wait_s=0.5)
    delays, frames = [], []
    for s in samples:
        for f in align.feed(s):
            frames.append(f)
            delays.append((s.stamp_ns - f.stamp_ns) / 1e9)
    late = [d for d, f in zip(delays, frames, strict=True) if f.stamp_ns > 2e9]
    assert max(late) < 0.2 and max(delays) < 0.8
    assert np.isnan(frames[-1].field[1]).all() and frames[-1].n_samples.tolist()[1] == 0
    assert align.counts['frames with a sensor missing'] > 20


def test_a_sensor_that_never_spoke_is_waited_for_only_once():
    frames = feed(stage(), [s for s in stream(2, 2000) if s.sensor == 'mag_1'], flush=False)
    assert len(frames) > 20


def test_late_duplicate_and_unordered_samples_are_counted():
    align = stage(1)
    feed(align, stream(1, 500), flush=False)
    for ms in (490, 485):
        align.feed(sample(ms, 0))
    align.feed(MagSample(0, 'mag_7', np.zeros(3), C))
    assert rejected(align.counts) == {'duplicate stamp': 1, 'out of order': 1,
                                      'unknown sensor mag_7': 1}
    slow = stage(2, max_wait_s=0.2)
    feed(slow, [s for s in stream(2, 2000) if s.sensor == 'mag_1'], flush=False)
    slow.feed(sample(100, 1))
    assert rejected(slow.counts) == {'late': 1}


def test_a_looped_recording_starts_anew_and_loses_nothing_before():
    align = stage()
    first = feed(align, stream(2, 2400), flush=False)
    second = feed(align, stream(2, 2400))
    assert align.counts['time jumped back'] == 1
    assert sum(f.n_samples.sum() for f in first + second) == 960
    assert not rejected(align.counts)


def test_memory_is_bounded():
    align = stage(2, max_wait_s=3600.0, most_pending=50)
    for k in range(1000):
        align.feed(sample(10.0 * k, 0))
    assert sum(len(q) for q in align._pending) == 50
    assert rejected(align.counts) == {'too many pending': 950}


def test_burst_mode_closes_a_round_at_its_last_sensor():
    align = stage(4, burst=True, period_s=0.5)
    for k in range(5):
        for j in range(4):
            frames = align.feed(sample(5000.0 * k + 7.0 * j, j, k))
            assert len(frames) == (1 if j == 3 else 0)
        np.testing.assert_allclose(frames[0].field, k)


def test_burst_mode_does_not_mix_rounds_after_a_lost_sample():
    align = stage(2, burst=True, period_s=0.5)
    samples = [s for s in stream(2, 1000) if not (s.sensor == 'mag_2' and s.field[0] == 40.0)]
    frames = feed(align, samples)
    for f in frames:
        there = f.field[f.n_samples > 0]
        assert np.ptp(there) == 0.0
    assert len(frames) == 100


@pytest.mark.parametrize('period', [0.02, 0.08, 0.3])
def test_every_sample_is_used_exactly_once(period):
    frames = feed(stage(2, period_s=period), stream(2, 3000))
    assert sum(f.n_samples.sum() for f in frames) == 600


@given(st.integers(0, 10_000))
def test_stamps_of_frames_always_increase_and_offsets_keep_the_true_times(seed):
    rng = np.random.default_rng(seed)
    samples = []
    for j in range(3):
        times = np.cumsum(rng.uniform(2.0, 60.0) * rng.uniform(0.9, 1.1, 60))
        samples += [sample(round(t, 3), j) for t in times if t < 900.0]
    samples.sort(key=lambda s: s.stamp_ns)
    for burst in (False, True):
        frames = feed(stage(3, burst=burst, period_s=0.08), samples)
        assert (np.diff([f.stamp_ns for f in frames]) > 0).all()
        for f in frames:
            assert (f.time_offset[f.n_samples == 0] == 0.0).all()
        times = sum((f.n_samples * (f.stamp_ns / 1e9 + f.time_offset)).sum() for f in frames)
        assert sum(f.n_samples.sum() for f in frames) == len(samples)
        assert times == pytest.approx(sum(s.stamp_ns for s in samples) / 1e9)
