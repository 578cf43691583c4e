"""Calibration: learning and freezing of backgrounds, invalid input, corrections."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.errors import NetworkError
from mag_tracking.stages.calibrate.output_buffer import OVERRULED
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from mag_tracking.stages.stage import rejected
from support.calibration_runs import EARTH, SIGMA, feed, running, sample, stage
from support.counters import assert_counts, count_of
from support.fed_background import FedBackground
from support.networks import line_network
from support.samples import MagSample, fed


def test_level_noise_and_drift_are_learnt():
    b = running()
    drift = np.array([5e-9, -3e-9, 0.0])
    feed(b, np.arange(0, 30, 0.01), drift=drift)
    error = (b.level(30.0) - EARTH - 30.0 * drift) / SIGMA
    # Bound on the error of a line that is fitted to 2000 samples and extrapolated by 1.5 s.
    assert np.abs(error).max() < 4.5 * np.sqrt(1 / 2000 * (1 + 3 * (1 + 2 * 1.75 / 20) ** 2))
    std = np.sqrt(np.diagonal(b.covariance))
    np.testing.assert_allclose(std, SIGMA, rtol=5 / np.sqrt(2 * 2000))


def test_a_background_is_not_ready_before_it_is_learnt():
    b = running()
    feed(b, np.arange(0, 2.0, 0.01))
    assert not b.ready
    with pytest.raises(ValueError, match='learnt'):
        b.level(2.0)


@pytest.mark.parametrize('rate', [1.0, 5.0, 8.0, 10.0, 12.5, 15.0, 25.0, 70.0, 200.0])
def test_a_background_is_learnt_at_any_sample_rate(rate):
    # Regression: at 10 and 12.5 Hz, blocks of eight samples did not fit into the interval.
    b = running()
    feed(b, np.arange(0, 3.0 + 24 / rate, 1 / rate))
    assert b.ready
    assert np.abs((b.level(3.0) - EARTH) / SIGMA).max() < 4.5 * (24.0 ** -0.5) * 2.0


@pytest.mark.parametrize('rate, at', [(1.0, 20.0), (1.0, 8.0), (2.0, 12.0), (2.0, 6.0)])
def test_a_target_that_passes_while_learning_does_not_raise_the_noise(rate, at):
    """A block of a slow sensor can contain a whole pass, which hardly changes the block's mean."""
    def target(t):
        return np.array([3e-6, -2e-6, 1e-6]) / (1 + ((t - at) / 0.8) ** 2) ** 2.5
    b = running()
    end = at + 10.0 + 60 / rate
    feed(b, np.arange(0, end, 1 / rate), signal=target)
    assert b.ready
    assert np.sqrt(np.diagonal(b.covariance)).max() < 2.5 * SIGMA.max()
    assert np.abs((b.level(end) - EARTH) / SIGMA).max() < 3.0


def test_a_target_freezes_the_background():
    def target(t):
        return np.array([3e-6, -2e-6, 1e-6]) / (1 + ((t - 15.0) / 0.8) ** 2) ** 2.5
    b = running()
    feed(b, np.arange(0, 15.0, 0.01), signal=target)
    assert b.frozen
    assert np.abs((b.level(15.0) - EARTH) / SIGMA).max() < 0.5
    feed(b, np.arange(15.0, 30.0, 0.01), signal=target, seed=1)
    assert not b.frozen
    assert np.abs((b.level(30.0) - EARTH) / SIGMA).max() < 0.5


def test_a_parked_car_becomes_background_only_after_the_relearn_time():
    parked = np.array([1e-6, 0.0, 0.0])
    b = running(relearn=20.0)
    feed(b, np.arange(0, 10, 0.01))
    feed(b, np.arange(10, 25, 0.01), signal=parked)
    assert b.frozen and b.n_relearnt == 0
    feed(b, np.arange(25, 40, 0.01), signal=parked)
    assert b.n_relearnt == 1
    assert np.abs((b.level(40.0) - EARTH - parked) / SIGMA).max() < 0.5
    disabled = running(relearn=0.0)
    feed(disabled, np.arange(0, 10, 0.01))
    feed(disabled, np.arange(10, 60, 0.05), signal=parked)
    assert disabled.frozen and disabled.n_relearnt == 0


def test_a_target_at_the_start_is_not_learnt():
    def passing(t):
        return np.array([2e-6, 1e-6, 0.0]) / (1 + ((t - 1.5) / 0.5) ** 2) ** 2.5
    b = running()
    feed(b, np.arange(0, 3.5, 0.01), signal=passing)
    assert not b.ready
    feed(b, np.arange(3.5, 12.0, 0.01), signal=passing, seed=1)
    assert b.ready
    assert np.abs((b.level(12.0) - EARTH) / SIGMA).max() < 0.6


def test_a_configured_background_with_noise_is_ready_immediately():
    b = running(background=EARTH, noise_std=SIGMA)
    assert b.ready
    np.testing.assert_array_equal(b.level(0.0), EARTH)
    np.testing.assert_allclose(np.diagonal(b.covariance), SIGMA**2)


def test_a_configured_background_without_noise_learns_the_noise():
    b = running(background=EARTH)
    assert not b.ready
    feed(b, np.arange(0, 5, 0.01))
    assert b.ready


@pytest.mark.parametrize('field, cause', [
    ([np.nan] * 3, 'all NaN'),
    ([np.inf, 0, 0], 'infinite'),
    ([0.02, 0.15, -0.49], 'gauss'),
    ([2.0, 15.0, -49.0], 'gauss'),
])
def test_invalid_fields_are_counted_and_rejected(field, cause):
    s = stage()
    assert fed(s, sample(1.0, field)) == []
    assert len(rejected(s.counts)) == 1 and cause in next(iter(rejected(s.counts)))
    assert s.counts_of('mag_1')['rejected'] == 1


def test_fields_of_millitesla_pass_with_a_larger_max_field():
    assert len(fed(stage(max_field=0.1), sample(1.0, [0.01, 0.0, 0.0]))) == 1


def test_a_reading_of_an_unknown_sensor_is_counted_and_rejected():
    s = stage()
    assert fed(s, sample(1.0, sensor='mag_9')) == []
    assert_counts(rejected(s.counts), {'mag_9': 1})


def test_a_missing_axis_stays_missing():
    out = fed(stage(), sample(1.0, [EARTH[0], EARTH[1], np.nan]))
    np.testing.assert_allclose(out[0].field[:2], 0.0, atol=1e-20)
    assert np.isnan(out[0].field[2])


def test_duplicate_and_out_of_order_timestamps_are_counted_and_rejected():
    s = stage()
    for t in (1.0, 1.0, 0.5, 1.1):
        fed(s, sample(t))
    assert_counts(rejected(s.counts), {'duplicate': 1, 'order': 1})


def test_a_jump_back_in_time_is_accepted_and_counted():
    s = stage()
    fed(s, sample(100.0))
    assert len(fed(s, sample(1.0))) == 1
    assert count_of(s.counts, 'jumped') == 1


def test_implausible_message_covariances_are_overruled_unless_trusted():
    stated = np.diag([1e-16, 2e-16, 3e-16])
    s = stage()
    np.testing.assert_array_equal(fed(s, sample(1.0, covariance=stated))[0].covariance, stated)
    # A missing covariance is replaced by the covariance from the network file.
    np.testing.assert_allclose(fed(s, sample(2.0))[0].covariance, 1.44e-16 * np.eye(3))
    # Rounding errors make all eigenvalues of half of the rank-one products positive.
    implausible = [
        -stated, np.zeros((3, 3)), np.diag([1e-16, 2e-16, np.nan]),
        stated + np.triu(np.ones((3, 3)), 1), 100.0 * stated, 0.01 * stated,
        *(1e-16 * np.outer(v, v) for v in np.random.default_rng(0).standard_normal((20, 3)))]
    correlated = stated.copy()
    correlated[0, 1] = correlated[1, 0] = 0.99 * np.sqrt(2.0) * 1e-16
    for k, C in enumerate([*implausible, correlated]):
        (out,) = fed(s, sample(3.0 + k, covariance=C))
        np.testing.assert_allclose(out.covariance, 1.44e-16 * np.eye(3))
    assert s.counts[OVERRULED] == 27 and not rejected(s.counts)
    s = stage(trust_covariances=True)
    for k, C in enumerate((100.0 * stated, 0.01 * stated, correlated)):
        np.testing.assert_array_equal(fed(s, sample(1.0 + k, covariance=C))[0].covariance, C)
    for C in (*implausible[:4], *implausible[6:]):
        assert fed(s, sample(9.0, covariance=C)) == []
    assert_counts(rejected(s.counts), {'definite': 24})


def test_forget_refuses_an_unknown_sensor():
    with pytest.raises(NetworkError, match='mag_9'):
        stage().forget(['mag_9'])


SOFT_IRON = np.array([[1.02, 0.03, 0.0], [-0.01, 0.97, 0.02], [0.0, 0.04, 1.05]])
HARD_IRON = np.array([4e-6, -3e-6, 7e-6])


def corrected(**properties):
    """Create `Calibrate` for two sensors with backgrounds; the second sensor has `properties`."""
    n = line_network(2)
    properties = {key: (None, value) for key, value in properties.items()
                  if key != 'clock_offset'} | {
        key: np.array([0.0, properties[key]]) for key in properties if key == 'clock_offset'}
    n = dataclasses.replace(n, background=(EARTH, EARTH), **properties)
    return Calibrate(n, CalibrateSettings())


def test_the_clock_offset_is_subtracted_from_timestamps():
    s = corrected(clock_offset=0.0213)
    (first,), (second,) = fed(s, sample(5.0)), fed(s, sample(5.0213, sensor='mag_2'))
    assert first.stamp_ns == second.stamp_ns == 5_000_000_000
    assert s.last_stamp_ns('mag_2') == 5_000_000_000
    # The samples of each sensor must remain in chronological order.
    assert fed(s, sample(5.0213, sensor='mag_2')) == []
    assert rejected(s.counts) == {'duplicate timestamp': 1}


def test_hard_and_soft_iron_of_a_sensor_are_corrected():
    s = corrected(offset=HARD_IRON, correction=SOFT_IRON)
    B = EARTH + [3e-7, -2e-7, 5e-7]
    (out,) = fed(s, sample(1.0, np.linalg.solve(SOFT_IRON, B) + HARD_IRON, 'mag_2'))
    np.testing.assert_allclose(out.field, B - EARTH, atol=1e-18)
    # The other sensor has no correction.
    (out,) = fed(s, sample(1.0, B))
    np.testing.assert_allclose(out.field, B - EARTH, atol=1e-18)
    (out,) = fed(corrected(offset=HARD_IRON), sample(1.0, B + HARD_IRON, 'mag_2'))
    np.testing.assert_allclose(out.field, B - EARTH, atol=1e-18)


def test_the_covariance_is_transformed_by_the_correction():
    stated = np.diag([1e-16, 2e-16, 3e-16])
    (out,) = fed(corrected(correction=SOFT_IRON), sample(1.0, sensor='mag_2', covariance=stated))
    np.testing.assert_allclose(out.covariance, SOFT_IRON @ stated @ SOFT_IRON.T)
    rng = np.random.default_rng(0)
    samples = (rng.standard_normal((20000, 3)) * np.sqrt(np.diagonal(stated))) @ SOFT_IRON.T
    np.testing.assert_allclose(out.covariance, np.cov(samples.T), atol=0.03 * 3e-16)


def test_a_reading_without_an_axis_that_the_correction_needs_is_rejected():
    field = [EARTH[0], EARTH[1], np.nan]
    s = corrected(correction=SOFT_IRON + 0.01)
    assert fed(s, sample(1.0, field, 'mag_2')) == []
    assert_counts(rejected(s.counts), {'axis': 1})
    # An offset needs no other axis.
    (out,) = fed(corrected(offset=HARD_IRON), sample(1.0, field, 'mag_2'))
    np.testing.assert_allclose(out.field[:2], -HARD_IRON[:2], atol=1e-18)
    assert np.isnan(out.field[2])


@pytest.mark.parametrize('C', [np.diag([1.02, 0.97, 1.05]),
                               [[1.02, 0.03, 0.0], [-0.01, 0.97, 0.0], [0.0, 0.0, 1.0]]])
def test_a_reading_without_an_axis_that_the_correction_ignores_passes(C):
    """In these corrections, x and y do not depend on z."""
    s, C = corrected(correction=np.array(C)), np.array(C)
    (out,) = fed(s, sample(1.0, [EARTH[0], EARTH[1], np.nan], 'mag_2'))
    np.testing.assert_allclose(out.field[:2], (C[:2, :2] - np.eye(2)) @ EARTH[:2], atol=1e-18)
    assert np.isnan(out.field[2])


def test_a_new_calibration_keeps_a_background_that_a_target_has_frozen():
    """Only the clock offset changes, so the parked car must not become the background."""
    network = line_network(1)
    stage = Calibrate(network, CalibrateSettings())
    rng = np.random.default_rng(3)

    def feed(first, last, target_field=0.0):
        out = []
        for k in range(first, last):
            out += fed(stage, MagSample(k * 10**7, 'mag_1', EARTH + target_field
                                        + SIGMA * rng.standard_normal(3)))
        return out

    feed(0, 800)
    car = np.array([5.8e-7, 0.0, 0.0])
    feed(800, 1000, car)
    assert stage.backgrounds()['mag_1'].frozen
    stage.update_network(dataclasses.replace(network, clock_offset=np.array([0.25])))
    out = feed(1000, 2000, car)
    assert stage.backgrounds()['mag_1'].frozen and stage.backgrounds()['mag_1'].n_relearnt == 0
    assert len(out) == 1000
    np.testing.assert_allclose(np.mean([s.field for s in out], axis=0), car, atol=1e-8)
    # The timestamps use the new clock offset, and are accepted as chronological.
    assert out[0].stamp_ns == 1000 * 10**7 - 250_000_000
    assert count_of(stage.counts, 'rejected: out') == 0


def test_a_new_hard_iron_offset_restarts_learning():
    network = line_network(1)
    stage = Calibrate(network, CalibrateSettings())
    for k in range(500):
        fed(stage, MagSample(k * 10**7, 'mag_1', EARTH + SIGMA * np.sin([k, 2 * k, 3 * k])))
    assert stage.backgrounds()['mag_1'].ready
    stage.update_network(dataclasses.replace(network, offset=(np.full(3, 1e-6),)))
    assert not stage.backgrounds()['mag_1'].measured
    with pytest.raises(NetworkError, match='expected mag_1'):
        stage.update_network(line_network(2))


def ends_of_blocks(phase, times):
    """Feed readings at `times` [s]; return (indices of readings that end a block, background)."""
    background = FedBackground(3.0, 20.0, 1.5, 0.25, 2.0, 60.0, phase=phase)
    state = background.sensors
    rng, ends, now = np.random.default_rng(0), [], 0
    for k, t in enumerate(times):
        background.add(t, 1e-8 * rng.standard_normal(3))
        assert state['is_full'][0] == (phase is not None and state['now'][0] != now)
        if state['now'][0] != now:
            ends.append(k)
            background.evaluate_block()
        now = state['now'][0]
    return ends, background


def test_blocks_of_many_sensors_end_at_staggered_times():
    """The ends remain staggered when all timestamps have the same jitter.

    Evaluating the blocks of a hundred sensors at once would delay the readings.
    """
    n, n_readings, ends_of_all = 10, 10_000, []
    times = (np.arange(n_readings) + np.random.default_rng(1).uniform(0.0, 0.05, n_readings)) / 100
    for j in range(n):
        ends, background = ends_of_blocks(j / n, times)
        assert background.ready
        # Rounding errors move an end by at most one reading.
        np.testing.assert_allclose(np.diff(ends), 25, atol=1.1)
        assert ends[0] == pytest.approx(25 * (1.0 + j / n), abs=1.1)
        ends_of_all += ends
    assert np.bincount(ends_of_all).max() <= 2


def test_a_block_without_a_phase_has_its_full_length():
    times = np.arange(200) / 100.0 + 0.005 * (np.arange(200) % 25 == 0)
    ends, _ = ends_of_blocks(None, times)
    assert len(ends) > 5 and (np.diff(times[ends]) >= 0.25 - 1e-9).all()
