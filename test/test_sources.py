"""Every source model, found by itself: Jacobians against differences, noise against integrals."""

import inspect

import numpy as np
import pytest
from scipy.linalg import expm

from mag_tracking.physics import sources
from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.motion import constant_velocity, integrator_noise
from mag_tracking.physics.sources import Magnet, PointVehicle

EXAMPLES = {
    'PointVehicle': PointVehicle(np.array([2e-6, 1.5e-5, -4.9e-5]), np.array([1.0, 1.0, 0.1]),
                                 4.0),
    'Magnet': Magnet(np.array([0.1, 0.2, 0.3]), 0.5),
}


def found():
    """The classes that behave as a SourceModel."""
    return sorted(name for name, c in inspect.getmembers(sources, inspect.isclass)
                  if hasattr(c, 'dipoles') and hasattr(c, 'propagate')
                  and c.__name__ != 'SourceModel')


def states(model, n=6):
    rng = np.random.default_rng(3)
    x = rng.standard_normal((n, len(model.state_names)))
    x[:, 3:6] += [4.0, 2.0, 0.0]
    return x


def test_every_model_has_an_example():
    assert found() == sorted(EXAMPLES)


@pytest.mark.parametrize('name', found())
def test_dipole_derivatives(name):
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


@pytest.mark.parametrize('name', found())
def test_propagation_derivatives(name):
    model = EXAMPLES[name]
    x = states(model)
    _, F, _ = model.propagate(x, 0.3)
    F = np.broadcast_to(F, (len(x),) + F.shape[-2:])
    for k in range(x.shape[1]):
        h = 1e-6 * np.eye(x.shape[1])[k]
        numeric = (model.propagate(x + h, 0.3)[0] - model.propagate(x - h, 0.3)[0]) / 2e-6
        np.testing.assert_allclose(F[:, :, k], numeric, rtol=0, atol=1e-7)


@pytest.mark.parametrize('name', found())
def test_process_noise_is_symmetric_and_not_negative(name):
    model = EXAMPLES[name]
    _, _, Q = model.propagate(states(model), 0.2)
    np.testing.assert_allclose(Q, np.swapaxes(Q, -1, -2), rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(Q).min() >= -1e-15


def test_constant_velocity_noise_is_the_exact_integral():
    """Van Loan's matrix exponential as the oracle."""
    dt, density = 0.37, np.array([1.0, 2.0, 0.5])
    A = np.zeros((6, 6))
    A[:3, 3:] = np.eye(3)
    G = np.zeros((6, 6))
    G[3:, 3:] = np.diag(density)
    big = expm(np.block([[-A, G], [np.zeros((6, 6)), A.T]]) * dt)
    np.testing.assert_allclose(integrator_noise(dt, density), big[6:, 6:].T @ big[:6, 6:],
                               rtol=1e-12)
    np.testing.assert_allclose(constant_velocity(dt), expm(A * dt), rtol=1e-14)


def test_vehicle_moment_is_hard_iron_turned_plus_soft_iron():
    model = EXAMPLES['PointVehicle']
    x = np.zeros((1, 10))
    x[0, 3:6], x[0, 6:9], x[0, 9] = [0.0, 7.0, 0.0], [100.0, 20.0, 5.0], 6.0
    expected = np.array([-20.0, 100.0, 5.0]) + 6.0 / MU0 * model.earth_field
    np.testing.assert_allclose(model.dipoles(x).m[0, 0], expected, rtol=1e-12)


def test_standing_vehicle_has_a_finite_model():
    d = EXAMPLES['PointVehicle'].dipoles(np.zeros((1, 10)))
    assert all(np.isfinite(a).all() for a in d)


def test_magnet_keeps_its_size_while_it_turns_a_little():
    x = np.zeros((1, 12))
    x[0, 6:9], x[0, 9:12] = [0.0, 0.0, 2.0], [0.3, 0.0, 0.0]
    moved, _, _ = EXAMPLES['Magnet'].propagate(x, 0.1)
    # About x by 0.03 rad: z goes towards -y.
    np.testing.assert_allclose(moved[0, 6:9], [0.0, -0.06, 2.0], atol=1e-3)
