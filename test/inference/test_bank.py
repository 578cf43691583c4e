"""Filter bank: log-weights, pruning, best hypothesis, ambiguity and consistency."""

from copy import copy

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from mag_tracking.inference.filter_bank import FilterBank, InitialBank, log_sum_exp
from mag_tracking.physics.dipole import MU0, sensor_fields
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.published_pose import VehicleOrientation, published_track
from support import plain_kalman
from support.networks import line_network
from support.process_noise import predicted


def bank(n=4, spread=10.0, label=None):
    x = np.zeros((n, 7))
    x[:, 0] = spread * np.arange(n)
    P = np.repeat(np.eye(7)[None], n, axis=0)
    return FilterBank(x, P, np.full(n, -np.log(n)),
                      np.arange(n) if label is None else np.array(label),
                      np.zeros(n, dtype=int), np.arange(n), np.arange(n)[:, None] + 0.5)


def test_pruning_keeps_innovations_with_their_hypotheses():
    b = bank(6)
    b.log_w = np.log([0.1, 0.3, 1e-14, 0.2, 0.2, 0.2])
    b.kind = 10 * np.arange(6)
    b.prune(20.0, 100)
    assert b.nis[:, 0].tolist() == [0.5, 1.5, 3.5, 4.5, 5.5]
    assert b.kind.tolist() == [0, 10, 30, 40, 50]
    assert b.origin.tolist() == b.label.tolist() == [0, 1, 3, 4, 5]


@pytest.mark.parametrize('other, label, ambiguous', [
    (0.01, 1, False), (0.2, 1, True), (0.2, 0, False)])
def test_another_arrival_makes_a_track_ambiguous_at_equal_positions(
        other, label, ambiguous):
    model = RowVehicle(np.zeros(3), np.ones(3), n_dipoles=1)
    x = np.tile([1.0, 2.0, 0.5, 10.0, 0.0, 0.0, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0], (2, 1))
    b = FilterBank(x, np.repeat(np.eye(12)[None], 2, axis=0), np.log([other, 1.0 - other]),
                   np.array([label, 0]), np.array([0, 1]), np.arange(2),
                   np.array([[7.0, np.nan], [1.0, 2.0]]))
    track = published_track(
        b, 1, model, VehicleOrientation(), ('left', 'right'), ('car', 'truck'),
        set(), None, difference=np.zeros(6), stamp_ns=1, id=1, ended=False,
        existence=1.0, degrees_of_freedom=6, predicted=np.zeros((2, 3)),
        mounting=np.zeros((0, 3)), mounting_covariance=np.zeros((0, 3, 3)))
    assert track.ambiguous == ambiguous
    assert track.doubts == (('another_arrival',) if ambiguous else ())
    assert (track.arrival, track.nis, track.kind) == ('left', 3.0, 'truck')
    assert track.nis_by_sensor.tolist() == [1.0, 2.0]
    assert track.kind_weight == pytest.approx(1.0 - other)
    assert [h.kind for h in track.hypotheses] == ['truck', 'car']
    other_hypothesis = track.hypotheses[-1]
    assert other_hypothesis.weight == pytest.approx(other)
    assert other_hypothesis.arrival == ('left', 'right')[label]
    assert other_hypothesis.position.tolist() == [1.0, 2.0, 0.5]
    assert other_hypothesis.velocity.tolist() == [10.0, 0.0, 0.0]
    assert other_hypothesis.moment.tolist() == [100.0, 0.0, 0.0]
    np.testing.assert_array_equal(other_hypothesis.covariance, np.eye(6))
    assert [h.weight for h in track.hypotheses[1:]] == [other_hypothesis.weight]


def test_log_sum_exp_equals_scipy_also_for_extreme_values():
    for a in ([-4500.0, 0.0, 3.0], [-1e5, -1e5, -1e5 + 1]):
        np.testing.assert_allclose(log_sum_exp(a), logsumexp(a), rtol=1e-14)
    assert log_sum_exp([-np.inf, -np.inf]) == -np.inf


def test_log_weights_thousands_of_nats_apart_are_exact():
    b = bank(2)
    b.reweight(np.array([-4500.0, 0.0]))
    np.testing.assert_allclose(b.log_w, [-4500.0, 0.0], atol=1e-12)
    b.reweight(np.array([4600.0, 0.0]))
    np.testing.assert_allclose(b.log_w, [0.0, -100.0], atol=1e-9)


def test_weights_follow_bayes_rule():
    rng = np.random.default_rng(0)
    b, total = bank(5), np.zeros(5)
    for _ in range(20):
        ll = rng.normal(0.0, 2.0, 5)
        total += ll
        b.reweight(ll)
    np.testing.assert_allclose(b.log_w, total - logsumexp(total), atol=1e-12)


def test_a_likelihood_that_is_not_finite_removes_only_its_own_weight():
    b = bank(3)
    assert np.isfinite(b.reweight(np.array([np.nan, 0.0, 0.0])))
    np.testing.assert_allclose(np.exp(b.log_w), [0.0, 0.5, 0.5])
    assert b.reweight(np.full(3, np.nan)) == -np.inf
    np.testing.assert_allclose(np.exp(b.log_w), [0.0, 0.5, 0.5])


def test_prune_limits_the_weight_ratio_and_the_number():
    b = bank(4)
    b.log_w = np.log([0.9, 0.1 - 1e-9 - 1e-14, 1e-9, 1e-14])
    assert b.prune(-np.log(1e-12), 10) == 1
    assert b.prune(-np.log(1e-12), 2) == 1
    np.testing.assert_allclose(np.exp(b.log_w).sum(), 1.0)
    assert len(b) == len(b.x) == len(b.P) == len(b.label) == 2


def test_best_is_the_heaviest_hypothesis_of_the_heaviest_label():
    b = bank(3, label=[0, 1, 1])
    b.log_w = np.log([0.4, 0.35, 0.25])
    assert b.best() == 1


def test_best_is_of_the_heaviest_kind_of_the_heaviest_arrival():
    b = bank(4, label=[0, 1, 1, 1])
    b.kind = np.array([0, 0, 1, 1])
    b.log_w = np.log([0.35, 0.25, 0.22, 0.18])
    assert b.best() == 2


def test_best_is_at_the_maximum_of_the_mixture_density():
    """The best of two distant hypotheses of equal weight has the smaller covariance.

    If a covariance is invalid, the heaviest hypothesis is the best.
    """
    b = bank(3, spread=100.0, label=[0, 0, 0])
    b.P[1, :3, :3] *= 0.5
    assert b.best() == 1
    b.log_w = np.log([0.2, 0.3, 0.5])
    for invalid in (np.nan, np.inf, -1.0):
        b.P[0, 0, 0] = invalid
        assert b.best() == 2


@pytest.mark.parametrize('spread', [0.5, 5.0, 500.0])
@pytest.mark.parametrize('n', [1, 2, 60])
def test_best_equals_the_maximum_of_individually_computed_densities(n, spread):
    rng = np.random.default_rng(n)
    for _ in range(20):
        A = rng.standard_normal((n, 3, 3))
        b = FilterBank(spread * rng.standard_normal((n, 3)), A @ np.swapaxes(A, 1, 2),
                       np.log(rng.dirichlet(np.full(n, 3.0))), np.zeros(n, dtype=int),
                       np.zeros(n, dtype=int), np.arange(n), np.zeros((n, 1)))
        candidates = np.flatnonzero(b.log_w >= b.log_w.max() - np.log(100.0))
        density = sum(np.exp(b.log_w[i]) * multivariate_normal.pdf(b.x[candidates], b.x[i], b.P[i])
                      for i in candidates)
        assert b.best() == candidates[np.argmax(density)]


def test_separated_weight_counts_distant_hypotheses_only():
    b = bank(3, spread=1.0)
    b.x[2, 0] = 30.0
    b.log_w = np.log([0.6, 0.3, 0.1])
    assert b.weight(b.is_separated(0)) == pytest.approx(0.1)


def initial_bank(network, earth, offset_std=0.5):
    """Bank of 126 hypotheses with a tight prior, all with an arrival along x."""
    x, P = [], []
    for m in 300.0 * moment_directions():
        for lateral in (-1.0, 0.0, 1.0):
            for speed in (8.0, 10.0, 12.0):
                x.append([-12.0, lateral, 0.5, speed, 0.0, 0.0, *(m - 4.0 * earth / MU0),
                          4.0, 4.0, 4.0])
                P.append(np.diag([0.5, offset_std, 0.1, 1.0, 0.3, 0.02,
                                  120.0, 120.0, 120.0, 1.0, 1.0, 1.0]) ** 2)
    bank = FilterBank.from_targets(np.array(x), np.array(P), np.zeros(len(x), dtype=int),
                                   len(network), 1e-8)
    return bank


def matched_run(rng, network, model, sigma):
    """NEES per state of the best hypothesis after one run simulated with the filter's model."""
    earth = model.earth_field
    bank = initial_bank(network, earth)
    row = rng.integers(len(bank))
    n_t, n_x = len(model.state_names), bank.x.shape[1]
    truth = rng.multivariate_normal(bank.x[row], bank.P[row])
    dt = 0.08
    C = np.repeat(sigma**2 * np.eye(3)[None], len(network), axis=0)
    for k in range(22):
        if k:
            moved, F, Q = predicted(model, truth[None, :n_t], dt)
            truth[:n_t] = moved[0] + rng.multivariate_normal(np.zeros(n_t), Q[0])
            truth[n_t:] += 1e-9 * np.sqrt(dt) * rng.standard_normal(n_x - n_t)
            x_target, F, Q = predicted(model, bank.x[:, :n_t], dt)
            plain_kalman.predict(bank.x, bank.P, x_target, F, Q, 1e-18 * dt)
        h = sensor_fields(network.positions, network.R_sw, *model.dipoles(truth[None, :n_t]))[0][0]
        y = h + truth[n_t:].reshape(-1, 3) + sigma * rng.standard_normal(h.shape)
        h, H, _ = sensor_fields(network.positions, network.R_sw, *model.dipoles(bank.x[:, :n_t]))
        log_likelihood, *_ = plain_kalman.update(bank.x, bank.P, y, h, H, C,
                                                 np.zeros((len(bank), len(network))))
        bank.reweight(log_likelihood)
        bank.prune(-np.log(1e-12), 600)
    i = bank.best()
    e = (truth - bank.x[i])[:6]
    return float(e @ np.linalg.solve(bank.P[i, :6, :6], e)) / 6.0


def test_anees_of_matched_runs_is_near_one():
    """The NEES of position and velocity is averaged over 200 runs with two sensors at 12.5 Hz."""
    earth = np.array([2e-6, 1.55e-5, -4.9e-5])
    network = line_network(2, tilt=0.0)
    model = RowVehicle(earth, np.array([0.1, 0.1, 1e-4]), 0.003, n_dipoles=1)
    rng = np.random.default_rng(42)
    nees = np.array([matched_run(rng, network, model, 1.2e-8 / np.sqrt(8.0))
                     for _ in range(200)])
    print(f'matched ANEES {nees.mean():.3f}, median {np.median(nees):.3f}, max {nees.max():.1f}')
    assert nees.mean() <= 1.3
    # The lower limit rejects a covariance that is far too large.
    assert nees.mean() >= 0.7


def random_bank(n, n_x, n_sensors=1):
    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n_x, n_x))
    return FilterBank(rng.standard_normal((n, n_x)), A @ np.swapaxes(A, 1, 2),
                      np.log(rng.dirichlet(np.ones(n))), np.arange(n) % 2, np.arange(n) % 3,
                      np.arange(n), np.zeros((n, n_sensors)))


@pytest.mark.parametrize('removed', [[2], [0, 5], [0, 1, 2, 4]])
def test_keep_leaves_the_remaining_hypotheses_unchanged(removed):
    bank = random_bank(6, 3)
    before, mask = bank.copy(), ~np.isin(np.arange(6), removed)
    assert bank.keep(mask) == len(removed)
    np.testing.assert_array_equal(bank.x, before.x[mask])
    np.testing.assert_array_equal(bank.P, before.P[mask])
    assert bank.x.flags.c_contiguous and bank.P.flags.c_contiguous
    np.testing.assert_array_equal(bank.origin, np.flatnonzero(mask))
    np.testing.assert_allclose(np.exp(bank.log_w).sum(), 1.0)


def test_an_initial_bank_returns_the_rows_of_its_source_bank():
    """Changes of the source bank, or of a copy that shares its arrays, have no effect."""
    from_targets = random_bank(5, 4)
    own_covariance = np.array([np.diag([1.0, 2.0]), np.diag([3.0, 4.0])])
    bank = FilterBank.from_targets(from_targets.x, from_targets.P, from_targets.label, 2, 1e-8,
                                   own_covariance, from_targets.kind)
    before, start = bank.copy(), InitialBank.of(bank, 4)
    other = copy(start)
    bank.x[:], bank.P[:] = np.nan, np.nan
    other.keep(np.array([False, False, True, False, True]))
    for copy_of_rows, rows in ((start.rows(np.array([4, 1])), [4, 1]),
                               (other.rows(np.arange(2)), [2, 4])):
        for name in ('x', 'P', 'label', 'kind', 'origin', 'nis'):
            np.testing.assert_array_equal(getattr(copy_of_rows, name), getattr(before, name)[rows])
        np.testing.assert_allclose(np.exp(copy_of_rows.log_w), 0.5)
    assert len(start) == 5 and len(other) == 2
