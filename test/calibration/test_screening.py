"""Detection of spikes and stuck sensors, without false alarms."""

import functools
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.calibration import core
from mag_tracking.calibration.core import HELD, MAX_HELD, PASSES, RELEASED, SPIKE
from mag_tracking.calibration.sensor_state import new_sensors
from mag_tracking.simulation.scenario import Path, random_vehicle
from support.networks import line_network
from support.samples import simulate
from support.scenario import point_body
from support.sensor_noise import EARTH, NS, SIGMA, noise


def quantised(fields, step):
    """Fields quantised to steps of `step` noise stds; 0 leaves the fields unchanged."""
    return np.round(fields / (step * SIGMA)) * step * SIGMA if step else fields


class SpikeScreen:
    """Spike detection by `core.screen_spike`, with a record of the readings held and released."""

    def __init__(self, threshold, std=SIGMA, step=np.inf):
        self.sensors, self._threshold, self._held = new_sensors(1), threshold, []
        self.sensors['step'] = step
        self.sensors['is_ready'], self.sensors['noise_std'] = std is not None, std or np.nan

    def feed(self, row, stamp, field):
        """Screen a reading; return the readings with a decision, as [(index, is spike)]."""
        verdict, out = core.screen_spike(self.sensors, self._threshold, stamp, field), []
        if verdict == SPIKE:
            assert self.sensors['n_held'][0] == len(self._held)
            out, self._held, self.sensors['n_held'] = [(r, True) for r in self._held], [], 0
            verdict = core.screen_spike(self.sensors, self._threshold, stamp, field)
        self._held.append(row)
        if verdict == HELD:
            return out
        assert verdict in (PASSES, RELEASED)
        return out + self.flush()

    def flush(self):
        """Release the held readings, and return them as `feed` does."""
        out, self._held = [(r, False) for r in self._held], []
        self.sensors['n_held'] = self.sensors['n_released'] = 0
        return out


def screened(fields, rate=100.0, std=SIGMA, threshold=30.0, step=np.inf):
    """(indices of spikes, maximum number of held readings, indices of readings released later)."""
    spikes, max_held, late, out, f = [], 0, [], 0, SpikeScreen(threshold, std, step)
    for k, field in enumerate(fields):
        decided = f.feed(k, round(k * NS / rate), field)
        assert [row for row, _ in decided] == list(range(out, out + len(decided)))
        out += len(decided)
        max_held = max(max_held, k + 1 - out)
        spikes += [row for row, is_spike in decided if is_spike]
        late += [row for row, _ in decided if row < k]
    rest = f.flush()
    assert [row for row, _ in rest] == list(range(out, len(fields)))
    assert not any(is_spike for _, is_spike in rest)
    return spikes, max_held, late


def stuck(fields):
    """Indices of the readings that are rejected as repetitions."""
    sensors = new_sensors(1)
    return [k for k, field in enumerate(fields) if core.is_stuck(sensors, field)]


# False alarms.

@pytest.mark.parametrize('step', [0.0, 0.3, 1.0, 3.0, 10.0])
@pytest.mark.parametrize('slope', [0.0, 2e-11])
@pytest.mark.parametrize('rate', [10.0, 100.0])
def test_noise_and_coarse_steps_at_rest_pass_immediately(step, slope, rate):
    """None of 10 000 readings is held or classified as stuck.

    The background may drift across a quantisation step of the sensor.
    """
    y = noise(10_000) + slope * np.arange(10_000)[:, None] * [1.0, 0.8, -0.6]
    y = quantised(y, step)
    assert stuck(y) == []
    assert screened(y, rate) == ([], 0, [])


@functools.cache
def passes(rate, speed, n=4):
    """Readings of a sensor while `n` vehicles pass at one metre, one after the other."""
    rng, fields = np.random.default_rng(1), []
    network = line_network(1)
    for k in range(n):
        if k % 2:
            body, lateral = random_vehicle(rng), 1.0 + 1.7 / 2
        else:
            body, lateral = point_body(rng.normal(0.0, 250.0, 3), 5.0, 0.5), 1.0
        begin = -40.0 - rng.uniform(0.0, speed / rate)
        samples, *_ = simulate(network, body, Path(np.array([begin, -4.5 + lateral]), 0.0, speed),
                               rate, 80.0 / speed + 3.0, rng)
        fields += [s.field for s in samples]
    return np.array(fields)


@pytest.mark.parametrize('step', [0.0, 1.0, 3.0, 10.0])
@pytest.mark.parametrize('rate', [10.0, 50.0, 100.0])
def test_vehicles_at_a_metre_are_no_spikes(rate, step):
    """No reading of a pass is a spike, even at 10 Hz.

    After the pass, a sensor with coarse steps at rest is not classified as stuck.
    """
    for speed in (6.0, 13.0, 25.0):
        y = quantised(passes(rate, speed), step)
        assert np.ptp(y) > 1000 * SIGMA
        assert screened(y, rate)[0] == []
        assert stuck(y) == []


# Spikes.

@pytest.mark.parametrize('sign', [-1.0, 1.0])
@pytest.mark.parametrize('n', [1, 2, 3])
@pytest.mark.parametrize('axis', [0, 1, 2])
@pytest.mark.parametrize('size, rate', [(2e-6, 100.0), (5e-4, 100.0), (5e-4, 10.0)])
def test_only_spikes_are_rejected(size, rate, axis, n, sign):
    y = noise(60)
    y[30:30 + n, axis] += sign * size * np.array([1.0, 0.8, 1.3])[:n]
    spikes, max_held, late = screened(y, rate)
    assert spikes == late == list(range(30, 30 + n)) and max_held == n


def test_spikes_of_changing_sign_and_axis_are_rejected():
    y = noise(60)
    y[30:33] += [[3e-6, 0.0, 0.0], [-4e-6, 0.0, 1e-6], [0.0, 9e-6, 0.0]]
    assert screened(y)[0] == [30, 31, 32]


def test_spikes_in_quick_succession_are_rejected():
    """A rejected spike does not affect the detection of the next spike."""
    y = noise(200)
    rows = [20, 22, 24, 40, 41, 43, 100, 105]
    y[rows] += 5e-6
    assert screened(y)[0] == rows


@pytest.mark.parametrize('size, found', [(28.0, False), (35.0, True)])
def test_threshold_is_in_standard_deviations_of_the_noise(size, found):
    y = np.tile(EARTH, (40, 1))
    y[30, 1] += size * SIGMA
    assert screened(y)[0] == ([30] if found else [])
    assert screened(y, threshold=60.0) == ([], 0, [])


@pytest.mark.parametrize('before, found', [(3.0, True), (5.0, False)])
def test_a_spike_is_steeper_than_preceding_changes(before, found):
    y = np.tile(EARTH, (40, 1))
    y[22:, 0] += before * SIGMA
    y[25, 0] += 36.0 * SIGMA
    assert bool(screened(y)[0]) == found
    # After eight readings, the earlier change has no effect.
    later = np.tile(EARTH, (40, 1))
    later[16:, 0] += before * SIGMA
    later[25, 0] += 36.0 * SIGMA
    assert screened(later)[0] == [25]


@pytest.mark.parametrize('rate, size, found', [
    (50.0, 25.0, False), (50.0, 35.0, True), (10.0, 3300.0, False), (10.0, 3700.0, True)])
def test_a_lower_rate_requires_a_larger_spike(rate, size, found):
    """The limit, for 30 m/s at 1 m, is 130 (30 Hz / rate)^3 noise stds, but at least 30."""
    y = np.tile(EARTH, (40, 1))
    y[30, 1] += size * SIGMA
    assert screened(y, rate)[0] == ([30] if found else [])


def test_a_gap_counts_as_a_lower_rate():
    f, spikes = SpikeScreen(30.0), []
    for k in range(40):
        stamp = k * NS // 100 + (NS if k >= 20 else 0)
        field = EARTH + (2e-6 if k == 20 else 0.0)
        spikes += [row for row, is_spike in f.feed(k, stamp, field) if is_spike]
    assert spikes == []


@pytest.mark.parametrize('size', [2e-6, -5e-4])
def test_a_step_is_no_spike(size):
    y = noise(80)
    y[30:] += size
    spikes, max_held, late = screened(y)
    assert (spikes, max_held, late) == ([], MAX_HELD, [30, 31, 32])


def test_the_differences_after_a_step_replace_the_earlier_ones():
    y = np.tile(EARTH, (60, 1))
    y[30:] += 3e-6
    y[34:] += 40.0 * SIGMA * np.arange(26)[:, None]
    assert screened(y) == ([], MAX_HELD, [30, 31, 32])


def test_a_spike_requires_eight_preceding_changes():
    for row, found in ((8, []), (9, [9])):
        y = np.tile(EARTH, (20, 1))
        y[row] += 3e-6
        assert screened(y)[0] == found


def test_both_spike_criteria_must_hold_on_the_same_axis():
    y = np.tile(EARTH, (40, 1))
    y[22:, 0] += 5.0 * SIGMA
    y[25] += np.array([36.0, 9.0, 0.0]) * SIGMA
    assert screened(y) == ([], 0, [])


def test_four_readings_are_a_step_and_a_later_spike_is_rejected():
    y = noise(80)
    y[30:34] += 3e-6
    y[60] += 3e-6
    assert screened(y)[0] == [60]


def test_a_spike_returns_close_to_the_previous_level():
    for share, found in ((0.25, True), (0.35, False)):
        y = np.tile(EARTH, (60, 1))
        y[30] += 3e-6
        y[31:] += share * 3e-6
        assert bool(screened(y)[0]) == found


def test_a_missing_axis_is_no_spike_and_hides_no_spike():
    y = noise(80)
    y[20:50, 2] = np.nan
    y[30] += 4e-6
    y[55:58, 0] = np.nan
    assert screened(y)[0] == [30]
    one_missing = noise(60)
    one_missing[21, 0] = np.nan
    one_missing[30, 0] += 4e-6
    assert screened(one_missing)[0] == [30]
    y[:, 0] = np.nan
    y[31, 1] = np.nan
    spikes, max_held, _ = screened(y)
    # If the axis is missing after the spike, the next reading decides.
    assert spikes == [30, 31] and max_held == 2
    assert screened(np.full((30, 3), np.nan)) == ([], 0, [])


def test_recent_differences_replace_an_unknown_noise():
    y = noise(3000)
    y[300:2900:100] += 5e-6
    rows, max_held, _ = screened(y, std=None, step=1e-11)
    assert rows == list(range(300, 2900, 100)) and max_held == 1
    # Without a known step, a change may be the first change of a sensor at rest.
    assert screened(y, std=None) == ([], 0, [])
    coarse = 2e-7 * np.round(y / 2e-7)
    assert screened(coarse, std=None, step=2e-7)[0] == rows
    coarse = 2e-6 * np.round(y / 2e-6)
    assert screened(coarse, std=None, step=2e-6) == ([], 0, [])


@pytest.mark.parametrize('size, found', [(4e-5, True), (6e-6, False)])
def test_a_glitch_of_an_axis_at_rest_is_rejected(size, found):
    """No magnetometer has steps of 13 uT; steps of 6 uT are possible."""
    y = np.tile([2e-6, 1.6e-5, -4.8e-5], (200, 1))
    y[100, 1] += size
    assert screened(y, std=None)[0] == ([100] if found else [])


@settings(derandomize=True, deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_readings_are_released_once_in_order_and_at_most_three_are_held(seed):
    rng = np.random.default_rng(seed)
    y = noise(300, seed)
    is_spike = rng.random(300) < rng.choice([0.02, 0.2, 0.6])
    y[is_spike] += rng.standard_normal((is_spike.sum(), 3)) * 10.0 ** rng.uniform(-8, -3)
    y[rng.random((300, 3)) < 0.05] = np.nan
    _, max_held, _ = screened(y, float(rng.choice([10.0, 100.0, 1000.0])))
    assert max_held <= MAX_HELD


# Repetitions.

@pytest.mark.parametrize('step, delay', [(0.0, 6), (0.3, 6), (1.0, 7)])
@pytest.mark.parametrize('n', [15, 150])
def test_a_frozen_sensor_is_detected_and_recovers_immediately(step, delay, n):
    y = quantised(noise(2000), step)
    y[1500:1500 + n] = y[1499]
    found = stuck(y)
    assert found == list(range(found[0], 1500 + n)) and 1500 <= found[0] < 1500 + delay


def test_repeated_freezes_are_detected():
    y = noise(3000)
    for k in range(500, 3000, 100):
        y[k:k + 60] = y[k - 1]
    rows = stuck(y)
    frozen = {r for k in range(500, 3000, 100) for r in range(k, k + 60)}
    assert set(rows) <= frozen
    # In each freeze, all but the first few readings are rejected.
    assert len(rows) >= 25 * 50
    assert max(Counter(r // 100 for r in frozen - set(rows)).values()) <= 7


def test_a_stuck_sensor_requires_enough_changes_and_repetitions():
    few, many = noise(49), noise(51)
    assert stuck(np.concatenate([few, np.tile(few[-1], (100, 1))])) == []
    assert stuck(np.concatenate([many, np.tile(many[-1], (100, 1))])) != []
    long = noise(30_000)
    y = np.concatenate([long, np.tile(long[-1], (10, 1))])
    assert stuck(y) == list(range(30_003, 30_010))


def test_limit_depends_on_the_usual_rate_of_repetitions():
    """If one in 30 readings is a repetition, a run of seven is a fault, and a run of six is not."""
    y = noise(9000)
    y[29::30] = y[28::30]
    assert stuck(y) == []
    limit = math.ceil(math.log(1e-9) / math.log(1 / 30))
    y = np.concatenate([y, np.tile(y[-2] + SIGMA, (20, 1))])
    assert stuck(y) == list(range(9000 + limit, 9020))


def test_old_repetitions_are_forgotten():
    """A freeze is detected although the sensor repeated many readings at the start."""
    y = noise(70_000)
    y[60:2000] = y[59]
    begin, end = stuck(y), 30_000
    assert begin == list(range(begin[0], 2000))
    late = noise(60_000)
    late[:4000] = late[0]
    late[end:end + 50] = late[end - 1]
    late[59_000:59_050] = late[58_999]
    rows = stuck(late)
    assert {59_010, 59_049} <= set(rows)


def test_coarse_steps_are_not_classified_as_stuck():
    """If the readings of a coarse sensor changed often, a value may repeat indefinitely at rest."""
    rng = np.random.default_rng(0)
    changes = np.eye(3)[rng.integers(0, 3, 4000)] * rng.choice([-1.0, 0.0, 1.0], (4000, 1))
    moving = np.cumsum(changes, axis=0) * 1e-7
    y = np.concatenate([np.zeros((300, 3)), moving, np.tile(moving[-1], (20_000, 1)), moving,
                        np.tile(moving[-1], (20_000, 1))])
    assert stuck(y) == []


def test_a_coarse_sensor_that_starts_in_a_pass_recovers():
    """The reading changes a hundred times and then rarely; the sensor is not stuck permanently."""
    moving = np.arange(100.0)[:, None] * np.array([1e-7, 2e-7, -1e-7])
    rest = [np.tile(moving[-1] + (k % 2) * 1e-7, (500, 1)) for k in range(20)]
    rows = np.array(stuck(np.concatenate([moving, *rest])))
    assert rows.max() < 100 + 5 * 500


def test_a_missing_axis_counts_as_a_repetition():
    y = noise(500)
    y[:, 1] = np.nan
    assert stuck(y) == []
    y[300:] = y[299]
    assert stuck(y)[-1] == 499 and stuck(y)[0] < 306
    y[400, 1] = 0.0
    assert 400 not in stuck(y)
