"""Clocks that step ahead: told from a gap that all had, and never at the cost of the others."""

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.stages.align.clock_step import ClockStepFilter
from support.clock_steps import sample, stepped, stream, wild

LIMIT = 500
"""[ms]; all stamps here are in milliseconds, as if those were nanoseconds."""


def run(ahead, arrivals):
    """([(sensor, stamp)] that passed, the same refused); a stamp may be (true time, stamp)."""
    passed, refused = [], []
    for j, t in arrivals:
        ok, wrong = ahead.feed(j, sample(t, j))
        passed += [(i, s.stamp_ns) for i, s in ok]
        refused += [(i, s.stamp_ns) for i, s in wrong]
    return passed, refused


def held(ahead):
    """[(sensor, stamp)] that wait."""
    return [(h[0], h[1].stamp_ns) for h in ahead.held]


def after(n, until=1000, most=10_000, **kwargs):
    """An `ClockStepFilter` that has seen a quiet stream."""
    ahead = ClockStepFilter(n, LIMIT, most)
    run(ahead, stream(n, 0, until, **kwargs))
    return ahead


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_quiet_streams_pass_at_once(seed):
    """Also late, twice, out of order, with gaps of one sensor and short ones of all."""
    rng = np.random.default_rng(seed)
    n, ahead = int(rng.integers(1, 7)), ClockStepFilter(6, LIMIT, 10)
    gap = 1000 + int(rng.integers(0, LIMIT - 60))
    for t in range(0, 3000, 10):
        for j in range(n):
            late = int(rng.integers(-40, 41))
            if (1000 < t < gap or j == 1 and t > 2000) or rng.random() < 0.1:
                continue
            s = sample(t + late, j)
            assert ahead.feed(j, s) == ([(j, s)], [])
    assert ahead.flush() == []


@pytest.mark.parametrize('step', [10, 100, 1000])
@pytest.mark.parametrize('n', [2, 3, 6])
def test_one_clock_steps_ahead_and_back(n, step):
    arrivals = stepped(stream(n, 0, 20_000, step), {1}, 5000, 12_000, by=1803)
    ahead = ClockStepFilter(n, LIMIT, 10_000)
    passed, refused = run(ahead, arrivals)
    wrong = [a for a, b in zip(arrivals, stream(n, 0, 20_000, step), strict=True) if a != b]
    if n == 2 and step == 1000:
        # Between two readings of the other it is alone for longer than it can be held.
        assert set(refused) <= set(wrong)
        return
    assert refused == wrong and len(wrong) == 7000 / step
    # Of the others nothing waits, so they are in the order in which they came.
    assert passed == [a for a in arrivals if a not in set(wrong)]
    assert held(ahead) == []


@pytest.mark.parametrize('n, step, most_held', [
    (1, 10, 0), (2, 10, 1), (3, 10, 1), (6, 10, 3), (6, 2000, 5)])
def test_when_all_jump_together_nothing_is_refused(n, step, most_held):
    arrivals = stream(n, 0, 3 * step, step) + stream(n, 3 * step + 10_000, 6 * step + 10_000, step)
    ahead, waiting, passed = ClockStepFilter(n, LIMIT, 10_000), 0, []
    for a in arrivals:
        ok, wrong = run(ahead, [a])
        passed += ok
        assert not wrong
        waiting = max(waiting, len(held(ahead)))
    assert passed == arrivals
    assert waiting <= most_held


def test_the_only_living_sensor_jumps():
    ahead = after(3)
    run(ahead, stream(3, 1000, 3000, skip=(1, 2)))
    assert run(ahead, [(0, 9000)]) == ([(0, 9000)], [])


def test_others_that_have_just_died_hold_it_up_for_so_long_only():
    ahead = after(3)
    jump = [(0, t) for t in range(9000, 9600, 10)]
    passed, refused = run(ahead, jump[:50])
    assert passed == refused == []
    assert run(ahead, jump[50:51]) == (jump[:51], [])
    assert run(ahead, jump[51:]) == (jump[51:], [])


@pytest.mark.parametrize('most', [20, 10_000])
def test_others_that_die_while_it_is_ahead_hold_it_up_for_so_long_only(most):
    """Once it was refused for ever, though nobody else was left."""
    ahead = after(6, most=most)
    run(ahead, stepped(stream(6, 1000, 3000), {2}, 1500, 9999, by=1000))
    alone = [(2, t) for t in range(4000, 6000, 10)]
    passed, refused = run(ahead, alone)
    assert passed[-1] == alone[-1] and len(passed) >= 150
    assert set(passed) >= set(alone[50:]) and not set(passed) & set(refused)
    assert held(ahead) == []


@pytest.mark.parametrize('which, right', [({1, 4}, False), ({0, 1, 4}, False),
                                          ({0, 1, 3, 4}, True)])
def test_the_majority_decides(which, right):
    arrivals = stepped(stream(6, 0, 4000), which, 1000, 9999, by=1000)
    ahead = ClockStepFilter(6, LIMIT, 10_000)
    passed, refused = run(ahead, arrivals)
    if right:
        assert not refused and passed != arrivals and sorted(passed) == sorted(arrivals)
        assert held(ahead) == []
    else:
        assert {j for j, _ in refused} == which
        assert {j for j, t in passed if t > 1500} == set(range(6)) - which
        assert len(passed) + len(refused) + len(held(ahead)) == len(arrivals)


def test_who_is_ahead_of_all_does_not_slip_through_when_the_others_jump():
    """Once everything that was held passed with them."""
    ahead = after(4)
    run(ahead, [(3, 100_000)])
    passed, refused = run(ahead, stream(3, 3000, 4000))
    assert passed == stream(3, 3000, 4000)
    assert refused == [(3, 100_000)] and held(ahead) == []


def test_a_clock_that_is_ahead_when_it_is_first_heard():
    """Of two nobody can tell who is right; of more it is the one that came alone."""
    two = ClockStepFilter(2, LIMIT, 10)
    assert run(two, [(0, 0), (1, 5000)]) == ([(0, 0), (1, 5000)], [])
    three = ClockStepFilter(3, LIMIT, 10)
    passed, refused = run(three, [(0, 0), (1, 1), (2, 5000), *stream(2, 10, 1000)])
    assert passed == [(0, 0), (1, 1), *stream(2, 10, 1000)] and refused == [(2, 5000)]


def test_a_sensor_that_is_first_heard_confirms_a_jump():
    ahead = ClockStepFilter(3, LIMIT, 10)
    run(ahead, [(0, 0), (1, 900)])
    assert run(ahead, [(0, 1450)]) == ([], [])
    assert run(ahead, [(2, 1460)]) == ([(0, 1450), (2, 1460)], [])


def test_each_jump_waits_anew():
    ahead = after(2)
    assert run(ahead, [(1, 3000), (1, 990), (1, 4000)]) == ([(1, 990)], [(1, 3000)])


def test_a_stamp_that_nobody_follows_waits_for_so_long_only():
    """It came once from a sensor that then fell silent."""
    ahead = after(3)
    run(ahead, [(1, 2000)])
    passed, refused = run(ahead, stream(3, 1000, 1490, skip=(1,)))
    assert refused == [] and held(ahead) == [(1, 2000)]
    _, refused = run(ahead, stream(3, 1490, 1530, skip=(1,)))
    assert refused == [(1, 2000)] and held(ahead) == []


def test_jumps_just_up_to_the_limit_pass():
    for by, passes in ((LIMIT, True), (LIMIT + 1, False)):
        ahead = ClockStepFilter(2, LIMIT, 10)
        run(ahead, [(0, 0), (1, 0)])
        assert bool(run(ahead, [(0, by)])[0]) == passes
    never = ClockStepFilter(2, inf, 10)
    assert run(never, [(0, 0), (1, 0), (0, 10**18)])[0][-1] == (0, 10**18)


def test_a_sensor_that_stamps_the_same_time_ahead_for_ever_fills_no_memory():
    ahead = after(2, most=5)
    arrivals = [a for t in range(1000, 5000, 10) for a in ((0, t), (1, 99_000 - t % 20))]
    for a in arrivals:
        ok, _ = run(ahead, [a])
        assert [j for j, _ in ok] == ([0] if a[0] == 0 else [])
        assert len(held(ahead)) <= 5


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_networks_of_slow_sensors_lose_nothing(seed):
    """Each slower than the limit, at any phase; nothing waits longer than two of its intervals."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    steps = [int(s) for s in rng.uniform(300.0, 3000.0, n)]
    if rng.random() < 0.3:
        steps = [steps[0]] * n
    first = [int(rng.uniform(0, s)) for s in steps]
    arrivals = sorted((t, j) for j in range(n) for t in range(first[j], 40_000, steps[j]))
    ahead = ClockStepFilter(n, LIMIT, 10)
    for t, j in arrivals:
        _, refused = run(ahead, [(j, t)])
        assert not refused
        assert all(t - s <= 2 * max(steps) for _, s in held(ahead))


def test_a_slow_sensor_beside_fast_ones():
    fast, slow = stream(3, 0, 9000), [(3, t) for t in range(500, 9000, 1000)]
    arrivals = sorted(fast + slow, key=lambda a: a[1])
    assert run(ClockStepFilter(4, LIMIT, 10), arrivals) == (arrivals, [])
    wrong = stepped(arrivals, {3}, 3000, 6000, by=1100)
    passed, refused = run(ClockStepFilter(4, LIMIT, 10), wrong)
    assert refused == [(3, t) for t in (4600, 5600, 6600)]
    assert passed == [a for a in wrong if a not in refused]


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_every_sample_comes_out_once_and_in_order(seed):
    rng = np.random.default_rng(seed)
    n, most = int(rng.integers(1, 7)), int(rng.choice([2, 10_000]))
    ahead = ClockStepFilter(n, LIMIT, most)
    came, passed, refused = [], [], []
    for j, t in wild(rng, n, 600):
        came.append((j, sample(t, j)))
        ok, wrong = ahead.feed(*came[-1])
        passed, refused = passed + ok, refused + wrong
        newest = max(s.stamp_ns for _, s in passed)
        for i in range(n):
            mine = [stamp for k, stamp in held(ahead) if k == i]
            assert len(mine) <= most
            # Nobody waits for longer than the limit by its own stamps, or by those of the others.
            assert not mine or min(mine) >= mine[-1] - LIMIT
        assert all(newest - h[2] <= LIMIT for h in ahead.held)
    passed += ahead.flush()
    assert held(ahead) == []
    order = {id(s): k for k, (_, s) in enumerate(came)}
    assert sorted(order[id(s)] for _, s in passed + refused) == list(range(len(came)))
    for i in range(n):
        mine = [order[id(s)] for j, s in passed if j == i]
        assert mine == sorted(mine)
