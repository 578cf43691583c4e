"""Bank of integrated random walks, compared with plain Kalman filters and with true models."""

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from scipy.special import logsumexp

from mag_tracking.inference.gauss_markov import STRENGTHS, SWITCH_INTERVAL_S, GaussMarkovVectors


def plain_filter(density, std):
    """Kalman filter of one component, implemented by filterpy."""
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.H, kf.P = np.array([[1.0, 0.0]]), np.diag([std**2, density])
    return kf


def by_plain_filters(series, variance, dt, scale, std):
    """Log-densities of the vectors `series` (n, m) by banks with one plain filter per component."""
    banks = [[plain_filter((s * scale)**2, std) for _ in series[0]] for s in STRENGTHS]
    log_w = np.full(len(STRENGTHS), -np.log(len(STRENGTHS)))
    out = []
    for y in series:
        p_stay = np.exp(-dt / SWITCH_INTERVAL_S)
        log_w = np.log(p_stay * np.exp(log_w) + (1.0 - p_stay) / len(STRENGTHS))
        for k, bank in enumerate(banks):
            for kf, value in zip(bank, y, strict=True):
                q = Q_continuous_white_noise(2, dt, (STRENGTHS[k] * scale)**2)
                kf.predict(F=np.array([[1.0, dt], [0.0, 1.0]]), Q=q)
                if np.isfinite(value):
                    kf.update(value, R=variance)
                    log_w[k] += kf.log_likelihood
        out.append(logsumexp(log_w))
        log_w -= out[-1]
    return np.array(out)


def test_densities_equal_those_of_plain_filters():
    rng = np.random.default_rng(0)
    series = np.cumsum(rng.standard_normal((25, 3)), axis=0)
    series[7, 1] = series[11] = np.nan
    vectors = GaussMarkovVectors(1, np.full(3, 0.5), 2.0)
    densities = []
    for y in series:
        is_present = np.isfinite(y)
        densities.append(vectors.log_density(
            np.zeros(is_present.sum(), dtype=np.int64), np.eye(3)[is_present], y[is_present],
            np.full(is_present.sum(), 0.04), 0.1))
    expected = by_plain_filters(series, 0.04, 0.1, 0.5, 2.0)
    assert densities == pytest.approx(expected, rel=1e-9)


def test_vectors_are_independent_and_measured_in_any_orientation():
    rng = np.random.default_rng(1)
    R = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    both, rotated = GaussMarkovVectors(2, np.ones(3), 1.0), GaussMarkovVectors(1, np.ones(3), 1.0)
    alone = [GaussMarkovVectors(1, np.ones(3), 1.0) for _ in range(2)]
    zero, variance = np.zeros(3, dtype=np.int64), np.full(3, 0.01)
    for _ in range(20):
        y = rng.standard_normal((2, 3))
        joint = both.log_density(np.repeat([0, 1], 3), np.tile(np.eye(3), (2, 1)), y.ravel(),
                                 np.full(6, 0.01), 0.05)
        each = [f.log_density(zero, np.eye(3), v, variance, 0.05)
                for f, v in zip(alone, y, strict=True)]
        assert joint == pytest.approx(sum(each), rel=1e-9)
        # A rotated sensor measures the same vector.
        assert rotated.log_density(zero, R, R @ y[0], variance, 0.05) == pytest.approx(
            each[0], rel=1e-6)


@pytest.mark.parametrize('strength', [0.1, 10.0, 1000.0])
def test_density_of_data_from_the_model_is_near_that_of_the_true_filter(strength):
    rng = np.random.default_rng(2)
    dt, n = 0.08, 400
    rate = np.cumsum(strength * np.sqrt(dt) * rng.standard_normal(n))
    y = np.cumsum(rate) * dt + rng.standard_normal(n)
    bank, true_filter = GaussMarkovVectors(1, np.ones(1), 1.0), plain_filter(strength**2, 1.0)
    log_density = true_log_density = 0.0
    for value in y:
        log_density += bank.log_density(np.zeros(1, dtype=np.int64), np.ones((1, 1)),
                                        np.array([value]), np.ones(1), dt)
        true_filter.predict(F=np.array([[1.0, dt], [0.0, 1.0]]),
                            Q=Q_continuous_white_noise(2, dt, strength**2))
        true_filter.update(value, R=1.0)
        true_log_density += true_filter.log_likelihood
    # The unknown strength costs its initial weight and at most log(1/p_stay) per frame.
    assert true_log_density - n * dt / SWITCH_INTERVAL_S - np.log(len(STRENGTHS)) \
        < log_density < true_log_density + 10.0


@pytest.mark.parametrize('gap, noise', [(3600.0, 4e-9), (86400.0, 1e-10), (10.0, 1e-12)])
def test_densities_stay_finite_over_long_gaps_and_with_little_noise(gap, noise):
    rng = np.random.default_rng(4)
    bank = GaussMarkovVectors(1, np.full(3, 2e-8), 1e-4)
    for k in range(20):
        density = bank.log_density(np.zeros(3, dtype=np.int64), np.eye(3),
                                   1e-6 + noise * rng.standard_normal(3), np.full(3, noise**2),
                                   gap if k % 5 == 4 else 0.08)
        assert np.isfinite(density)
    # The bank still follows the signal: a repeated value has a high density.
    y = np.full(3, 1e-6)
    densities = [bank.log_density(np.zeros(3, dtype=np.int64), np.eye(3), value,
                                  np.full(3, noise**2), 0.08) for value in (y, y, y + 1e3 * noise)]
    # A strength larger by a factor of 1000 costs log(1000) per axis.
    assert densities[2] < densities[1] - 15.0


def test_components_of_zero_strength_are_constant():
    """Combinations of a varying and a constant component are measured; the oracle is filterpy."""
    rng = np.random.default_rng(5)
    bank = GaussMarkovVectors(1, np.array([0.5, 0.0]), 2.0)
    H = np.array([[1.0, 0.3], [0.2, -1.0]])
    filters, log_w = [], np.full(len(STRENGTHS), -np.log(len(STRENGTHS)))
    for strength in STRENGTHS:
        kf = KalmanFilter(dim_x=3, dim_z=2)
        kf.H, kf.R = np.insert(H, 1, 0.0, axis=1), 0.04 * np.eye(2)
        kf.P = np.diag([4.0, (0.5 * strength)**2, 4.0])
        filters.append(kf)
    for y in np.cumsum(rng.standard_normal((25, 2)), axis=0):
        p_stay = np.exp(-0.1 / SWITCH_INTERVAL_S)
        log_w = np.log(p_stay * np.exp(log_w) + (1.0 - p_stay) / len(STRENGTHS))
        for k, kf in enumerate(filters):
            Q = np.zeros((3, 3))
            Q[:2, :2] = Q_continuous_white_noise(2, 0.1, (0.5 * STRENGTHS[k])**2)
            F = np.eye(3)
            F[0, 1] = 0.1
            kf.predict(F=F, Q=Q)
            kf.update(y)
            log_w[k] += kf.log_likelihood
        expected = logsumexp(log_w)
        log_w -= expected
        assert bank.log_density(np.zeros(2, dtype=np.int64), H, y, np.full(2, 0.04), 0.1) \
            == pytest.approx(expected, rel=1e-8)
