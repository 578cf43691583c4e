"""Arrivals and departures of vehicles, distinguished by the two ends of a level change."""

import dataclasses
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from mag_tracking.calibration.blocks import Blocks
from mag_tracking.calibration.level_change import (
    CLEAR_SIZE,
    LevelChange,
    SharedChanges,
    growth_of,
    level_change,
)
from mag_tracking.physics.dipole import dipole_field
from support.calibration_runs import EARTH, SIGMA, feed, running

BLOCK_S = 0.25


@pytest.mark.parametrize('ratio', [4.0, 10.0, 40.0])
def test_growth_of_an_approach_and_of_a_start_agrees_with_theory(ratio):
    """The magnitude is distance^-3 at constant speed, or the square of the time."""
    t = np.linspace(0.0, 1.0, 4001)
    near = ratio**(-1.0 / 3.0)
    # The magnitude grows from slightly below 1 to slightly above the ratio.
    distance = 1.02 - (1.05 - 0.98 * near) * t
    for size, each in ((distance**-3.0, ratio**(1.0 / 12.0)),
                       (1.1 * ratio * t**2, ratio**-0.125)):
        growth = growth_of(t, size, 1.0, ratio)
        assert [a / b for a, b in pairwise(growth)] == pytest.approx([each] * 3, rel=5e-3)
        assert growth[:2].sum() / growth[2:].sum() == pytest.approx(each**2, rel=5e-3)


def test_growth_without_start_or_end_is_not_evaluated():
    t = np.arange(6.0)
    assert growth_of(t, np.array([2.0, 3.0, 4.0, 6.0, 8.0, 20.0]), 1.0, 10.0) is None
    assert growth_of(t, np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0]), 1.0, 10.0) is None


def test_growth_across_a_gap_is_not_evaluated():
    t, size = np.arange(12.0), 0.3 * 1.5**np.arange(12.0)
    no_gap, with_gap = np.arange(12), np.r_[0:4, 7:12]
    quarter = np.log(10.0) / np.log(1.5) / 4.0
    assert growth_of(t[no_gap], size[no_gap], 1.0, 10.0) == pytest.approx([quarter] * 4)
    assert growth_of(t[with_gap], size[with_gap], 1.0, 10.0) is None


def ride(t, at, acceleration, top, stops):
    """Position (n,) [m] along the road of a vehicle that stops or starts at time `at` [s].

    The vehicle accelerates or brakes at a constant rate to or from the speed `top` [m/s].
    """
    elapsed = np.maximum(at - t if stops else t - at, 0.0)
    accelerating = np.minimum(elapsed, top / acceleration)
    distance = 0.5 * acceleration * accelerating**2 + top * (elapsed - accelerating)
    return -distance if stops else distance


def vehicle(seed, stops, at=12.0):
    """Field (3,) [T], as a function of t [s], of a vehicle that stops or starts near a sensor."""
    rng = np.random.default_rng(seed)
    moment = rng.uniform(200.0, 600.0) * _direction(rng)
    stop_position = np.array([rng.uniform(-3.0, 3.0), rng.uniform(3.0, 6.0), 0.5])
    acceleration, top = rng.uniform(1.0, 4.0), rng.uniform(6.0, 14.0)

    def signal(t):
        r = np.array([ride(t, at, acceleration, top, stops), 0.0, 0.0]) + stop_position
        return dipole_field(r, moment)
    return signal


def _direction(rng):
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def blocks_of(signal, seconds, seed=0):
    """`Blocks` of a signal; each block mean has the noise of 25 averaged readings."""
    time = np.arange(0.5 * BLOCK_S, seconds, BLOCK_S)
    noise = np.random.default_rng(seed).standard_normal((len(time), 3)) * SIGMA / 5.0
    mean = np.array([signal(t) for t in time]) + noise
    return Blocks(time, mean, np.zeros((len(time), 3, 3)), np.full((len(time), 3), 25.0))


def evaluated(blocks, n_steady=12):
    before = np.tile(blocks.mean[:6].mean(axis=0), (len(blocks.time), 1))
    return level_change(blocks, n_steady, before, SIGMA, 0.0)


def time_reversed(blocks):
    return blocks._replace(mean=blocks.mean[::-1])


@pytest.mark.parametrize('stops', [True, False])
def test_a_stopping_vehicle_has_arrived_and_a_starting_one_has_departed(stops):
    """A clear change and its time reversal are never both arrivals or both departures."""
    results = []
    for seed in range(80):
        begin, end = (0.0, 16.0) if stops else (8.0, 30.0)
        signal = vehicle(seed, stops)
        blocks = blocks_of(lambda t, s=signal, b=begin: s(t + b), end - begin, seed)
        found, reverse = evaluated(blocks), evaluated(time_reversed(blocks))
        if found.size >= CLEAR_SIZE:
            results.append(found.has_departed)
            assert found.has_departed is None \
                or reverse.has_departed in (None, not found.has_departed)
    assert len(results) > 20
    # A wrong decision is worse than no decision.
    assert results.count(stops) == 0
    assert results.count(not stops) >= 0.9 * len(results)


def queue(seed):
    """Signal of two vehicles that stop one behind the other, and time of the second stop [s]."""
    rng = np.random.default_rng(seed)
    gap, delay = rng.uniform(6.0, 8.0), rng.uniform(1.5, 5.0)
    stop_position = np.array([rng.uniform(-3.0, 3.0), rng.uniform(3.0, 6.0), 0.5])
    cars = [(rng.uniform(200.0, 600.0) * _direction(rng), rng.uniform(1.0, 4.0),
             rng.uniform(6.0, 14.0), 12.0 + k * delay, stop_position - [k * gap, 0.0, 0.0])
            for k in range(2)]

    def signal(t):
        return sum(dipole_field(np.array([ride(t, at, a, top, True), 0.0, 0.0]) + final, moment)
                   for moment, a, top, at, final in cars)
    return signal, 12.0 + delay


@pytest.mark.parametrize('case', ['queue', 'reverse'])
def test_a_queue_or_a_reversing_vehicle_has_not_departed(case):
    """At most one of 50 runs yields a departure.

    The change is evaluated whenever the latest two seconds are steady.
    """
    n_departed, n_arrived = 0, 0
    for seed in range(50):
        signal, end = queue(seed) if case == 'queue' else reverse(seed)
        blocks = blocks_of(signal, end + 8.0, seed)
        results = set()
        for k in range(round(14.0 / BLOCK_S), len(blocks.time)):
            past_blocks = Blocks(*(values[:k] for values in blocks))
            latest = past_blocks.mean[-8:]
            if (np.abs(latest - latest.mean(axis=0)) < 2.0 * SIGMA).all():
                results.add(evaluated(past_blocks, 8).has_departed)
        n_departed, n_arrived = n_departed + (True in results), n_arrived + (False in results)
    assert n_departed <= 1 and n_arrived > 20


def reverse(seed):
    """Signal of a vehicle that overshoots by 6 m, waits 1 s and reverses; time of its stop [s]."""
    rng = np.random.default_rng(seed)
    moment = rng.uniform(200.0, 600.0) * _direction(rng)
    stop_position = np.array([rng.uniform(-3.0, 3.0), rng.uniform(3.0, 6.0), 0.5])

    def signal(t):
        x = 6.0 + ride(t, 12.0, 2.0, 8.0, True) if t < 12.0 \
            else 6.0 - min(max(t - 13.0, 0.0), 6.0)
        return dipole_field(np.array([x, 0.0, 0.0]) + stop_position, moment)
    return signal, 19.0


def test_a_step_a_ramp_and_a_small_change_are_not_decided():
    def ramp(t, length=2.0, size=1e-6):
        return size * np.clip((t - 6.0) / length, 0.0, 1.0) * np.ones(3)
    for signal in (lambda t: ramp(t, 1e-3), ramp, lambda t: 1e-3 * vehicle(0, True)(t)):
        assert evaluated(blocks_of(signal, 16.0)).has_departed is None


def test_a_change_that_is_not_clear_is_decided_by_a_clear_one():
    shared = SharedChanges()
    weak = LevelChange(100.0, 0.5 * CLEAR_SIZE, False)
    strong = LevelChange(101.0, 2.0 * CLEAR_SIZE, True)
    assert shared.evaluate_change(0, weak) is False
    assert shared.evaluate_change(1, strong) is True
    assert shared.evaluate_change(0, weak) is True
    # A change at another time has no effect, and a clear change is evaluated alone.
    assert shared.evaluate_change(0, dataclasses.replace(weak, since=90.0)) is False
    assert shared.evaluate_change(2, dataclasses.replace(
        strong, size=1.5 * CLEAR_SIZE, has_departed=False)) is False


def is_clear(seed):
    """Whether the field of the standing vehicle is a clear change, with a margin."""
    field = vehicle(seed, stops=True, at=0.0)(1.0)
    return np.linalg.norm(field / SIGMA) > 1.2 * CLEAR_SIZE


CLEAR = [seed for seed in range(20) if is_clear(seed)][:4]


@pytest.mark.parametrize('seed', CLEAR)
@pytest.mark.parametrize('rate', [100.0, 20.0])
def test_a_departed_vehicle_is_removed_from_the_background_in_seconds(seed, rate):
    """At the replacement, the vehicle is at least 30 m away, and its field is below the noise.

    At 20 Hz, with blocks of 0.4 s, the replacement takes a second longer.
    """
    signal = vehicle(seed, stops=False, at=15.0)
    b = running()
    b.sensors['first_ns'] = 0
    end = 22.5 if rate == 100.0 else 23.5
    feed(b, np.arange(0.0, end, 1.0 / rate), signal=signal)
    assert b.n_relearnt == 1 and (np.abs(b.level(end) - EARTH - signal(end)) < 2.0 * SIGMA).all()
    # All readings with the replaced background are doubtful, later readings are not.
    (begin, end_ns), = b.doubtful_times
    assert 0 < begin < 1e9 and end_ns is not None and not b.doubtful
    assert b.departed_at == pytest.approx(19.5, abs=2.5)


@pytest.mark.parametrize('seed', CLEAR)
def test_a_vehicle_at_a_red_light_does_not_become_the_background(seed):
    """The background is not doubtful, although it was measured for only a few seconds."""
    b = running(relearn=120.0)
    feed(b, np.arange(0.0, 70.0, 0.02), signal=vehicle(seed, stops=True, at=12.0))
    assert b.frozen and not b.n_relearnt and not b.doubtful and b.departed_at is None


def test_one_axis_is_sufficient_and_a_missing_axis_causes_no_delay():
    signal = vehicle(CLEAR[0], stops=False, at=15.0)
    one_axis, two_axes = running(), running()
    rng = np.random.default_rng(0)
    for t in np.arange(0.0, 24.0, 0.01):
        field = EARTH + signal(t) + SIGMA * rng.standard_normal(3)
        one_axis.add(t, np.where(np.arange(3) == 1, field, np.nan))
        two_axes.add(t, np.where((np.arange(3) == 2) & (t > 14.0), np.nan, field))
    assert one_axis.n_relearnt == two_axes.n_relearnt == 1
    assert np.abs(one_axis.level(24.0) - EARTH)[1] < SIGMA[1]
    assert (np.abs(two_axes.level(24.0) - EARTH) < SIGMA)[:2].all()


def test_a_change_before_a_backward_time_jump_is_not_used():
    shared = SharedChanges()
    b = running(evaluate_change=partial(shared.evaluate_change, 1))
    shared.evaluate_change(1, LevelChange(100.0, 2.0 * CLEAR_SIZE, True))
    b.forget()
    assert shared.evaluate_change(0, LevelChange(100.0, 1.0, None)) is None


def test_a_given_background_is_not_replaced_after_a_departure():
    signal = vehicle(CLEAR[0], stops=False, at=15.0)
    b = running(background=EARTH + signal(0.0), noise_std=SIGMA)
    feed(b, np.arange(0.0, 22.5, 0.01), signal=signal)
    assert b.n_relearnt == 0
