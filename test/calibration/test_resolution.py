"""Resolution of a sensor: steps of its readings, and the resulting error."""

import numpy as np
import pytest

from mag_tracking.calibration import core
from mag_tracking.calibration.core import DITHERED, MAX_REST_NS
from mag_tracking.calibration.sensor_state import (
    completed_steps,
    new_sensors,
    smallest_steps,
)
from support.fed_background import FedBackground

MS = 1_000_000


def sensor_after(fields, interval=10 * MS):
    """State of a sensor, (1,) SENSOR array, after the readings `fields` (n, 3)."""
    sensors = new_sensors(1)
    for k, field in enumerate(fields):
        core.note_step(sensors, k * interval, np.array(field, dtype=float))
    return sensors


def coarse(sigma, step, n=600, offset=0.3, seed=0):
    y = sigma * np.random.default_rng(seed).standard_normal((n, 3)) + offset * step
    return step * np.round(y / step)


@pytest.mark.parametrize('sigma, step', [(1e-8, 1e-7), (4e-8, 1e-7), (1e-7, 1e-7), (1e-8, 1e-10)])
def test_the_smallest_change_is_the_step(sigma, step):
    y = 5e-5 + coarse(sigma, step, offset=0.45, n=6000)
    np.testing.assert_allclose(sensor_after(y)[0]['step'], step, rtol=1e-6)
    np.testing.assert_allclose(smallest_steps(y), step, rtol=1e-6)
    # Single precision does not affect the result.
    y = y.astype(np.float32).astype(float)
    np.testing.assert_allclose(smallest_steps(y), step, rtol=1e-3 if step > 1e-9 else 10.0)


def test_missing_axes_and_spikes_do_not_change_the_step():
    y = coarse(5e-8, 1e-7)
    y[::7, 1] = np.nan
    y[::50, 0] += 2e-5
    y[:, 2] = np.nan
    for step in (sensor_after(y)[0]['step'], smallest_steps(y)):
        np.testing.assert_allclose(step, [1e-7, 1e-7, np.inf])


def test_a_field_that_changes_with_every_reading_has_no_observable_steps():
    y = np.cumsum(np.random.default_rng(0).uniform(1e-6, 3e-6, (60, 3)), axis=0)
    state = sensor_after(y)
    assert (state[0]['step'] > 1e-6).all() and (core.steps_of(state, False) == 0.0).all()
    assert (core.steps_of(sensor_after(coarse(1e-8, 1e-7, offset=0.45)), False) > 0.0).all()
    assert np.isinf(core.steps_of(sensor_after(np.ones((5, 3))), False)).all()


def test_the_compiled_rule_agrees_with_a_plain_implementation():
    background = FedBackground(3.0, 20.0, 1.5, 0.25, 2.0, 60.0)
    y = coarse(4e-8, 1e-7, seed=3)
    y[::11, 0] = np.nan
    stamps = np.cumsum(np.random.default_rng(1).integers(1, 100 * MS, len(y)))
    sensors = new_sensors(1)
    for stamp, field in zip(stamps.tolist(), y, strict=True):
        background.note(stamp, field)
        core.note_step(sensors, stamp, field)
        for name in ('step', 'raw', 'rest_since_ns', 'n_rest', 'n_same', 'n_changed'):
            np.testing.assert_array_equal(sensors[0][name], background.sensors[0][name], name)


def test_a_rest_counts_as_one_measurement_for_a_limited_time():
    n = MAX_REST_NS // (10 * MS)
    assert sensor_after(np.ones((3, 3)))[0]['n_rest'].tolist() == [3, 3, 3]
    assert sensor_after(np.ones((10 * n, 3)))[0]['n_rest'].tolist() == [n + 1] * 3
    after_change = sensor_after([*np.ones((10 * n, 3)), [1.0, 1.0, 2.0]])
    assert after_change[0]['n_rest'].tolist() == [n + 1, n + 1, 1]


@pytest.mark.parametrize('sigma', [0.01, 0.1, 0.2, 0.4, 0.5, 1.0, 3.0])
def test_mean_of_readings_has_the_predicted_error(sigma):
    """Over many levels, the mean of `n` readings has the error predicted from noise and steps."""
    rng, n, errors, predicted = np.random.default_rng(0), 8, [], []
    for level in rng.uniform(-0.5, 0.5, 4000):
        y = np.round(level + sigma * rng.standard_normal((n, 1)))
        variance = np.array([np.var(np.round(level + sigma * rng.standard_normal(200)))])
        at_rest = variance[0] <= DITHERED
        runs, run = [], 0
        for k in range(n):
            run = run + 1 if k and y[k] == y[k - 1] else 1
            runs.append(run)
        errors.append(y.mean() - level)
        predicted.append(np.sum(variance[0] + at_rest * np.array(runs) / 12.0) / n**2)
    ratio = np.mean(np.square(errors)) / np.mean(predicted)
    # The predicted error is too large if noise crosses the edge of a step, and rarely too small.
    assert 0.2 < ratio < 1.8, ratio


def test_an_axis_that_never_changed_is_at_rest_or_dead():
    v, inf = np.array([0.0, 0.01, 0.0]), np.inf
    np.testing.assert_array_equal(completed_steps(v, np.array([inf, 1.0, inf])), [1.0, 1.0, 1.0])
    fine = np.array([0.0, 4.0, 0.0])
    np.testing.assert_array_equal(completed_steps(fine, np.array([inf, 1.0, inf])),
                                  [np.nan, 1.0, np.nan])
    unknown = np.full(3, inf)
    np.testing.assert_array_equal(completed_steps(np.zeros(3), unknown), unknown)
    one = np.array([np.nan, 0.0, np.nan])
    np.testing.assert_array_equal(completed_steps(one, np.array([inf, 2.0, inf])), [inf, 2.0, inf])


def test_an_axis_at_rest_keeps_its_steps_if_another_becomes_noisy():
    """The other axes retain their quantisation variance; otherwise, their noise would be zero."""
    sensors = new_sensors(1)
    sensors['noise'], sensors['step'] = np.zeros((3, 3)), [np.inf, 1e-6, np.inf]
    limits = np.empty(3)
    core.apply_steps(sensors, 5.0, limits)
    np.testing.assert_allclose(sensors[0]['step_variance'], 1e-12 / 12.0)
    sensors['noise'][0, 1, 1] = 9e-12
    core.apply_steps(sensors, 5.0, limits)
    np.testing.assert_allclose(sensors[0]['step_variance'][[0, 2]], 1e-12 / 12.0)
    assert sensors[0]['step_variance'][1] == 0.0
