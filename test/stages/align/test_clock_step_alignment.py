"""Alignment during forward clock steps: each sample is used, rejected with a cause, or held."""


import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.settings import replace
from mag_tracking.stages.align.stage import MAX_HELD, Align
from mag_tracking.stages.settings import AlignSettings
from mag_tracking.stages.stage import rejected
from support.clock_steps import sample, stream, wild, with_clock_step
from support.counters import assert_counts, count_of
from support.networks import line_network
from support.samples import one

MS = 1_000_000


def align(n, **changes):
    return Align(line_network(n), replace(AlignSettings(), changes))


def frames_of(stage, arrivals):
    return [f for j, t in arrivals for f in stage.feed(one(sample(t * MS, j)))]


def n_held(stage):
    return stage.n_held


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_every_sample_is_used_rejected_or_held(seed):
    """Samples fed = used in frames + rejected + held, after every sample and after jumps back."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    stage = align(n, max_clock_jump_s=float(rng.choice([0.05, 0.5, 3.0])),
                  burst=bool(rng.integers(2)), max_wait_s=float(rng.choice([0.1, 0.5])),
                  max_buffered=int(rng.choice([2, 10_000])))
    n_used, n_fed = 0, 0
    for j, t in wild(rng, n, 500):
        n_used += sum(int(f.n_samples.sum()) for f in frames_of(stage, [(j, t)]))
        n_fed += 1
        if rng.random() < 0.005:
            n_used += sum(int(f.n_samples.sum()) for f in stage.flush())
            assert n_held(stage) == 0
        assert n_fed == n_used + sum(rejected(stage.counts).values()) + n_held(stage)
    n_used += sum(int(f.n_samples.sum()) for f in stage.flush())
    assert n_held(stage) == 0
    assert n_fed == n_used + sum(rejected(stage.counts).values())


def test_held_samples_are_aligned_before_a_restart_and_may_cause_restarts():
    """The held samples are at 60, 30 and 20 s; the samples after them begin at 0.1 s."""
    stage = align(3)
    frames = frames_of(stage, [*stream(3, 0, 5000), (1, 60_000), (1, 30_000), (1, 20_000)])
    assert stage.n_held_ahead == 3
    frames += frames_of(stage, [(0, 100), *stream(3, 110, 1000)])
    frames += stage.flush()
    assert rejected(stage.counts) == {}
    assert count_of(stage.counts, 'jumped') == 3
    assert sum(int(f.n_samples.sum()) for f in frames) == 1500 + 3 + 1 + 267


def test_a_clock_step_leaves_the_frames_of_other_sensors_unchanged():
    """The frames equal the frames of a network in which the sensor with the step falls silent."""
    arrivals = stream(6, 0, 6000)
    stage, other = align(6), align(6)
    frames = frames_of(stage, with_clock_step(arrivals, {2}, 2000, 4000, by=1000)) + stage.flush()
    without_steps = [a for a in arrivals if a[0] != 2 or not 2000 <= a[1] < 4000]
    expected = frames_of(other, without_steps) + other.flush()
    assert_counts(rejected(stage.counts), {'mag_3': 200})
    assert [(f.stamp_ns, f.n_samples.tolist()) for f in frames] == [
        (f.stamp_ns, f.n_samples.tolist()) for f in expected]


def test_a_gap_of_all_sensors_is_accepted_and_zero_disables_the_filter():
    stage = align(6)
    frames = frames_of(stage, stream(6, 0, 2000) + stream(6, 12_000, 14_000)) + stage.flush()
    assert sum(int(f.n_samples.sum()) for f in frames) == 2400 and not rejected(stage.counts)
    disabled = align(6, max_clock_jump_s=0.0)
    frames_of(disabled, with_clock_step(stream(6, 0, 3000), {2}, 1000, 9999, by=1000))
    assert set(rejected(disabled.counts)) == {'late'}


def test_clock_steps_are_detected_after_a_jump_back_in_time():
    stage = align(3)
    frames_of(stage, stream(3, 100_000, 102_000))
    frames_of(stage, with_clock_step(stream(3, 0, 4000), {1}, 2000, 3000, by=1000))
    assert_counts(rejected(stage.counts), {'mag_2': 100})


def test_a_sensor_that_falls_silent_while_ahead_is_named_in_the_count():
    stage = align(3)
    frames_of(stage, stream(3, 0, 1000) + [(1, 5000)] + stream(3, 1000, 3000, skip=(1,)))
    assert_counts(rejected(stage.counts), {'mag_2': 1})


def test_the_number_of_held_samples_with_equal_timestamps_is_bounded():
    for max_buffered_samples, expected in ((4, 4), (10_000, MAX_HELD)):
        stage = align(3, max_buffered=max_buffered_samples)
        frames_of(stage, stream(3, 0, 1000))
        frames_of(stage, [(1, 9000)] * 100)
        assert stage.n_held_ahead == expected
        assert count_of(rejected(stage.counts), 'mag_2') == 100 - expected


def test_rejections_by_clock_steps_are_counted_for_each_sensor():
    stage = align(6)
    frames_of(stage, with_clock_step(stream(6, 0, 4000), {0, 5}, 1000, 2000, by=5000))
    assert_counts(rejected(stage.counts), {'mag_1': 100, 'mag_6': 100})


def test_jumps_are_measured_from_the_newest_timestamp_of_all_sensors():
    """One sensor delivers samples every 0.1 s; the samples of the other arrive 0.45 s late."""
    stage = align(2, period_s=0.1, max_clock_jump_s=0.5, max_wait_s=2.0)
    for k in range(50):
        stage.feed(one(sample((1000 + 100 * k) * MS, 0)))
        stage.feed(one(sample((550 + 100 * k) * MS, 1)))
        assert stage.n_held_ahead == 0
    assert not rejected(stage.counts)
