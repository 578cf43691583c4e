"""The most frequent level of a sensor, and when it is needed."""

import numpy as np
import pytest

from mag_tracking.apps.first_pass import first_pass
from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate
from support.calibration_runs import EARTH, SIGMA
from support.networks import line_network
from support.samples import MagSample, batch

NETWORK, SETTINGS = line_network(1), CalibrateSettings()


def readings(signal, seconds=60.0, rate=50.0, seed=0, step=0.0):
    """Of one sensor: noise about the Earth's field and `signal(t)` (3,) or a number [T]."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / rate)
    fields = [EARTH + signal(s) + SIGMA * rng.standard_normal(3) for s in t]
    if step:
        fields = [step * np.round(f / step) for f in fields]
    return batch([MagSample(int(s * 1e9), 'mag_1', f) for s, f in zip(t, fields, strict=True)])


def found(signal, settings=SETTINGS, network=NETWORK, **more):
    return first_pass([readings(signal, **more)], network, settings)


def passing(*times, size=1e-6):
    return lambda t: sum(size * np.exp(-((t - at) / 0.8)**2) for at in times)


def stands(until):
    """A vehicle that leaves at `until` [s]."""
    return lambda t: 2e-6 / (1.0 + np.exp(np.clip((t - until) / 0.2, -50.0, 50.0)))


@pytest.mark.parametrize('signal', [
    lambda t: 0.0, passing(20.0), passing(7.0, 12.0, 17.0, 30.0), lambda t: 3e-9 * t,
    lambda t: 1e-8 * t, lambda t: 2e-6 * (25.0 < t < 40.0)])
def test_after_a_quiet_beginning_nothing_is_needed(signal):
    assert found(signal).levels == {}


@pytest.mark.parametrize('signal', [
    passing(1.0), passing(2.0, 9.0, 14.0), passing(*np.arange(1.5, 60.0, 5.0)),
    stands(15.0), lambda t: stands(8.0)(t) + passing(11.0)(t)])
@pytest.mark.parametrize('step', [0.0, 1e-7])
def test_the_most_frequent_level_is_that_between_the_targets(signal, step):
    level = found(signal, step=step).levels['mag_1']
    np.testing.assert_allclose(level.level, EARTH, atol=5e-9 if not step else 0.6 * step)
    assert not step or (np.sqrt(level.covariance.diagonal()) < step).all()


def test_a_target_that_stands_there_at_first_is_not_the_background():
    """It leaves; from then on the background is what it was after that."""
    signal = readings(stands(15.0))
    stage = Calibrate(NETWORK, SETTINGS)
    first_pass([signal], NETWORK, SETTINGS).apply(stage)
    out = stage.feed(signal)[0]
    t = out.stamp_ns / 1e9
    assert np.abs(out.field[t < 12.0].mean(axis=0) - 2e-6).max() < 1e-8
    assert np.abs(out.field[t > 18.0].mean(axis=0)).max() < 3e-9
    assert len(out) == len(signal)


def test_nothing_is_searched_where_the_background_is_given_or_nothing_is_asked_for():
    import dataclasses

    given = dataclasses.replace(NETWORK, background=(EARTH,))
    assert found(passing(1.0), network=given).levels == {}
    assert found(passing(1.0), replace(SETTINGS, {'look_ahead_s': 0.0})).levels == {}


def test_a_recording_of_nothing_but_a_target_has_no_level():
    assert found(lambda t: 1e-7 * t, seconds=20.0).levels == {}
    assert found(lambda t: 0.0, seconds=0.5).levels == {}


def test_the_readings_may_come_in_batches_of_any_size():
    whole = readings(passing(1.0))
    expected = first_pass([whole], NETWORK, SETTINGS).levels['mag_1']
    parts = (whole.part(slice(i, i + 7)) for i in range(0, len(whole), 7))
    level = first_pass(parts, NETWORK, SETTINGS).levels['mag_1']
    np.testing.assert_array_equal(level.level, expected.level)
