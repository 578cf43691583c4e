"""Marks for missing readings and regular repetitions in raw readings."""

import numpy as np
import pytest

from mag_tracking.calibration.reading_faults import reading_faults
from support.sensor_noise import EARTH, SIGMA, noise

N = 512


def quantised(fields, step):
    return np.round(fields / (step * SIGMA)) * step * SIGMA if step else fields


def a_pass(n=N):
    """Readings with a car of some microtesla in the middle."""
    t = np.arange(n)[:, None] - n / 2
    return noise(n) + np.exp(-(t / 20.0)**2) * [4e-6, -2e-6, 3e-6]


def held(ratio, step, seed=0, n=N):
    """Readings of a sensor that measures once in `ratio` readings."""
    measured = quantised(noise(n, seed), step)
    return measured[np.floor(np.arange(n) / ratio + 1e-9).astype(int)]


@pytest.mark.parametrize('step', [0.0, 1.25])
@pytest.mark.parametrize('ratio', [1.5, 2, 2.5, 3, 10 / 3, 4, 5, 6, 7, 8, 9, 10])
def test_the_ratio_of_the_rates_is_found(ratio, step):
    assert reading_faults(held(ratio, step)).repetition == pytest.approx(ratio, rel=0.005)


@pytest.mark.parametrize('step', [0.3, 0.85, 1.0, 2.0, 3.0, 5.0, 10.0])
@pytest.mark.parametrize('n', [128, 256, 512])
def test_repetitions_by_rounding_are_random(n, step):
    """A false alarm in a thousand windows would be found."""
    rng = np.random.default_rng(int(10 * step) + n)
    for _ in range(100):
        fields = quantised(EARTH + SIGMA * rng.standard_normal((n, 3)), step)
        assert not reading_faults(fields)


@pytest.mark.parametrize('loss', [0.0, 0.05, 0.2])
@pytest.mark.parametrize('jitter', [0.0, 0.05])
def test_the_ratio_is_found_despite_lost_readings(loss, jitter):
    rng = np.random.default_rng(int(100 * loss))
    kept = rng.random(N) >= loss
    stamps = (1e7 * (np.arange(N) + jitter * rng.standard_normal(N))).astype(np.int64)
    assert reading_faults(held(4, 1.25)[kept], stamps[kept]).repetition == pytest.approx(4.0)


def test_only_the_readings_that_changed_remain():
    fields = held(5, 0.0)
    kept = reading_faults(fields).without(fields)
    is_kept = ~np.isnan(kept).all(axis=1)
    assert np.array_equal(np.flatnonzero(is_kept), np.arange(0, N, 5))
    assert np.array_equal(kept[is_kept], fields[is_kept])


MARKS = {'nanotesla': 9.9999e-5, 'double': 1e296, 'float': np.finfo(np.float32).max.item(),
         'counts': -4096 * 1.5e-8, 'zero': 0.0, 'minus one': -1.0, 'range': 4.9151e-4}


@pytest.mark.parametrize('rows', [
    slice(3, None, 97), slice(1, None, 2), slice(100, 160), np.flatnonzero(np.arange(N) % 3)],
    ids=['rare', 'every second', 'one gap', 'two of three'])
@pytest.mark.parametrize('axes', [[0, 1, 2], [2]], ids=['all', 'z'])
@pytest.mark.parametrize('name', MARKS)
def test_marks_are_found_and_left_out(name, axes, rows):
    fields = a_pass()
    clean = fields.copy()
    fields[np.arange(N)[rows][:, None], axes] = MARKS[name]
    faults = reading_faults(fields)
    expected = np.full(3, np.nan)
    expected[axes] = MARKS[name]
    np.testing.assert_array_equal(faults.marks, [expected])
    clean[np.arange(N)[rows][:, None], axes] = np.nan
    np.testing.assert_array_equal(faults.without(fields), clean)


@pytest.mark.parametrize('mark', [0.0, 9.9999e-5])
@pytest.mark.parametrize('axes', [[0, 1, 2], [2]], ids=['all', 'z'])
def test_marks_at_the_start_are_found(mark, axes):
    fields, expected = a_pass(), np.full(3, np.nan)
    fields[:200, axes] = expected[axes] = mark
    np.testing.assert_array_equal(reading_faults(fields).marks, [expected])


@pytest.mark.parametrize('step', [0.0, 1.0, 10.0, 100.0])
def test_a_level_that_is_left_at_once_is_not_a_mark(step):
    """A vehicle departs between two readings, or a sensor was stuck."""
    fields = quantised(noise(N) + np.where(np.arange(N) < 200, 2e-6, 0.0)[:, None], step)
    assert not len(reading_faults(fields).marks)
    fields[:200] = fields[0]
    assert not len(reading_faults(fields).marks)


@pytest.mark.parametrize('mark', [0.0, 9.9999e-5])
def test_marks_of_a_sensor_that_rests_in_one_step_are_found(mark):
    fields = quantised(noise(N), 30.0)
    fields[5::25] = mark
    np.testing.assert_array_equal(reading_faults(fields).marks, [[mark] * 3])


def test_a_mark_of_two_axes_is_found_once():
    fields = a_pass()
    fields[::31, [0, 2]] = -3.75e-4, -4.18e-4
    np.testing.assert_array_equal(reading_faults(fields).marks, [[-3.75e-4, np.nan, -4.18e-4]])


@pytest.mark.parametrize('seed', range(5))
def test_huge_values_that_are_equal_by_chance_on_one_axis_are_not_marks(seed):
    fields = quantised(noise(N, seed), 1.25)
    fields[7::50] *= 1e9
    assert not len(reading_faults(fields).marks)


def test_a_mark_of_zero_on_an_axis_without_a_field_belongs_to_the_others():
    fields = noise(N) - [EARTH[0], 0.0, 0.0]
    fields[::40] = 0.0
    np.testing.assert_array_equal(reading_faults(fields).marks, np.zeros((1, 3)))


def test_two_marks_and_a_repetition_are_found_together():
    fields = held(4, 0.0)
    fields[50:80] = 0.0
    fields[300:330] = 9.9999e-5
    faults = reading_faults(fields)
    assert sorted(faults.marks[:, 0]) == [0.0, 9.9999e-5]
    assert faults.repetition == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize('step', [0.0, 1.0, 10.0, 100.0])
def test_passes_steps_and_spikes_are_not_marks(step):
    spikes = a_pass()
    spikes[40::60] += 1e-5 * np.random.default_rng(0).uniform(1.0, 2.0, (8, 3))
    parked = noise(N) + np.where((np.arange(N) > 200) & (np.arange(N) < 350), 1e-6, 0.0)[:, None]
    clipped = np.minimum(a_pass(), EARTH + 2e-6)
    for fields in (a_pass(), spikes, parked, clipped, noise(N), np.tile(EARTH, (N, 1)),
                   np.full((N, 3), np.nan), np.zeros((0, 3))):
        assert not len(reading_faults(quantised(fields, step)).marks)
