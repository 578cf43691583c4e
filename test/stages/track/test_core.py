"""Compiled filters: step-by-step comparison with NumPy, and rejected arguments."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import core
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.initiation_vehicle import start_vehicle
from mag_tracking.stages.track.target import target_of
from support.bundled import POINT
from support.networks import line_network
from support.plain_filter import PlainFilter

SIGMA = 4e-9
N_LARGE = 23
"""Number of sensors at which the updates of all cases process only half of the covariance (see
`HALVED_FROM`)."""
N_TARGETS = {'two rows that turn': 2, 'three points': 3}
"""{case: number of vehicles that share a state}; 1 for all other cases."""
CASES = {
    'two rows that turn': ('vehicle', {}),
    'three points': ('vehicle', POINT),
    'row that turns': ('vehicle', {}),
    'row, straight on': ('vehicle', {'track.vehicle.turn_acceleration': 0.0}),
    'point': ('vehicle', POINT),
    'backgrounds alone': ('vehicle', {'track.mounting_std_deg': 0.0,
                                      'track.model_error_time_s': 0.0}),
    'mounting': ('vehicle', {'track.model_error_time_s': 0.0}),
    'model errors': ('vehicle', {'track.mounting_std_deg': 0.0}),
    'magnet': ('magnet', {}),
    'magnet, linearised three times': ('magnet', {'track.iterations': 3}),
    'magnet, with all states': ('magnet', {'track.mounting_std_deg': 3.0,
                                           'track.model_error_time_s': 0.3})}


def case(name, n_sensors=3, n_hyp=6, seed=0):
    """(compiled filter, plain filter, bank near the sensors, frames, intervals [s]) of
    `CASES[name]`."""
    target, changes = CASES[name]
    settings = settings_for(target, changes).track
    network, rng = line_network(n_sensors), np.random.default_rng(seed)
    model = target_of(settings, network).model
    n_targets = N_TARGETS.get(name, 1)
    filters = [of(network, model, settings, n_targets) for of in (BankFilter, PlainFilter)]
    names = model.state_names * n_targets
    size = np.array([{'x': 3.0, 'y': 1.0, 'z': 0.3, 'v': 2.0, 'm': 50.0, 'D': 2.0, 'L': 1.0,
                      'w': 0.3}[n[0]] for n in names])
    if target == 'magnet':
        size[6:9], size[9:] = 0.5, 2.0
    P = np.array([(root := rng.standard_normal((len(names), len(names)))) @ root.T
                  for _ in range(n_hyp)]) * 0.02 + 0.2 * np.eye(len(names))
    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    bank = FilterBank.from_targets(
        size * rng.standard_normal((n_hyp, len(names))) + np.isin(names, 'z') * 2.0,
        P * np.outer(size, size), np.zeros(n_hyp, dtype=int), n_sensors, 1e-8,
        filters[0].observation.own_covariance,
        rng.integers(0, len(settings.vehicle.kinds),
                     (n_hyp, n_targets) if n_targets > 1 else n_hyp)
        if target == 'vehicle' else None)
    if settings.vehicle.turn_acceleration and target == 'vehicle':
        # Half of the hypotheses do not turn.
        for w in np.flatnonzero(np.isin(names, 'w')):
            bank.x[::2, w] = 0.0
            bank.P[::2, w] = bank.P[::2, :, w] = 0.0
    frames = []
    for k in range(7):
        field = 3e-8 * rng.standard_normal((n_sensors, 3))
        A = rng.standard_normal((n_sensors, 3, 3))
        C = SIGMA**2 * (A @ np.swapaxes(A, 1, 2) + np.eye(3))
        if k == 2:
            field[0, 1], C[0, 1], C[0, :, 1] = np.nan, np.nan, np.nan
        if k == 4:
            field[1], C[1] = np.nan, np.nan
        offset = 0.03 * rng.standard_normal(n_sensors) if k in (3, 5) else np.zeros(n_sensors)
        frames.append(FieldFrame(k, field, C, np.full(n_sensors, 4), offset, True))
    return *filters, bank, frames, [0.0, 0.1, 0.07, 0.1, 0.2, 0.1, 0.1]


def assert_same(a, b, tolerance=1e-9):
    """Assert equal states and covariances of two banks; `tolerance` is in standard deviations of
    `b`."""
    std = np.sqrt(np.einsum('pii->pi', b.P))
    std = np.where(std > 0.0, std, 1.0)
    assert np.abs((a.x - b.x) / std).max() <= tolerance
    assert np.abs((a.P - b.P) / std[:, :, None] / std[:, None]).max() <= tolerance


@pytest.mark.parametrize('n_sensors', [3, N_LARGE])
@pytest.mark.parametrize('name', CASES)
def test_a_bank_advanced_through_frames_matches_numpy(name, n_sensors):
    """In some frames, an axis or a sensor is missing, or the sampling times of sensors differ."""
    compiled, plain, bank, frames, intervals = case(name, n_sensors)
    other = bank.copy()
    for filter_, b in ((compiled, bank), (plain, other)):
        filter_.move(b, -0.3)
    assert_same(bank, other)
    for frame, dt in zip(frames, intervals, strict=True):
        other.x, other.P = bank.x.copy(), bank.P.copy()
        predicted, log_likelihood = compiled.advance(bank, frame, dt)
        expected, expected_log_likelihood = plain.advance(other, frame, dt)
        assert_same(bank, other)
        np.testing.assert_allclose(bank.nis, other.nis, rtol=1e-9)
        np.testing.assert_allclose(predicted, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(log_likelihood, expected_log_likelihood, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(bank.P, np.swapaxes(bank.P, 1, 2))


@pytest.mark.parametrize('first_is_updated', [False, True])
@pytest.mark.parametrize('passes, step, rejects_outliers, at_predictions', [
    (1, 0.5, False, False), (3, 0.5, False, False), (2, 1.0, True, True)])
@pytest.mark.parametrize('name, n_sensors', [*((name, 3) for name in CASES), ('mounting', N_LARGE)])
def test_filtering_and_smoothing_along_paths_matches_numpy(
        name, n_sensors, passes, step, rejects_outliers, at_predictions, first_is_updated):
    compiled, plain, bank, frames, intervals = case(name, n_sensors, 1 if rejects_outliers else 4)
    paths = np.repeat(bank.x[:, None], len(frames), axis=1)
    if at_predictions:
        paths[:] = np.nan
    other, other_paths = bank.copy(), paths.copy()
    with np.errstate(invalid='ignore'):
        got, expected = (filter_.run_along(
            b, frames, intervals, p, passes=passes, step=step, first_is_updated=first_is_updated,
            rejects_outliers=rejects_outliers, wants_covariances=True)
            for filter_, b, p in ((compiled, bank, paths), (plain, other, other_paths)))
    std = np.sqrt(np.einsum('pkii->pki', expected.covariances))
    std = np.where(std > 0.0, std, 1.0)
    assert_same(bank, other, 1e-6)
    assert np.abs((paths - other_paths) / std).max() <= 1e-6
    difference = (got.covariances - expected.covariances) / std[..., :, None] / std[..., None, :]
    assert np.abs(difference).max() <= 1e-6
    np.testing.assert_array_equal(got.used, expected.used)
    np.testing.assert_allclose(got.log_likelihood, expected.log_likelihood, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(got.max_shift, expected.max_shift, rtol=1e-5, atol=1e-6)


def test_a_hypothesis_at_a_sensor_is_ruled_out_and_the_others_are_not():
    compiled, _, bank, frames, _ = case('point')
    alone = bank.alone(0)
    bank.x[1, :3] = compiled.observation.positions[1]
    _, log_likelihood = compiled.advance(bank, frames[0], 0.0)
    _, single_log_likelihood = compiled.advance(alone, frames[0], 0.0)
    assert log_likelihood[1] == -np.inf and np.isfinite(np.delete(log_likelihood, 1)).all()
    np.testing.assert_array_equal(alone.P[0], bank.P[0])
    assert log_likelihood[0] == single_log_likelihood[0]
    assert np.isfinite(bank.x).all() and np.isfinite(bank.P).all()


@pytest.mark.parametrize('bad', [
    np.zeros((3, 3)), np.diag([-1.0, 1.0, 1.0]),
    [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 2.0], [0.0, 1.0, 0.0], [2.0, 0.0, 1.0]]])
def test_noise_that_is_not_positive_definite_is_rejected(bad):
    compiled, _, bank, frames, intervals = case('point')
    x, paths = bank.x.copy(), np.repeat(bank.x[:, None], 7, axis=1)
    frames[0].covariance[1] = SIGMA**2 * np.array(bad)
    with pytest.raises(ValueError, match='definite'):
        compiled.advance(bank, frames[0], 0.0)
    with pytest.raises(ValueError, match='definite'):
        compiled.run_along(bank, frames, intervals, paths, passes=1, step=0.5,
                           first_is_updated=False)
    np.testing.assert_array_equal(bank.x, x)


@pytest.mark.parametrize('corrupt, error', [
    (lambda b: setattr(b, 'x', b.x[:, :-1].copy()), 'x: shape'),
    (lambda b: setattr(b, 'P', b.P[:, :-1].copy()), 'P: shape'),
    (lambda b: setattr(b, 'P', b.P[:-1].copy()), 'P: shape')])
def test_arrays_of_wrong_shapes_are_rejected(corrupt, error):
    compiled, _, bank, frames, _ = case('point')
    corrupt(bank)
    with pytest.raises(ValueError, match=error):
        compiled.advance(bank, frames[0], 0.0)


@pytest.mark.parametrize('name', CASES)
def test_a_bank_is_advanced_in_place_unless_its_prior_is_kept(name):
    compiled, _, bank, frames, intervals = case(name, n_hyp=3)
    before, kept = bank.copy(), bank.copy()
    x, P, kept_x, kept_P = bank.x, bank.P, kept.x, kept.P
    moved = compiled.advance(bank, frames[1], intervals[1])
    assert bank.x is x and bank.P is P and not np.array_equal(x, before.x)
    for got, expected in zip(compiled.advance(kept, frames[1], intervals[1], keeps_prior=True),
                             moved, strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(kept.x, bank.x)
    np.testing.assert_array_equal(kept.P, bank.P)
    np.testing.assert_array_equal(kept_x, before.x)
    np.testing.assert_array_equal(kept_P, before.P)


def test_output_arrays_that_would_be_copied_are_rejected():
    """The results would be written to the copy and lost."""
    compiled, _, bank, frames, intervals = case('point')
    paths = np.repeat(bank.x[:, None], 7, axis=1)
    for bad in (np.asfortranarray(paths), paths.astype(np.float32)):
        with pytest.raises(TypeError, match='incompatible'):
            compiled.run_along(bank, frames, intervals, bad, passes=1, step=0.5,
                               first_is_updated=False)
    bank.P.flags.writeable = False
    with pytest.raises(ValueError, match='read-only|not writeable'):
        compiled.advance(bank, frames[0], 0.0)


@pytest.mark.parametrize('name', ['row that turns', 'point', 'magnet'])
def test_an_invalid_hypothesis_does_not_affect_the_others(name):
    """Rounding errors may make a covariance indefinite; the resulting NaN must not spread."""
    compiled, _, bank, frames, intervals = case(name, n_hyp=4)
    paths = np.repeat(bank.x[:, None], len(frames), axis=1)
    found = []
    for is_invalid in (False, True):
        b, p = bank.copy(), paths.copy()
        if is_invalid:
            b.P[0] *= -1.0
        path_result = compiled.run_along(b, frames, intervals, p, passes=3, step=0.5,
                                         first_is_updated=False, wants_covariances=True)
        found.append((b.x[1:], b.P[1:], p[1:], path_result.covariances[1:],
                      path_result.log_likelihood[1:], path_result.max_shift[1:]))
    assert path_result.log_likelihood[0] == -np.inf
    for expected, got in zip(*found, strict=True):
        np.testing.assert_array_equal(got, expected)


def test_a_path_through_infinity_has_not_converged():
    compiled, _, bank, frames, intervals = case('point', n_hyp=2)
    paths = np.repeat(bank.x[:, None], len(frames), axis=1)
    paths[0, 2] = np.inf
    path_result = compiled.run_along(bank, frames, intervals, paths, passes=1, step=0.5,
                                     first_is_updated=False)
    assert np.isnan(path_result.max_shift[0]) and np.isfinite(path_result.max_shift[1])


def test_the_number_of_vehicles_that_share_a_state_is_bounded():
    for count in (0, core.MAX_TARGETS + 1):
        with pytest.raises(ValueError, match='count: from 1 to 4'):
            core.VehiclesFilter(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), 0, 0, count, 12,
                                *ROW)


def test_two_vehicles_without_common_sensors_are_filtered_independently():
    """Each vehicle passes its own sensors, far from the sensors of the other vehicle."""
    settings = settings_for('vehicle', {**POINT, 'track.background_std': 1e-8}).track
    near, rng = line_network(2), np.random.default_rng(1)
    far = dataclasses.replace(line_network(2), positions=near.positions + [5e4, 0.0, 0.0],
                              names=('a', 'b'), topics=('/a', '/b'))
    both = dataclasses.replace(
        line_network(4), positions=np.vstack([near.positions, far.positions]),
        R_ws=np.concatenate([near.R_ws, far.R_ws]))
    model = target_of(settings, near).model
    banks = [start_vehicle(settings.vehicle, network, FieldFrame(
        0, np.full((2, 3), 1e-8), np.tile(SIGMA**2 * np.eye(3), (2, 1, 1)), np.ones(2),
        np.zeros(2), True), settings.background_std, BankFilter(
            network, model, settings).observation.own_covariance).alone(3)
        for network in (near, far)]
    filters = [BankFilter(network, model, settings) for network in (near, far)]
    together = joint_bank(*banks, len(model.state_names))
    joint = BankFilter(both, model, settings, 2)
    for k in range(6):
        field = 3e-8 * rng.standard_normal((4, 3))
        C = np.tile(SIGMA**2 * np.eye(3), (4, 1, 1))
        log_likelihood = joint.advance(together, FieldFrame(
            k, field, C, np.ones(4), np.zeros(4), True), 0.1)[1]
        separate = [f.advance(b, FieldFrame(k, field[rows], C[rows], np.ones(2), np.zeros(2), True),
                              0.1)[1] for f, b, rows in zip(
                                 filters, banks, (slice(0, 2), slice(2, 4)), strict=True)]
        assert log_likelihood[0] == pytest.approx(separate[0][0] + separate[1][0], rel=1e-9)
        for i, bank in enumerate(banks):
            view, n_t = together.extract_target(i, len(model.state_names)), len(model.state_names)
            np.testing.assert_allclose(view.x[0, :n_t], bank.x[0, :n_t], rtol=1e-9, atol=1e-9)
            std = np.sqrt(np.diagonal(bank.P[0])[:n_t])
            assert np.abs((view.P[0, :n_t, :n_t] - bank.P[0, :n_t, :n_t])
                          / np.outer(std, std)).max() <= 1e-9


def joint_bank(a, b, n_t):
    """Join the targets and sensors of two banks of one hypothesis; each target has `n_t` states."""
    n_own = (a.x.shape[1] - n_t) // 2 - 3
    columns = [(bank, np.arange(n_t), i * n_t + np.arange(n_t)) for i, bank in enumerate((a, b))]
    for i, bank in enumerate((a, b)):
        own = np.arange(2 * n_own)
        columns.append((bank, n_t + own, 2 * n_t + i * 2 * n_own + own))
        background = np.arange(6)
        columns.append((bank, n_t + 2 * n_own + background,
                        2 * n_t + 4 * n_own + 6 * i + background))
    n_x = 2 * a.x.shape[1]
    x, P = np.zeros((1, n_x)), np.zeros((1, n_x, n_x))
    for bank, of, to in columns:
        x[0, to] = bank.x[0, of]
        P[0, to[:, None], to] = bank.P[0][np.ix_(of, of)]
    both = [np.stack([getattr(a, name), getattr(b, name)], axis=1) for name in ('label', 'kind')]
    return FilterBank(x, P, np.zeros(1), *both, np.zeros(1, dtype=int), np.full((1, 4), np.nan))


ROW = (1, [1.0] * 3, [1.0] * 3, 0.1, 0.1, 0.0, 1.0, 1.0)


@pytest.mark.parametrize('n_angles, n_errors, n_states, row, error', [
    (1, 0, 12, ROW, 'three'), (0, 2, 12, ROW, 'three'), (0, 0, 9, ROW, 'n_states'),
    (0, 0, 0, ROW, 'n_states'), (0, 0, 9, (0, *ROW[1:]), 'n_states'),
    (0, 0, 9, (50, *ROW[1:]), 'n_states'),
    (0, 0, 9 + 3 * 90 + 1, (90, *ROW[1:]), 'more states')])
def test_a_filter_with_an_invalid_state_is_rejected(n_angles, n_errors, n_states, row, error):
    with pytest.raises(ValueError, match=error):
        core.RowVehicleFilter(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), n_angles, n_errors,
                              n_states, *row)
