"""Clock offsets from knocks: invariances, standard deviations, and cases without an offset."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mag_tracking.calibration.clock import knock_lag, shock

GRAVITY = np.array([0.0, 0.0, 9.81])
KNOCKS = (2.0, 3.3)
NOISE = 0.02


def double_sided(t):
    """Double-sided exponential pulse of 30 ms, as in the recordings."""
    return np.exp(-np.abs(t) / 0.03)


def ringing(t):
    """Response of a struck post, which rings at 10 Hz."""
    s = np.maximum(t, 0.0)
    return np.where(t > 0.0, np.exp(-s / 0.08) * np.sin(2.0 * np.pi * 10.0 * s), 0.0)


def smooth(t):
    return np.exp(-0.5 * (t / 0.02)**2)


def accelerations(t, shape=double_sided, knocks=KNOCKS, rotation=None, direction=(0.3, -0.5, 0.8),
                  rng=None, noise=0.0):
    """Accelerations (n, 3) [m/s^2] of a rotated sensor at the true times `t`."""
    level = sum(8.0 * shape(t - k) for k in knocks)
    R = Rotation.identity() if rotation is None else rotation
    a = R.inv().apply(GRAVITY + level[:, None] * np.asarray(direction))
    return a if rng is None else a + noise * rng.standard_normal(a.shape)


def times(rng, rate, end=5.0):
    """Sampling times (n,) [s] with a random phase and a jitter of a fifth of an interval."""
    n = int(end * rate)
    return (np.arange(n) + rng.random() + 0.2 * rng.uniform(-1.0, 1.0, n)) / rate


def pair(offset, seed=0, rates=(100.0, 100.0), noise=NOISE, is_rotated=True, **kwargs):
    """(t, shock, t, shock) of two sensors; the clock of the second is ahead by `offset` [s]."""
    rng = np.random.default_rng(seed)
    out = []
    for ahead, rate in zip((0.0, offset), rates, strict=True):
        t = times(rng, rate)
        R = Rotation.random(random_state=rng) if is_rotated else None
        out += [t + ahead, shock(accelerations(t, rotation=R, rng=rng, noise=noise, **kwargs))]
    return out


@pytest.mark.parametrize('offset', [-0.31, -0.0123, 0.0, 0.0007, 0.0049, 0.05, 0.4])
def test_offset_is_positive_if_the_clock_is_ahead(offset):
    lag = knock_lag(*pair(offset, rates=(400.0, 400.0)), 0.5)
    assert lag.reason == '' and lag.correlation > 0.99
    # The error is at most a tenth of a sample.
    assert abs(lag.offset - offset) < 0.25e-3


def test_a_sensor_has_no_lag_to_itself():
    t, s, *_ = pair(0.0)
    lag = knock_lag(t, s, t, s, 0.5)
    assert abs(lag.offset) < 2e-6 and lag.correlation == pytest.approx(1.0)


@pytest.mark.parametrize('seed', range(5))
def test_exchanged_sensors_have_the_opposite_lag(seed):
    p = pair(0.0237, seed, rates=(100.0, 100.0))
    forward, backward = knock_lag(*p, 0.5), knock_lag(*p[2:], *p[:2], 0.5)
    assert forward.reason == backward.reason == ''
    # The other sensor is interpolated, so a difference of a fraction of a sample remains.
    assert abs(forward.offset + backward.offset) < 1.5e-3 and forward.offset > 0.02


def test_a_common_shift_of_the_times_has_no_effect():
    t, s, u, v = pair(0.02)
    a, b = knock_lag(t, s, u, v, 0.5), knock_lag(t + 40.0, s, u + 40.0, v, 0.5)
    assert b.offset == pytest.approx(a.offset, abs=3e-6)


def test_magnitude_of_the_knock_has_no_effect():
    t, s, u, v = pair(0.02)
    a, b = knock_lag(t, s, u, v, 0.5), knock_lag(t, s, u, 3.0 * v, 0.5)
    assert b.offset == pytest.approx(a.offset, abs=3e-6)
    assert b.std == pytest.approx(a.std, rel=1e-2)


def test_shock_does_not_depend_on_the_orientation():
    t = np.arange(0.0, 5.0, 0.01)
    a = accelerations(t)
    for seed in range(5):
        R = Rotation.random(random_state=seed)
        np.testing.assert_allclose(shock(R.apply(a)), shock(a), atol=1e-12)
    # The shock at rest is zero, and missing values remain missing.
    a[7] = np.nan
    s = shock(a)
    assert np.isnan(s[7]) and np.nanmedian(s) == 0.0
    peak = 8.0 * np.linalg.norm([0.3, -0.5, 0.8])
    assert np.nanmax(s) == pytest.approx(peak, rel=1e-6)


SHAPES = {'double-sided': double_sided, 'ringing': ringing, 'smooth': smooth}


UNRESOLVED = pytest.mark.xfail(strict=True, reason=(
    'mean square 2.0: the magnitude of a 10 Hz ringing has a cusp every 50 ms, which is not '
    'resolved at 100 Hz'))


@pytest.mark.parametrize('shape, rates', [
    pytest.param(shape, rates, marks=[UNRESOLVED] * (shape == 'ringing' and rates[0] == 100.0))
    for shape in SHAPES for rates in [(100.0, 100.0), (200.0, 100.0), (400.0, 400.0)]])
def test_error_agrees_with_its_std(shape, rates, n=60):
    """The mean normalised squared error is below its chi-square limit, and not far below one."""
    squares, missed = [], 0
    for seed in range(n):
        rng = np.random.default_rng(1000 + seed)
        offset = rng.uniform(-0.3, 0.3)
        direction = rng.standard_normal(3)
        lag = knock_lag(*pair(offset, seed, rates, shape=SHAPES[shape],
                              direction=direction / np.linalg.norm(direction)), 0.5)
        if lag.reason:
            missed += 1
        else:
            squares.append(((lag.offset - offset) / lag.std)**2)
    print(f'{shape} {rates}: mean square {np.mean(squares):.2f}, {missed} of {n} without a lag')
    assert missed <= 0.05 * n
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(squares)) / len(squares)
    assert np.mean(squares) < high
    assert np.mean(squares) > 0.1 * low


@pytest.mark.parametrize('rates', [(50.0, 50.0), (50.0, 400.0), (100.0, 100.0), (400.0, 100.0),
                                   (400.0, 400.0)])
@pytest.mark.parametrize('shape', ['double-sided', 'smooth'])
def test_error_is_a_fraction_of_a_sample(shape, rates):
    errors = [knock_lag(*pair(0.0173, seed, rates, shape=SHAPES[shape]), 0.5).offset - 0.0173
              for seed in range(20)]
    assert np.abs(errors).max() < 0.2 / min(rates)


def test_lag_is_exact_with_10_hz_at_rest_and_100_hz_near_knocks():
    """The sensors of the recordings use these sampling rates."""
    for seed in range(10):
        t, s, u, v = pair(-0.0213, seed)
        is_kept = []
        for clock, ahead in ((t, 0.0), (u, -0.0213)):
            near = (clock - ahead > KNOCKS[0] - 0.2) & (clock - ahead < KNOCKS[1] + 0.2)
            is_kept.append(near | (np.arange(len(clock)) % 10 == 0))
        lag = knock_lag(t[is_kept[0]], s[is_kept[0]], u[is_kept[1]], v[is_kept[1]], 0.5)
        assert lag.reason == '' and abs(lag.offset + 0.0213) < 1e-3


def test_a_sensor_without_a_knock_is_reported():
    t, s, u, v = pair(0.01)
    at_rest = 0.02 * np.random.default_rng(0).random(len(t))
    for args, text in (((t, at_rest, u, v), 'the reference measured no knock'),
                       ((t, s, t, at_rest), 'the sensor measured no knock'),
                       ((t, s, t, 0.0 * s), 'the sensor measured no knock'),
                       ((t, s, t[:5], s[:5]), 'the sensor measured no knock')):
        lag = knock_lag(*args, 0.5)
        assert lag.reason == text
        assert np.isnan(lag.offset) and np.isnan(lag.std)


def test_knocks_measured_by_one_sensor_each_yield_no_lag():
    rng = np.random.default_rng(3)
    t = times(rng, 100.0, 12.0)
    s = shock(accelerations(t, knocks=(2.0,), rng=rng, noise=NOISE))
    v = shock(accelerations(t, knocks=(9.0,), rng=rng, noise=NOISE))
    lag = knock_lag(t, s, t, v, 0.5)
    assert ' 6.' in lag.reason and '0.5 s' in lag.reason
    assert np.isnan(lag.offset)


def test_clocks_that_differ_by_decades_yield_no_lag():
    t, s, u, v = pair(0.01)
    lag = knock_lag(t, s, u + 1e9, v, 0.5)
    assert '1e+09 s' in lag.reason


@pytest.mark.parametrize('offset', [0.51, 0.52, 0.53, 0.56, 0.6, 0.8, 2.0, -0.52, -0.53, -0.8])
def test_an_offset_beyond_the_maximum_yields_no_wrong_lag(offset):
    lag = knock_lag(*pair(offset, knocks=(2.0, 2.8)), 0.5)
    assert lag.reason or abs(lag.offset - offset) < max(5.0 * lag.std, 1e-3)
    # A lag up to two samples beyond the maximum may be correct; larger lags are not searched.
    assert lag.reason or abs(offset) < 0.54


def test_evenly_spaced_knocks_are_ambiguous():
    even = tuple(1.0 + 0.25 * k for k in range(13))
    assert 'unevenly' in knock_lag(*pair(0.02, knocks=even), 0.5).reason
    # Uneven spacing resolves the ambiguity.
    uneven = tuple(np.cumsum([1.0, 0.25, 0.4, 0.17, 0.33, 0.21, 0.46]))
    assert knock_lag(*pair(0.02, knocks=uneven), 0.5).offset == pytest.approx(0.02, abs=5e-4)


def test_a_gap_in_the_readings_does_not_affect_the_lag():
    t, s, u, v = pair(0.02)
    is_kept = (u < 2.4) | (u > 2.9)
    assert knock_lag(t, s, u[is_kept], v[is_kept], 0.5).offset == pytest.approx(0.02, abs=5e-4)
    # With a gap over a knock of one sensor, there is no lag or the correct lag.
    is_kept = (u < 1.8) | (u > 2.3)
    lag = knock_lag(t, s, u[is_kept], v[is_kept], 0.5)
    assert lag.reason or lag.offset == pytest.approx(0.02, abs=1e-3)


@pytest.mark.parametrize('first', [1.9, 1.96, 1.98, 2.0, 2.02])
def test_a_recording_cut_in_a_knock_yields_no_wrong_lag(first):
    t, s, u, v = pair(0.02, knocks=(2.0,))
    for a in ((t[t > first], s[t > first], u, v), (t, s, u[u > first], v[u > first]),
              (t[t < first], s[t < first], u[u < first], v[u < first])):
        lag = knock_lag(*a, 0.5)
        assert lag.reason or abs(lag.offset - 0.02) < max(5.0 * lag.std, 2e-3)
