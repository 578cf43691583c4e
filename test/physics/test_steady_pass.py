"""Row of dipoles on a path with acceleration and turn rate, measured with clock offsets."""

import numpy as np
import pytest

from mag_tracking.physics.passes import N_PATH, N_STRAIGHT, PATH, RowPass, SteadyPass

RNG = np.random.default_rng(4)
T, POSITIONS, M = RNG.uniform(-1.0, 1.0, 6), RNG.uniform(-5.0, 5.0, (6, 3)), RNG.standard_normal(
    (6, 3, 3))
CLOCK = np.array([-1, 0, -1, 1, 0, 1])
STRAIGHT = np.array([1.0, 2.0, 0.5, 9.0, 0.3, 0.2, 2.5])
CURVED = np.append(STRAIGHT, [1.5, -0.6, 0.8])


def model(free, n_dipoles=3, t=T, fixed=None):
    return SteadyPass(t, POSITIONS, M, CLOCK, np.arange(free),
                      np.zeros(N_PATH + 2) if fixed is None else fixed, n_dipoles)


@pytest.mark.parametrize('n_dipoles', [1, 3, 5])
def test_a_straight_path_equals_a_row_at_constant_velocity(n_dipoles):
    v, heading = STRAIGHT[3:5]
    path = np.array([*STRAIGHT[:3], v * np.cos(heading), v * np.sin(heading), 0.0, STRAIGHT[6]])
    level_path = np.where(np.arange(N_STRAIGHT) == PATH.index('climb'), 0.0, STRAIGHT)
    row = RowPass(T, POSITIONS, M, n_dipoles).basis(path[None, :7 if n_dipoles > 1 else 6])
    np.testing.assert_allclose(model(N_STRAIGHT, n_dipoles).basis(level_path[None]), row, rtol=1e-9,
                               atol=1e-20)


def test_clock_offsets_shift_the_sample_times():
    offsets = np.array([0.12, -0.05])
    shifted = T - np.append(offsets, 0.0)[CLOCK]
    with_offsets = model(N_PATH + 2).basis(np.append(CURVED, offsets)[None])
    np.testing.assert_allclose(with_offsets, model(N_PATH, t=shifted).basis(CURVED[None]),
                               rtol=1e-12)


def test_a_curved_path_equals_its_numerical_integration():
    """The field of a single dipole equals the field of a dipole at the integrated position."""
    _, _, _, v, heading, climb, _, gain, rate, turn_acceleration = CURVED
    for time in (-1.0, 0.7, 1.5):
        steps = (np.arange(200_000) + 0.5) * time / 200_000
        angle = heading + (rate + 0.5 * turn_acceleration * steps) * steps
        speed = v + gain * steps
        mean_velocity = np.array([np.mean(speed * np.cos(angle)), np.mean(speed * np.sin(angle)),
                                  climb])
        end = np.zeros(N_PATH + 2)
        end[:3] = CURVED[:3] + time * mean_velocity
        curved = model(N_PATH, 1, np.full(6, time)).basis(CURVED[None])
        stationary = model(N_PATH, 1, np.zeros(6)).basis(end[None, :N_PATH])
        np.testing.assert_allclose(curved, stationary, rtol=1e-6, atol=1e-20)


@pytest.mark.parametrize('path', [np.append(STRAIGHT, [0.0, 0.0, 0.0]), CURVED])
def test_derivatives_agree_with_differences(path):
    theta = np.append(path, [0.02, -0.03])[None]
    m = model(N_PATH + 2)
    p = RNG.standard_normal((1, 9))
    D = m.derivative(theta, p)
    for k in range(theta.shape[1]):
        h = 1e-6 * np.eye(theta.shape[1])[k]
        numeric = np.einsum('nyi,ni->ny', m.basis(theta + h) - m.basis(theta - h), p) / 2e-6
        np.testing.assert_allclose(D[:, :, k], numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())


def test_parameters_that_are_not_free_keep_their_fixed_values():
    fixed = np.append(CURVED, [0.1, 0.2])
    partial = SteadyPass(T, POSITIONS, M, CLOCK, np.array([0, 3, 10]), fixed, 3)
    theta = np.array([[1.5, 8.0, 0.3]])
    expected = fixed.copy()
    expected[[0, 3, 10]] = theta[0]
    np.testing.assert_array_equal(partial.all_parameters(theta), expected[None])
    np.testing.assert_array_equal(partial.basis(theta), model(N_PATH + 2).basis(expected[None]))
