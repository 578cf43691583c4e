"""Plain Kalman filter, an oracle in other tests, compared with a dense filter and filterpy."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from scipy.stats import chi2, multivariate_normal

from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.simulation.scenario import Path
from mag_tracking.stages.track.target import target_of
from support import plain_kalman
from support.bundled import POINT
from support.marks import studied
from support.networks import line_network
from support.samples import one, simulate
from support.scenario import point_body


def dense_update(x, P, y, h, H, C, inflation, x_lin, n_own=0):
    """Textbook update of one hypothesis with all sensors stacked (oracle).

    Returns the mean, the covariance, the log-likelihood, the NIS, and the whitened Jacobian,
    innovation and innovation covariance.
    """
    n_sensors, n_t = len(H), H.shape[2] - n_own
    full = np.zeros((3 * n_sensors, len(x)))
    full[:, -3 * n_sensors:] = np.eye(3 * n_sensors)
    for j in range(n_sensors):
        first_own = n_t + n_own * j
        full[3 * j:3 * j + 3, :n_t] = H[j, :, :n_t]
        full[3 * j:3 * j + 3, first_own:first_own + n_own] = H[j, :, n_t:]
    R = np.zeros((3 * n_sensors, 3 * n_sensors))
    for j in range(n_sensors):
        R[3 * j:3 * j + 3, 3 * j:3 * j + 3] = C[j] + inflation[j] * np.eye(3)
    is_present = ~np.isnan(y.ravel())
    full, R = full[is_present], R[np.ix_(is_present, is_present)]
    predicted = (h.ravel() + x_lin[-3 * n_sensors:])[is_present] + full @ (x - x_lin)
    nu = y.ravel()[is_present] - predicted
    # Whitened, because values in tesla are below general-purpose tolerances.
    W = np.linalg.inv(np.linalg.cholesky(R))
    A = W @ full
    S = A @ P @ A.T + np.eye(len(A))
    K = np.linalg.solve(S, A @ P).T
    log_likelihood = multivariate_normal(np.zeros(len(A)), S).logpdf(W @ nu) \
        + np.linalg.slogdet(W)[1]
    z = W @ nu
    P_new = P - K @ A @ P
    return (x + K @ z, 0.5 * (P_new + P_new.T), log_likelihood, z @ np.linalg.solve(S, z),
            (A, z, S))


def bank_in_a_pass(n_sensors, missing=False):
    """State of a bank in the middle of a simulated pass, and the inputs of its next update."""
    network = line_network(n_sensors)
    rng = np.random.default_rng(5)
    samples, *_ = simulate(network, point_body([250.0, -120.0, 90.0], 5.0, 0.5),
                           Path(np.array([-60.0, -1.0]), 0.0, 10.0), 25.0, 12.0, rng)
    pipeline = Pipeline(network, settings_for('vehicle', {
        **POINT, 'align.period_s': 0.04, 'track.mounting_std_deg': 0.0,
        'track.model_error_time_s': 0.0, 'track.max_sensors': 1000,
        'track.vehicle.arrival_names': ['a'],
        'track.vehicle.arrival_headings_deg': [0.0]}))
    frame = None
    for sample in samples:
        for record in pipeline.feed(one(sample)):
            if hasattr(record, 'target_present') and record.target_present:
                frame = record
        if pipeline.track.counts['poses'] >= 25:
            break
    bank = pipeline.track.bank
    y = frame.field + 1e-8 * rng.standard_normal(frame.field.shape)
    if missing:
        y[0, 2] = np.nan
        y[1] = np.nan
    x, P = bank.x.copy(), bank.P.copy()
    model = target_of(pipeline.settings.track, network).model
    h, H, gradient = sensor_fields(network.positions, network.R_sw,
                                   *model.dipoles(x[:, :len(model.state_names)]))
    C = np.repeat(1.44e-16 * np.array([[1.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.8]])[None],
                  n_sensors, axis=0)
    return x, P, y, h, H, C, gradient**2


def compare(n_sensors, missing=False, shift=0.0):
    """Maximum differences of updated means [std] and covariances [std^2] from both oracles."""
    x, P, y, h, H, C, inflation = bank_in_a_pass(n_sensors, missing)
    x_lin = x + shift * np.sqrt(np.einsum('nii->ni', P))
    new_x, new_P = x.copy(), P.copy()
    log_likelihood, nis, _ = plain_kalman.update(new_x, new_P, y, h, H, C, inflation, x_lin)
    largest = np.zeros(4)
    for p in range(len(x)):
        expected_x, expected_P, expected_ll, expected_nis, (A, z, _) = dense_update(
            x[p], P[p], y, h[p], H[p], C, inflation[p], x_lin[p])
        sd = np.sqrt(np.diagonal(expected_P))
        largest[0] = max(largest[0], np.abs((new_x[p] - expected_x) / sd).max())
        largest[1] = max(largest[1], np.abs((new_P[p] - expected_P) / np.outer(sd, sd)).max())
        assert abs(log_likelihood[p] - expected_ll) <= 1e-8 * max(1.0, abs(expected_ll))
        assert abs(nis[p].sum() - expected_nis) <= 1e-8 * max(1.0, expected_nis)
        ekf = ExtendedKalmanFilter(len(x[p]), len(z))
        ekf.x, ekf.P, ekf.R = x[p].copy(), P[p].copy(), np.eye(len(z))
        ekf.update(z, lambda _, A=A: A, lambda _, z=z: np.zeros_like(z))
        largest[2] = max(largest[2], np.abs((new_x[p] - ekf.x) / sd).max())
        largest[3] = max(largest[3], np.abs((new_P[p] - ekf.P) / np.outer(sd, sd)).max())
    return largest


@pytest.mark.parametrize('n_sensors', studied([2, 8, 32], [2, 8]))
def test_update_equals_dense_oracle_and_filterpy(n_sensors):
    dense_mean, dense_cov, ekf_mean, ekf_cov = compare(n_sensors)
    print(f'{n_sensors} sensors: dense {dense_mean:.1e} sd, {dense_cov:.1e}; '
          f'filterpy {ekf_mean:.1e} sd, {ekf_cov:.1e}')
    assert max(dense_mean, ekf_mean) <= 1e-8
    assert max(dense_cov, ekf_cov) <= 1e-9


def test_update_with_missing_axes_and_sensors():
    assert max(compare(3, missing=True)) <= 1e-8


@pytest.mark.parametrize('n_own', [0, 2, 3])
@pytest.mark.parametrize('n_t', [0, 3, 5, 7, 12])
def test_update_of_values_near_one_with_any_axes_missing(n_t, n_own):
    """Values near one reveal a missing axis that is not excluded; values in tesla would not."""
    rng = np.random.default_rng(n_t)
    n_sensors = 8
    n_x = n_t + (n_own + 3) * n_sensors
    x = rng.standard_normal((1, n_x))
    P, C = (np.stack([a @ a.T + 0.1 * np.eye(k) for a in rng.standard_normal((n, k, k))])
            for n, k in ((1, n_x), (n_sensors, 3)))
    h = rng.standard_normal((1, n_sensors, 3))
    H = rng.standard_normal((1, n_sensors, 3, n_t + n_own))
    inflation = rng.uniform(0.0, 1.0, (1, n_sensors))
    x_lin = x + rng.standard_normal(x.shape)
    y = rng.standard_normal((n_sensors, 3))
    patterns = np.array([[j >> a & 1 for a in range(3)] for j in range(n_sensors)], dtype=bool)
    y[patterns] = np.nan
    C[patterns] = np.nan
    C[np.broadcast_to(patterns[:, None, :], C.shape)] = np.nan
    new_x, new_P = x.copy(), P.copy()
    log_likelihood, nis, _ = plain_kalman.update(new_x, new_P, y, h, H, C, inflation, x_lin, n_own)
    filled = np.where(np.isnan(C), np.eye(3), C)
    expected_x, expected_P, expected_ll, expected_nis, _ = dense_update(
        x[0], P[0], y, h[0], H[0], filled, inflation[0], x_lin[0], n_own)
    np.testing.assert_allclose(new_x[0], expected_x, atol=1e-9)
    np.testing.assert_allclose(new_P[0], expected_P, atol=1e-9)
    np.testing.assert_allclose([log_likelihood[0], nis[0].sum()], [expected_ll, expected_nis],
                               rtol=1e-9)


def test_update_linearised_away_from_the_mean():
    assert max(compare(2, shift=0.3)[:2]) <= 1e-8


def test_nees_of_a_linear_gaussian_case_is_chi_square():
    """With a linear model, true prior and true noise, the mean NEES is within its 95 % interval."""
    rng = np.random.default_rng(11)
    runs, steps, n_t, n_sensors, dt = 400, 12, 6, 2, 0.1
    n_x = n_t + 3 * n_sensors
    F, Q = np.eye(6), 0.02 * np.eye(6)
    F[:3, 3:] = dt * np.eye(3)
    P0 = np.diag(np.r_[np.full(3, 2.0), np.full(3, 1.0), np.full(6, 0.3)])
    truth = rng.multivariate_normal(np.zeros(n_x), P0, runs)
    x, P = np.zeros((runs, n_x)), np.repeat(P0[None], runs, axis=0)
    H = np.repeat(rng.standard_normal((n_sensors, 3, n_t))[None], runs, axis=0)
    C = np.repeat(np.diag([0.5, 1.0, 2.0])[None], n_sensors, axis=0)
    nis = []
    for k in range(steps):
        if k:
            truth[:, :n_t] = truth[:, :n_t] @ F.T + rng.multivariate_normal(np.zeros(6), Q, runs)
            truth[:, n_t:] += np.sqrt(0.01) * rng.standard_normal((runs, n_x - n_t))
            plain_kalman.predict(x, P, x[:, :n_t] @ F.T, F, Q, 0.01)
        noise = rng.standard_normal((runs, n_sensors, 3)) * np.sqrt([0.5, 1.0, 2.0])
        y = np.einsum('pjic,pc->pji', H, truth[:, :n_t]) \
            + truth[:, n_t:].reshape(runs, n_sensors, 3) + noise
        # The measurement differs between runs, so each run is updated separately.
        for p in range(runs):
            h = np.einsum('jic,c->ji', H[p], x[p, :n_t])[None]
            nis.append(plain_kalman.update(x[p:p + 1], P[p:p + 1], y[p], h, H[p:p + 1], C,
                                           np.zeros((1, n_sensors)))[1][0])
    e = truth - x
    nees = np.einsum('pi,pij,pj->p', e, np.linalg.inv(P), e)
    low, high = chi2.ppf([0.025, 0.975], runs * n_x) / runs
    print(f'linear Gaussian NEES {nees.mean():.3f}, band {low:.3f} .. {high:.3f}')
    assert low <= nees.mean() <= high
    # Innovations are white: in every step, each sensor contributes three degrees of freedom.
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nis)) / len(nis)
    by_sensor = np.mean(nis, axis=0)
    print(f'NIS by sensor {by_sensor.round(3)}, band {low:.3f} .. {high:.3f}')
    assert (low <= by_sensor).all() and (by_sensor <= high).all()
