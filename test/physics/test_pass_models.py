"""All pass models: derivatives compared with finite differences, and models with each other."""

import inspect

import numpy as np
import pytest

from mag_tracking.physics import passes
from mag_tracking.physics.passes import N_PATH, RowPass, SteadyPass, SuperposedPasses

RNG = np.random.default_rng(4)
T, POSITIONS, M = RNG.uniform(-1.0, 1.0, 6), RNG.uniform(-5.0, 5.0, (6, 3)), RNG.standard_normal(
    (6, 3, 3))
EXAMPLES = {
    **{f'RowPass with n_dipoles={d}': RowPass(T, POSITIONS, M, d) for d in (1, 2, 3, 4)},
    'SuperposedPasses': SuperposedPasses.from_orders((1, 3), T, POSITIONS, M),
    'SteadyPass': SteadyPass(T, POSITIONS, M, np.full(6, -1), np.arange(N_PATH), np.zeros(N_PATH),
                             3)}
N_PARAMETERS = {
    name: model.path_slices[-1].stop if isinstance(model, SuperposedPasses)
    else N_PATH if isinstance(model, SteadyPass) else len(model.names)
    for name, model in EXAMPLES.items()}
"""Number of path parameters of each model."""


def test_every_model_has_an_example():
    names = {name for name, c in inspect.getmembers(passes, inspect.isclass)
             if hasattr(c, 'basis') and hasattr(c, 'derivative')}
    assert names == {name.split()[0] for name in EXAMPLES}


@pytest.mark.parametrize('name', EXAMPLES)
def test_derivatives_agree_with_differences(name):
    model = EXAMPLES[name]
    theta = np.random.default_rng(5).uniform(1.0, 4.0, (5, N_PARAMETERS[name]))
    p = np.random.default_rng(6).standard_normal((5, model.basis(theta).shape[-1]))
    D = model.derivative(theta, p)
    for k in range(theta.shape[1]):
        h = 1e-6 * np.eye(theta.shape[1])[k]
        numeric = np.einsum('nyi,ni->ny', model.basis(theta + h) - model.basis(theta - h), p) / 2e-6
        np.testing.assert_allclose(D[:, :, k], numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())


def test_superposed_fields_add_up():
    rng = np.random.default_rng(7)
    rows = [RowPass(T, POSITIONS, M, d) for d in (2, 1, 3)]
    paths = [rng.uniform(1.0, 4.0, len(row.names)) for row in rows]
    moments = [rng.standard_normal(3 * row.n_dipoles) for row in rows]
    model = SuperposedPasses.from_orders((2, 1, 3), T, POSITIONS, M)
    total = model.basis(np.concatenate(paths)[None])[0] @ np.concatenate(moments)
    np.testing.assert_allclose(total, sum(
        row.basis(path[None])[0] @ m for row, path, m in zip(rows, paths, moments, strict=True)))
    for path, found in zip(paths, model.split(np.concatenate(paths)), strict=True):
        np.testing.assert_array_equal(path, found)


def test_a_row_of_negative_length_is_reversed():
    rng = np.random.default_rng(8)
    model = SuperposedPasses.from_orders((3, 1), T, POSITIONS, M)
    theta, p = rng.uniform(1.0, 4.0, 13), rng.standard_normal(12)
    theta[6] = -2.5
    reversed_theta, moments = model.with_nonnegative_length(theta, p)
    assert reversed_theta[6] == 2.5
    np.testing.assert_allclose(model.basis(reversed_theta[None])[0] @ moments,
                               model.basis(theta[None])[0] @ p)
    same, unchanged = model.with_nonnegative_length(reversed_theta, moments)
    np.testing.assert_array_equal(same, reversed_theta)
    np.testing.assert_array_equal(unchanged, moments)


def test_a_row_far_away_has_the_field_of_one_dipole():
    path, moments = np.array([1.0, 2.0, 0.5, 3.0, 1.0, 0.0, 2.0]), RNG.standard_normal((3, 3))
    errors = []
    for distance in (60.0, 600.0):
        row, dipole = (RowPass(T, POSITIONS + [distance, 0.0, 0.0], M, d) for d in (3, 1))
        field = row.basis(path[None])[0] @ (row.combinations.T @ moments.ravel())
        expected = dipole.basis(path[None, :6])[0] @ moments.sum(axis=0)
        errors.append(np.abs(field - expected).max() / np.abs(expected).max())
    assert errors[0] < 0.1 and errors[1] < 0.2 * errors[0]
