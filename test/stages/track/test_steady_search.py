"""Search for vehicles on straight paths in the frames of a window."""

import numpy as np
import pytest

from mag_tracking.physics.passes import RowPass
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.steady_search import N_DIPOLES, PathPrior, StartGrid, SteadySearch
from mag_tracking.units import NS
from support.busy_worlds import NETWORKS
from support.networks import line_network

NOISE = 6e-9
VEHICLE = settings_for('vehicle').track.vehicle
FIRST_PATH = np.array([4.0, -1.8, 0.5, 12.0, 0.0, 0.0, 3.0])
SECOND_PATH = np.array([-2.0, 1.7, 0.6, 15.0, np.pi, 0.0, 2.5])
MOMENTS = {id(FIRST_PATH): [120.0, -90.0, -100.0], id(SECOND_PATH): [-60.0, 130.0, -110.0]}


def field_of(path, network, t):
    """Field (n, n_sensors, 3) [T] of a row of three dipoles; time zero is at the last frame."""
    n = len(network)
    velocity = path[3] * np.array([np.cos(path[4]), np.sin(path[4]), 0.0])
    model = RowPass(np.repeat(t, n), np.tile(network.positions, (len(t), 1)),
                    np.tile(np.eye(3), (n * len(t), 1, 1)), 3)
    moments = np.tile(MOMENTS[id(path)], 3)
    p = np.linalg.solve(model.combinations, moments)
    basis = model.basis(np.concatenate([path[:3], velocity, path[6:]])[None])[0]
    return (basis @ p).reshape(len(t), n, 3)


def search_of(*paths, n_sensors=4, seed=0):
    """(`SteadySearch`, its grid) for two seconds of frames with vehicles on `paths`."""
    network, rng = NETWORKS[n_sensors], np.random.default_rng(seed)
    t = np.arange(-24, 1) * 0.08
    field = sum(field_of(path, network, t) for path in paths)
    field = field + NOISE * rng.standard_normal(field.shape)
    C = np.tile(NOISE**2 * np.eye(3), (len(network), 1, 1))
    frames = [FieldFrame(round(s * NS), f, C, np.full(len(network), 4), np.zeros(len(network)),
                         True) for s, f in zip(t, field, strict=True)]
    samples = PassSamples.of(network, frames, 0, len(network))
    prior = PathPrior.of(VEHICLE, network)
    return (SteadySearch(samples, prior, np.zeros(len(samples.y)), 2e-8 * samples.backgrounds),
            StartGrid(samples, prior, prior.starts(VEHICLE, network)))


@pytest.mark.parametrize('gap_m', [300.0, 99e3])
def test_starts_cover_the_neighbourhood_of_distant_sensors(gap_m):
    """The number of starts does not grow with a gap between the sensors."""
    network, compact = line_network(4, gap_m), line_network(4)
    starts, compact_starts = (PathPrior.of(VEHICLE, n).starts(VEHICLE, n)
                              for n in (network, compact))
    assert len(compact_starts) < len(starts) < 4 * len(compact_starts)
    distance = np.linalg.norm(starts[:, None, :2] - network.positions[:, :2], axis=2)
    assert (distance.min(axis=0) < 4.0).all()


def assert_near(path, truth, distance=0.5, speed=1.0):
    assert np.hypot(*(path[:2] - truth[:2])) <= distance, (path, truth)
    assert abs(path[3] - truth[3]) <= speed and abs(np.cos(path[4] - truth[4]) - 1.0) <= 0.02


@pytest.mark.parametrize('truth', [FIRST_PATH, SECOND_PATH])
def test_a_single_vehicle_is_found(truth):
    search, grid = search_of(truth)
    best = search.best(grid, 3)
    assert_near(best[0], truth)
    total = search.moments(best[0])[0].sum(axis=0)
    np.testing.assert_allclose(total, 3.0 * np.array(MOMENTS[id(truth)]), atol=60.0)


@pytest.mark.parametrize('n_sensors', [2, 4])
def test_two_vehicles_that_meet_are_found_in_any_order(n_sensors):
    search, grid = search_of(FIRST_PATH, SECOND_PATH, n_sensors=n_sensors)
    pair = search.pairs(grid, 3, 2)[0]
    pair = pair if pair[0, 0] > pair[1, 0] else pair[::-1]
    assert_near(pair[0], FIRST_PATH, 1.5, 1.5)
    assert_near(pair[1], SECOND_PATH, 1.5, 1.5)


def test_another_vehicle_is_found_beside_a_known_one():
    search, grid = search_of(FIRST_PATH, SECOND_PATH)
    assert_near(search.beside(FIRST_PATH).best(grid, 1)[0], SECOND_PATH, 1.0, 1.5)


def test_the_field_of_a_known_vehicle_is_not_another_vehicle():
    """Only noise remains, which no path explains better than another."""
    search, grid = search_of(FIRST_PATH)
    alone, beside = search.cost(grid), search.beside(FIRST_PATH).cost(grid)
    assert np.ptp(alone) > 1000.0
    # The priors of paths and moments contribute a few dozen to the difference.
    assert np.ptp(beside) < 100.0


@pytest.mark.parametrize('truths', [[FIRST_PATH], [FIRST_PATH, SECOND_PATH]])
def test_the_gradient_of_the_cost_is_exact(truths):
    """Kaufman's Jacobian yields the exact gradient, also for two vehicles together."""
    search, _ = search_of(*truths)
    offset = np.array([0.3, 0.2, 0.1, -0.5, 0.02, 0.01, 0.3])
    theta = np.concatenate([truth + offset for truth in truths])[None]
    r, J = search.residual_and_jacobian(theta)
    gradient = -2.0 * np.einsum('nyi,ny->ni', J, r)[0]
    step = 1e-5
    for k in range(theta.shape[1]):
        moved = np.repeat(theta, 2, axis=0)
        moved[:, k] += [step, -step]
        cost = (search.residual_and_jacobian(moved)[0]**2).sum(axis=1)
        assert gradient[k] == pytest.approx((cost[0] - cost[1]) / (2.0 * step), rel=1e-5, abs=1e-3)


def test_the_cost_of_the_grid_matches_the_full_covariance():
    """Cost differences match the log-density of the frames for a point target with Gaussian moment,
    backgrounds and noise."""
    search, grid = search_of(FIRST_PATH)
    beside, rows = search.beside(SECOND_PATH), np.arange(0, len(grid.theta), 97)
    std = search.prior.moment_std[0] * np.sqrt(3.0)
    expected = []
    for k in rows:
        C = np.hstack([beside.columns, std * grid.bases[:, 3 * k:3 * k + 3]])
        S = np.eye(len(C)) + C @ C.T
        expected.append(search.samples.y @ np.linalg.solve(S, search.samples.y)
                        + np.linalg.slogdet(S)[1] + grid.prior_cost[k])
    cost = beside.cost(grid)[rows]
    np.testing.assert_allclose(cost - cost[0], np.array(expected) - expected[0],
                               rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize('miss', [0.0, 1e-12, 1e-9, 1e-6])
def test_a_path_through_a_sensor_raises_no_error(miss):
    """A step of the search may lead through a sensor."""
    search, grid = search_of(FIRST_PATH, SECOND_PATH)
    at = np.append(search.samples.positions[0] + [0.0, 0.0, miss], FIRST_PATH[3:])
    pair = np.append(at, SECOND_PATH)
    for theta in (at[None], pair[None]):
        search.refined(theta, 3)
    through = StartGrid(search.samples, search.prior, np.vstack([at, FIRST_PATH]))
    cost = search.cost(through)
    assert np.isfinite(cost[1]) and not np.isnan(cost).any()


def test_pairs_are_ranked_by_the_density_of_the_frames():
    """The density includes moments, backgrounds and noise. The vehicles of all pairs have the same
    order."""
    search, grid = search_of(FIRST_PATH, SECOND_PATH)
    pairs = search.pairs(grid, 3, 2)
    model, density = search.samples.straight_model(N_DIPOLES), []
    for pair in pairs:
        columns = [A * search.prior.moment_std for A in model.basis(pair)]
        C = np.hstack([search.columns, *columns])
        S = np.eye(len(C)) + C @ C.T
        residual = search.prior.residual_and_jacobian(pair)[0]
        density.append(search.samples.y @ np.linalg.solve(S, search.samples.y)
                       + np.linalg.slogdet(S)[1] + (residual**2).sum())
        kept, swapped = (np.hypot(*(pair[order, :2] - pairs[0][:, :2]).T).sum()
                         for order in ([0, 1], [1, 0]))
        assert kept <= swapped
    assert density == sorted(density) and density[0] < density[-1]


def test_moments_of_a_pair_are_those_of_its_vehicles():
    search, _ = search_of(FIRST_PATH, SECOND_PATH)
    for pair in ([FIRST_PATH, SECOND_PATH], [SECOND_PATH, FIRST_PATH]):
        totals = search.moments(np.concatenate(pair)).sum(axis=1)
        np.testing.assert_allclose(totals, [3.0 * np.array(MOMENTS[id(path)]) for path in pair],
                                   atol=60.0)


def test_pairs_are_distinct_minima():
    search, grid = search_of(FIRST_PATH, SECOND_PATH)
    pairs = np.array(search.pairs(grid, 3, 2))
    differences = np.abs(pairs[:, None] - pairs)
    assert len(pairs) > 1
    assert all((differences[i, k] > 0.3).any() for i in range(len(pairs)) for k in range(i))


@pytest.mark.parametrize('stationary', [0, 1])
def test_a_pair_with_a_stationary_vehicle_is_rejected(stationary):
    search, _ = search_of(FIRST_PATH, SECOND_PATH)
    pair = np.array([FIRST_PATH, SECOND_PATH])
    assert np.isfinite(search.refined(pair.reshape(1, -1), 0)[1]).all()
    pair[stationary, 3] = 0.1
    assert np.isinf(search.refined(pair.reshape(1, -1), 0)[1]).all()


@pytest.mark.parametrize('away, is_sensed', [
    (0.0, True), (15.0, True), (90.0, False), (300.0, False), (1e23, False), (-1e200, False)])
def test_a_vehicle_that_no_sensor_senses_is_rejected(away, is_sensed):
    """A distant vehicle does not improve the fit of the frames."""
    search, _ = search_of(FIRST_PATH)
    other = np.append(away, SECOND_PATH[1:])
    for theta in (other, np.append(FIRST_PATH, other), np.append(other, FIRST_PATH)):
        assert np.isfinite(search.refined(theta[None], 0)[1]).all() == is_sensed


def test_pairs_that_diverge_are_discarded(monkeypatch):
    """The squares of the diverged positions overflow."""
    search, grid = search_of(FIRST_PATH, SECOND_PATH)
    refined = SteadySearch.refined

    def diverging(self, theta, *args):
        path, cost = refined(self, theta, *args)
        if theta.shape[1] == 14:
            path[::2], cost[::2] = 1e200, np.inf
        return path, cost

    monkeypatch.setattr(SteadySearch, 'refined', diverging)
    pairs = search.pairs(grid, 3, 2)
    assert pairs and all((np.abs(pair) < 1e3).all() for pair in pairs)


def test_a_search_without_a_valid_start_finds_nothing():
    search, _ = search_of(FIRST_PATH)
    at = np.append(search.samples.positions[0], FIRST_PATH[3:])
    grid = StartGrid(search.samples, search.prior, at[None])
    assert search.best(grid, 3).shape == (0, 7) and search.pairs(grid, 3, 2) == []


def test_stationary_and_reversing_vehicles_are_not_found():
    search, grid = search_of(FIRST_PATH)
    assert (search.best(grid, 5)[:, 3] >= 0.2 * min(VEHICLE.speeds)).all()
