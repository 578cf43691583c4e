"""A device's clock against lines whose truth is known; limits from the laws of the delays."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from mag_tracking.drivers.device_clock import (
    LOST,
    NO_FIT,
    NO_TICKS,
    OUT_OF_RANGE,
    RESET,
    STEP_BACK,
    STEP_FORWARD,
    ArrivalClock,
    ClockSettings,
    DeviceClock,
)
from mag_tracking.drivers.lower_line import likely_slopes, lower_hull
from mag_tracking.errors import SettingsError
from mag_tracking.settings import replace

MHZ = {'tick_s': 1e-6, 'wrap': 2**32}
SMALL = {'tick_s': 1e-4, 'wrap': 2**16}
START = 5 * 86400 * 10**9


def clock_of(**changes):
    return DeviceClock(replace(ClockSettings(), changes))


def stamps_of(clock, ticks, arrival):
    """Stamps as float, NaN where there is none."""
    out = [clock.stamp(*p) for p in zip(ticks.tolist(), arrival.tolist(), strict=True)]
    return np.array([math.nan if s is None else s for s in out])


def exponential(mean):
    return lambda rng, t: rng.exponential(mean, len(t))


def timer(rng, t, period=0.016):
    return np.ceil(t / period) * period - t


def stalls(rng, t):
    return rng.exponential(1e-3, len(t)) + 0.2 * (rng.random(len(t)) < 0.01)


def constant(rng, t):
    return np.full(len(t), 2e-3)


def measured(rng, seconds, rate=100.0, ppm=0.0, wander_ppm=0.0, counter=MHZ, first=4_294_000_000,
             irregular=1.0):
    """(ticks as the device would count without end, time of each [s]); of any phase."""
    n = int(seconds * rate)
    d = (np.arange(n) + irregular * rng.random(n)) / rate
    count = np.floor(d / counter['tick_s']).astype(np.int64)
    d = count * counter['tick_s']
    w = 2.0 * math.pi / 600.0
    return count + first, d * (1.0 + 1e-6 * ppm) + 1e-6 * wander_ppm / w * (1.0 - np.cos(w * d))


def arrivals(rng, t, delay):
    """Arrival [ns]; no message overtakes another."""
    came = np.maximum.accumulate(t + delay(rng, t))
    return START + np.round(came * 1e9).astype(np.int64)


def errors_of(stamps, t):
    return stamps - (START + np.round(t * 1e9))


def simulate(seed=0, delay=None, seconds=100.0, rate=100.0, counter=MHZ, **kwargs):
    """(ticks, arrival [ns], time [s]) of a device on a line, by default exponential of 2 ms."""
    rng = np.random.default_rng(seed)
    count, t = measured(rng, seconds, rate, counter=counter, **kwargs)
    return count % counter['wrap'], arrivals(rng, t, delay or exponential(2e-3)), t


# name: delay, its density at zero as the mean of an exponential [s], part of the messages that
# come by it, wander [ppm], counter, part lost.
LINES = {
    'constant': (constant, 0.0, 1.0, 0.0, MHZ, 0.0),
    'exponential 2 ms': (exponential(2e-3), 2e-3, 1.0, 0.0, MHZ, 0.0),
    'exponential, 16 bit': (exponential(2e-3), 2e-3, 1.0, 0.0, SMALL, 0.0),
    'exponential, 20 % lost': (exponential(2e-3), 2e-3, 0.8, 0.0, MHZ, 0.2),
    'timer of 16 ms': (timer, 16e-3, 1.0, 0.0, MHZ, 0.0),
    # Of 100 Hz a stall begins at every hundredth and holds up the 20 after it.
    'stalls of 200 ms': (stalls, 1e-3, 1.0 / 1.2, 0.0, MHZ, 0.0),
    'wander of 2 ppm': (exponential(2e-3), 2e-3, 1.0, 2.0, MHZ, 0.0),
    'wander, constant': (constant, 0.0, 1.0, 2.0, MHZ, 0.0)}


def law(mean, rate, wander_ppm, begin, end, z):
    """Limit [s] of the error at the newest end of a line after `begin` .. `end` s.

    No point lies between the line and the truth. A line that is off by x at the end and
    not too low in the middle leaves a triangle of x T / 4 empty, which holds z = rate / mean
    x T / 4 points on average: P = exp(-z), for the two-dimensional family of lines times
    1 + z + z^2 / 2. Taking a slope about as likely lowers it by another mean / (rate T), twice
    at the end. What bends by f' is off from its chord or tangent by b = f' T^2 / 8, and by 17/16
    squared of it at the end of a block that is a 32nd of T. The median height above the tangent
    is b / 4: slopes that are lower by b / 4 / log(2) / 32 in the middle, and differ by as much as
    a bend lets them, are off by T / 2 sqrt(2 f' b / (128 log(2))) = 0.21 b.
    """
    bend = 2e-6 * math.pi / 600.0 * wander_ppm * min(end, 120.0)**2 / 8.0
    return (4.0 * z + 2.0) * mean / (rate * begin) + (1.13 + 0.21) * bend + 4e-9


@pytest.mark.parametrize('line', LINES)
def test_accuracy_is_that_of_the_law(line):
    delay, mean, part, wander, counter, lost = LINES[line]
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        count, t = measured(rng, 120.0, ppm=(100.0, -100.0, 7.0)[seed % 3], wander_ppm=wander,
                            counter=counter, first=(0, 4_290_000_000)[seed % 2])
        arrival = arrivals(rng, t, delay)
        fixed = 2e-3 if delay is constant else 0.0
        keep = rng.random(len(t)) >= lost
        clock = clock_of(min_delay_s=fixed, **counter)
        e = np.full(len(t), math.nan)
        e[keep] = errors_of(stamps_of(clock, count[keep] % counter['wrap'], arrival[keep]), t[keep])
        assert not clock.counts and not clock.restarts
        errors.append(e)
    row, within = f'{line:24}', True
    for begin, end in ((10, 20), (60, 120)):
        e = np.array(errors)[:, begin * 100:end * 100] * 1e-9
        rms, worst = np.sqrt(np.nanmean(e**2)), np.nanmax(np.abs(e))
        # The mean square of what is beyond z with (1 + z + z^2 / 2) exp(-z) is 12; z = 12: 5e-4.
        limits = [law(mean, 100.0 * part, wander, begin, end, z) for z in (math.sqrt(12.0), 12.0)]
        row += (f' | after {begin} s: rms {rms * 1e6:7.3f} us of {limits[0] * 1e6:7.3f},'
                f' worst {worst * 1e6:7.3f} of {limits[1] * 1e6:7.3f}')
        within &= rms < limits[0] and worst < limits[1]
    print(row)
    assert within, row


def test_what_beats_with_a_timer_is_known_to_the_step_of_the_beat():
    # 10 ms and 16 ms have steps of 2 ms, and no statistics help.
    ticks, arrival, t = simulate(delay=timer, irregular=0.0)
    e = errors_of(stamps_of(clock_of(), ticks, arrival), t)[1000:]
    assert np.abs(e).max() <= 2e6 + 1


def test_line_is_that_of_a_linear_programme():
    rng = np.random.default_rng(5)
    for _ in range(20):
        n = int(rng.integers(5, 60))
        x = np.sort(rng.random(n)) * 100.0
        y = 0.3 * x + rng.exponential(2.0, n)
        A = np.column_stack([np.ones(n), x - x.mean()])
        best = linprog([-1.0, 0.0], A, y, bounds=(None, None))
        points = list(zip(x, y, strict=True))
        low, high = likely_slopes(points)
        assert low <= best.x[1] + 1e-9 and best.x[1] <= high + 1e-9
        above = np.sort(y - A @ best.x)[2:]
        room = above[len(above) // 2] / math.log(2.0) / n
        # The interval ends where the highest line of that slope is lower by just the room.
        for slope in (low, high):
            assert best.x[0] - np.min(y - slope * (x - x.mean())) == pytest.approx(room, rel=1e-6)


@given(st.lists(st.tuples(st.integers(0, 12), st.integers(-9, 9)), min_size=1, max_size=12))
@settings(derandomize=True, deadline=None)
def test_hull_is_convex_and_below_every_point(points):
    points.sort()
    hull = lower_hull(points)
    assert hull[0] == points[0] and hull[-1][0] == points[-1][0] and set(hull) <= set(points)
    wide = [p for i, p in enumerate(hull) if i == 0 or p[0] > hull[i - 1][0]]
    slopes = np.diff([y for _, y in wide]) / np.diff([x for x, _ in wide])
    assert (np.diff(slopes) > 0.0).all()
    at = np.interp([x for x, _ in points], *zip(*wide, strict=True))
    assert (at <= np.array([y for _, y in points]) + 1e-9).all()


DELAYS = st.lists(st.integers(0, 50_000_000), min_size=2, max_size=120)


def sequence(delays, period_ms=20, ppm=10.0):
    """(ticks, arrival [ns], time [ns]) of messages that overtake each other."""
    ticks = [1000 * period_ms * i for i in range(len(delays))]
    time = [round(1000 * t * (1.0 + 1e-6 * ppm)) for t in ticks]
    return ticks, [a + d for a, d in zip(time, delays, strict=True)], time


@given(DELAYS, st.integers(-2**62, 2**62), st.integers(1, 500))
@settings(derandomize=True, deadline=None)
def test_later_arrivals_are_later_stamps(delays, shift, period_ms):
    ticks, arrival, _ = sequence(delays, period_ms)
    one, two = clock_of(window_s=2.0), clock_of(window_s=2.0)
    for t, a in zip(ticks, arrival, strict=True):
        assert two.stamp(t, a + shift) == one.stamp(t, a) + shift


@given(DELAYS, st.integers(1, 500))
@settings(derandomize=True, deadline=None)
def test_stamps_go_back_by_no_more_than_the_line_moves(delays, period_ms):
    """By the spread of the delays, and by twice the most drift over what is remembered."""
    ticks, arrival, time = sequence(delays, period_ms)
    clock = clock_of(window_s=2.0, max_drift_ppm=20.0)
    stamps = [clock.stamp(*p) for p in zip(ticks, arrival, strict=True)]
    steps = np.diff(stamps) - np.diff(time)
    # What is remembered: the window and the blocks at its ends, one of which is one period.
    remembered = 2.0 * (1.0 + 2.0 / 64.0) * 1e9 + 2e6 * period_ms
    assert (steps >= min(delays) - max(delays) - 2.0 * 30e-6 * remembered - 2.0).all()


@given(st.lists(st.tuples(st.one_of(st.none(), st.floats(), st.integers(-10, 2**33)),
                          st.integers(0, 10**10)), max_size=60),
       st.sampled_from([0, 2**16, 2**32]))
@settings(derandomize=True, deadline=None)
def test_whatever_comes_is_stamped_in_the_past_or_counted(readings, wrap):
    clock = clock_of(wrap=wrap, tick_s=1e-4, min_delay_s=0.25)
    stamps = [clock.stamp(*r) for r in readings]
    assert sum(s is None for s in stamps) == clock.counts.total()
    assert all(s <= a - 250_000_000
               for s, (_, a) in zip(stamps, readings, strict=True) if s is not None)


def test_without_random_delays_differences_are_those_of_the_counter():
    clock = clock_of(min_delay_s=0.01)
    ticks = np.cumsum(np.random.default_rng(0).integers(1, 20_000, 3000))
    stamps = [clock.stamp(int(t), START + 1000 * int(t)) for t in ticks]
    assert stamps == [START + 1000 * int(t) - 10_000_000 for t in ticks]


def test_diagnostics_are_those_of_the_line():
    for seed, ppm in enumerate((80.0, -33.0)):
        ticks, arrival, t = simulate(seed, ppm=ppm)
        clock = clock_of()
        assert math.isnan(clock.drift_ppm + clock.spread_s) and math.isnan(clock.stamp_std)
        e = errors_of(stamps_of(clock, ticks, arrival), t)
        # Off by z = 12 at both ends.
        assert abs(clock.drift_ppm - ppm) < 2e6 * law(2e-3, 100.0, 0.0, 100.0, 100.0, 12.0) / 100.0
        # Of 256 exponential delays, 95 in 100 are below 3 means, give or take 4 deviations.
        p = 0.95 + np.array([-4.0, 4.0]) * math.sqrt(0.05 * 0.95 / 256)
        low, high = -2e-3 * np.log(1.0 - np.minimum(p, 0.999))
        assert low < clock.spread_s < high
        # The least of 188 delays in a block of 1.875 s; nine in ten are below 2.3 means.
        assert clock.stamp_std == pytest.approx(2.3 * 2e-3 / 188, rel=0.5)
        assert np.abs(e[3000:]).max() * 1e-9 < clock.stamp_std


def test_stated_error_holds_where_the_drift_wanders():
    rng = np.random.default_rng(1)
    count, t = measured(rng, 900.0, 10.0, wander_ppm=2.0)
    clock, errors, stated = clock_of(wrap=0), [], []
    for c, a, true in zip(count.tolist(), arrivals(rng, t, constant).tolist(), t, strict=True):
        errors.append(clock.stamp(c, a) - START - true * 1e9 - 2e6)
        stated.append(clock.stamp_std * 1e9)
    e, s = np.array(errors[300:]), np.array(stated[300:])
    assert np.sqrt(np.mean(e**2)) < np.sqrt(np.mean(s**2)) < 3.0 * np.sqrt(np.mean(e**2))


def test_thirty_days_of_a_counter_of_a_megahertz():
    """Seventeen minutes in each day; the counter goes round 20 times in each silence."""
    clock = clock_of(min_delay_s=2e-3)
    day = 86_400_000_000
    for i in range(31):
        ticks = i * day + np.arange(0, 1000_000_000, 500_000)
        # 30 ppm, exactly.
        time = [START + 1000 * int(t) + 3 * int(t) // 100 for t in ticks]
        e = np.array([clock.stamp(int(t) % 2**32, s + 2_000_000) - s
                      for t, s in zip(ticks, time, strict=True)])
        # Over a day the drift is known by two nanoseconds in the window.
        assert np.abs(e[:4]).max() < (1e9 if i == 0 else 2.0 / 120.0 * 86400.0)
        assert np.abs(e[100:]).max() < 4
    assert not clock.counts and not clock.restarts


def test_messages_lost_over_several_turns_of_the_counter():
    ticks, arrival, t = simulate(seconds=200.0, counter=SMALL, ppm=60.0)
    lost = ((t > 30.0) & (t < 75.0)) | ((t > 80.0) & (t < 83.3))
    clock = clock_of(**SMALL)
    e = errors_of(stamps_of(clock, ticks[~lost], arrival[~lost]), t[~lost])
    assert np.abs(e[1000:]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 10.0, 10.0, 12.0)
    assert not clock.counts and not clock.restarts


def wait_of(rate):
    """Readings that a restart may cost: two tolerances (0.1 s and twice 95 % of the delays)."""
    return 2.0 * (0.1 + 2.0 * 4.0 * 2e-3) * rate + 3


@pytest.mark.parametrize('change, cause, counter', [
    (1.0, STEP_FORWARD, MHZ), (-1.0, STEP_BACK, MHZ), ('late', RESET, MHZ), ('at once', RESET, MHZ),
    (1.0, STEP_FORWARD, SMALL), (-1.0, STEP_BACK, SMALL)])
def test_a_clock_that_steps_begins_anew(change, cause, counter):
    ticks, arrival, t = simulate(counter=counter, ppm=50.0)
    after = t > 50.0
    if cause == RESET:
        keep = ~after | (t > 51.2) | (change == 'at once')
        ticks, arrival, t, after = ticks[keep], arrival[keep], t[keep], after[keep]
        # It may have begun before its last reading came.
        ticks[after] = (ticks[after] - ticks[after][0] + 40_000) % counter['wrap']
    else:
        ticks[after] = (ticks[after] + round(change / counter['tick_s'])) % counter['wrap']
    clock = clock_of(**counter)
    e = errors_of(stamps_of(clock, ticks, arrival), t)
    assert clock.restarts == {cause: 1} and clock.counts == {NO_FIT: np.isnan(e).sum()}
    k = int(np.argmax(after))
    # The new clock's first message came by chance as late as any.
    assert not np.isnan(e[:k]).any() and np.isnan(e[k:]).sum() <= wait_of(100.0)
    new = e[k:][~np.isnan(e[k:])]
    assert np.abs(new[:50]).max() * 1e-9 < 12.0 * 2e-3
    # What is known of the drift remains: 10 s later it is good already.
    assert np.abs(new[1000:]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 10.0, 10.0, 12.0)


@pytest.mark.parametrize('reset, cause', [(False, STEP_BACK), (True, RESET)])
def test_a_step_back_in_a_silence_is_taken_for_a_queue_at_first(reset, cause):
    """A counter that stood still for 0.3 s, or a small one that began anew."""
    ticks, arrival, t = simulate(counter=SMALL, first=3 if reset else 4_294_000_000)
    keep = (t < 45.5) | (t > 47.9)
    ticks, arrival, t, after = ticks[keep], arrival[keep], t[keep], t[keep] > 47.9
    # 47.9 s are 7 turns and 2 s.
    late = (ticks[after][0] - 5) * 1e-4 if reset else 0.3
    ticks[after] = (ticks[after] - round(late * 1e4)) % 2**16
    # Once the drift is known, what it might have been excuses nothing.
    clock = clock_of(max_drift_ppm=5000.0, **SMALL)
    e = errors_of(stamps_of(clock, ticks, arrival), t)
    assert clock.restarts == {cause: 1} and not clock.counts
    # For max_delay_s it is believed to be a queue.
    assert np.abs(e[(t > 47.9) & (t < 52.8)] + late * 1e9).max() < 1e6
    assert np.abs(e[t > 58.2]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 5.0, 5.0, 12.0)


@pytest.mark.parametrize('sensors', [1, 3])
def test_a_wrong_device_time_now_and_then_does_no_harm(sensors):
    """Of any size, or early by a digit: each gets no time, and the others get the same."""
    ticks, arrival, t = (np.repeat(a, sensors) for a in simulate(seconds=60.0))
    rng = np.random.default_rng(2)
    wrong = np.repeat(rng.random(len(t) // sensors) < 0.02, sensors) & (t > 6.0)
    bad = ticks.copy()
    bad[wrong] = np.repeat(np.where(rng.random(len(t) // sensors) < 0.5, ticks[::sensors] + 30_000,
                                    rng.integers(0, 2**32, len(t) // sensors)),
                           sensors)[wrong] % 2**32
    clock = clock_of()
    stamps = stamps_of(clock, bad, arrival)
    assert wrong.sum() > 50 * sensors and not clock.restarts
    assert clock.counts == {NO_FIT: wrong.sum()} and np.isnan(stamps[wrong]).all()
    right = stamps_of(clock_of(), ticks[~wrong], arrival[~wrong])
    assert np.array_equal(stamps[~wrong], right)


def test_of_two_clocks_in_turn_the_first_goes_on():
    ticks, arrival, t = simulate(seconds=300.0)
    other = (ticks + 777_000_000) % 2**32
    clock = clock_of()
    clock.stamp(int(ticks[0]), int(arrival[0]))
    both = np.column_stack([ticks, other]).ravel()[1:]
    stamps = stamps_of(clock, both, np.repeat(arrival, 2)[1:])
    assert np.isnan(stamps[::2]).all() and clock.counts == {NO_FIT: len(t)}
    assert np.nanmax(np.abs(errors_of(stamps[1999::2], t[1000:]))) < 1e5 and not clock.restarts


def test_two_clocks_by_the_second_are_many_restarts_and_nothing_worse():
    ticks, arrival, t = simulate(seconds=200.0)
    ticks[t % 2.0 > 1.0] += 777_000_000
    clock = clock_of()
    stamps = stamps_of(clock, ticks % 2**32, arrival)
    assert 150 <= clock.restarts.total() <= 199 and set(clock.restarts) == {STEP_FORWARD, STEP_BACK}
    assert np.isnan(stamps).sum() == clock.counts[NO_FIT] <= 200 * wait_of(100.0)


def test_a_queue_that_empties_is_no_new_clock():
    """The machine stood still for 12 s, then reads all at once."""
    ticks, arrival, t = simulate()
    stalled = (t > 40.0) & (t < 52.0)
    arrival[stalled] = START + 52 * 10**9
    clock = clock_of()
    e = errors_of(stamps_of(clock, ticks, arrival), t)
    assert clock.counts == {NO_FIT: ((t > 40.0) & (t < 47.0)).sum()} and not clock.restarts
    assert np.nanmax(np.abs(e[1000:])) * 1e-9 < law(2e-3, 100.0, 0.0, 10.0, 10.0, 12.0)


def test_a_port_that_was_opened_late_gives_a_heap_at_first():
    ticks, arrival, t = simulate()
    arrival = np.maximum(arrival, START + 3 * 10**9)
    clock = clock_of()
    e = errors_of(stamps_of(clock, ticks, arrival), t)
    assert not clock.counts and not clock.restarts
    # At the least the quickest since then counts, with the most drift.
    assert np.abs(e[400:]).max() < 2e6 + 500e-6 * 10e9
    assert np.abs(e[2000:]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 15.0, 15.0, 12.0)


@pytest.mark.parametrize('change_ms', [10.8, -10.8])
@pytest.mark.parametrize('back, restarts', [(0.0, {}), (30.0, {LOST: 1})])
def test_a_cable_that_was_out_for_an_hour(change_ms, back, restarts):
    """Meanwhile the drift changes by 3 ppm, and perhaps the clock steps by half a minute."""
    ticks, arrival, t = simulate(seed=3, seconds=200.0, ppm=40.0)
    hour = 3600 * 10**9 + round(change_ms * 1e6)
    out = t > 100.0
    arrival[out] += hour
    ticks[out] += round(3.6e9 / (1.0 + 40e-6) - back * 1e6)
    clock = clock_of()
    e = errors_of(stamps_of(clock, ticks % 2**32, arrival), t) - out * hour
    assert clock.restarts == restarts and np.isnan(e).sum() == clock.counts[NO_FIT]
    assert clock.counts[NO_FIT] <= (wait_of(100.0) if restarts else 0)
    after = e[out][~np.isnan(e[out])]
    # At first by the drift from before; a block and a few messages later by what comes.
    assert np.abs(after[:20]).max() < 24e6 and np.abs(after[50:]).max() < 2e6
    assert np.abs(after[1000:]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 10.0, 10.0, 12.0)


def test_a_step_in_a_minute_of_silence_is_a_step():
    ticks, arrival, t = simulate()
    out = t > 50.0
    arrival[out] += 60 * 10**9
    ticks[out] += 70_000_000
    clock = clock_of()
    stamps_of(clock, ticks % 2**32, arrival)
    assert clock.restarts == {STEP_FORWARD: 1}


def test_three_device_times_confirm_a_new_clock_however_slow_it_is():
    """Three sensors, read every 10 s, of an oscillator that is 3 % off."""
    clock, out = clock_of(max_drift_ppm=50_000.0, window_s=600.0), []
    for i in range(100):
        # After the step the first two come a second late.
        d = 10.0 * i
        arrival = START + round((1.03 * d + (i in (62, 63))) * 1e9)
        ticks = round((d + 777.0 * (i >= 60)) * 1e6)
        out += [clock.stamp(ticks, arrival) for _ in range(3)]
        if i in (59, 62):
            assert math.isnan(clock.stamp_std) == (i == 62)
    assert [i for i, s in enumerate(out) if s is None] == list(range(180, 186))
    assert clock.restarts == {STEP_FORWARD: 1}
    assert clock.drift_ppm == pytest.approx(30_000.0, abs=0.1)
    assert out[-1] == START + round(1.03 * 990.0 * 1e9)


def test_what_agrees_with_nothing_waits_for_three():
    clock = clock_of(window_s=10.0)
    out = [clock.stamp(ticks, START + 20 * i * 10**9)
           for i, ticks in enumerate((0, 20_000_000, 3_000_000_000, 2_000_000_000, 900_000_000))]
    assert [s is None for s in out] == [False, False, True, True, False]
    assert clock.restarts == {LOST: 1}


def test_a_counter_that_runs_backwards_is_believed_for_the_least_step():
    clock = clock_of()
    for i in range(1000):
        clock.stamp(10_000 * i, START + 10_000_000 * i)
    out = [clock.stamp(9_990_000 - 10_000 * i, START + 9_990_000_000 + 10_000_000 * i)
           for i in range(1, 100)]
    assert [s is None for s in out] == [i > 10 for i in range(1, 100)]


def test_a_queue_at_the_beginning_is_no_delay():
    """Two seconds late for the first three, then dropped."""
    ticks, arrival, t = simulate()
    late = t < 3.0
    arrival[late] += 2 * 10**9
    clock = clock_of()
    e = errors_of(stamps_of(clock, ticks[late | (t > 5.0)], arrival[late | (t > 5.0)]),
                  t[late | (t > 5.0)])
    assert not clock.counts and not clock.restarts
    assert np.abs(e[3000:]).max() * 1e-9 < law(2e-3, 100.0, 0.0, 20.0, 20.0, 12.0)


def test_drift_of_hours_does_not_add_up_to_a_turn():
    """400 ppm over three hours are 4.3 s; half a turn is 3.3 s."""
    clock = clock_of(**SMALL)
    for i in range(10_800):
        time = START + round(i * 1.0004e9)
        assert abs(clock.stamp(i * 10_000 % 2**16, time) - time) < (2e6 if i < 60 else 4)


def test_blocks_of_one_message_of_which_every_other_is_overtaken():
    """Every other message comes 20 ms later and is overtaken; each is a block of its own."""
    clock = clock_of(window_s=1.0)
    came = sorted((round(1.0003e7 * i) + 20_000_000 * (i % 2), i) for i in range(400))
    e = [clock.stamp(10_000 * i, START + a) - START - 1.0003e7 * i for a, i in came]
    assert np.abs(e[100:]).max() < 10.0


def test_points_of_one_device_time_have_no_slope():
    """Only if even arrivals are out of order."""
    clock = clock_of(window_s=1.0)
    for i in range(1, 20):
        clock.stamp(2000 * i, START + 60_000_000 + 2_000_000 * i)
        assert clock.stamp(20, START) == START
    assert clock.drift_ppm == 0.0 or math.isnan(clock.drift_ppm)


@pytest.mark.parametrize('early_us', [900, 1200])
def test_a_message_is_believed_if_early_by_a_millisecond(early_us):
    clock = clock_of(max_drift_ppm=1.0)
    for i in range(1000):
        clock.stamp(10_000 * i, START + 10_000_000 * i)
    stamp = clock.stamp(10_000_000, START + 10_000_000_000 - 1000 * early_us)
    assert (stamp is None) == (early_us > 1000)


def test_stamps_are_rounded():
    clock = clock_of(tick_s=1e-10, wrap=0)
    assert clock.stamp(0, START) == START
    assert [clock.stamp(4, START + 10), clock.stamp(6, START + 10)] == [START, START + 1]


def test_messages_that_overtake_each_other_are_fine():
    rng = np.random.default_rng(4)
    count, t = measured(rng, 60.0)
    came = START + np.round((t + rng.exponential(20e-3, len(t))) * 1e9).astype(np.int64)
    order = np.argsort(came)
    clock = clock_of()
    e = errors_of(stamps_of(clock, count[order] % 2**32, came[order]), t[order])
    assert not clock.counts and not clock.restarts
    assert np.abs(e[2000:]).max() * 1e-9 < law(20e-3, 100.0, 0.0, 20.0, 20.0, 12.0)


def test_delays_of_seconds_are_no_steps():
    for rate in (100.0, 1.0):
        ticks, arrival, t = simulate(delay=exponential(0.3), seconds=30_000.0 / rate, rate=rate)
        clock = clock_of()
        stamps_of(clock, ticks, arrival)
        assert not clock.counts and not clock.restarts


@pytest.mark.parametrize('part', [1.0, 0.3])
def test_a_line_that_becomes_quicker_is_believed(part):
    """From 52 ms to 2 ms, for all messages or for some of them."""
    rng = np.random.default_rng(6)
    count, t = measured(rng, 100.0, irregular=0.0)
    slow = (t < 50.0) | (rng.random(len(t)) > part)
    came = START + np.round((t + 2e-3 + 50e-3 * slow) * 1e9).astype(np.int64)
    order = np.argsort(came, kind='stable')
    clock = clock_of(min_delay_s=2e-3)
    e = errors_of(stamps_of(clock, count[order] % 2**32, came[order]), t[order])
    assert clock.restarts == {STEP_FORWARD: 1} and clock.counts[NO_FIT] <= wait_of(100.0)
    assert np.abs(e[6000:]).max() < 1e3


def test_random_numbers_begin_anew_now_and_then_only():
    ticks, arrival, t = simulate(seconds=1000.0, rate=20.0, first=0)
    random = t > 20.0
    ticks[random] = np.random.default_rng(0).integers(0, 2**60, random.sum())
    clock = clock_of(wrap=0)
    stamps_of(clock, ticks, arrival)
    # 980 s, whenever nothing has fitted for window_s.
    assert clock.restarts.total() == 8
    assert clock.counts == {NO_FIT: random.sum() - 8}


def test_memory_does_not_grow():
    ticks, arrival, _ = simulate(seconds=600.0, rate=50.0)
    clock, sizes = clock_of(), []
    for part in np.array_split(np.column_stack([ticks, arrival]), 5):
        stamps_of(clock, *part.T)
        sizes.append(len(pickle.dumps(clock)))
    assert sizes[-1] < 1.2 * sizes[1] and sizes[-1] < 10_000


def test_what_cannot_be_a_count_has_no_time():
    clock = clock_of(**SMALL)
    for ticks in (2**16, 1e9, -1, math.nan, math.inf, -math.inf):
        assert clock.stamp(ticks, START) is None
    assert clock.stamp(None, START) is None
    assert clock.counts == {OUT_OF_RANGE: 6, NO_TICKS: 1} and not clock.restarts
    assert clock.stamp(2**16 - 1, START) == START
    assert clock_of(wrap=0).stamp(math.inf, START) is None


def test_without_a_counter_it_is_the_arrival():
    clock = ArrivalClock(replace(ClockSettings(), {'min_delay_s': 0.004}))
    assert clock.stamp(None, START) == clock.stamp(77, START) == START - 4_000_000
    assert not clock.counts and not clock.restarts
    assert math.isnan(clock.drift_ppm) and math.isnan(clock.spread_s)
    assert math.isnan(clock.stamp_std)


@pytest.mark.parametrize('changes, text', [
    ({'min_step_s': 2.0, 'max_delay_s': 1.0}, 'min_step_s: 2 s is longer than'),
    ({'wrap': 256, 'tick_s': 1e-3}, 'wrap: the counter wraps every 0.256 s')])
def test_settings_that_contradict_each_other_are_refused(changes, text):
    with pytest.raises(SettingsError, match=text):
        clock_of(**changes)
