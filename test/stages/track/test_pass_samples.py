"""Compiled fit of a pass: comparison with NumPy, and rejected arguments."""

import numpy as np
import pytest

from mag_tracking.inference.least_squares import LINEAR_RANK_TOLERANCE, SeparableProblem, refine
from mag_tracking.inference.matrices import PSEUDO_INVERSE_TOLERANCE, pseudo_inverse
from mag_tracking.physics.passes import N_PATH, N_STRAIGHT, PATH, SteadyPass
from mag_tracking.stages.track import core
from mag_tracking.stages.track.pass_samples import N_STEPS, TOLERANCE, PassSamples
from support.steady_frames import FOUR, ROAD, STRAIGHT, TURNS, steady_frames


def samples_of(network, clocks, path=STRAIGHT):
    """`PassSamples` of a simulated pass."""
    return PassSamples.of(network, steady_frames(np.random.default_rng(5), network, path,
                                                 clocks=clocks), 0)


def starts_of(path, free, n=3):
    """Start values (n, n_free) at increasing distances from the true path."""
    truth = np.append(path, np.zeros(3))[free]
    errors = np.random.default_rng(6).standard_normal((n, len(free))) * [[0.02], [0.05], [0.1]][:n]
    return truth + errors * np.where(free >= N_STRAIGHT, 0.1, 1.0)


@pytest.mark.parametrize('n_dipoles', [1, 3, 5])
@pytest.mark.parametrize('network, path, clocks, free', [
    (ROAD, STRAIGHT, (0.1,), np.arange(N_STRAIGHT)),
    (ROAD, TURNS, (0.0,), np.arange(N_PATH)),
    (ROAD, STRAIGHT, (0.1,), np.append(np.arange(N_STRAIGHT), N_PATH)),
    (FOUR, STRAIGHT, (0.0, 0.1, 0.0), np.append(np.arange(N_STRAIGHT), N_PATH + np.arange(3)))])
def test_the_fit_of_a_pass_matches_numpy(network, path, clocks, free, n_dipoles):
    """Each fit has a single start, because only the best of several fits is returned. Iterations
    amplify rounding errors, so the tolerance is wide."""
    data = samples_of(network, clocks, path)
    if n_dipoles == 1:
        # One dipole has no length.
        free = free[free != PATH.index('length')]
    model = SteadyPass(data.t, data.positions, data.M, data.clock, free,
                       np.zeros(N_PATH + data.n_clocks), n_dipoles)
    problem = SeparableProblem(model, data.y, data.backgrounds)
    for start in starts_of(path, free):
        theta, cost, P, _ = refine(problem.residual_and_jacobian, start[None], N_STEPS, TOLERANCE)
        got, got_cost, got_P = data.fit(n_dipoles, free, start[None])
        std = np.sqrt(np.diagonal(P[0]))
        assert got_cost == pytest.approx(cost[0], rel=1e-6)
        assert np.abs((got[free] - theta[0]) / std).max() < 1e-3
        assert np.abs((got_P - P[0]) / np.outer(std, std)).max() < 1e-3


def test_the_best_start_is_returned_and_an_invalid_one_costs_infinity():
    data, free = samples_of(ROAD, (0.1,)), np.arange(N_STRAIGHT)
    starts = starts_of(STRAIGHT, free)
    each = [data.fit(3, free, start[None])[1] for start in starts]
    unusable = np.full_like(starts[0], np.nan)
    assert data.fit(3, free, np.vstack([unusable, starts]))[1] == min(each)
    _, cost, P = data.fit(3, free, unusable[None])
    assert cost == np.inf and not P.any()


def test_undetermined_parameters_have_zero_variance():
    """The length of a row of one dipole is undetermined, and its variance in the pseudo-inverse is
    zero."""
    data = samples_of(ROAD, (0.0,))
    free = np.arange(N_STRAIGHT)
    _, cost, P = data.fit(1, free, STRAIGHT[None, :N_STRAIGHT])
    assert np.isfinite(cost) and P[N_STRAIGHT - 1, N_STRAIGHT - 1] == 0.0
    assert (np.diagonal(P)[:N_STRAIGHT - 1] > 0.0).all()


def test_the_pseudo_inverse_of_the_fit_matches_numpy():
    """One free parameter is listed twice, so the information matrix is singular."""
    data = samples_of(ROAD, (0.0,))
    free = np.arange(N_STRAIGHT)
    model = SteadyPass(data.t, data.positions, data.M, data.clock, free,
                       np.zeros(N_PATH + data.n_clocks), 3)
    problem = SeparableProblem(model, data.y, data.backgrounds)
    doubled_theta, cost, P = data.fit(3, np.sort(np.append(free, 0)), np.append(
        STRAIGHT[0], STRAIGHT[:N_STRAIGHT])[None])
    _, J = problem.residual_and_jacobian(doubled_theta[None, free])
    doubled = J[0][:, np.sort(np.append(free, 0))]
    expected = pseudo_inverse((doubled.T @ doubled)[None])[0]
    assert np.isfinite(cost)
    np.testing.assert_allclose(P, expected, rtol=1e-5, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize('length', [1e-1, 1e-2, 1e-3])
def test_the_fit_of_almost_coincident_dipoles_matches_numpy(length):
    """The cost and covariance are computed at the start, without any step."""
    data = samples_of(ROAD, (0.0,))
    free = np.array([PATH.index('x'), PATH.index('length')])
    fixed = np.append(STRAIGHT, 0.0)
    model = SteadyPass(data.t, data.positions, data.M, data.clock, free, fixed, 5)
    problem = SeparableProblem(model, data.y, data.backgrounds)
    theta = np.array([[0.0, length]])
    nuisance = np.linalg.qr(data.backgrounds)[0]
    cost, P = np.empty(1), np.empty((1, 2, 2))
    core.fit_steady_pass(
        theta=theta.copy(), cost=cost, covariance=P, free=free, fixed=fixed, offsets=model.offsets,
        combinations=model.combinations, t=data.t, positions=data.positions, M=data.M,
        clock=data.clock, y=data.y - nuisance @ (nuisance.T @ data.y), nuisance=nuisance,
        n_steps=0, tolerance=0.0, max_damping=1e12, full_rank=1e-3,
        linear_rank=LINEAR_RANK_TOLERANCE, rank=PSEUDO_INVERSE_TOLERANCE)
    residual, J = problem.residual_and_jacobian(theta)
    assert cost[0] == pytest.approx(float(residual[0] @ residual[0]), rel=1e-6)
    # Eigenvalues near the limit are accurate to only a few digits.
    np.testing.assert_allclose(P[0], pseudo_inverse((J[0].T @ J[0])[None])[0], rtol=0.3)


@pytest.mark.parametrize('name, value, error', [
    ('clock', np.full(4, 1), 'clock: '),
    ('clock', np.full(4, -2), 'clock: '),
    ('fixed', np.zeros(N_PATH - 1), 'fixed: '),
    ('free', np.array([0, 11]), 'free: '),
    ('free', np.array([-1, 3]), 'free: '),
    ('y', np.zeros(11), 'y: shape'),
    ('nuisance', np.zeros((11, 2)), 'nuisance: shape'),
    ('M', np.zeros((3, 3, 3)), 'M: shape'),
    ('combinations', np.eye(2), 'combinations: shape'),
    ('covariance', np.zeros((1, 3, 3)), 'covariance: shape')])
def test_invalid_arrays_are_rejected(name, value, error):
    arguments = {
        'theta': np.zeros((1, 2)), 'cost': np.zeros(1), 'covariance': np.zeros((1, 2, 2)),
        'free': np.arange(2), 'fixed': np.zeros(N_PATH + 1), 'offsets': np.zeros(1),
        'combinations': np.eye(1), 't': np.arange(4.0), 'positions': np.ones((4, 3)),
        'M': np.tile(np.eye(3), (4, 1, 1)), 'clock': np.full(4, -1), 'y': np.zeros(12),
        'nuisance': np.zeros((12, 2)), 'n_steps': 1, 'tolerance': 0.0, 'max_damping': 1e12,
        'full_rank': 1e-3, 'linear_rank': 1e-11, 'rank': 1e-15}
    core.fit_steady_pass(**arguments)
    with pytest.raises(ValueError, match=error):
        core.fit_steady_pass(**{**arguments, name: value})
