"""Geometry calibration with faulty sensors, faulty poses or invalid arguments."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.calibration.network_fit import rotation
from mag_tracking.calibration.network_geometry import calibrate_geometry, fitted_geometry
from mag_tracking.physics.dipole import dipole_field
from support.magnet_boards import MOMENT, SETTINGS, board, calibrated_boards, estimated, simulated


@pytest.fixture(scope='module')
def boards():
    """Simulate and calibrate several boards; return a list of (simulated data, geometry)."""
    return calibrated_boards()


def agree_within(g, h, network, max_stds):
    """Whether two estimates agree within `max_stds` stds of the first estimate."""
    return bool((np.abs(estimated(g, network) - estimated(h, network))
                 < max_stds * np.sqrt(np.diagonal(g.covariance))).all())


def test_a_dead_sensor_is_treated_as_missing(boards):
    (network, field, positions, axes, _), _ = boards[2]
    incomplete = field.copy()
    incomplete[:, 4] = np.nan
    incomplete[3, 5, 1] = np.nan
    incomplete[:, 6, 2] = np.nan
    g = calibrate_geometry(network, incomplete, positions, axes, MOMENT, SETTINGS)
    assert g.converged
    assert np.isnan(g.bias[4]).all() and np.isinf(g.bias_std[4]).all()
    assert np.isnan(g.bias[6]).tolist() == [False, False, True]
    np.testing.assert_allclose(g.position_std[4], SETTINGS.position_std, rtol=0.1)
    assert g.gain[4] == 1.0 and np.isnan(g.sensor_residual[4])
    assert g.network.background[4] is None and g.network.background[0] is not None
    others = np.delete(np.arange(9), 4)
    reduced = replace(network, names=tuple(np.array(network.names)[others].tolist()),
                      positions=network.positions[others], R_ws=network.R_ws[others],
                      topics=tuple(np.array(network.topics)[others].tolist()),
                      noise_std=network.noise_std[:8], background=())
    h = calibrate_geometry(reduced, incomplete[:, others], positions, axes, MOMENT, SETTINGS)
    assert (np.abs(g.gain[others] - h.gain) < 1e-4 * h.gain_std).all()
    assert (np.abs(g.network.positions[others] - h.network.positions)
            < 1e-4 * h.position_std).all()
    assert (np.abs(g.shared - h.shared) < 1e-4 * h.shared_std).all()


@pytest.mark.parametrize('shift', [2e-2, 4e-3])
def test_an_outlying_pose_is_reported_and_has_little_effect(boards, shift):
    (network, field, positions, axes, _), g = boards[5]
    faulty = positions.copy()
    faulty[7, 0] += shift
    h = calibrate_geometry(network, field, faulty, axes, MOMENT, SETTINGS)
    assert h.converged and h.suspect_poses == (7,) and h.suspect_sensors == ()
    assert agree_within(g, h, network, 1.0)
    # The faulty pose does not increase the residuals of the sensors.
    np.testing.assert_allclose(h.sensor_residual, g.sensor_residual, rtol=0.1)


def test_a_pose_with_the_readings_of_another_pose_is_reported(boards):
    (network, field, positions, axes, _), g = boards[6]
    faulty = field.copy()
    faulty[7] = field[8]
    h = calibrate_geometry(network, faulty, positions, axes, MOMENT, SETTINGS)
    assert h.converged and h.suspect_poses == (7,) and h.suspect_sensors == ()
    assert agree_within(g, h, network, 1.0)


def apply_fault(field, fault):
    """Copy readings and apply a fault to sensor 2."""
    faulty = field.copy()
    if fault == 'flipped':
        faulty[:, 2, 1] *= -1.0
    elif fault == 'swapped':
        faulty[:, 2] = faulty[:, 2][:, [1, 0, 2]]
    elif fault == 'rotated':
        faulty[:, 2] = faulty[:, 2] @ rotation(np.array([0.0, 0.4, 0.0]))
    elif fault == 'gain':
        faulty[:, 2] *= 2.0
    else:
        faulty[:, 2] = np.nan
    return faulty


@pytest.mark.parametrize('fault', ['flipped', 'swapped', 'rotated', 'gain'])
def test_a_faulty_sensor_is_reported(boards, fault):
    """The estimates of the other sensors are almost as good as without the faulty sensor."""
    others, z2 = np.delete(np.arange(9), 2), {fault: [], 'dead': []}
    for (network, field, positions, axes, x), _ in boards[:8]:
        for case, values in z2.items():
            g = calibrate_geometry(network, apply_fault(field, case), positions, axes, MOMENT,
                                   SETTINGS)
            z = (_corrections(g, network) - x[0][:, 3:]) / _corrections_std(g)
            values.append(np.square(z[others]).mean())
            assert g.converged and g.suspect_poses == ()
            assert g.suspect_sensors == (() if case == 'dead' else ('mag_2',))
    print(f'mean squared z with a sensor {fault} {np.mean(z2[fault]):.2f}, '
          f'without it {np.mean(z2["dead"]):.2f}')
    assert np.mean(z2[fault]) < 1.25 * np.mean(z2['dead'])


def _corrections(geometry, network):
    """Estimated corrections of the sensors (n, 7) without the biases."""
    return estimated(geometry, network)[:-12].reshape(-1, 10)[:, 3:]


def _corrections_std(geometry):
    """Standard deviations of `_corrections`, (n, 7)."""
    return np.sqrt(np.diagonal(geometry.covariance))[:-12].reshape(-1, 10)[:, 3:]


def test_too_few_poses_do_not_converge():
    network, field, positions, axes, _ = simulated(9)
    for K in (1, 2):
        g = calibrate_geometry(network, field[:K], positions[:K], axes[:K], MOMENT, SETTINGS)
        assert not g.converged and f'poses is {K}' in g.reason
    g = calibrate_geometry(network, field, positions, axes, MOMENT, replace(SETTINGS, iterations=1))
    assert not g.converged and 'steps: 1' in g.reason


def test_one_sensor_adds_almost_no_information():
    network, field, positions, axes, _ = simulated(9)
    scarce_field = np.full((3, 9, 3), np.nan)
    scarce_field[:, 0] = field[:3, 0]
    g = calibrate_geometry(network, scarce_field, positions[:3], axes[:3], MOMENT, SETTINGS)
    assert (g.position_std > 0.95 * SETTINGS.position_std).all()
    assert (g.gain_std > 0.95 * SETTINGS.gain_std).all()
    # The std never exceeds the prior, even for a poor fit.
    assert (g.position_std <= (1.0 + 1e-9) * SETTINGS.position_std).all()
    free_pose_unit = np.repeat([0.1, 0.5, 0.0], [3, 2, 3])
    g = fitted_geometry(network, scarce_field, positions[:3], axes[:3], MOMENT, SETTINGS,
                        np.zeros(12), free_pose_unit)
    assert not g.converged and 'few readings' in g.reason
    assert np.isnan(g.normalised_cost)


def test_poses_at_one_place_add_no_information_on_the_geometry():
    network, *_ = simulated(9)
    rng = np.random.default_rng(1)
    B = np.einsum('nij,nj->ni', network.R_sw,
                  dipole_field(network.positions - [0.05, 0.05, 0.08], [0.0, 0.0, MOMENT]))
    field = B + 3e-5 + 1e-7 * rng.standard_normal((30, 9, 3))
    g = calibrate_geometry(network, field, np.tile([0.05, 0.05, 0.08], (30, 1)),
                           np.tile([0.0, 0.0, 1.0], (30, 1)), MOMENT, SETTINGS)
    assert not g.converged and 'almost equal' in g.reason
    assert (g.position_std > 0.9 * SETTINGS.position_std).all()
    assert (g.gain_std > 0.9 * SETTINGS.gain_std).all()


def test_a_magnet_of_opposite_polarity_is_rejected():
    network, field, positions, axes, _ = simulated(9)
    g = calibrate_geometry(network, field, positions, -axes, MOMENT, SETTINGS)
    assert not g.converged and 'normalised cost' in g.reason


@pytest.mark.parametrize('change, message', [
    ({'axes': np.ones((5, 3))}, 'pose 0: .*unit axis'),
    ({'positions': np.full((5, 3), np.nan)}, 'pose 0: .*position'),
    ({'field': np.full((5, 9, 3), np.inf)}, 'infinite'),
    ({'positions': np.full((5, 3), 0.0)},
     r'pose 0: \[0.0, 0.0, 0.0\]'),
    ({'moment': 0.0}, 'moment is 0.0'), ({'moment': np.nan}, 'moment is nan'),
    ({'network': replace(board(), noise_std=(None,) * 9)}, 'sensor mag_0: noise_std is None'),
    ({'field': np.zeros((0, 9, 3)), 'positions': np.zeros((0, 3)), 'axes': np.zeros((0, 3))},
     'no poses')])
def test_invalid_arguments_raise_value_error(change, message):
    network, field, positions, axes, _ = simulated(1, n_poses=5)
    given = {'network': network, 'field': field, 'positions': positions, 'axes': axes,
             'moment': MOMENT, **change}
    with pytest.raises(ValueError, match=message):
        calibrate_geometry(**given, settings=SETTINGS)
