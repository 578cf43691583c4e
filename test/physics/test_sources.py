"""Source models: finite-difference check of Jacobians, and exact integrals of process noise."""

import inspect

import numpy as np
import pytest
from scipy.linalg import expm

from mag_tracking.geometry import cross_matrix, left_jacobian, rotation_about_z
from mag_tracking.physics import sources, vehicles
from mag_tracking.physics.dipole import MU0, sensor_fields
from mag_tracking.physics.sources import Magnet, constant_velocity, decaying_turn, integrator_noise
from mag_tracking.physics.vehicles import MAX_TURN_RATE, RowVehicle, ellipsoid_moment
from support.process_noise import predicted as with_noise

EARTH, ACCELERATION = np.array([2e-6, 1.5e-5, -4.9e-5]), np.array([1.0, 1.0, 0.1])
EXAMPLES = {
    'RowVehicle': RowVehicle(EARTH, ACCELERATION, 0.1, 0.02),
    'RowVehicle with one dipole': RowVehicle(EARTH, ACCELERATION, 0.1, n_dipoles=1),
    'RowVehicle with four dipoles': RowVehicle(EARTH, ACCELERATION, 0.1, 0.02, 4),
    'RowVehicle with turn rate': RowVehicle(EARTH, ACCELERATION, 0.1, 0.02, 3, 3.0, 1.5),
    'Magnet': Magnet(np.array([0.1, 0.2, 0.3]), 0.5),
}


def model_names():
    """Names of the classes with the interface of a `SourceModel`."""
    return sorted(name for module in (sources, vehicles)
                  for name, c in inspect.getmembers(module, inspect.isclass)
                  if hasattr(c, 'dipoles') and hasattr(c, 'propagate')
                  and c.__name__ != 'SourceModel')


def states(model, n=6):
    rng = np.random.default_rng(3)
    x = rng.standard_normal((n, len(model.state_names)))
    x[:, 3:6] += [4.0, 2.0, 0.0]
    return x


def test_every_model_has_an_example():
    assert model_names() == sorted({name.split()[0] for name in EXAMPLES})


@pytest.mark.parametrize('name', EXAMPLES)
def test_dipole_derivatives_agree_with_differences(name):
    model = EXAMPLES[name]
    x = states(model)
    d = model.dipoles(x)
    for k in range(x.shape[1]):
        h = 1e-6 * np.eye(x.shape[1])[k]
        up, down = model.dipoles(x + h), model.dipoles(x - h)
        for value, derivative in (('r', 'dr_dx'), ('m', 'dm_dx')):
            numeric = (getattr(up, value) - getattr(down, value)) / 2e-6
            analytic = getattr(d, derivative)[..., k]
            np.testing.assert_allclose(analytic, numeric, rtol=0,
                                       atol=1e-7 * max(1.0, np.abs(numeric).max()))


@pytest.mark.parametrize('dt', [-0.5, 0.003, 0.3, 4.0])
@pytest.mark.parametrize('name', EXAMPLES)
def test_propagation_derivatives_agree_with_differences(name, dt):
    model = EXAMPLES[name]
    x = states(model)
    _, F, _ = with_noise(model, x, dt)
    F = np.broadcast_to(F, (len(x),) + F.shape[-2:])
    for k in range(x.shape[1]):
        h = 1e-6 * np.eye(x.shape[1])[k]
        numeric = (model.propagate(x + h, dt)[0] - model.propagate(x - h, dt)[0]) / 2e-6
        np.testing.assert_allclose(F[:, :, k], numeric, rtol=0, atol=1e-6)


@pytest.mark.parametrize('name', EXAMPLES)
def test_process_noise_is_symmetric_and_positive_semidefinite(name):
    model = EXAMPLES[name]
    _, _, Q = with_noise(model, states(model), 0.2)
    np.testing.assert_allclose(Q, np.swapaxes(Q, -1, -2), rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(Q).min() >= -1e-15


def test_constant_velocity_noise_is_the_exact_integral():
    """The oracle is Van Loan's matrix exponential."""
    dt, density = 0.37, np.array([1.0, 2.0, 0.5])
    A = np.zeros((6, 6))
    A[:3, 3:] = np.eye(3)
    G = np.zeros((6, 6))
    G[3:, 3:] = np.diag(density)
    exp_block = expm(np.block([[-A, G], [np.zeros((6, 6)), A.T]]) * dt)
    np.testing.assert_allclose(integrator_noise(dt, density),
                               exp_block[6:, 6:].T @ exp_block[:6, 6:], rtol=1e-12)
    np.testing.assert_allclose(constant_velocity(dt), expm(A * dt), rtol=1e-14)


@pytest.mark.parametrize('rate', [-0.8, -1e-9, 0.0, 1e-5, 0.4])
def test_a_coordinated_turn_is_a_circular_arc(rate):
    """The oracle is the matrix exponential. Backward propagation restores the state."""
    x, dt = np.array([[1.0, 2.0, 0.5, 6.0, -3.0, 0.2, rate]]), 1.7
    A = np.zeros((6, 6))
    A[:3, 3:] = np.eye(3)
    A[3, 4], A[4, 3] = -rate, rate
    predicted, _ = decaying_turn(x, dt, 1.0, 1.0)
    np.testing.assert_allclose(predicted[0, :6], expm(A * dt) @ x[0, :6], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(decaying_turn(predicted, -dt, 1.0, 1.0)[0], x, atol=1e-12)
    if rate:
        centre = x[0, :2] + np.array([3.0, 6.0]) / rate
        np.testing.assert_allclose(np.hypot(*(predicted[0, :2] - centre)), np.hypot(6.0, 3.0)
                                   / abs(rate), rtol=1e-6)


def test_turn_rate_is_a_stationary_gauss_markov_process():
    model, dt = EXAMPLES['RowVehicle with turn rate'], 0.4
    rng = np.random.default_rng(0)
    x = states(model, 200_000)
    x[:, 3:6] = [6.0, 0.0, 0.0]
    x[:, -1] = 0.5 * rng.standard_normal(len(x))
    later_rate, _, Q = with_noise(model, x, dt)
    later_rate = later_rate[:, -1] + np.sqrt(Q[0, -1, -1]) * rng.standard_normal(len(x))
    assert later_rate.std() == pytest.approx(0.5, rel=0.01)
    assert np.corrcoef(x[:, -1], later_rate)[0, 1] == pytest.approx(np.exp(-dt / 1.5), abs=0.01)
    assert model.turn_variance(np.array([0.0, 1.0, 12.0])).tolist() == [
        MAX_TURN_RATE**2, MAX_TURN_RATE**2, 0.25**2]


def test_a_turn_does_not_depend_on_the_step_size():
    model = EXAMPLES['RowVehicle with turn rate']
    x = np.zeros((1, len(model.state_names)))
    x[0, 3], x[0, -1] = 6.0, 1.0
    steps = x.copy()
    for _ in range(100):
        steps = model.propagate(steps, 0.02)[0]
    at_once = model.propagate(x, 2.0)[0]
    # Integral of a turn rate that decays with a time constant of 1.5 s.
    expected = 1.5 * -np.expm1(-2.0 / 1.5)
    for predicted in (steps, at_once):
        assert np.arctan2(predicted[0, 4], predicted[0, 3]) == pytest.approx(expected, rel=1e-9)
        assert predicted[0, -1] == pytest.approx(np.exp(-2.0 / 1.5), rel=1e-9)


def test_turn_rate_does_not_decay_in_backward_propagation():
    """Backward propagation has no process noise, so the turn rate must not decay."""
    model = EXAMPLES['RowVehicle with turn rate']
    predicted, F, _ = with_noise(model, states(model), -3.0)
    assert np.array_equal(predicted[:, -1], states(model)[:, -1]) and (F[:, -1, -1] == 1.0).all()


def test_a_turn_rate_known_to_be_zero_keeps_the_path_straight():
    straight, turning = EXAMPLES['RowVehicle'], EXAMPLES['RowVehicle with turn rate']
    x = states(turning)
    x[:, -1] = 0.0
    P = np.tile(np.eye(x.shape[1]), (len(x), 1, 1))
    P[:, -1], P[:, :, -1] = 0.0, 0.0
    predicted, F, Q = with_noise(turning, x, 0.3, P)
    expected, F_straight, Q_straight = with_noise(straight, x[:, :-1], 0.3)
    np.testing.assert_allclose(predicted[:, :-1], expected, atol=1e-12)
    np.testing.assert_allclose(F[0, :-1, :-1], F_straight, atol=1e-12)
    np.testing.assert_allclose(Q[:, :-1, :-1], Q_straight, atol=1e-15)
    # A variance of exactly zero identifies hypotheses that do not turn.
    after = F @ P @ np.swapaxes(F, 1, 2) + Q
    assert not predicted[:, -1].any() and not after[:, -1].any() and not after[:, :, -1].any()


def test_vehicle_moment_is_rotated_hard_iron_plus_soft_iron():
    model = EXAMPLES['RowVehicle with one dipole']
    x = np.zeros((1, 12))
    x[0, 3:6], x[0, 6:9], x[0, 9:] = [0.0, 7.0, 0.0], [100.0, 20.0, 5.0], 6.0
    expected = np.array([-20.0, 100.0, 5.0]) + 6.0 / MU0 * model.earth_field
    np.testing.assert_allclose(model.dipoles(x).m[0, 0], expected, rtol=1e-12)


@pytest.mark.parametrize('heading', [0.0, 0.7, 2.0, -2.9])
def test_soft_iron_is_induced_along_the_axes_of_the_vehicle(heading):
    """The moment equals R D R' B0/mu0 and `ellipsoid_moment`; see MITRE12 eq. (A.5)."""
    model, axes = EXAMPLES['RowVehicle'], (2.1, 0.9)
    along = np.array([1.0, 0.0, 0.0])
    p1, p2 = (ellipsoid_moment(axes, 11.0, 0.0, b)[k] * MU0 for k, b in (
        (0, along), (1, np.roll(along, 1))))
    x = np.zeros((1, len(model.state_names)))
    x[0, 3:5] = 5.0 * np.array([np.cos(heading), np.sin(heading)])
    x[0, 15:18] = 1.0, 2.0, 4.0
    R = rotation_about_z(heading)
    np.testing.assert_allclose(model.dipoles(x).m[0].sum(axis=0),
                               R @ np.diag([1.0, 2.0, 4.0]) @ R.T @ EARTH / MU0, rtol=1e-9)
    x[0, 15:18] = p1, p2, p2
    np.testing.assert_allclose(model.dipoles(x).m[0].sum(axis=0),
                               ellipsoid_moment(axes, 11.0, heading, EARTH), rtol=1e-9)


@pytest.mark.parametrize('name', ['RowVehicle', 'RowVehicle with one dipole'])
def test_model_of_a_stationary_vehicle_is_finite(name):
    model = EXAMPLES[name]
    x = np.zeros((1, len(model.state_names)))
    assert all(np.isfinite(a).all() for a in (*model.dipoles(x), *with_noise(model, x, 0.1)))


def test_states_of_another_model_are_rejected():
    with pytest.raises(ValueError, match='too few states for 3 dipoles'):
        EXAMPLES['RowVehicle'].dipoles(np.zeros((2, 10)))


def row_state(d, length, heading=0.6):
    """Create the state of a row of `d` dipoles; the total moment does not depend on `d`."""
    x = np.zeros((1, 6 + 3 * d + (4 if d > 1 else 3)))
    x[0, :6] = [3.0, -1.0, 0.5, 8.0 * np.cos(heading), 8.0 * np.sin(heading), 0.2]
    x[0, 6:6 + 3 * d] = np.tile(np.array([250.0, -90.0, 60.0]) / d, d)
    x[0, 6 + 3 * d:9 + 3 * d] = 4.0
    x[0, 9 + 3 * d:] = length
    return x


def field_of(model, x, points):
    """Field (n, 3) [T] of a state at `points` (n, 3) [m]."""
    return sensor_fields(points, np.tile(np.eye(3), (len(points), 1, 1)), *model.dipoles(x))[0][0]


def test_a_row_is_centred_at_the_position_along_the_heading():
    """The positions of four dipoles follow TSP14 eq. (10b)."""
    x = row_state(4, 3.6)
    r = EXAMPLES['RowVehicle with four dipoles'].dipoles(x).r[0]
    heading = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(r[i - 1], x[0, :3] + (i - 2.5) * 3.6 / 3 * heading, atol=1e-12)


def test_a_row_of_zero_length_equals_a_point():
    points = np.random.default_rng(0).uniform(-8.0, 8.0, (20, 3))
    point = field_of(EXAMPLES['RowVehicle with one dipole'], row_state(1, 0.0), points)
    for name, d in (('RowVehicle', 3), ('RowVehicle with four dipoles', 4)):
        np.testing.assert_allclose(field_of(EXAMPLES[name], row_state(d, 0.0), points), point,
                                   rtol=1e-11, atol=1e-11 * np.abs(point).max())


def test_a_row_reversed_end_to_end_has_the_same_field():
    x = row_state(3, 3.0)
    x[0, 6:15] = [100.0, 20.0, 3.0, 80.0, -9.0, 1.0, 10.0, 70.0, 5.0]
    y = x.copy()
    y[0, 6:15] = x[0, 6:15].reshape(3, 3)[::-1].ravel()
    y[0, -1] = -3.0
    points = np.random.default_rng(0).uniform(-8.0, 8.0, (20, 3))
    B = field_of(EXAMPLES['RowVehicle'], x, points)
    np.testing.assert_allclose(field_of(EXAMPLES['RowVehicle'], y, points), B, rtol=1e-12,
                               atol=1e-12 * np.abs(B).max())


def test_a_uniform_row_approaches_a_dipole_with_the_squared_distance():
    """The row has no quadrupole, so the first error term is the octupole."""
    direction = np.array([[0.3, 0.9, 0.1]])
    errors = []
    for distance in (40.0, 80.0, 160.0):
        x1, x3 = row_state(1, 0.0), row_state(3, 3.0)
        points = x1[:, :3] + distance * direction / np.linalg.norm(direction)
        B = field_of(EXAMPLES['RowVehicle with one dipole'], x1, points)
        errors.append(np.linalg.norm(field_of(EXAMPLES['RowVehicle'], x3, points) - B)
                      / np.linalg.norm(B))
    assert errors[0] < 0.02
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.02)


def test_total_moment_and_differences_have_their_own_drift():
    model = EXAMPLES['RowVehicle']
    x = row_state(3, 3.0)
    Q = with_noise(model, x, 0.5)[2][0, 6:15, 6:15].reshape(3, 3, 3, 3)
    squared_norm = 250.0**2 + 90.0**2 + 60.0**2 + (4.0 / MU0) ** 2 * (EARTH @ EARTH)
    np.testing.assert_allclose(Q.sum(axis=(0, 2)), 0.1**2 * squared_norm * 0.5 * np.eye(3),
                               rtol=1e-12)
    between = Q[0, :, 0] - Q[0, :, 1]
    np.testing.assert_allclose(between, 0.02**2 * squared_norm * 0.5 * np.eye(3), rtol=1e-9)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 0.0099, 0.0101, 0.5, 3.0])
def test_left_jacobian_is_the_mean_of_the_intermediate_rotations(angle):
    v = angle * np.array([0.6, -0.48, 0.64])
    K, term, series = cross_matrix(v), np.eye(3), np.zeros((3, 3))
    for n in range(1, 40):
        series += term / n
        term = term @ K / n
    np.testing.assert_allclose(left_jacobian(v), series, rtol=0, atol=2e-15)


def magnet_state(m, w):
    return np.r_[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, m, w][None]


def test_a_magnet_rotates_by_the_full_angle_and_keeps_its_moment():
    model = EXAMPLES['Magnet']
    # A rotation about x by 90 degrees maps z to -y.
    predicted, _, _ = with_noise(model, magnet_state([0.0, 0.0, 2.0], [0.5 * np.pi, 0.0, 0.0]), 1.0)
    np.testing.assert_allclose(predicted[0, 6:9], [0.0, -2.0, 0.0], atol=1e-12)
    x = states(model)
    for dt in (0.01, 0.3, 5.0, -2.0):
        forward, _, _ = with_noise(model, x, dt)
        np.testing.assert_allclose(np.linalg.norm(forward[:, 6:9], axis=1),
                                   np.linalg.norm(x[:, 6:9], axis=1), rtol=1e-12)
        back, _, _ = with_noise(model, forward, -dt)
        np.testing.assert_allclose(back, x, atol=1e-9)


def test_a_small_rotation_of_a_magnet_follows_the_published_model():
    """PHD15 Paper A eq. (24) is a first-order approximation of the rotation."""
    dt, x = 1e-4, states(EXAMPLES['Magnet'])
    predicted, F, Q = with_noise(EXAMPLES['Magnet'], x, dt)
    m, w = x[:, 6:9], x[:, 9:12]
    np.testing.assert_allclose(predicted[:, 6:9], m + dt * np.cross(w, m), atol=1e-7)
    for p in range(len(x)):
        C = np.array([np.cross(e, m[p]) for e in np.eye(3)]).T  # w x m = C w
        np.testing.assert_allclose(F[p, 6:9, 9:12], dt * C, atol=1e-7)
        np.testing.assert_allclose(Q[p, 6:9, 9:12], 0.5 * dt**2 / 2.0 * C, atol=1e-11)


def rotation_noise(std_w, std_m, dt, density=0.0):
    """Variance of the neglected rotation terms along the moment: (sampled, modelled)."""
    model = Magnet(np.zeros(3), density)
    rng = np.random.default_rng(8)
    x = magnet_state(np.array([0.3, -0.4, 1.2]), np.array([0.2, 0.1, 0.0]))
    P = np.zeros((1, 12, 12))
    P[0, 6:9, 6:9], P[0, 9:, 9:] = np.diag(std_m**2), np.diag(std_w**2)
    predicted, F, Q_nominal = with_noise(model, x, dt)
    added_noise = (with_noise(model, x, dt, P)[2] - Q_nominal)[0, 6:9, 6:9]
    samples = np.repeat(x, 400_000, axis=0)
    samples[:, 6:9] += std_m * rng.standard_normal((len(samples), 3))
    samples[:, 9:] += std_w * rng.standard_normal((len(samples), 3))
    neglected = model.propagate(samples, dt)[0][:, 6:9] - predicted[0, 6:9] - np.einsum(
        'ij,nj->ni', F[0, 6:9], samples - x)
    u = predicted[0, 6:9] / np.linalg.norm(predicted[0, 6:9])
    np.testing.assert_allclose(added_noise, (u @ added_noise @ u) * np.outer(u, u), atol=1e-12)
    return np.mean((neglected @ u) ** 2), u @ added_noise @ u


@pytest.mark.study
def test_noise_covers_the_second_order_of_an_uncertain_rotation():
    """The oracle is the difference between exact and linearised rotation of sampled moments."""
    std_w = np.array([0.10, 0.25, 0.15])
    expected, added_noise = rotation_noise(std_w, np.zeros(3), 0.5)
    assert added_noise == pytest.approx(expected, rel=0.05)
    # The noise is limited to the squared magnitude of the moment.
    assert rotation_noise(1e3 * std_w, np.zeros(3), 0.5)[1] == pytest.approx(1.69)


def test_a_known_rotation_adds_no_noise_to_an_uncertain_moment():
    """If a known rotation added noise, the noise would accumulate over many short steps."""
    expected, added_noise = rotation_noise(np.zeros(3), np.full(3, 0.2), 0.5)
    assert expected < 1e-20 and added_noise < 1e-20
    # The noise of the angular velocity adds an angle variance proportional to dt^3.
    assert rotation_noise(np.zeros(3), np.zeros(3), 1.0, 0.04)[1] == pytest.approx(
        2.0 * (0.04 / 3.0) ** 2 * 1.69)


def test_noise_of_a_magnet_without_moment_is_finite():
    _, F, Q = with_noise(EXAMPLES['Magnet'], np.zeros((1, 12)), 0.1, np.eye(12)[None])
    assert np.isfinite(F).all() and np.isfinite(Q).all() and not Q[0, 6:9, 6:9].any()
