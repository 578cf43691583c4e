"""Sensor placement: bounds compared with oracles and fits, detection, and the command `plan`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.placement import (
    DIRECTIONS,
    PlannedTarget,
    Sampling,
    bounds_of,
    detection_probabilities,
    pass_information,
)
from mag_tracking.apps.plan import compute_plan
from mag_tracking.apps.plan_report import summary_lines
from mag_tracking.cli import main
from mag_tracking.inference.crlb import bound, information
from mag_tracking.inference.detection_theory import missed_detection_probability
from mag_tracking.physics.dipole import dipole_field, dipole_jacobians
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE
from support.networks import line_network
from support.passes import NOISE, ROAD, measured, network_of

CAR = PlannedTarget(400.0, 0.5, 10.0)
POINTS = np.array([[0.0, 1.0], [4.0, -2.0], [-9.0, 6.0]])


def sensor_poses(network):
    return network.positions, network.R_sw


@pytest.mark.parametrize('error, background_std', [(0.0, np.inf), (0.04, 1e-8), (0.0, 1e-9)])
def test_information_equals_the_stacked_measurements(error, background_std):
    """The oracle stacks the Jacobians of all frames, with the backgrounds as states."""
    network = line_network(4)
    sampling = Sampling(0.1, 4e-9, error, background_std, 1.0)
    computed = pass_information(*sensor_poses(network), CAR, sampling, POINTS, 0.7)
    assert computed.shape == (3, 7, 4, 9, 9)
    t, frame_weight = sampling.times()
    assert frame_weight == 1.0 and len(t) == 21
    v = 10.0 * np.array([np.cos(0.7), np.sin(0.7), 0.0])
    for p, d in ((0, 0), (1, 4), (2, 6)):
        r = np.append(POINTS[p], 0.5) + t[:, None] * v
        m = 400.0 * DIRECTIONS[d]
        for j in range(4):
            R = network.R_sw[j]
            dB_dr, dB_dm = dipole_jacobians(network.positions[j] - r, m)
            H = np.concatenate([-dB_dr, -t[:, None, None] * dB_dr, dB_dm], axis=-1)
            H = np.concatenate([R @ H, np.tile(np.eye(3), (len(t), 1, 1))], axis=-1)
            size = np.linalg.norm(dipole_field(network.positions[j] - r, m), axis=1)
            C = ((4e-9)**2 + (error * size)**2)[:, None, None] * np.eye(3)
            J = information(H, C) + np.diag([0.0] * 9 + [background_std**-2] * 3)
            expected = J[:9, :9] - J[:9, 9:] @ np.linalg.solve(J[9:, 9:], J[9:, :9])
            scale = np.sqrt(np.diagonal(J)[:9])
            np.testing.assert_allclose(computed[p, d, j] / np.outer(scale, scale),
                                       expected / np.outer(scale, scale), rtol=0, atol=1e-9)


def test_bounds_equal_the_blocks_of_the_covariance():
    J = pass_information(*sensor_poses(ROAD), CAR, Sampling(0.1, 4e-9), POINTS, 0.0).sum(axis=2)
    for prior in (np.zeros((9, 9)), PlannedTarget(400.0, 0.5, 10.0, 0.2, 0.1).prior()):
        bounds = bounds_of(J, prior)
        for at in ((0, 1), (2, 5)):
            variance = np.diagonal(bound(J[at], prior))
            expected = np.sqrt([variance[:2].sum(), variance[3:5].sum(), variance[6:].sum()])
            np.testing.assert_allclose(bounds[at], expected, rtol=1e-5)


def test_neither_an_additional_sensor_nor_a_prior_increases_the_bounds():
    three_poses = np.vstack([ROAD.positions, [[6.0, 1.0, 0.0]]]), np.tile(np.eye(3), (3, 1, 1))
    J = pass_information(*three_poses, CAR, Sampling(0.1, 4e-9), POINTS, 0.0)
    two, three = bounds_of(J[:, :, :2].sum(axis=2), np.zeros((9, 9))), bounds_of(
        J.sum(axis=2), np.zeros((9, 9)))
    assert (three <= two * (1.0 + 1e-9)).all() and (three < 0.9 * two).any()
    known = bounds_of(J.sum(axis=2), PlannedTarget(400.0, 0.5, 10.0, 0.1, 0.1).prior())
    assert (known <= three * (1.0 + 1e-9)).all()


def test_bounds_scale_with_the_network():
    """If the network is scaled by u and the moments by u^3, the position bounds scale with u."""
    u = 0.02
    small = PlannedTarget(400.0 * u**3, 0.5 * u, 10.0 * u)
    J = pass_information(*sensor_poses(ROAD), CAR, Sampling(0.1, 4e-9), POINTS, 0.3).sum(axis=2)
    K = pass_information(u * ROAD.positions, ROAD.R_sw, small, Sampling(0.1, 4e-9), u * POINTS,
                         0.3).sum(axis=2)
    no_prior = np.zeros((9, 9))
    # The constant information of 1e-12 in `bounds_of` is not scaled.
    np.testing.assert_allclose(bounds_of(K, no_prior) / [u, u, u**3], bounds_of(J, no_prior),
                               rtol=1e-4)


def test_position_bound_of_one_sensor_is_very_large():
    network = network_of([[0.0, -4.5, 0.0]])
    J = pass_information(*sensor_poses(network), CAR, Sampling(0.1, 4e-9), POINTS, 0.0).sum(axis=2)
    assert (bounds_of(J, np.zeros((9, 9)))[..., 0] > 1e3).all()


def test_fits_reach_the_bound():
    """The normalised squared errors of 40 fits of a point are chi-square distributed."""
    rng, path = np.random.default_rng(3), np.array([0.0, 1.0, 0.5, 10.0, 0.0, 0.0])
    sampling = Sampling(0.01, NOISE, half_window=2.0, max_frames=500)
    J = pass_information(*sensor_poses(ROAD), CAR, sampling, path[None, :2], 0.0)[0, 4].sum(axis=0)
    P = bound(J)[:2, :2]
    nees = 0.0
    for _ in range(40):
        fit = fit_pass(measured(ROAD, path, 400.0 * DIRECTIONS[4:5], rng), 1)
        # Convert from the time zero of the fit to the time zero of the path.
        error = (fit.position - fit.data.stamp_ns / 1e9 * fit.velocity - path[:3])[:2]
        nees += error @ np.linalg.solve(P, error)
    low, high = chi2.ppf([0.0005, 0.9995], 80)
    assert low < nees < high


def test_detection_probability_agrees_with_the_energy_detector():
    points = np.array([[12.0, 0.0], [0.0, 30.0], [14.0, 3.0]])
    noise = np.array([4e-9, 6e-9])
    probability = detection_probabilities(*sensor_poses(ROAD), CAR, Sampling(0.08, noise), points,
                                          1e-3)
    rng = np.random.default_rng(1)
    for p, d in ((0, 0), (1, 2), (2, 5)):
        r = np.append(points[p], 0.5)
        h = dipole_field(ROAD.positions - r, 400.0 * DIRECTIONS[d]) / noise[:, None]
        energy = np.square(h + rng.standard_normal((20000, 2, 3))).sum(axis=(1, 2))
        rate = np.mean(energy > chi2.isf(1e-3, 6))
        assert probability[p, d] == pytest.approx(ncx2.sf(chi2.isf(1e-3, 6), 6, np.square(h).sum()))
        assert abs(rate - probability[p, d]) < 4.0 * np.sqrt(
            probability[p, d] * (1 - probability[p, d]) / 20000)


@pytest.fixture(scope='module')
def road_plan():
    return compute_plan(
        ROAD, PlannedTarget(400.0, 0.5, 10.0, 0.2, 0.1), Sampling(0.08, 4e-9, 0.04, 1e-8),
        [('right', 0.0, 0.0)], (-12.0, -12.0, 12.0, 12.0), settings_for('vehicle'),
        clearance=2.0, n_grid=13)


def test_a_plan_is_consistent(road_plan):
    p = road_plan
    lane, = p.lanes
    # A complete pass contains more information than the part of the pass before a frame.
    assert (lane.pass_std[:, 0] <= 1.05 * lane.filter_std).all()
    assert lane.detection[np.argmin(np.abs(lane.along))] > 0.999
    # The road and the two sensors are symmetric.
    np.testing.assert_allclose(p.position_std, p.position_std[::-1], rtol=0.2)
    assert np.nanmin(p.std_with_added_sensor) < p.std_without_added_sensor
    assert (np.nan_to_num(p.std_with_added_sensor)
            <= p.std_without_added_sensor * (1.0 + 1e-9)).all()
    assert abs(p.best_position[1]) >= 2.0 and np.isnan(p.std_with_added_sensor).any()
    missed = p.miss_curve[:, 1]
    assert (np.diff(missed) > -1e-6).all() and missed[0] < 1e-6 < missed[-1]
    assert p.observability.kernel_dimension == 0
    bounds = p.bounds_at_closest
    assert (bounds['with prior'] <= bounds['without prior'] * (1.0 + 1e-9)).all()


def test_plan_writes_all_its_files(tmp_path, capsys):
    out = tmp_path / 'out'
    out.mkdir()
    for name in ('plan.json', 'plan_lanes.png'):
        (out / name).symlink_to(tmp_path / 'elsewhere')
    assert main(['plan', '--network', str(NETWORK_FILE), '--target', 'truck', '--heading', '0',
                 '--grid', '9', '--out', str(out)]) == 0
    assert not (tmp_path / 'elsewhere').exists()
    assert {p.name for p in out.iterdir()} == {
        'plan.json', 'plan_position.png', 'plan_detection.png', 'plan_sensor.png', 'report.html',
        'plan_lanes.png'}
    content = json.loads((out / 'plan.json').read_text())
    assert len(content['position_std']) == len(content['y']) and content['lanes'][0]['along']
    text = capsys.readouterr().out
    assert 'additional sensor: best at' in text and 'observable, condition number' in text


@pytest.mark.parametrize('options, message', [
    (['--target', 'tank'], '--target: '),
    (['--target', 'car', '--moment', '3'], '--target: '),
    (['--moment', '3'], '--height: '),
    (['--moment', '-3', '--height', '1'], '--moment: expected 1e-06 to 1e+06, got -3'),
    (['--speed', '0'], '--speed: expected 0.0001 to 1000, got 0'),
    (['--rate', 'nan'], '--rate'),
    (['--noise-std', '0'], '--noise-std'),
    (['--heading', '0', '--offset', '1', '2'], '--offset: expected 1 numbers'),
    (['--area', '5', '0', '1', '9'], '--area: expected X0 < X1'),
    (['--field-error', '2'], '--field-error'),
    (['--clearance', '-1'], '--clearance'),
    (['--grid', '2'], '--grid'),
    (['--height', 'nan'], '--height'),
    (['--area', '0', '0', '1e9', '1e9'], '--area: a side'),
    (['--area', '0', '0', '1', '1000'], '--area: '),
    (['--heading', '0', '0'], 'lanes'),
    (['--target', 'magnet'], '--moment: '),
    (['--target', 'magnet', '--moment', '0.5', '--height', '0.3'],
     '--speed: expected less than 5.23 m/s, got 10: '),
])
def test_plan_rejects_invalid_options(tmp_path, capsys, options, message):
    assert main(['plan', '--network', str(NETWORK_FILE), *options,
                 '--out', str(tmp_path / 'out')]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('options', [
    # Map and lane points at a sensor; no position with the clearance; two lanes with one heading.
    ['--height', '0', '--heading', '0', '--offset', '4.5', '--area', '-10', '-10', '10', '10'],
    ['--height', '0', '--heading', '90', '--area', '-9', '-9', '9', '9', '--clearance', '1e6'],
    ['--heading', '0', '0', '--offset', '2', '-2', '--rate', '1'],
])
def test_plan_accepts_unusual_options(tmp_path, capsys, options):
    out = tmp_path / 'out'
    assert main(['plan', '--network', str(NETWORK_FILE), '--grid', '9', *options,
                 '--out', str(out)]) == 0
    content = json.loads((out / 'plan.json').read_text())
    assert len(content['lanes']) == (2 if '--rate' in options else 1)
    assert len(list(out.glob('*.png'))) == 4
    if '1e6' in options:
        assert 'no position' in capsys.readouterr().out


def test_the_additional_sensor_has_the_clearance_from_each_lane():
    p = compute_plan(ROAD, CAR, Sampling(0.08, 4e-9, 0.04, 1e-8),
                     [('a', 0.0, 2.0), ('b', 0.0, -3.0)], (-12.0, -12.0, 12.0, 12.0),
                     settings_for('vehicle'), clearance=1.5, n_grid=13)
    y = np.linspace(-12.0, 12.0, p.std_with_added_sensor.shape[0])
    is_clear = (np.abs(y - 2.0) >= 1.5) & (np.abs(y + 3.0) >= 1.5)
    assert np.array_equal(np.isfinite(p.std_with_added_sensor).all(axis=1), is_clear)


def test_the_summary_states_on_which_side_of_the_centre_detection_begins(road_plan):
    lane, = road_plan.lanes
    for first, text in ((-5.0, 'at 5 m before the centre;'), (3.0, 'at 3 m past the centre;'),
                        (np.inf, 'nowhere;')):
        plan = replace(road_plan, lanes=(replace(
            lane, along=np.array([-5.0, 3.0, 9.0]), detection=1.0 * (
                np.array([-5.0, 3.0, 9.0]) >= first), filter_std=np.ones(3),
            pass_std=np.ones((3, 3))),))
        assert any(f'reaches 90% {text}' in line for line in summary_lines(plan))


def test_missed_detection_probability_agrees_with_simulation():
    rng = np.random.default_rng(2)
    p = rng.uniform(0.0, 0.6, (12, 2))
    probability = missed_detection_probability(p, 3)
    is_detected = rng.random((40000, 12, 2)) < p
    is_run = is_detected[:, :-2] & is_detected[:, 1:-1] & is_detected[:, 2:]
    rate = 1.0 - is_run.any(axis=1).mean(axis=0)
    assert (np.abs(rate - probability) < 4.0 * np.sqrt(
        probability * (1.0 - probability) / 40000)).all()
    np.testing.assert_allclose(missed_detection_probability(p, 1), np.prod(1.0 - p, axis=0))


def test_the_std_of_a_lane_does_not_depend_on_the_frame_rate():
    """A third of the frames with a third of the variance results in the same std."""
    slow = PlannedTarget(400.0, 0.5, 0.8, 0.2, 0.1)
    lanes = [compute_plan(
        ROAD, slow, Sampling(0.08 * k, 4e-9 / np.sqrt(k), 0.04 / np.sqrt(k), 1e-8, 20.0),
        [('a', 0.0, 1.0)], (-12.0, -12.0, 12.0, 12.0), settings_for('vehicle'), n_grid=5).lanes[0]
        for k in (1, 3)]
    assert len(lanes[0].along) == len(lanes[1].along) == 121
    np.testing.assert_allclose(lanes[0].filter_std, lanes[1].filter_std, rtol=1e-6)


def test_std_of_a_lane_is_the_median_over_moment_directions(road_plan):
    lane, = road_plan.lanes
    J = pass_information(*sensor_poses(ROAD), road_plan.target, road_plan.sampling, lane.points,
                         lane.heading).sum(axis=2)
    std = bounds_of(J, road_plan.target.prior())
    np.testing.assert_allclose(lane.pass_std, np.median(std, axis=1))
    assert (lane.pass_std[:, 0] < 0.95 * std[..., 0].max(axis=1)).any()
