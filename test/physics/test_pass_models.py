"""All pass models: derivatives compared with finite differences, and models with each other."""

import inspect

import numpy as np
import pytest

from mag_tracking.analysis.pass_data import separable_problem
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.inference.least_squares import SeparableProblem, refine
from mag_tracking.physics import pass_expansions, passes
from mag_tracking.physics.multipole import multipole_moments
from mag_tracking.physics.pass_expansions import AndersonPass, MultipolePass
from mag_tracking.physics.passes import (
    N_PATH,
    RowPass,
    SteadyPass,
    SuperposedPasses,
    anderson_field,
)
from mag_tracking.simulation.scenario import random_vehicle
from support.passes import NOISE, measured, network_of

RNG = np.random.default_rng(4)
T, POSITIONS, M = RNG.uniform(-1.0, 1.0, 6), RNG.uniform(-5.0, 5.0, (6, 3)), RNG.standard_normal(
    (6, 3, 3))
EXAMPLES = {
    **{f'RowPass with n_dipoles={d}': RowPass(T, POSITIONS, M, d) for d in (1, 2, 3, 4)},
    **{f'MultipolePass of order {d}': MultipolePass(T, POSITIONS, M, d) for d in (1, 2, 3)},
    'AndersonPass': AndersonPass(T, M),
    'SuperposedPasses': SuperposedPasses.from_orders((1, 3), T, POSITIONS, M),
    'SteadyPass': SteadyPass(T, POSITIONS, M, np.full(6, -1), np.arange(N_PATH), np.zeros(N_PATH),
                             3)}
N_PARAMETERS = {
    name: model.path_slices[-1].stop if isinstance(model, SuperposedPasses)
    else N_PATH if isinstance(model, SteadyPass) else len(model.names)
    for name, model in EXAMPLES.items()}
"""Number of path parameters of each model."""


def test_every_model_has_an_example():
    names = {name for module in (passes, pass_expansions)
             for name, c in inspect.getmembers(module, inspect.isclass)
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


def test_a_row_far_away_has_the_field_of_its_multipoles():
    path, moments = np.array([1.0, 2.0, 0.5, 3.0, 1.0, 0.0, 2.0]), RNG.standard_normal((3, 3))
    far_positions = POSITIONS + [60.0, 0.0, 0.0]
    row = RowPass(T, far_positions, M, 3)
    field = row.basis(path[None])[0] @ (row.combinations.T @ moments.ravel())
    u = path[3:6] / np.linalg.norm(path[3:6])
    dipoles = np.linspace(-1.0, 1.0, 3)[:, None] * u
    errors = []
    for order in (1, 2, 3):
        model = MultipolePass(T, far_positions, M, order)
        expansion = model.basis(path[None, :6])[0] @ multipole_moments(dipoles, moments, order)
        errors.append(np.abs(expansion - field).max() / np.abs(field).max())
    assert errors[0] < 0.1 and errors[1] < 0.2 * errors[0] and errors[2] < 0.2 * errors[1]


def test_multipoles_describe_a_vehicle_better_with_every_order():
    """The vehicle is a cloud of sixty dipoles at a distance of 4 m."""
    network = network_of([[0.0, -4.0, 0.0], [0.0, 4.0, 0.0]])
    rng = np.random.default_rng(3)
    path = np.array([0.0, 0.0, 0.5, 9.0, 0.0, 0.0])
    data = measured(network, path, np.zeros((1, 3)), rng)
    t = data.t[data.sensor == 0]
    B = random_vehicle(rng).field(network.earth_field, np.outer(t, [9.0, 0.0]),
                                  np.zeros(len(t)), network.positions)
    data.field[:] += np.concatenate([B[:, 0], B[:, 1]])
    costs = []
    for order in (1, 2, 3):
        problem = separable_problem(data, lambda *a, order=order: MultipolePass(*a, order))
        _, cost, _, _ = refine(problem.residual_and_jacobian, path[None], 200, 1e-9)
        costs.append(cost[0] / data.n_values)
    print(f'normalised costs of orders 1 to 3: {", ".join(f"{c:.2f}" for c in costs)}')
    assert costs[0] > 1.2 * costs[1] and costs[1] >= costs[2] and costs[2] < 1.2


def test_anderson_functions_and_the_dipole_agree_on_one_sensor():
    """Both models estimate the same CPA time and the same ratio of speed to range."""
    network = network_of([[0.0, -4.5, 0.0]])
    path, m = np.array([0.5, 0.0, 0.6, 9.0, 0.3, 0.0]), np.array([[100.0, 250.0, -200.0]])
    data = measured(network, path, m, np.random.default_rng(1))
    exact = anderson_field(data.t, path[:3] - network.positions[0], path[3:6], m[0])
    assert np.abs(data.field - exact).max() < 6.0 * NOISE
    problem = SeparableProblem(AndersonPass(data.t, data.whitening), (data.field / NOISE).ravel(),
                               np.tile(np.eye(3), (len(data.t), 1)))
    theta, cost, P, converged = refine(problem.residual_and_jacobian, np.array([[0.0, 1.5]]), 100)
    b = fit_pass(data, 1)
    zero = b.data.stamp_ns / 1e9
    assert converged[0] and abs(cost[0] / data.n_values - 1.0) < 0.1
    # The dipole model has fewer unknowns, so its std is not larger.
    std = np.sqrt(np.diagonal(P[0]))
    assert abs(theta[0, 0] - b.bearing.cpa_time - zero) < 3.0 * std[0] < 0.05
    assert abs(theta[0, 1] - b.bearing.rate) < 3.0 * std[1] < 0.2
    assert b.bearing.cpa_time_std <= 1.001 * std[0]
