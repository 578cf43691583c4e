"""Direction from the sense of rotation of a field: published values, Monte Carlo, fusion."""

import numpy as np
import pytest

from mag_tracking.inference.driving_direction import (
    FieldRotation,
    field_rotation,
    fused_log_odds,
    lag_of,
)

N = 100
"""Number of samples in the window of the published simulation."""


def signal(distance=1.0, direction=1.0, n=N):
    """Field (n, 2), without mu0 / 4 pi, of a dipole (1, 1, 1) that moves from x = -5 to 5 m."""
    r = np.stack([direction * np.linspace(-5.0, 5.0, n), np.full(n, distance), np.zeros(n)], axis=1)
    size = np.linalg.norm(r, axis=1)[:, None]
    return (3.0 * r * r.sum(axis=1)[:, None] / size**5 - 1.0 / size**3)[:, :2]


def noise_for(h, snr_db):
    """Noise standard deviation for a signal-to-noise ratio; PHD15 Paper B eq. (40)."""
    return float(np.sqrt(np.mean(np.sum(h**2, axis=1)) * 10.0**(-snr_db / 10.0)))


def expected_rotation(signal, noise_std, lag):
    """Mean and variance of `field_rotation` for a noise-free field (n, 2) [T] that is zero outside
    the window; PHD15 Paper B eq. (12), (14)."""
    padded = np.pad(signal, ((lag, lag), (0, 0)))
    differences = np.sum(np.square(padded[2 * lag:] - padded[:-2 * lag]))
    return FieldRotation(field_rotation(padded, noise_std, lag).correlation,
                         noise_std**2 / lag**2 * differences
                         + 2.0 * len(signal) / lag**2 * noise_std**4)


def test_expected_rotation_equals_the_published_simulation():
    """PHD15 Paper B, section VI, recomputed with the published parameters."""
    h = signal()
    assert np.mean(np.sum(h**2, axis=1)) == pytest.approx(0.583103, abs=1e-6)
    assert expected_rotation(h, 1.0, 1).correlation == pytest.approx(-8.73775, abs=1e-5)
    assert expected_rotation(h, 1.0, 15).correlation == pytest.approx(-1.12269, abs=1e-5)
    # These values agree with 20 000 Monte Carlo runs.
    assert expected_rotation(h, noise_for(h, -10.0), 15).variance == pytest.approx(33.42, abs=5e-3)
    for snr_db, error in ((-20, 0.4919), (-15, 0.4747), (-10, 0.4230), (-5, 0.2881), (0, 0.0773),
                          (5, 0.00098)):
        found = expected_rotation(h, noise_for(h, snr_db), 15)
        assert found.error_probability == pytest.approx(error, abs=1e-4)


def normalised_errors(snr_db, lag, runs=4000):
    """Differences between simulation and theory, in standard errors of the simulation.

    Compared are the mean, variance, error rate and estimated variance of the correlation.
    """
    rng, h = np.random.default_rng([snr_db + 50, lag]), signal()
    std = noise_for(h, snr_db)
    padded = np.pad(h, ((lag, lag), (0, 0)))
    found = [field_rotation(padded + std * rng.standard_normal(padded.shape), std, lag)
             for _ in range(runs)]
    f, estimates = (np.array(v) for v in zip(*found, strict=True))
    expected = expected_rotation(h, std, lag)
    assert estimates.min() >= 2.0 * N / lag**2 * std**4
    root_n, error = np.sqrt(runs), max(expected.error_probability, 1.0 / runs)
    out = [(f.mean() - expected.correlation) / f.std() * root_n,
           (f.var() - expected.variance) / np.std((f - f.mean())**2) * root_n,
           # The statistic is not exactly normal; the tolerance is one percentage point.
           max(0.0, abs(np.mean(f > 0.0) - error) - 0.01) / np.sqrt(error * (1 - error)) * root_n]
    # If noise dominates, the lower limit increases the estimate of the variance.
    return [*out, (estimates.mean() - expected.variance) / estimates.std() * root_n
            if snr_db >= 0 else 0.0]


def test_mean_variance_and_error_rate_agree_with_theory():
    """PHD15 Paper B eq. (12), (14), (17), (16), at six signal-to-noise ratios and four lags."""
    z = np.abs([normalised_errors(snr_db, lag) for snr_db in (-10, -5, 0, 5, 10, 20)
                for lag in (3, 7, 11, 15)])
    # Of 24 values, one exceeds three standard errors with probability 1/16, two with 1/500.
    assert (np.count_nonzero(z > 3.0, axis=0) <= 1).all() and z.max() < 4.0, z


def test_sign_is_that_of_the_direction_for_any_yaw_of_the_sensor():
    h, c, s = signal(), np.cos(0.7), np.sin(0.7)
    unrotated = expected_rotation(h, 0.1, 7)
    assert unrotated.left_to_right > 0.999 and unrotated.log_odds > 6.0
    assert expected_rotation(signal(direction=-1.0), 0.1, 7).log_odds < -6.0
    rotated = expected_rotation(h @ np.array([[c, -s], [s, c]]), 0.1, 7)
    assert rotated == pytest.approx(unrotated)


def test_the_published_best_lag_requires_a_distance_of_two_metres():
    """The best lag is 7 samples at the published distance of 1 m; the published lag 15 fits 2 m."""
    def best(distance):
        h = signal(distance)
        std, lags = noise_for(h, -5.0), list(range(1, 26))
        errors = [expected_rotation(h, std, lag).error_probability for lag in lags]
        return lags[int(np.argmin(errors))]

    assert best(1.0) == 7 and 13 <= best(2.0) <= 15


def test_the_lag_of_a_pass_is_near_the_optimum():
    rng, h = np.random.default_rng(3), signal()
    std = noise_for(h, 0.0)
    window = np.pad(h, ((25, 25), (0, 0))) + std * rng.standard_normal((N + 50, 2))
    errors = {p: expected_rotation(h, std, p).error_probability for p in range(1, 26)}
    assert errors[lag_of(window, std, 25)] < 3.0 * min(errors.values())


def test_noise_alone_yields_no_direction():
    rng = np.random.default_rng(4)
    p = np.array([field_rotation(rng.standard_normal((80, 2)), 1.0, 5).left_to_right
                  for _ in range(2000)])
    assert abs(p.mean() - 0.5) < 0.03
    assert lag_of(np.zeros((50, 2)), 1.0, 10) == 0
    for lag in (0, 25, 40):
        with pytest.raises(ValueError, match='lag'):
            field_rotation(np.zeros((50, 2)), 1.0, lag)


def test_sensors_on_both_sides_are_fused():
    """PHD15 Paper B eq. (20)-(23): product of the odds, inverted on the other side of the road."""
    this_side, other_side = FieldRotation(-2.0, 1.0), FieldRotation(1.0, 1.0)
    p, q = this_side.left_to_right, 1.0 - other_side.left_to_right
    fused = fused_log_odds([this_side.log_odds, other_side.log_odds], [True, False])
    assert fused == pytest.approx(np.log(p * q / ((1.0 - p) * (1.0 - q))))
    # The probability of this log-odds rounds to one.
    assert FieldRotation(-40.0, 1.0).log_odds > 800.0
