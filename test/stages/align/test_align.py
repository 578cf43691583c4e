"""Alignment into frames: order of arrival, missing sensors, burst mode, rejected samples, cost."""

import dataclasses
from collections import Counter
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.settings import replace
from mag_tracking.stages.align import stage as align_stage
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.settings import AlignSettings
from mag_tracking.stages.stage import rejected
from support.counters import assert_counts, count_of
from support.disordered_samples import C, disorder
from support.networks import line_network
from support.samples import MagSample, one

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')


def sample(ms, j, value=1.0):
    return MagSample(int(ms * 1_000_000), f'mag_{j + 1}', np.full(3, float(value)), C)


def stage(n=2, **changes):
    return Align(line_network(n), replace(AlignSettings(), changes))


def feed(align, samples, flush=True):
    out = [f for s in samples for f in align.feed(one(s))]
    return out + (align.flush() if flush else [])


def stream(n, duration_ms, step=10.0, offset=3.0):
    samples = [sample(k * step + offset * j, j, k) for j in range(n)
               for k in range(int(duration_ms / step))]
    return sorted(samples, key=lambda s: s.stamp_ns)


def key(frames):
    return [(f.stamp_ns, f.field.tobytes(), f.covariance.tobytes(), f.n_samples.tobytes())
            for f in frames]


def test_a_frame_averages_its_samples_and_reduces_the_noise():
    frames = feed(stage(), stream(2, 800))
    assert len(frames) == 10
    assert frames[0].n_samples.tolist() == [8, 8]
    np.testing.assert_allclose(frames[0].field, np.mean(range(8)))
    np.testing.assert_allclose(frames[0].covariance[0], C / 8)


def test_time_offsets_are_the_mean_sample_times_of_each_sensor():
    """Both sensors sample every 10 ms, mag_2 3 ms later; then mag_2 samples only every 30 ms."""
    frames = feed(stage(), stream(2, 800))
    np.testing.assert_allclose(frames[0].time_offset, [-1.5e-3, 1.5e-3])
    assert frames[0].stamp_ns == 36_500_000
    slow = [s for s in stream(2, 800)
            if s.sensor == 'mag_1' or s.stamp_ns % 30_000_000 == 3_000_000]
    first = feed(stage(), slow)[0]
    # The samples are at 0, 10 .. 70 ms and at 3, 33, 63 ms; the timestamp is their mean.
    mean = (280 + 99) / 11 * 1e-3
    np.testing.assert_allclose(first.time_offset, [0.035 - mean, 0.033 - mean], atol=1e-9)
    single = feed(stage(), [s for s in stream(2, 800) if s.sensor == 'mag_1'])
    assert single[0].time_offset.tolist() == [0.0, 0.0]


@given(st.data())
def test_frames_do_not_depend_on_the_interleaving_of_the_sensors(data):
    """Samples change their order only between sensors, and by no more than the maximum wait."""
    queues = [[s for s in stream(3, 600) if s.sensor == f'mag_{j + 1}'] for j in range(3)]
    mixed = []
    while any(queues):
        j = data.draw(st.sampled_from([j for j in range(3) if queues[j]]))
        mixed.append(queues[j].pop(0))
    assert key(feed(stage(3, max_wait_s=5.0), mixed)) == \
        key(feed(stage(3, max_wait_s=5.0), stream(3, 600)))


def test_sensors_of_different_rates_and_with_a_missing_axis_share_frames():
    a = stream(1, 800)
    b = [MagSample(int(k * 40e6 + 1e6), 'mag_2', np.array([1.0, np.nan, 2.0]), C)
         for k in range(20)]
    frames = feed(stage(), sorted(a + b, key=lambda s: s.stamp_ns))
    assert {tuple(f.n_samples) for f in frames} == {(8, 2)}
    assert np.isnan(frames[0].field[1, 1]) and np.isfinite(frames[0].field[1, [0, 2]]).all()


def test_a_sensor_that_stops_becomes_a_nan_row_and_delays_frames_only_once():
    samples = [s for s in stream(2, 4000) if s.sensor == 'mag_1' or s.stamp_ns < 1e9]
    align = stage(max_wait_s=0.5)
    delays, frames = [], []
    for s in samples:
        for f in align.feed(one(s)):
            frames.append(f)
            delays.append((s.stamp_ns - f.stamp_ns) / 1e9)
    late = [d for d, f in zip(delays, frames, strict=True) if f.stamp_ns > 2e9]
    assert max(late) < 0.2 and max(delays) < 0.8
    assert np.isnan(frames[-1].field[1]).all() and frames[-1].n_samples.tolist()[1] == 0
    assert count_of(align.counts, 'missing') > 20


def test_a_sensor_without_any_sample_delays_frames_only_once():
    frames = feed(stage(), [s for s in stream(2, 2000) if s.sensor == 'mag_1'], flush=False)
    assert len(frames) > 20


def test_late_duplicate_and_out_of_order_samples_are_counted():
    align = stage(1)
    feed(align, stream(1, 500), flush=False)
    for ms in (490, 485):
        align.feed(one(sample(ms, 0)))
    align.feed(one(MagSample(0, 'mag_7', np.zeros(3), C)))
    assert_counts(rejected(align.counts), {'duplicate': 1, 'order': 1, 'mag_7': 1})
    slow = stage(2, max_wait_s=0.2)
    feed(slow, [s for s in stream(2, 2000) if s.sensor == 'mag_1'], flush=False)
    slow.feed(one(sample(100, 1)))
    assert rejected(slow.counts) == {'late': 1}


def test_a_missing_covariance_is_taken_from_the_network_or_rejected():
    network = line_network(2)
    stds = (None, np.array([1e-8, 2e-8, 3e-8]))
    align = Align(dataclasses.replace(network, noise_std=stds), AlignSettings())
    frames = feed(align, [MagSample(0, f'mag_{j}', np.ones(3)) for j in (1, 2)] + [sample(1, 0)])
    np.testing.assert_array_equal(frames[0].covariance, [C, np.diag(stds[1] ** 2)])
    assert_counts(rejected(align.counts), {'noise_std': 1})


def test_a_looped_recording_restarts_the_alignment_and_loses_no_samples():
    align = stage()
    first = feed(align, stream(2, 2400), flush=False)
    second = feed(align, stream(2, 2400))
    assert count_of(align.counts, 'jumped') == 1
    assert sum(f.n_samples.sum() for f in first + second) == 960
    assert not rejected(align.counts)


def test_the_number_of_held_samples_is_bounded():
    align = stage(2, max_wait_s=3600.0, max_buffered=50)
    for k in range(1000):
        align.feed(one(sample(10.0 * k, 0)))
    assert align.n_held == 50
    assert_counts(rejected(align.counts), {'pending': 950})


def test_burst_mode_completes_a_round_with_the_sample_of_its_last_sensor():
    align = stage(4, burst=True, period_s=0.5)
    for k in range(5):
        for j in range(4):
            frames = align.feed(one(sample(5000.0 * k + 7.0 * j, j, k)))
            assert len(frames) == (1 if j == 3 else 0)
        np.testing.assert_allclose(frames[0].field, k)


def test_burst_mode_does_not_mix_rounds_after_a_lost_sample():
    align = stage(2, burst=True, period_s=0.5)
    samples = [s for s in stream(2, 1000) if not (s.sensor == 'mag_2' and s.field[0] == 40.0)]
    frames = feed(align, samples)
    for f in frames:
        present = f.field[f.n_samples > 0]
        assert np.ptp(present) == 0.0
    assert len(frames) == 100


def test_burst_mode_measures_silence_from_the_newest_sample_in_a_frame():
    """The first frame contains the samples at 0 and 150 ms, the second only the sample at 10 ms."""
    align = stage(2, burst=True, period_s=1.0, max_wait_s=0.05)
    arrivals = [(0, 0), (10, 0), (150, 1), (155, 1)]
    assert [len(align.feed(one(sample(ms, j)))) for ms, j in arrivals] == [0, 0, 2, 1]


def test_burst_mode_accepts_samples_one_nanosecond_apart():
    frames = feed(stage(1, burst=True), [sample(1e-6 * k, 0) for k in range(1, 6)])
    assert [f.stamp_ns for f in frames] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize('period', [0.02, 0.08, 0.3])
def test_every_sample_is_used_exactly_once(period):
    frames = feed(stage(2, period_s=period), stream(2, 3000))
    assert sum(f.n_samples.sum() for f in frames) == 600


@given(st.integers(0, 10_000))
def test_frame_timestamps_increase_and_offsets_preserve_sample_times(seed):
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


class PlainAlign:
    """Reference implementation in plain Python, which evaluates all sensors at every sample."""

    def __init__(self, n, s):
        self.n, self.burst, self.max_held, self.counts = n, s.burst, s.max_buffered, Counter()
        self.period, self.max_wait, self.max_jump = (
            round(1e9 * v) for v in (s.period_s, s.max_wait_s, align_stage.MAX_BACKWARD_JUMP_S))
        self.begin()

    def begin(self):
        self.held, self.seen, self.latest, self.taken = [], [], {}, {}
        self.end = self.stamp = None

    def feed(self, x):
        j, t, out = int(x.sensor[4:]) - 1, x.stamp_ns, []
        if np.isnan(x.field).all() or np.isinf(x.field).any():
            self.counts['rejected: no finite field'] += 1
            return []
        if t <= self.latest.get(j, -1):
            jump = self.latest[j] - t
            if jump <= self.max_jump:
                self.counts['rejected: out of order' if jump
                            else 'rejected: duplicate timestamp'] += 1
                return []
            out = self.flush()
            self.begin()
            self.counts['time jumped back'] += 1
        self.latest[j] = t
        if self.end is not None and t < self.end:
            self.counts['rejected: late'] += 1
            return []
        self.seen.append(t)
        self.held = sorted([*self.held, (t, j, x)], key=lambda h: h[:2])
        if len([h for h in self.held if h[1] == j]) > self.max_held:
            self.held.remove(next(h for h in self.held if h[1] == j))
            self.counts['rejected: too many pending samples'] += 1
        return out + self.flush(False)

    def flush(self, final=True):
        out = []
        while self.held:
            oldest = {j: t for t, j, _ in reversed(self.held)}
            start, length = min(oldest.values()), self.period
            if self.burst:
                half_intervals = [(t - self.taken[j]) // 2 for j, t in oldest.items()
                                  if j in self.taken]
                length = max(1, min([length, *half_intervals]))
            elif self.end is not None and start < self.end + self.period:
                start = self.end
            if not (final or self.complete(start + length, oldest)):
                break
            out.append(self.frame(start + length, oldest))
        return out

    def complete(self, end, oldest):
        newest, last = max(self.seen), max(self.taken.values(), default=0)
        all_sensors = range(self.n)

        def is_active(j, at):
            return (self.latest[j] >= at - self.max_wait if j in self.latest
                    else newest - min(self.seen) < self.max_wait)
        return all(self.latest.get(j, -1) >= end for j in all_sensors if is_active(j, newest)) or (
            self.burst and all(oldest[j] < end if j in oldest else not is_active(j, last)
                               for j in all_sensors))

    def frame(self, end, oldest):
        taken = [h for h in self.held if h[0] < end and (not self.burst or h[0] == oldest[h[1]])]
        self.held = [h for h in self.held if h not in taken]
        self.taken.update({j: t for t, j, _ in taken})
        times = [t for t, *_ in taken]
        self.end = max(times) + 1 if self.burst else end
        mean = min(times) + round(sum(t - min(times) for t in times) / len(times))
        self.stamp = mean if self.stamp is None else max(mean, self.stamp + 1)
        rows = [[h for h in taken if h[1] == j] for j in range(self.n)]
        self.counts['frames'] += 1
        self.counts['frames with a sensor missing'] += not all(rows)
        return self.stamp, [self.average(row) for row in rows]

    def average(self, row):
        if not row:
            return np.full(3, np.nan), np.full((3, 3), np.nan), 0, 0.0
        values = np.array([x.field for *_, x in row])
        n = np.count_nonzero(~np.isnan(values), axis=0)
        return (np.nansum(values, axis=0) / np.where(n > 0, n, np.nan),
                sum(x.covariance for *_, x in row) / len(row) / min(n[n > 0]),
                len(row), sum(t - self.stamp for t, *_ in row) / len(row) / 1e9)


@settings(max_examples=200)
@given(st.integers(0, 10 ** 6))
def test_frames_and_counts_match_the_reference_at_every_sample(seed):
    n, rng = 1 + seed % 6, np.random.default_rng(seed)
    chosen = replace(AlignSettings(), {
        'burst': bool(rng.integers(2)), 'period_s': float(rng.choice([1e-4, 0.01, 0.03, 0.2])),
        'max_wait_s': float(rng.choice([0.001, 0.02, 0.1, 0.5, 60.0])),
        'max_clock_jump_s': 0.0, 'max_buffered': int(rng.choice([2, 5, 20, 10000]))})
    with mock.patch.object(align_stage, 'MAX_BACKWARD_JUMP_S', float(rng.choice([0.0, 0.05, 1.0]))):
        compare_with_reference(n, rng, chosen)


def compare_with_reference(n, rng, chosen):
    align, reference = Align(line_network(n), chosen), PlainAlign(n, chosen)
    frames, rows = [], []
    for s in disorder(rng, n):
        found = align.flush() if s is None else align.feed(one(s))
        expected = reference.flush() if s is None else reference.feed(s)
        assert [f.stamp_ns for f in found] == [stamp for stamp, _ in expected]
        assert +align.counts == +reference.counts
        frames += found
        rows += [row for _, sensors in expected for row in sensors]
    for k, name in enumerate(('field', 'covariance', 'n_samples', 'time_offset')):
        got = [v for f in frames for v in getattr(f, name)]
        np.testing.assert_allclose(got, [row[k] for row in rows], rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize('changes', [{}, {'burst': True, 'period_s': 0.5, 'max_wait_s': 2.0},
                                     {'max_wait_s': 3600.0, 'max_buffered': 20}])
def test_the_cost_of_a_sample_does_not_depend_on_the_number_of_sensors(changes):
    """The cost is the number of attribute look-ups; samples are lost and one sensor has a gap."""
    class CountedAlign(Align):
        lookups = Counter()

        def __getattribute__(self, name):
            CountedAlign.lookups[name] += 1
            return super().__getattribute__(name)
    rng, cost = np.random.default_rng(1), []
    for n in (6, 60):
        CountedAlign.lookups.clear()
        samples = [s for s in stream(n, 1000.0, offset=3.6 / n) if rng.uniform() > 0.02
                   and (s.sensor != 'mag_3' or not 300e6 < s.stamp_ns < 700e6)]
        feed(CountedAlign(line_network(n), replace(AlignSettings(), changes)), samples)
        cost.append(CountedAlign.lookups.total() / len(samples))
    assert cost[1] < 1.1 * cost[0]
