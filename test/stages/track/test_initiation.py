"""Track initiation: states, covariances and weights of the first hypotheses."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.initiation_magnet import start_magnet
from mag_tracking.stages.track.initiation_vehicle import (
    CROSS_SPEED_STD,
    MAX_START_DISTANCE,
    SPEED_STD,
    TURN_SHARE,
    start_vehicle,
    vehicle_model,
)
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.target import target_of
from support.bundled import POINT
from support.networks import line_network
from support.track_runs import magnet_frames

SETTINGS = settings_for('magnet').track.magnet


def start(frame, network, relative_std=0.0, own_covariance=None):
    return start_magnet(SETTINGS, network, frame, 1e-12, own_covariance, relative_std)


def test_the_hypothesis_on_the_side_that_fits_better_is_heavier():
    """A flat board without z axes cannot distinguish a magnet above it from one below it; a noisy z
    axis can."""
    network, frames, truth = magnet_frames(1)
    field = np.einsum('jik,jk->ji', network.R_ws, frames[0].field)
    network = dataclasses.replace(network, R_ws=np.repeat(np.eye(3)[None], 9, axis=0))
    field[1:, 2] = np.nan
    C = frames[0].covariance.copy()
    C[0, 2, 2] = (0.5 * abs(field[0, 2])) ** 2
    bank = start(dataclasses.replace(frames[0], field=field, covariance=C), network)
    above = np.linalg.norm(bank.x[:, :3] - truth[0, :3], axis=1) < 0.005
    below = np.linalg.norm(bank.x[:, :3] - truth[0, :3] * [1, 1, -1], axis=1) < 0.005
    assert above.sum() == below.sum() == 1
    # For the hypothesis below the board, the z axis differs by twice the field, which is four
    # standard deviations of half the field.
    gap = float(bank.log_w[above][0] - bank.log_w[below][0])
    assert gap == pytest.approx(0.5 * 4.0**2, rel=0.1)


@pytest.mark.parametrize('spacing', [0.05, 1.0, 2e4])
def test_a_magnet_starts_beside_a_line_of_sensors(spacing):
    """The grid covers a long narrow box; its number of points does not grow with the length. The
    direction from the line to the magnet is not observable."""
    network = line_network(5, tilt=0.0)
    network = dataclasses.replace(network, positions=spacing * np.arange(5)[:, None] * [1, 0, 0])
    truth, m = network.positions[1] + [0.0, 0.08, 0.0], np.array([1.0, 0.5, 2.0])
    field = dipole_field(network.positions - truth, m)
    C = np.tile(1e-18 * np.eye(3), (5, 1, 1))
    tracemalloc.start()
    bank = start(FieldFrame(0, field, C, np.ones(5, dtype=int), np.zeros(5)), network)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6 and bank is not None
    if spacing < 10.0:
        x, y, z = bank.x[np.argmax(bank.log_w), :3]
        np.testing.assert_allclose([x, np.hypot(y, z)], truth[:2], atol=0.03)


def test_every_vehicle_starts_with_the_moment_of_the_settings(road_network):
    """The configured moment is the sum of the moments of hard and soft iron."""
    vehicle = settings_for('vehicle').track.vehicle
    frame = FieldFrame(0, np.full((2, 3), 1e-7), np.repeat(1e-16 * np.eye(3)[None], 2, axis=0),
                       np.full(2, 8), np.zeros(2))
    bank = start_vehicle(vehicle, road_network, frame, 2e-8, None)
    model = vehicle_model(vehicle, road_network)
    moments, lengths = np.array([(k.moment, k.length) for k in vehicle.kinds])[bank.kind].T
    length, turn = (model.state_names.index(name) for name in 'Lw')
    m = model.dipoles(bank.x[:, :turn + 1]).m.sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), moments,
                               rtol=1e-9)
    np.testing.assert_array_equal(bank.x[:, length], lengths)
    # In 50 uT, the soft iron of each axis contributes the induced share of this moment.
    soft = [model.state_names.index(f'D{axis}') for axis in 'xyz']
    share = bank.x[:, soft] * 5e-5 / MU0 / moments[:, None]
    np.testing.assert_allclose(share, vehicle.induced_share, rtol=1e-12)
    share_covariance = (bank.P[:, soft][:, :, soft] * (5e-5 / MU0)**2
                        / np.square(moments)[:, None, None])
    np.testing.assert_allclose(share_covariance / vehicle.induced_share_std**2 - 1.0,
                               np.tile(np.eye(3), (len(bank), 1, 1)), atol=1e-9)
    assert len(bank) == 3 * 3 * 14 * 3 * 3 * 2
    # Half of the hypotheses turn, in an unknown direction, with half the configured standard
    # deviation.
    turns = bank.P[:, turn, turn] > 0.0
    assert np.count_nonzero(turns) == len(bank) // 2 and not bank.x[:, turn].any()
    speed = np.hypot(*bank.x[:, 3:5].T)[turns]
    np.testing.assert_allclose(bank.P[turns, turn, turn],
                               (0.5 * vehicle.turn_acceleration / speed)**2)
    assert np.exp(bank.log_w[turns]).sum() == pytest.approx(TURN_SHARE)
    assert len(set(bank.origin)) == len(bank)
    # The length and the differences between dipoles of a point have no variance.
    points = bank.P[bank.kind == 0]
    assert not points[:, length, length].any()
    np.testing.assert_allclose(points[:, 6, 6], points[:, 6, 9], rtol=1e-12)
    for label, heading in enumerate(np.deg2rad(vehicle.arrival_headings_deg)):
        rows = bank.label == label
        along = bank.x[rows, :2] @ [np.cos(heading), np.sin(heading)]
        assert (along <= 0.0).all()  # all hypotheses start before the sensors
        speed = np.hypot(*bank.x[rows, 3:5].T)
        np.testing.assert_allclose(bank.x[rows, 3], speed * np.cos(heading), atol=1e-9)
        assert set(np.round(speed, 6)) == set(vehicle.speeds)
        # The standard deviations of the velocity match the settings, relative to the speed.
        ahead = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-ahead[1], ahead[0]])
        for direction, share in ((ahead, SPEED_STD), (across, CROSS_SPEED_STD)):
            std = np.sqrt(direction @ bank.P[rows, 3:5, 3:5] @ direction)
            np.testing.assert_allclose(std, share * speed, rtol=1e-9)


@pytest.mark.parametrize('missing', [None, 0])
def test_a_vehicle_starts_where_its_field_first_has_the_frame_energy(missing):
    """One step further back on its path, the field of the vehicle has less energy than the
    frame."""
    network = line_network(6)
    vehicle = settings_for('vehicle', POINT).track.vehicle
    std = np.array([1e-8, 2e-8, 4e-8])
    field = np.full((6, 3), 1e-7)
    if missing is not None:
        field[missing] = np.nan
    C = np.repeat(np.diag(std**2)[None], 6, axis=0)
    present = ~np.isnan(field)
    required = np.nansum((field / std) ** 2) - present.sum()
    bank = start_vehicle(vehicle, network, FieldFrame(0, field, C, np.full(6, 8), np.zeros(6)),
                         2e-8, None)
    model = vehicle_model(vehicle, network)

    def energy(back):
        """Field energy at the sensors for each hypothesis, moved back along its path by `back`
        [m]."""
        x = bank.x[:, :model_size].copy()
        x[:, :2] -= back * x[:, 3:5] / np.hypot(*x[:, 3:5].T)[:, None]
        m = model.dipoles(x).m.sum(axis=1)
        B = dipole_field(network.positions - x[:, None, :3], m[:, None])
        h = np.einsum('jsw,njw->njs', np.swapaxes(network.R_ws, 1, 2), B)
        return np.sum(np.where(present, h / std, 0.0) ** 2, axis=(1, 2))

    model_size = len(model.state_names)
    ahead = bank.x[:, 3:5] / np.hypot(*bank.x[:, 3:5].T)[:, None]
    # [m] Distance to the outermost sensor along the path.
    along = ahead @ (network.positions - network.centre)[:, :2].T
    before = along.min(axis=1) - np.sum(ahead * (bank.x[:, :2] - network.centre[:2]), axis=1)
    reached = energy(0.0) >= required * (1.0 - 1e-9)
    assert reached.mean() > 0.5
    # A vehicle that never reaches the energy starts at the outermost sensor.
    np.testing.assert_allclose(before[~reached], 0.0, atol=1e-9)
    starts_inside = reached & (before < MAX_START_DISTANCE - 1e-9)
    assert starts_inside.mean() > 0.5
    assert (energy(MAX_START_DISTANCE / 159.0)[starts_inside] < required).all()


def test_the_start_covariance_includes_the_model_error():
    network, frames, truth = magnet_frames(1)
    certain, uncertain = start(frames[0], network), start(frames[0], network, relative_std=0.05)
    assert np.trace(uncertain.P[0, :3, :3]) > 100.0 * np.trace(certain.P[0, :3, :3])
    rng = np.random.default_rng(2)
    nees = []
    for _ in range(40):
        field = frames[0].field + 0.05 * np.linalg.norm(
            frames[0].field, axis=1)[:, None] * rng.standard_normal((9, 3))
        bank = start(dataclasses.replace(frames[0], field=field), network, relative_std=0.05)
        e = bank.x[bank.best(), :3] - truth[0, :3]
        nees.append(e @ np.linalg.solve(bank.P[bank.best(), :3, :3], e) / 3.0)
    assert 0.4 < np.mean(nees) < 1.6


def test_residuals_of_the_fit_widen_the_start_covariance():
    """The measurement errors exceed the declared noise, which the residuals of the fit reveal."""
    network, frames, truth = magnet_frames(1)
    rng = np.random.default_rng(3)
    nees = []
    for _ in range(40):
        field = frames[0].field + 2e-6 * rng.standard_normal((9, 3))
        bank = start(dataclasses.replace(frames[0], field=field), network)
        e = bank.x[bank.best(), :3] - truth[0, :3]
        nees.append(e @ np.linalg.solve(bank.P[bank.best(), :3, :3], e) / 3.0)
    # The declared noise is a twentieth of the errors. Without the residuals the NEES would be 400.
    assert 0.4 < np.mean(nees) < 2.0


def test_a_magnet_track_estimates_mounting_angles():
    network, frames, truth = magnet_frames()
    stage = TrackManager(network, settings_for('magnet', {'track.mounting_std_deg': 2.0}).track)
    tracks = [t for f in frames for t in stage.feed(f)]
    assert np.linalg.norm(tracks[-1].position - truth[-1, :3]) < 1e-3
    assert tracks[-1].mounting.shape == (9, 3)
    assert (tracks[0].mounting_std <= np.deg2rad(2.0)).all()
    assert (tracks[0].mounting_std > np.deg2rad(0.1)).all()


@pytest.mark.parametrize('name, is_spin', [
    ('speed_std', False), ('acceleration', False), ('spin_std', True),
    ('angular_acceleration', True)])
def test_a_magnet_that_may_move_faster_has_a_less_certain_pose(name, is_spin):
    network, frames, _ = magnet_frames(2)
    variances = []
    for value in (1e-4, 10.0):
        settings = settings_for('bench', {f'track.magnet.{name}': value}).track
        stage = TrackManager(network, settings)
        track = [t for f in frames for t in stage.feed(f)][-1]
        # The largest variance of the orientation is that of the unobservable roll.
        variances.append(np.linalg.eigvalsh(track.orientation_covariance)[:2].sum() if is_spin
                         else np.trace(track.covariance))
    assert variances[1] > 1.01 * variances[0]


def test_drifting_backgrounds_are_not_a_target(road_network):
    """The frames are flagged as containing a target, but only the backgrounds drift."""
    drift = 3e-8
    settings = settings_for('vehicle', {'track.background_drift': drift}).track
    stage = TrackManager(road_network, settings)
    rng = np.random.default_rng(5)
    level, dt, noise, tracks = np.zeros((2, 3)), 0.08, 4e-9, []
    C = np.repeat(noise**2 * np.eye(3)[None], 2, axis=0)
    for k in range(100):
        level += drift * np.sqrt(dt) * rng.standard_normal((2, 3))
        y = level + noise * rng.standard_normal((2, 3))
        tracks += stage.feed(FieldFrame(round(k * dt * 1e9), y, C, np.full(2, 8), np.zeros(2),
                                        True, 1e3, 6))
    existence = np.array([t.existence for t in tracks if isinstance(t, Track)])
    assert len(existence) and existence[-1] < 0.5


def test_backgrounds_drift_between_frames_and_mounting_angles_do_not(road_network):
    drift, dt = 1e-8, 0.5
    settings = settings_for('vehicle', {'track.background_drift': drift}).track
    stage = TrackManager(road_network, settings)
    C = np.repeat(1e-16 * np.eye(3)[None], 2, axis=0)
    stage.feed(FieldFrame(0, np.full((2, 3), 1e-7), C, np.full(2, 8), np.zeros(2), True, 1e3, 6))
    before = np.diagonal(stage.bank.P, axis1=1, axis2=2).copy()
    model = target_of(settings, road_network).model
    BankFilter(road_network, model, settings).move(stage.bank, dt)
    after, n_t = np.diagonal(stage.bank.P, axis1=1, axis2=2), len(model.state_names)
    own, grown = (a[:, n_t:n_t + 12].reshape(-1, 2, 6) for a in (before, after))
    np.testing.assert_array_equal(grown[:, :, :3], own[:, :, :3])
    # Model errors return to unit variance with their time constant of 0.3 s.
    np.testing.assert_allclose(1.0 - grown[:, :, 3:],
                               np.exp(-2.0 * dt / 0.3) * (1.0 - own[:, :, 3:]), atol=1e-12)
    assert (own[:, :, 3:] < 1.0 - 1e-6).any()
    np.testing.assert_allclose((after - before)[:, n_t + 12:], drift**2 * dt, rtol=1e-6)
