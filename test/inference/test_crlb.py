"""Information, observability and bounds: check values of TSP14, properties and oracles."""

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.crlb import (
    bound,
    cpa_information,
    information,
    observability,
    path_bound,
    snr,
    snr_range,
)
from mag_tracking.physics.dipole import K_DIPOLE, dipole_field, dipole_jacobians

NAMES = [f'{state}_{axis}' for state in ('r0', 'v0', 'm') for axis in 'xyz']
R0, V0, ONES, UP = ([-3.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0])
ONE, TWO = [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
CAR, ROAD = [-20.0, 5.0, 0.4, 10.0, 0.3, 0.0, 200.0, -150.0, 250.0], [[0.0] * 3, [0.0, 9.0, 0.0]]
NOISE = 1.3e-16
"""[T^2] Noise variance of TSP14 section VI.B."""


def jacobian(m, positions, r0=R0, v0=V0, n_t=60):
    """Jacobian (n_t, n_sensors, 3, 9) with respect to [r0, v0, m] of the moving source."""
    t = 0.1 * np.arange(n_t)[:, None, None]
    d = np.asarray(positions) - (np.asarray(r0) + t * np.asarray(v0))
    dB_dd, dB_dm = dipole_jacobians(d, np.asarray(m))
    return np.concatenate([-dB_dd, -t[..., None] * dB_dd, dB_dm], axis=-1)


def example_information(m, positions):
    """Fisher information in the example of TSP14, with R = I and the field without mu0/4pi."""
    return information(jacobian(m, positions) / K_DIPOLE, np.eye(3))


def car_jacobian(positions):
    """Jacobian of 40 samples of a car with respect to [r0, v0, m, b]; b are the backgrounds."""
    H, n = jacobian(CAR[6:], positions, CAR[:3], CAR[3:6], n_t=40), len(positions)
    H_b = np.broadcast_to(np.eye(3 * n).reshape(n, 3, 3 * n), (40, n, 3, 3 * n))
    return np.concatenate([H, H_b], axis=-1)


CAR_SCALE = np.repeat([5.0, 5.0, 300.0, 1e-8], [3, 3, 3, 6])
CORRELATED = NOISE * np.array([[2.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 1.5]])


# The field of a moment perpendicular to the plane of motion depends on the distance only.
ROTATION_KERNEL = [*np.cross(UP, R0), *np.cross(UP, V0), 0.0, 0.0, 0.0]


@pytest.mark.parametrize('m, sensors, kernel, smallest, condition, unobservable', [
    (ONES, ONE, [[*R0, *V0, 3, 3, 3]], (0.2305, 5e-5), (np.inf, 0), 'r0_x r0_y v0_x m_x m_y m_z'),
    (UP, ONE, [[*R0, *V0, 0, 0, 3], ROTATION_KERNEL], (0.714, 5e-4), (np.inf, 0),
     'r0_x r0_y v0_x v0_y m_z'),
    (ONES, TWO, np.empty((0, 9)), (3.956, 5e-4), (2571, 0.5), ''),
])
def test_observability_of_the_published_example(m, sensors, kernel, smallest, condition,
                                                unobservable):
    """Check values of an example of TSP14 Proposition 1, to the published digits."""
    o, k = observability(example_information(m, sensors), NAMES), len(kernel)
    print(f'{len(sensors)} sensors, m = {m}:', o.eigenvalues, o.condition_number)
    assert np.all(np.abs(o.eigenvalues[:k]) < 1e-12 * o.eigenvalues[-1])
    assert o.eigenvalues[k] == pytest.approx(smallest[0], abs=smallest[1])
    assert o.condition_number == pytest.approx(condition[0], abs=condition[1])
    assert o.kernel_dimension == k and o.unobservable == tuple(unobservable.split())
    np.testing.assert_allclose(o.kernel @ o.kernel.T @ np.transpose(kernel), np.transpose(kernel),
                               atol=1e-10)


def test_scaled_observability_does_not_depend_on_units():
    """With given scales, the eigenvalues do not depend on the units of the states."""
    J = information(car_jacobian(ROAD), NOISE * np.eye(3))
    unit = np.repeat([1e3, 1e3, 1.0, 1e9], [3, 3, 3, 6])
    names = NAMES + list('abcdef')
    found = observability(J, names, CAR_SCALE)
    in_other_units = observability(J / np.outer(unit, unit), names, CAR_SCALE * unit)
    assert found.kernel_dimension == 0
    np.testing.assert_allclose(found.eigenvalues, in_other_units.eigenvalues, rtol=1e-6)
    # Without scales, the background in tesla dominates all other states.
    assert observability(J, names).kernel_dimension > 0
    # The kernel is returned in the units of the states: [r0, v0, 3 m, 0].
    one = information(car_jacobian(ROAD[:1]), NOISE * np.eye(3))
    kernel = observability(one, names[:12], CAR_SCALE[:12]).kernel
    x = np.concatenate([CAR[:6], 3.0 * np.array(CAR[6:]), np.zeros(3)])
    assert kernel.shape == (12, 1)
    np.testing.assert_allclose(kernel[:, 0] * (x[0] / kernel[0, 0]), x, rtol=1e-6, atol=1e-7)


def test_known_cpa_range_makes_one_sensor_observable():
    J, prior = example_information(ONES, ONE), cpa_information(R0, V0, 0.1)
    assert observability(J + prior, NAMES).kernel_dimension == 0
    # Only the prior determines the range, so the bound of the range equals the prior.
    gradient = np.array([0.0, 1.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0])
    assert gradient @ bound(J, prior) @ gradient == pytest.approx(0.1**2, rel=1e-9)
    # With a kernel of two dimensions, the heading remains unobservable.
    assert observability(example_information(UP, ONE) + prior, NAMES).kernel_dimension == 1


def test_cpa_information_is_that_of_the_gradient_of_the_range():
    """The oracle is a gradient by central differences; the equation of TSP14 lacks a minus sign."""
    def cpa_range(x):
        return np.linalg.norm(np.cross(x[:3], x[3:6])) / np.linalg.norm(x[3:6])

    x, step = np.array([-4.0, 2.0, 0.7, 3.0, 0.5, -0.2, *ONES]), 1e-5
    gradient = np.array([(cpa_range(x + e) - cpa_range(x - e)) / (2 * step)
                         for e in step * np.eye(9)])
    np.testing.assert_allclose(cpa_information(x[:3], x[3:6], 0.3),
                               np.outer(gradient, gradient) / 0.3**2, rtol=1e-7, atol=1e-8)


def test_estimate_of_a_linear_model_reaches_the_bound():
    rng, n, H = np.random.default_rng(3), 4000, car_jacobian(ROAD)
    P = bound(information(H, CORRELATED), np.diag(1.0 / CAR_SCALE**2))
    L = np.linalg.cholesky(CORRELATED)
    x = CAR_SCALE * rng.standard_normal((n, 15))
    y = np.einsum('tsai,ni->ntsa', H, x)
    y += np.einsum('ab,ntsb->ntsa', L, rng.standard_normal(y.shape))
    # Independent estimate: least squares of x / scale on rows whitened by Cholesky.
    A = np.vstack([np.linalg.solve(L, H).reshape(-1, 15) * CAR_SCALE, np.eye(15)])
    z = np.hstack([np.linalg.solve(L, y[..., None]).reshape(n, -1), np.zeros((n, 15))])
    e = CAR_SCALE * np.linalg.lstsq(A, z.T, rcond=None)[0].T - x
    nees = np.einsum('ni,ij,nj->', e, np.linalg.inv(P), e)
    low, high = chi2.ppf([0.005, 0.995], 15 * n) / (15 * n)
    print(f'NEES per state {nees / (15 * n):.4f}, limits {low:.4f} .. {high:.4f}')
    assert low <= nees / (15 * n) <= high
    # Each variance is tested separately; the total significance is 1 % for all fifteen.
    low, high = chi2.ppf([0.005 / 15, 1.0 - 0.005 / 15], n) / n
    ratio = (e**2).mean(axis=0) / np.diag(P)
    assert np.all((low <= ratio) & (ratio <= high)), ratio


@pytest.mark.parametrize('m', [ONES, UP])
def test_unobservable_states_have_infinite_variance(m):
    J = example_information(m, ONE)
    P = bound(J)
    unobservable = np.isin(NAMES, observability(J, NAMES).unobservable)
    assert np.array_equal(np.isinf(np.diag(P)), unobservable)
    assert np.all(np.isnan(P[unobservable][:, ~unobservable])) and np.all(
        np.isfinite(P[np.ix_(~unobservable, ~unobservable)]))
    for weak in (1e-6 * np.eye(9), 1e-6 * np.diag(1.0 + np.arange(9.0))):
        limit = np.linalg.inv(J + weak)[np.ix_(~unobservable, ~unobservable)]
        np.testing.assert_allclose(P[np.ix_(~unobservable, ~unobservable)], limit, rtol=1e-4,
                                   atol=1e-5)


def test_a_state_with_a_small_part_in_the_kernel_is_unobservable():
    """In the kernel vector, one state has the component 1e-5, and four others have 1 to 3."""
    A = np.random.default_rng(4).standard_normal((20, 6))
    n = np.array([1e-5, 1.0, -2.0, 1.0, 0.0, 3.0])
    A -= np.outer(A @ n, n) / (n @ n)
    J = A.T @ A
    unobservable = n != 0.0
    assert np.array_equal(np.isinf(np.diag(bound(J))), unobservable)
    # One state has no information, and the units differ by many decades.
    np.testing.assert_allclose(bound(np.diag([4.0, 0.0, 1e16])), [
        [0.25, np.nan, 0.0], [np.nan, np.inf, np.nan], [0.0, np.nan, 1e-16]], rtol=1e-12)


def test_bound_of_an_observable_case_is_the_inverse_in_any_units():
    J, unit = example_information(ONES, TWO), 10.0 ** np.arange(-12, 15, 3)
    expected = np.linalg.inv(J)
    P = bound(J * np.outer(unit, unit)) * np.outer(unit, unit)
    np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_bound_never_exceeds_the_prior():
    """MITRE12 figure 5: at a large distance, the bounds approach the prior."""
    std = np.array([30.0, 5.0, 1.0, 4.5, 1.0, 0.1, 100.0, 100.0, 100.0])
    near, far = (np.sqrt(np.diag(bound(information(
        jacobian(CAR[6:], ONE, [-20.0, y, 0.0], [11.0, 0.0, 0.0]), NOISE * np.eye(3)),
        np.diag(std**-2)))) for y in (5.0, 300.0))
    assert np.all(near <= std) and near[0] < 0.1 * std[0]
    np.testing.assert_allclose(far, std, rtol=1e-3)


def test_exactly_known_states_have_zero_variance():
    """MITRE12 section 4.3; the other states have the bound of a problem without these states."""
    J, free = example_information(ONES, ONE), np.ix_([1, 2, 3, 5, 6, 7, 8], [1, 2, 3, 5, 6, 7, 8])
    expected = np.zeros((9, 9))
    expected[free] = np.linalg.inv(J[free])
    prior = np.diag([np.inf, 0.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(bound(J, prior), expected, rtol=1e-8, atol=1e-10)


def plain_kalman(F, Q, H, C, P):
    """Covariances after each update by the textbook recursion with all sensors stacked (oracle)."""
    out = []
    for F_k, Q_k, H_k in zip(F, Q, H, strict=True):
        P = F_k @ P @ F_k.T + Q_k
        is_present = ~np.isnan(H_k).any(axis=-1).ravel()
        A = H_k.reshape(-1, H_k.shape[-1])[is_present]
        R = np.kron(np.eye(len(H_k)), C)[np.ix_(is_present, is_present)]
        K = P @ A.T @ np.linalg.inv(A @ P @ A.T + R)
        P = P - K @ A @ P
        out.append(P)
    return np.array(out)


def filter_problem():
    """F, Q, H and P0 along the path of a car, states [r, v, m, b]; some axes are missing."""
    dt, n = 0.1, 40
    F, Q, H = np.eye(15), np.zeros((15, 15)), car_jacobian(ROAD)
    F[:3, 3:6] = dt * np.eye(3)
    Q[:6, :6] = 0.25 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
    H[..., 3:6] = 0.0
    H[7:9, 1] = H[20, 0, 2] = np.nan
    P0 = np.diag(np.repeat([25.0, 25.0, 9e4, 1e-16], [3, 3, 3, 6]))
    return np.repeat(F[None], n, 0), np.repeat(Q[None], n, 0), H, P0


def relative_difference(P, expected):
    """Maximum difference of two covariances, relative to the products of the expected stds."""
    std = np.sqrt(np.einsum('...ii->...i', expected))
    return np.abs((P - expected) / (std[..., :, None] * std[..., None, :])).max()


def test_path_bound_is_the_covariance_of_the_kalman_filter():
    F, Q, H, P0 = filter_problem()
    expected = plain_kalman(F, Q, H, CORRELATED, P0)
    P = path_bound(F, Q, H, CORRELATED, P0)
    print('path bound against the filter:', relative_difference(P, expected))
    assert relative_difference(P, expected) < 1e-7
    assert P[-1][0, 0] < 0.02 * P0[0, 0]
    # The same with whitened Jacobians, and with one F and Q for all steps.
    white = np.linalg.solve(np.linalg.cholesky(CORRELATED), H[:7])
    assert relative_difference(path_bound(F[0], Q[0], white, None, P0), expected[:7]) < 1e-7


def test_path_bound_accepts_states_known_exactly():
    """The vertical components have neither initial variance nor process noise."""
    (F, Q, H, P0), known = filter_problem(), [2, 5, 8]
    Q[:, known] = Q[:, :, known] = P0[known, known] = 0.0
    P = path_bound(F, Q, H, CORRELATED, P0)
    assert np.all(P[:, known] == 0.0)
    free = np.setdiff1d(np.arange(15), known)
    subset = np.ix_(range(40), free, free)
    expected = plain_kalman(F[subset], Q[subset], H[..., free], CORRELATED, P0[np.ix_(free, free)])
    assert relative_difference(P[subset], expected) < 1e-7


def test_path_bound_without_process_noise_ends_at_the_batch_bound():
    F, Q, H, P0 = filter_problem()
    F[0] = np.eye(15)
    P = path_bound(F, 0.0 * Q, H, CORRELATED, P0)
    # The batch bound refers to the first sample; the last filter step is 39 samples later.
    H_batch = H.copy()
    H_batch[..., 3:6] = 0.1 * np.arange(40)[:, None, None, None] * H[..., :3]
    shift = np.eye(15) + 3.9 * np.eye(15, k=3) * (np.arange(15) < 6)
    batch = shift @ bound(information(H_batch, CORRELATED), np.linalg.inv(P0)) @ shift.T
    assert relative_difference(P[-1], batch) < 1e-7


def test_missing_axes_and_sensors_add_no_information():
    H = car_jacobian(ROAD)[:5]
    H[1, 0] = H[2, 1, 1] = np.nan
    C = np.repeat(CORRELATED[None], 2, axis=0) * np.array([1.0, 3.0])[:, None, None]
    J = np.zeros((15, 15))
    for t, j in np.ndindex(5, 2):
        p = np.flatnonzero(~np.isnan(H[t, j, :, 0]))
        J += H[t, j, p].T @ np.linalg.inv(C[j][np.ix_(p, p)]) @ H[t, j, p]
    found, scale = information(H, C), np.outer(CAR_SCALE, CAR_SCALE)
    np.testing.assert_allclose(found * scale, J * scale, rtol=1e-12,
                               atol=1e-12 * (J * scale).max())
    # The covariance of missing axes is ignored.
    C = np.broadcast_to(C, (5, 2, 3, 3)).copy()
    C[1, 0], C[2, 1, 1], C[2, 1, :, 1] = np.nan, np.nan, np.nan
    np.testing.assert_array_equal(information(H, C), found)
    assert np.all(information(np.full((4, 3, 9), np.nan), np.eye(3)) == 0.0)


def test_snr_is_the_energy_of_the_field_and_minimal_abeam():
    """T10 eq. (5.21) is the minimum over directions; along the axis the SNR is 4 times larger."""
    h = 1e-8 * np.array([[1.0, -2.0, 0.5], [1.0, np.nan, 2.0], [np.nan] * 3])
    expected, _ = whitened_energy(h, np.repeat(CORRELATED[None], 3, axis=0))
    np.testing.assert_allclose(snr(h, CORRELATED), expected, rtol=1e-12)
    r = np.random.default_rng(1).standard_normal((1000, 3))
    r *= 12.0 / np.linalg.norm(r, axis=1, keepdims=True)
    r[0] = [12.0, 0.0, 0.0]
    exact = snr(dipole_field(r, [0.0, 0.0, 450.0]), NOISE * np.eye(3))
    exact /= (K_DIPOLE * 450.0 / 12.0**3)**2 / NOISE
    assert exact[0] == pytest.approx(1.0, rel=1e-12)
    assert exact.min() > 1.0 - 1e-12 and 3.9 < exact.max() <= 4.0


def test_range_of_a_magnetometer_is_about_ten_metres():
    """T10 eq. (5.22)-(5.24) and (6.1) as published, and with the correct scale of TSP14."""
    t10 = snr_range(1.0, np.sqrt(1e-21), 9.2)
    cars = snr_range(np.array([300.0, 600.0, 1800.0]), np.sqrt(NOISE), 9.2)
    print(f'range: {t10:.2f} m; cars and truck {cars}')
    assert t10 == pytest.approx((1e7 / 9.2) ** (1 / 6), rel=1e-12)
    assert cars == pytest.approx([9.54, 12.02, 17.33], abs=0.01)
    at_range = dipole_field([cars[0], 0.0, 0.0], [0.0, 0.0, 300.0])
    assert snr(at_range, NOISE * np.eye(3)) == pytest.approx(9.2, rel=1e-12)


H9, I9, SKEW = np.ones((4, 3, 9)), np.eye(9), np.eye(3) + 0.5 * np.eye(3, k=1)


@pytest.mark.parametrize('call, message', [
    (lambda: information(H9, np.ones((1, 3))), r'C .*\(1, 3\)'),
    (lambda: information(H9, np.ones((5, 3, 3))), r'C .*\(5, 3, 3\)'),
    (lambda: information(H9, 1e-16 * np.ones((3, 3))), r'C\[0\] .*definite.*1e-16'),
    (lambda: information(H9, -1e-16 * np.eye(3)), r'C\[0\] .*semidefinite.*-1e-16'),
    (lambda: information(H9, np.nan * np.eye(3)), r'C\[0\] .*finite'),
    (lambda: information(H9, 1e-16 * SKEW), r'C\[0\] .*symmetric'),
    (lambda: information(np.where(np.arange(9) == 4, np.nan, H9)), r'H \[0, 0\]'),
    (lambda: observability(np.ones((9, 8)), NAMES), r'information .*\(9, 8\)'),
    (lambda: bound(I9, -2.0 * I9), 'prior .*-2.0'),
    (lambda: path_bound(I9, -I9, H9, None, I9), r'Q\[0\] '),
    (lambda: path_bound(I9, 0 * I9, H9, None, -I9), 'P0 '),
])
def test_invalid_arguments_raise_value_error_with_the_value(call, message):
    with pytest.raises(ValueError, match=message):
        call()
