"""Prescan of a recording for the most frequent level of a sensor, and conditions for its use."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.records import Readings
from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.prescan import prescan
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.calibration_runs import EARTH, SIGMA
from support.networks import line_network
from support.samples import MagSample, batch

NETWORK, SETTINGS = line_network(1), CalibrateSettings()


def readings(signal, seconds=60.0, rate=50.0, seed=0, step=0.0):
    """Readings of one sensor: the sum of noise, the Earth's field and `signal(t)` [T]."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / rate)
    fields = [EARTH + signal(s) + SIGMA * rng.standard_normal(3) for s in t]
    if step:
        fields = [step * np.round(f / step) for f in fields]
    return batch([MagSample(int(s * 1e9), 'mag_1', f) for s, f in zip(t, fields, strict=True)])


def prescan_of(signal, settings=SETTINGS, network=NETWORK, **more):
    return prescan([readings(signal, **more)], network, settings)


def passing(*times, size=1e-6):
    return lambda t: sum(size * np.exp(-((t - at) / 0.8)**2) for at in times)


def departing(until):
    """Signal of a vehicle that departs at `until` [s]."""
    return lambda t: 2e-6 / (1.0 + np.exp(np.clip((t - until) / 0.2, -50.0, 50.0)))


@pytest.mark.parametrize('signal', [
    lambda t: 0.0, passing(20.0), passing(7.0, 12.0, 17.0, 30.0), lambda t: 3e-9 * t,
    lambda t: 1e-8 * t, lambda t: 2e-6 * (25.0 < t < 40.0)])
def test_a_recording_with_a_quiet_beginning_has_no_level(signal):
    assert prescan_of(signal).levels == {}


@pytest.mark.parametrize('signal', [
    passing(1.0), passing(2.0, 9.0, 14.0), passing(*np.arange(1.5, 60.0, 5.0)),
    departing(10.0), lambda t: departing(8.0)(t) + passing(11.0)(t)])
@pytest.mark.parametrize('step', [0.0, 1e-7])
def test_the_most_frequent_level_is_that_between_the_targets(signal, step):
    level = prescan_of(signal, step=step).levels['mag_1']
    np.testing.assert_allclose(level.level, EARTH, atol=5e-9 if not step else 0.6 * step)
    assert not step or (np.sqrt(level.covariance.diagonal()) < step).all()


def test_a_target_present_at_the_start_is_not_the_background():
    """The background is the level after the departure of the target."""
    signal = readings(departing(10.0))
    stage = Calibrate(NETWORK, SETTINGS)
    prescan([signal], NETWORK, SETTINGS).apply(stage)
    out = stage.feed(signal)[0]
    t = out.stamp_ns / 1e9
    assert np.abs(out.field[t < 8.0].mean(axis=0) - 2e-6).max() < 1e-8
    assert np.abs(out.field[t > 13.0].mean(axis=0)).max() < 3e-9
    assert len(out) == len(signal)


@pytest.mark.parametrize('arrives, until', [(10.0, 40.0), (6.0, 20.0)])
def test_a_target_that_arrives_later_and_stays_is_not_the_background(arrives, until):
    def signal(t):
        return 2e-6 - departing(arrives)(t)
    assert prescan_of(signal, seconds=until).levels == {}
    # Without relearning, a level stays the background even if another level lasts longer.
    no_relearning = replace(SETTINGS, {'relearn_s': 0.0})
    assert prescan_of(signal, no_relearning, seconds=10.0 * until).levels == {}


def test_a_level_that_lasts_most_of_the_recording_is_not_the_background():
    """The vehicle departs, so the background is the short level after the departure."""
    def departing_slowly(t):
        distance = 0.5 * 2.0 * max(t - 30.0, 0.0)**2
        return 4e-6 / (1.0 + (distance / 5.0)**2)**1.5
    level, = prescan_of(departing_slowly, seconds=44.0).levels.values()
    assert (np.abs(level.level - EARTH) < SIGMA).all() and level.begin > 33.0


def test_a_first_level_that_returns_is_the_background():
    """Two vehicles arrive; one vehicle departs, and half of the field remains until 60 s."""
    def queue(t):
        distance = 0.5 * 2.0 * max(t - 30.0, 0.0)**2
        return (2e-6 + 2e-6 / (1.0 + (distance / 5.0)**2)**1.5) * (20.0 < t < 60.0)
    assert prescan_of(queue, seconds=80.0).levels == {}


@pytest.mark.parametrize('rates', [(50.0, 1.0), (2.0, 2.0), (100.0, 5.0)])
@pytest.mark.parametrize('starts', [0.0, 7.0, 40.0])
def test_slow_and_late_sensors_without_a_target_have_no_level(rates, starts):
    network, parts = line_network(2), []
    for j, (rate, start) in enumerate(zip(rates, (0.0, starts), strict=True)):
        part = readings(lambda t: 0.0, 120.0, rate, seed=j)
        late = dataclasses.replace(part, names=(f'mag_{j + 1}',))
        parts.append(late.part(late.stamp_ns >= start * 1e9))
    joined = Readings.joined(parts)
    joined = joined.part(np.argsort(joined.stamp_ns, kind='stable'))
    assert prescan([joined], network, SETTINGS).levels == {}


@pytest.mark.parametrize('value', [EARTH, np.zeros(3), np.array([2e-5, 0.0, 0.0]),
                                   EARTH + np.array([1.234e-8, -5.6e-9, 7.7e-9])])
def test_a_sensor_that_never_changes_has_no_background(value):
    constant = batch([MagSample(int(k * 1e7), 'mag_1', value) for k in range(2000)])
    stage, found_levels = Calibrate(NETWORK, SETTINGS), prescan([constant], NETWORK, SETTINGS)
    found_levels.apply(stage)
    assert stage.feed(constant) == [] and stage.unready() == ['mag_1']


def test_no_level_is_searched_for_a_given_background():
    given = dataclasses.replace(NETWORK, background=(EARTH,))
    assert prescan_of(passing(1.0), network=given).levels == {}


def test_a_recording_of_only_a_target_has_no_level():
    assert prescan_of(lambda t: 1e-7 * t, seconds=20.0).levels == {}
    assert prescan_of(lambda t: 0.0, seconds=0.5).levels == {}


def test_level_does_not_depend_on_the_batches():
    batch_of_all = readings(passing(1.0))
    expected = prescan([batch_of_all], NETWORK, SETTINGS).levels['mag_1']
    parts = (batch_of_all.part(slice(i, i + 7))
             for i in range(0, len(batch_of_all), 7))
    level = prescan(parts, NETWORK, SETTINGS).levels['mag_1']
    np.testing.assert_array_equal(level.level, expected.level)
