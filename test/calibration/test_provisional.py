"""Background estimation when a recording does not start quietly.

Provisional and doubtful backgrounds, and their replacement.
"""

import dataclasses

import numpy as np
import pytest

from mag_tracking.calibration.doubtful_times import (
    DOUBTFUL_BACKGROUND,
    are_doubtful,
    doubtful_since,
    merged,
    shifted,
    updated,
)
from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.calibration_runs import EARTH, SIGMA, feed, running
from support.dense_traffic import traffic
from support.networks import line_network
from support.samples import MagSample, batch

RATE = 50.0


def run_on(signal, seconds, **changes):
    """Background after `seconds` [s] of a signal [T] added to the Earth field."""
    b = running(**changes)
    feed(b, np.arange(0.0, seconds, 1.0 / RATE), signal=signal)
    return b


def level_error(b):
    return np.sqrt(b.sensors[0]['level_variance'])


@pytest.mark.parametrize('seed', range(5))
def test_a_provisional_background_is_found_between_vehicles(seed):
    """The level is correct within its std, although no interval of three seconds is quiet."""
    signal = traffic(2.0, seed=seed)
    assert not run_on(signal, 5.5).ready
    b = run_on(signal, 14.0)
    assert b.ready and b.doubtful and not b.certain
    assert (np.abs(b.level(14.0) - EARTH) < 3.0 * level_error(b) + SIGMA).all()
    assert (level_error(b) > 0.0).all()


@pytest.mark.parametrize('seed', range(5))
def test_a_provisional_background_becomes_certain(seed):
    signal = traffic(2.0, seed=seed)
    b = run_on(signal, 60.0)
    assert b.certain and (level_error(b) == 0.0).all()
    # Tails of vehicles within the noise of a block of 12 readings are not detected.
    assert (np.abs(b.level(60.0) - EARTH) < 2.0 * SIGMA).all()


def test_a_quiet_interval_makes_the_background_certain():
    b = run_on(traffic(2.0, end=12.0), 18.0)
    assert b.certain
    assert (np.abs(b.level(18.0) - EARTH) < SIGMA).all()


@pytest.mark.parametrize('relearn', [0.0, 60.0])
@pytest.mark.parametrize('signal', [
    0.0, lambda t: np.array([2e-6, 0.0, 0.0]) / (1 + ((t - 12.0) / 0.8)**2)**2.5])
def test_a_background_from_a_quiet_beginning_is_never_doubtful(signal, relearn):
    b = run_on(signal, 30.0, relearn=relearn)
    assert b.certain and not b.doubtful_times


def standing_vehicle(until):
    return lambda t: np.array([2e-6, -1e-6, 0.0]) * (t < until)


def test_a_background_with_a_vehicle_at_the_start_is_doubtful_and_replaced():
    """The vehicle leaves after 4 s. After another 4 s, either level may be the background."""
    for seconds, is_doubtful, has_departed in ((4.0, False, False), (9.5, True, False),
                                               (24.0, False, True)):
        b = run_on(standing_vehicle(4.0), seconds)
        assert b.ready and b.doubtful == is_doubtful
        error = np.abs(b.level(seconds) - EARTH)
        assert (error < SIGMA).all() == has_departed


@pytest.mark.parametrize('stood_s', [4.0, 20.0])
def test_a_background_with_a_vehicle_before_dense_traffic_is_doubtful_and_replaced(stood_s):
    """The most frequent level replaces the background, because no quiet interval follows."""
    vehicles = traffic(2.0, begin=stood_s)

    def signal(t):
        return standing_vehicle(stood_s)(t) + vehicles(t)

    b_early = run_on(signal, stood_s + 55.0)
    assert b_early.doubtful or (np.abs(b_early.level(60.0) - EARTH) < 2.0 * SIGMA).all()
    b = run_on(signal, 140.0)
    assert b.certain and (np.abs(b.level(140.0) - EARTH) < 2.0 * SIGMA).all()


def test_a_wrong_given_background_is_replaced_once():
    b = run_on(traffic(2.0), 140.0, background=EARTH + 2e-6, noise_std=SIGMA)
    assert b.n_relearnt == 1 and (np.abs(b.level(140.0) - EARTH) < 2.0 * SIGMA).all()


def test_a_vehicle_that_stood_in_dense_traffic_is_replaced():
    """The vehicle stands for half a minute and departs; the traffic continues."""
    vehicles = traffic(2.0, begin=40.0)
    b = run_on(lambda t: standing_vehicle(40.0)(t) + vehicles(t) + traffic(2.0, end=6.0)(t), 170.0)
    assert b.certain and (np.abs(b.level(170.0) - EARTH) < 2.0 * SIGMA).all()


@pytest.mark.parametrize('later', [60.0, 700.0])
def test_another_stopping_car_is_not_a_former_background(later):
    """A car parks for 100 s; later, another car with 60 % of its field stops for 5 s."""
    def signal(t):
        stop_time = 120.0 + later
        return np.array([2e-6, 0.0, 1e-6]) * ((20.0 < t < 120.0)
                                              + 0.6 * (stop_time < t < stop_time + 5.0))
    b = running()
    feed(b, np.arange(0.0, 127.0 + later, 0.04), signal=signal)
    assert b.n_relearnt == 2 and (np.abs(b.level(127.0 + later) - EARTH) < SIGMA).all()


def test_an_axis_that_stops_reporting_does_not_delay_the_others():
    vehicles = traffic(2.0)
    b, rng = running(), np.random.default_rng(0)
    for t in np.arange(0.0, 14.0, 1.0 / RATE):
        field = EARTH + vehicles(t) + SIGMA * rng.standard_normal(3)
        b.add(t, np.where([False, False, t > 1.5], np.nan, field))
    assert b.ready and (np.abs(b.level(14.0) - EARTH)[:2] < 3.0 * level_error(b)[:2]).all()


def test_a_former_background_is_restored_within_seconds():
    """A car parks for two minutes. The former level is restored within 6 s of its departure."""
    def parked(t):
        return np.array([2e-6, 0.0, 1e-6]) * (20.0 < t < 140.0)
    assert (np.abs(run_on(parked, 130.0).level(130.0) - EARTH - parked(130.0)) < SIGMA).all()
    b = run_on(parked, 146.0)
    assert not b.frozen and b.n_relearnt == 2
    assert (np.abs(b.level(146.0) - EARTH) < SIGMA).all()


def test_a_drift_too_large_for_a_sensor_is_doubtful():
    """The drift due to an approaching vehicle is doubtful; the drift of a warming sensor is not."""
    for rate, is_doubtful in ((2e-8, True), (1e-9, False)):
        b = run_on(lambda t, rate=rate: rate * t * np.ones(3), 6.0)
        assert b.ready and b.doubtful == is_doubtful
        assert ((level_error(b) > 0.0) == is_doubtful).all()


def readings(signal, seconds, seed=0):
    rng = np.random.default_rng(seed)
    return batch([MagSample(int(t * 1e9), 'mag_1', EARTH + signal(t) + SIGMA
                            * rng.standard_normal(3)) for t in np.arange(0.0, seconds, 1 / RATE)])


def calibrated(parts, network=None, **changes):
    stage = Calibrate(network or line_network(1), replace(CalibrateSettings(), changes))
    out = [c for part in parts for c in stage.feed(part)]
    return stage, np.concatenate([c.covariance for c in out]), np.concatenate(
        [c.stamp_ns for c in out])


def test_covariance_includes_the_error_of_a_provisional_background():
    stage, covariance, stamps = calibrated([readings(traffic(2.0), 60.0)])
    times = stage.input_doubts()[DOUBTFUL_BACKGROUND]['mag_1']
    doubtful = np.array([are_doubtful(times, s) for s in stamps.tolist()])
    (begin, end), = times
    assert 6e9 <= begin < 15e9 < end < 60e9
    variance = np.einsum('kii->ki', covariance)
    assert doubtful.any() and not doubtful.all()
    assert variance[doubtful].min() > 1.5 * variance[~doubtful].max()


def test_doubtful_intervals_do_not_depend_on_the_batches():
    batch_of_all = readings(traffic(2.0), 40.0)
    stage, covariance, _ = calibrated([batch_of_all])
    parts = [batch_of_all.part(slice(i, i + 7)) for i in range(0, len(batch_of_all), 7)]
    other_stage, other_covariance, _ = calibrated(parts)
    assert stage.input_doubts() == other_stage.input_doubts() != {}
    np.testing.assert_array_equal(covariance, other_covariance)


def test_doubtful_intervals_follow_the_clock():
    network = line_network(1)
    stage, *_ = calibrated([readings(traffic(2.0), 14.0)], network)
    (begin, _), = stage.input_doubts()[DOUBTFUL_BACKGROUND]['mag_1']
    stage.update_network(dataclasses.replace(network, clock_offset=np.array([0.5])))
    assert stage.input_doubts()[DOUBTFUL_BACKGROUND]['mag_1'] == ((begin - 500_000_000, None),)


def test_a_given_background_is_not_doubtful():
    network = dataclasses.replace(line_network(1), background=(EARTH,))
    stage, covariance, _ = calibrated([readings(traffic(2.0), 30.0)], network)
    assert stage.input_doubts() == {}
    np.testing.assert_array_equal(stage.background('mag_1'), EARTH)


def test_a_doubtful_background_is_not_stored_for_a_restart():
    stage, *_ = calibrated([readings(traffic(2.0), 14.0)])
    assert stage.stored('mag_1') is None
    stage, *_ = calibrated([readings(traffic(2.0), 60.0)])
    assert stage.stored('mag_1') is not None


def test_doubtful_intervals_are_recorded_and_merged():
    times = ()
    for stamp, is_doubtful in ((1, False), (2, True), (3, True), (5, False), (9, True)):
        times = updated(times, stamp, is_doubtful)
    assert times == ((2, 5), (9, None))
    assert [are_doubtful(times, t) for t in (1, 2, 4, 5, 9, 99)] == [False, True, True, False, True,
                                                                     True]
    for k in range(100):
        times = updated(times, 10 + k, k % 2 == 1)
    assert len(times) == 16 and times[-1] == (109, None)
    assert shifted(times, 5)[-1] == (114, None)
    # An interval that began earlier replaces the open interval.
    assert merged({'a': ((1, 2), (4, None))}, {'a': ((3, 6),)}) == {'a': ((1, 2), (3, 6))}
    assert doubtful_since(((1, 2), (4, 5), (6, None)), 3) == ((1, 2), (3, None))
    assert doubtful_since(((1, 4),), 3) == ((1, None),)
    assert merged({'a': ((1, 2), (4, None))}, {'a': ((4, 6),), 'b': ((3, None),)}) \
        == {'a': ((1, 2), (4, 6)), 'b': ((3, None),)}
    # An interval without an end is closed at the start of the next interval.
    assert merged({'a': ((1, None),)}, {'a': ((4, 6),)}) == {'a': ((1, 4), (4, 6))}
    # An interval of zero length replaces, and is replaced by, an interval with the same start.
    assert merged({'a': ((4, None),)}, {'a': ((4, 4),)}) == {'a': ((4, 4),)}
    assert merged({'a': ((4, 4),)}, {'a': ((4, None),)}) == {'a': ((4, None),)}
    # The doubtful background was replaced by a background that was never doubtful.
    assert merged({'a': ((1, 2), (4, None))}, {'a': ()}) == {'a': ((1, 2),)}
