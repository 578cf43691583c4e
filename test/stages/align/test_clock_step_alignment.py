"""Clocks that step ahead, as the alignment meets them: nothing is lost uncounted."""

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.settings import replace
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.stages.align.stage import MAX_HELD, Align
from mag_tracking.stages.stage import rejected
from support.clock_steps import sample, stepped, stream, wild
from support.networks import line_network
from support.samples import one

MS = 1_000_000


def align(n, **changes):
    return Align(line_network(n), replace(AlignSettings(), changes))


def frames_of(stage, arrivals):
    return [f for j, t in arrivals for f in stage.feed(one(sample(t * MS, j)))]


def waiting(stage):
    return stage.n_held


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_the_alignment_loses_nothing_uncounted(seed):
    """Samples in = in frames + rejected + waiting, at every sample, also where time jumps back."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    stage = align(n, max_clock_jump_s=float(rng.choice([0.05, 0.5, 3.0])),
                  burst=bool(rng.integers(2)), max_wait_s=float(rng.choice([0.1, 0.5])),
                  max_backward_jump_s=float(rng.choice([0.1, 1])),
                  max_buffered=int(rng.choice([2, 10_000])))
    used, came = 0, 0
    for j, t in wild(rng, n, 500):
        used += sum(int(f.n_samples.sum()) for f in frames_of(stage, [(j, t)]))
        came += 1
        if rng.random() < 0.005:
            used += sum(int(f.n_samples.sum()) for f in stage.flush())
            assert waiting(stage) == 0
        assert came == used + sum(rejected(stage.counts).values()) + waiting(stage)
    used += sum(int(f.n_samples.sum()) for f in stage.flush())
    assert waiting(stage) == 0
    assert came == used + sum(rejected(stage.counts).values())


def test_a_jump_back_while_samples_are_held_that_go_back_themselves():
    """Those that are held are aligned before the restart; they may be a restart themselves."""
    stage = align(3)
    frames = frames_of(stage, [*stream(3, 0, 5000), (1, 60_000), (1, 30_000), (1, 20_000)])
    assert stage.n_held_ahead == 3
    frames += frames_of(stage, [(0, 100), *stream(3, 110, 1000)])
    frames += stage.flush()
    assert rejected(stage.counts) == {}
    assert stage.counts['time jumped back'] == 3
    assert sum(int(f.n_samples.sum()) for f in frames) == 1500 + 3 + 1 + 267


def test_the_others_go_on_as_if_the_one_ahead_were_not_there():
    """But for the wait that any sensor is given that falls silent."""
    arrivals = stream(6, 0, 6000)
    stage, without = align(6), align(6)
    frames = frames_of(stage, stepped(arrivals, {2}, 2000, 4000, by=1000)) + stage.flush()
    silent = [a for a in arrivals if a[0] != 2 or not 2000 <= a[1] < 4000]
    expected = frames_of(without, silent) + without.flush()
    assert rejected(stage.counts) == {'ahead of all other sensors: mag_3': 200}
    assert [(f.stamp_ns, f.n_samples.tolist()) for f in frames] == [
        (f.stamp_ns, f.n_samples.tolist()) for f in expected]


def test_a_gap_of_all_is_no_fault_and_a_setting_of_zero_is_never():
    stage = align(6)
    frames = frames_of(stage, stream(6, 0, 2000) + stream(6, 12_000, 14_000)) + stage.flush()
    assert sum(int(f.n_samples.sum()) for f in frames) == 2400 and not rejected(stage.counts)
    never = align(6, max_clock_jump_s=0.0)
    frames_of(never, stepped(stream(6, 0, 3000), {2}, 1000, 9999, by=1000))
    assert set(rejected(never.counts)) == {'late'}


def test_after_a_restart_it_goes_by_the_new_time():
    stage = align(3)
    frames_of(stage, stream(3, 100_000, 102_000))
    frames_of(stage, stepped(stream(3, 0, 4000), {1}, 2000, 3000, by=1000))
    assert rejected(stage.counts) == {'ahead of all other sensors: mag_2': 100}


def test_who_fell_silent_ahead_is_named_by_its_own_name():
    stage = align(3)
    frames_of(stage, stream(3, 0, 1000) + [(1, 5000)] + stream(3, 1000, 3000, skip=(1,)))
    assert rejected(stage.counts) == {'ahead of all other sensors: mag_2': 1}


def test_few_samples_of_a_sensor_wait_also_where_its_stamps_stand_still():
    for most, expected in ((4, 4), (10_000, MAX_HELD)):
        stage = align(3, max_buffered=most)
        frames_of(stage, stream(3, 0, 1000))
        frames_of(stage, [(1, 9000)] * 100)
        assert stage.n_held_ahead == expected
        assert rejected(stage.counts)['ahead of all other sensors: mag_2'] == 100 - expected


def test_counts_name_each_sensor():
    stage = align(6)
    frames_of(stage, stepped(stream(6, 0, 4000), {0, 5}, 1000, 2000, by=5000))
    assert Counter(rejected(stage.counts)) == {
        'ahead of all other sensors: mag_1': 100, 'ahead of all other sensors: mag_6': 100}


def test_what_is_ahead_is_so_of_the_newest_not_of_the_latest():
    """A sensor whose samples come 0.45 s late; those of the other are 0.1 s apart."""
    stage = align(2, period_s=0.1, max_clock_jump_s=0.5, max_wait_s=2.0)
    for k in range(50):
        stage.feed(one(sample((1000 + 100 * k) * MS, 0)))
        stage.feed(one(sample((550 + 100 * k) * MS, 1)))
        assert stage.n_held_ahead == 0
    assert not rejected(stage.counts)
