"""Clock step filter: distinguish a forward clock step from a gap in the samples of all sensors."""

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.stages.align.clock_step import ClockStepFilter
from support.clock_steps import sample, stream, wild, with_clock_step

LIMIT = 500
"""[ms] Maximum forward jump. Timestamps in these tests are in milliseconds, although the filter
documents nanoseconds."""


def run(clock_filter, arrivals):
    """Feed arrivals; return the passed and the rejected samples, each as [(sensor, timestamp)]."""
    passed, rejected = [], []
    for j, t in arrivals:
        accepted, wrong = clock_filter.feed(j, sample(t, j))
        passed += [(i, s.stamp_ns) for i, s in accepted]
        rejected += [(i, s.stamp_ns) for i, s in wrong]
    return passed, rejected


def held(clock_filter):
    """Held samples as [(sensor, timestamp)]."""
    return [(h[0], h[1].stamp_ns) for h in clock_filter.held]


def filter_after(n, until=1000, max_held=10_000, **kwargs):
    """Create a `ClockStepFilter` and feed a stream without clock steps to it."""
    clock_filter = ClockStepFilter(n, LIMIT, max_held)
    run(clock_filter, stream(n, 0, until, **kwargs))
    return clock_filter


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_streams_without_clock_steps_pass_immediately(seed):
    """Samples may be late, repeated and unordered, with gaps of one sensor and of all sensors."""
    rng = np.random.default_rng(seed)
    n, clock_filter = int(rng.integers(1, 7)), ClockStepFilter(6, LIMIT, 10)
    gap = 1000 + int(rng.integers(0, LIMIT - 60))
    for t in range(0, 3000, 10):
        for j in range(n):
            late = int(rng.integers(-40, 41))
            if (1000 < t < gap or j == 1 and t > 2000) or rng.random() < 0.1:
                continue
            s = sample(t + late, j)
            assert clock_filter.feed(j, s) == ([(j, s)], [])
    assert clock_filter.flush() == []


@pytest.mark.parametrize('step', [10, 100, 1000])
@pytest.mark.parametrize('n', [2, 3, 6])
def test_samples_of_a_clock_that_steps_ahead_and_back_are_rejected(n, step):
    arrivals = with_clock_step(stream(n, 0, 20_000, step), {1}, 5000, 12_000, by=1803)
    clock_filter = ClockStepFilter(n, LIMIT, 10_000)
    passed, rejected = run(clock_filter, arrivals)
    wrong = [a for a, b in zip(arrivals, stream(n, 0, 20_000, step), strict=True) if a != b]
    if n == 2 and step == 1000:
        # Between two samples of the correct sensor, only the stepped sensor reports for longer
        # than the limit, so some of its samples pass.
        assert set(rejected) <= set(wrong)
        return
    assert rejected == wrong and len(wrong) == 7000 / step
    # Samples of the other sensors are never held, so they keep the order of arrival.
    assert passed == [a for a in arrivals if a not in set(wrong)]
    assert held(clock_filter) == []


@pytest.mark.parametrize('n, step, max_n_held', [
    (1, 10, 0), (2, 10, 1), (3, 10, 1), (6, 10, 3), (6, 2000, 5)])
def test_a_jump_of_all_sensors_is_accepted(n, step, max_n_held):
    arrivals = stream(n, 0, 3 * step, step) + stream(n, 3 * step + 10_000, 6 * step + 10_000, step)
    clock_filter, n_held, passed = ClockStepFilter(n, LIMIT, 10_000), 0, []
    for a in arrivals:
        accepted, wrong = run(clock_filter, [a])
        passed += accepted
        assert not wrong
        n_held = max(n_held, len(held(clock_filter)))
    assert passed == arrivals
    assert n_held <= max_n_held


def test_a_jump_of_the_only_active_sensor_is_accepted():
    clock_filter = filter_after(3)
    run(clock_filter, stream(3, 1000, 3000, skip=(1, 2)))
    assert run(clock_filter, [(0, 9000)]) == ([(0, 9000)], [])


def test_sensors_that_have_just_stopped_delay_a_jump_by_the_limit_only():
    clock_filter = filter_after(3)
    jump = [(0, t) for t in range(9000, 9600, 10)]
    passed, rejected = run(clock_filter, jump[:50])
    assert passed == rejected == []
    assert run(clock_filter, jump[50:51]) == (jump[:51], [])
    assert run(clock_filter, jump[51:]) == (jump[51:], [])


@pytest.mark.parametrize('max_held', [20, 10_000])
def test_a_stepped_clock_is_held_for_the_limit_only_after_all_others_stop(max_held):
    """Regression: samples of the stepped clock were rejected forever after all others stopped."""
    clock_filter = filter_after(6, max_held=max_held)
    run(clock_filter, with_clock_step(stream(6, 1000, 3000), {2}, 1500, 9999, by=1000))
    later_arrivals = [(2, t) for t in range(4000, 6000, 10)]
    passed, rejected = run(clock_filter, later_arrivals)
    assert passed[-1] == later_arrivals[-1] and len(passed) >= 150
    assert set(passed) >= set(later_arrivals[50:]) and not set(passed) & set(rejected)
    assert held(clock_filter) == []


@pytest.mark.parametrize('stepped_sensors, is_accepted', [
    ({1, 4}, False), ({0, 1, 4}, False), ({0, 1, 3, 4}, True)])
def test_the_majority_of_sensors_decides_which_clocks_stepped(stepped_sensors, is_accepted):
    arrivals = with_clock_step(stream(6, 0, 4000), stepped_sensors, 1000, 9999, by=1000)
    clock_filter = ClockStepFilter(6, LIMIT, 10_000)
    passed, rejected = run(clock_filter, arrivals)
    if is_accepted:
        assert not rejected and passed != arrivals and sorted(passed) == sorted(arrivals)
        assert held(clock_filter) == []
    else:
        assert {j for j, _ in rejected} == stepped_sensors
        assert {j for j, t in passed if t > 1500} == set(range(6)) - stepped_sensors
        assert len(passed) + len(rejected) + len(held(clock_filter)) == len(arrivals)


def test_a_clock_ahead_of_all_others_is_rejected_when_the_others_jump():
    """Regression: all held samples passed together with the jump of the other sensors."""
    clock_filter = filter_after(4)
    run(clock_filter, [(3, 100_000)])
    passed, rejected = run(clock_filter, stream(3, 3000, 4000))
    assert passed == stream(3, 3000, 4000)
    assert rejected == [(3, 100_000)] and held(clock_filter) == []


def test_a_clock_that_is_ahead_in_its_first_sample_is_rejected_by_majority():
    """All samples of two clocks pass, because either clock may be correct. The majority of more
    clocks is considered correct."""
    two = ClockStepFilter(2, LIMIT, 10)
    assert run(two, [(0, 0), (1, 5000)]) == ([(0, 0), (1, 5000)], [])
    three = ClockStepFilter(3, LIMIT, 10)
    passed, rejected = run(three, [(0, 0), (1, 1), (2, 5000), *stream(2, 10, 1000)])
    assert passed == [(0, 0), (1, 1), *stream(2, 10, 1000)] and rejected == [(2, 5000)]


def test_the_first_sample_of_another_sensor_confirms_a_jump():
    clock_filter = ClockStepFilter(3, LIMIT, 10)
    run(clock_filter, [(0, 0), (1, 900)])
    assert run(clock_filter, [(0, 1450)]) == ([], [])
    assert run(clock_filter, [(2, 1460)]) == ([(0, 1450), (2, 1460)], [])


def test_each_jump_needs_its_own_confirmation():
    clock_filter = filter_after(2)
    assert run(clock_filter, [(1, 3000), (1, 990), (1, 4000)]) == ([(1, 990)], [(1, 3000)])


def test_a_timestamp_that_no_sensor_follows_is_held_for_the_limit_only():
    """The timestamp is from a single sample of a sensor that then falls silent."""
    clock_filter = filter_after(3)
    run(clock_filter, [(1, 2000)])
    passed, rejected = run(clock_filter, stream(3, 1000, 1490, skip=(1,)))
    assert rejected == [] and held(clock_filter) == [(1, 2000)]
    _, rejected = run(clock_filter, stream(3, 1490, 1530, skip=(1,)))
    assert rejected == [(1, 2000)] and held(clock_filter) == []


def test_jumps_up_to_the_limit_pass():
    for by, passes in ((LIMIT, True), (LIMIT + 1, False)):
        clock_filter = ClockStepFilter(2, LIMIT, 10)
        run(clock_filter, [(0, 0), (1, 0)])
        assert bool(run(clock_filter, [(0, by)])[0]) == passes
    unlimited = ClockStepFilter(2, inf, 10)
    assert run(unlimited, [(0, 0), (1, 0), (0, 10**18)])[0][-1] == (0, 10**18)


def test_repeated_timestamps_ahead_of_all_do_not_fill_the_memory():
    clock_filter = filter_after(2, max_held=5)
    arrivals = [a for t in range(1000, 5000, 10) for a in ((0, t), (1, 99_000 - t % 20))]
    for a in arrivals:
        accepted, _ = run(clock_filter, [a])
        assert [j for j, _ in accepted] == ([0] if a[0] == 0 else [])
        assert len(held(clock_filter)) <= 5


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_networks_of_slow_sensors_lose_no_samples(seed):
    """Sampling intervals may exceed `LIMIT`. A sample is held for at most twice the longest."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    steps = [int(s) for s in rng.uniform(300.0, 3000.0, n)]
    if rng.random() < 0.3:
        steps = [steps[0]] * n
    first = [int(rng.uniform(0, s)) for s in steps]
    arrivals = sorted((t, j) for j in range(n) for t in range(first[j], 40_000, steps[j]))
    clock_filter = ClockStepFilter(n, LIMIT, 10)
    for t, j in arrivals:
        _, rejected = run(clock_filter, [(j, t)])
        assert not rejected
        assert all(t - s <= 2 * max(steps) for _, s in held(clock_filter))


def test_a_clock_step_of_a_slow_sensor_among_fast_ones_is_rejected():
    fast, slow = stream(3, 0, 9000), [(3, t) for t in range(500, 9000, 1000)]
    arrivals = sorted(fast + slow, key=lambda a: a[1])
    assert run(ClockStepFilter(4, LIMIT, 10), arrivals) == (arrivals, [])
    wrong = with_clock_step(arrivals, {3}, 3000, 6000, by=1100)
    passed, rejected = run(ClockStepFilter(4, LIMIT, 10), wrong)
    assert rejected == [(3, t) for t in (4600, 5600, 6600)]
    assert passed == [a for a in wrong if a not in rejected]


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_every_sample_passes_or_is_rejected_once_and_in_order(seed):
    rng = np.random.default_rng(seed)
    n, max_held = int(rng.integers(1, 7)), int(rng.choice([2, 10_000]))
    clock_filter = ClockStepFilter(n, LIMIT, max_held)
    arrived, passed, rejected = [], [], []
    for j, t in wild(rng, n, 600):
        arrived.append((j, sample(t, j)))
        accepted, wrong = clock_filter.feed(*arrived[-1])
        passed, rejected = passed + accepted, rejected + wrong
        newest = max(s.stamp_ns for _, s in passed)
        for i in range(n):
            own = [stamp for k, stamp in held(clock_filter) if k == i]
            assert len(own) <= max_held
            # No sample is held longer than the limit, by the timestamps of any sensor.
            assert not own or min(own) >= own[-1] - LIMIT
        assert all(newest - h[2] <= LIMIT for h in clock_filter.held)
    passed += clock_filter.flush()
    assert held(clock_filter) == []
    order = {id(s): k for k, (_, s) in enumerate(arrived)}
    assert sorted(order[id(s)] for _, s in passed + rejected) == list(range(len(arrived)))
    for i in range(n):
        own = [order[id(s)] for j, s in passed if j == i]
        assert own == sorted(own)
