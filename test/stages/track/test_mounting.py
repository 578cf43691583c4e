"""Mounting errors of sensors: derivatives, estimation by a track, and priors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.physics.dipole import dipole_field, rotated_fields
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.simulation.scenario import Path
from mag_tracking.stages.track.initiation_vehicle import vehicle_model
from mag_tracking.stages.track.observation import Observation
from support.bundled import POINT
from support.networks import line_network
from support.samples import one, simulate
from support.scenario import SensorErrorModel, point_body
from support.track_runs import NOISE, drive


def fields_and_angles():
    rng = np.random.default_rng(4)
    return (rng.standard_normal((5, 3, 3)), rng.standard_normal((5, 3, 3, 4)),
            0.2 * rng.standard_normal((5, 3, 3)))


def test_zero_angles_change_nothing():
    h, H, angles = fields_and_angles()
    rotated, derivative = rotated_fields(h, H, 0.0 * angles)
    np.testing.assert_array_equal(rotated, h)
    np.testing.assert_array_equal(derivative[..., :4], H)


def test_small_angles_are_a_rotation_to_first_order():
    h, H, angles = fields_and_angles()
    for scale in (1e-1, 1e-2, 1e-3):
        R = rotation_from_quaternion(quaternion_from_rotation_vector(scale * angles))
        rotated, derivative = rotated_fields(h, H, scale * angles)
        worst = np.linalg.norm(rotated - (R @ h[..., None])[..., 0], axis=-1)
        limit = 0.5 * (scale * np.linalg.norm(angles, axis=-1)) ** 2
        assert (worst <= 1.01 * limit * np.linalg.norm(h, axis=-1)).all()
        assert (np.linalg.norm(derivative[..., :4] - R @ H, axis=-2)
                <= 1.01 * limit[..., None] * np.linalg.norm(H, axis=-2)).all()


def test_derivatives_by_state_and_angle_match_finite_differences():
    """The field without rotation is linear in the state here, with the derivative H."""
    h, H, angles = fields_and_angles()

    def field(v):
        return rotated_fields(h + (H @ v[:4]), H, (v[4:].reshape(3, 3) + angles))[0]

    v = np.zeros(4 + 9)
    derivative = rotated_fields(h, H, angles)[1]
    for k in range(len(v)):
        e = 1e-6 * np.eye(len(v))[k]
        expected = (field(v + e) - field(v - e)) / 2e-6
        if k < 4:
            np.testing.assert_allclose(derivative[..., k], expected, atol=1e-8)
            continue
        # The angles of one sensor do not affect the other sensors.
        j, a = divmod(k - 4, 3)
        np.testing.assert_allclose(derivative[:, j, :, 4 + a], expected[:, j], atol=1e-8)
        assert not np.delete(expected, j, axis=1).any()


ANGLES = np.deg2rad([[4.0, -3.0, 6.0], [-5.0, 2.0, 3.0]])


@pytest.fixture(scope='module')
def rotated_pass():
    """(network, tracks, {timestamp: frame}) of a pass by sensors that are rotated by `ANGLES`."""
    network = line_network(2)
    samples, *_ = simulate(network, point_body([600.0, -300.0, 160.0], 5.0, 0.5),
                           Path(np.array([-70.0, -1.2]), 0.0, 10.0), 100.0, 12.0,
                           np.random.default_rng(6))
    R = rotation_from_quaternion(quaternion_from_rotation_vector(ANGLES))
    pipeline = Pipeline(network, settings_for('vehicle', {
        **POINT, 'track.field_error': 0.02, 'track.vehicle.kinds.car.near_field_length': 0.0}))
    tracks, frames = [], {}
    for s in samples:
        rotated = R[network.names.index(s.sensor)] @ s.field
        for record in pipeline.feed(one(replace(s, field=rotated))):
            if isinstance(record, FieldFrame):
                frames[record.stamp_ns] = record
            elif isinstance(record, Track) and not record.ended:
                tracks.append(record)
    return network, tracks, frames


def test_mounting_angles_are_estimated_within_their_standard_deviations(rotated_pass):
    last = rotated_pass[1][-1]
    z = (last.mounting - ANGLES) / last.mounting_std
    assert np.abs(z).max() < 3.0
    # The angles of both sensors together are more accurate than before the pass.
    assert np.linalg.norm(last.mounting - ANGLES) < 0.5 * np.linalg.norm(ANGLES)
    assert (last.mounting_std < 0.8 * np.deg2rad(5.0)).all()


def test_the_predicted_field_is_that_of_the_published_pose(rotated_pass):
    network, tracks, frames = rotated_pass
    for t in tracks:
        B_s = np.einsum('jik,jk->ji', network.R_sw,
                        dipole_field(network.positions - t.position, t.moment))
        model = B_s + np.cross(t.mounting, B_s)
        # The difference is the background; the angles change the field by up to 6e-8 T.
        assert np.abs(t.predicted - model).max() < 2.5e-8
    near = [t for t in tracks if np.hypot(*t.position[:2]) < 6.0]
    assert len(near) > 5
    for t in near:
        field = frames[t.stamp_ns].field
        assert np.abs(field - t.predicted).max() < 4.0 * NOISE / np.sqrt(8) + 0.1 * np.abs(
            field).max()
        assert 0.0 < t.nis < 20.0 and t.degrees_of_freedom == 6


def test_a_tracker_without_mounting_angles_publishes_none():
    network = line_network(2)
    tracks, *_ = drive(network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
                       Path(np.array([-70.0, -1.2]), 0.0, 10.0),
                       changes={'track.mounting_std_deg': 0.0})
    assert tracks[0].mounting.shape == tracks[0].mounting_std.shape == (0, 3)
    assert tracks[0].predicted.shape == (2, 3)


@cache
def passes(n):
    """{mounting_std_deg: (mean NEES, RMS error [m])} within 5 m of the origin, over `n` passes.

    The sensors have random tilts with a standard deviation of 5 degrees.
    """
    network = line_network(2, tilt=0.0)
    out = {}
    for mounting in (0.0, 5.0):
        nees, squares = [], []
        for seed in range(n):
            side = 1.2 if seed % 2 else -1.2
            tracks, _, truth = drive(
                network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
                Path(np.array([-70.0, side]), 0.0, 10.0), seed=seed,
                changes={**POINT, 'track.mounting_std_deg': mounting, 'track.field_error': 0.02,
                         'track.vehicle.kinds.car.near_field_length': 0.0},
                flaws=SensorErrorModel(bias_std=1e-6, tilt_std=np.deg2rad(5.0)))
            live = [t for t in tracks if not t.ended]
            for t, q in zip(live, truth, strict=True):
                if np.hypot(*q) < 5.0:
                    e = t.position[:2] - q
                    nees.append(e @ np.linalg.solve(t.covariance[:2, :2], e) / 2)
                    squares.append(e @ e)
        out[mounting] = float(np.mean(nees)), float(np.sqrt(np.mean(squares)))
    return out


@pytest.mark.study
def test_estimated_mounting_angles_make_the_covariance_consistent():
    trusted, estimated = (passes(8)[mounting] for mounting in (0.0, 5.0))
    print(f'mean NEES and RMS error [m]: estimated {estimated}, trusted {trusted}')
    assert estimated[0] < 2.0
    assert estimated[0] < 0.5 * trusted[0]
    assert estimated[1] < trusted[1]


STD = np.deg2rad([0.3, 0.3, 2.3])


def observation(network, mounting_std_deg=5.0, error_time=0.3):
    model = vehicle_model(settings_for('vehicle').track.vehicle, network)
    return Observation(network, model, np.deg2rad(mounting_std_deg), error_time)


def rotated_network(*rotations, std):
    """Network of sensors with the orientations `rotations` and their standard deviations `std`
    [rad]."""
    network = line_network(len(rotations), tilt=0.0)
    return replace(network, R_ws=np.array([R.as_matrix() for R in rotations]),
                   orientation_std=tuple(std))


def test_orientation_covariances_are_rotated_into_sensor_frames():
    upright, side = Rotation.identity(), Rotation.from_euler('x', 90.0, True)
    askew = Rotation.from_euler('zyx', [40.0, 20.0, -70.0], True)
    o = observation(rotated_network(upright, side, askew, side, std=(STD, STD, STD, None)))
    P = o.own_covariance
    np.testing.assert_allclose(P[0, :3, :3], np.diag(STD**2), atol=1e-18)
    # The sensor's y axis is the world's z axis, about which the heading rotates.
    np.testing.assert_allclose(P[1, :3, :3], np.diag(STD[[0, 2, 1]]**2), atol=1e-18)
    # In the sensor frame, the variance about the vertical equals the variance of the heading.
    up = askew.inv().apply([0.0, 0.0, 1.0])
    assert up @ P[2, :3, :3] @ up == pytest.approx(STD[2]**2)
    assert np.trace(P[2, :3, :3]) == pytest.approx(STD @ STD)
    # Without a declared uncertainty, the setting applies.
    np.testing.assert_allclose(P[3, :3, :3], np.deg2rad(5.0)**2 * np.eye(3), atol=1e-15)
    for block in P:
        np.testing.assert_array_equal(block[3:, 3:], np.eye(3))
        assert not block[:3, 3:].any()


def test_angle_covariances_are_the_blocks_of_each_sensor():
    o = observation(line_network(3))
    n = o.n_target + 3 * o.n_own + 9
    A = np.random.default_rng(0).standard_normal((n, n))
    P = A @ A.T
    found = o.angle_covariances(P)
    for j in range(3):
        first = o.n_target + 6 * j
        np.testing.assert_array_equal(found[j], P[first:first + 3, first:first + 3])
    x = np.arange(float(n))
    np.testing.assert_array_equal(o.angles(x)[1], x[o.n_target + 6:o.n_target + 9])
    # Without estimated angles, there are no covariances. Without a correlation time of the model
    # error, the angles are the only states between targets and backgrounds.
    assert observation(line_network(3), 0.0).angle_covariances(P).shape == (0, 3, 3)
    bare = observation(line_network(3), error_time=0.0)
    rows = slice(o.n_target + 6, o.n_target + 9)
    np.testing.assert_array_equal(bare.angle_covariances(P)[2], P[rows, rows])


def test_a_narrow_mounting_prior_stays_narrow():
    """The first sensor lies on its side. Its orientation is known accurately, except for the
    heading."""
    side = Rotation.from_euler('x', 90.0, True)
    network = rotated_network(side, Rotation.identity(), std=(STD, None))
    tracks, *_ = drive(network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
                       Path(np.array([-70.0, -1.2]), 0.0, 10.0), POINT)
    live = [t for t in tracks if not t.ended]
    first, last = live[0].mounting_std, live[-1].mounting_std
    assert (last[0] <= 1.02 * STD[[0, 2, 1]]).all()
    # The first sensor's y axis is vertical, so its rotation about y starts with the uncertainty of
    # the heading.
    assert first[0, 1] == pytest.approx(STD[2], rel=0.2)
    np.testing.assert_allclose(first[0, [0, 2]], STD[0], rtol=0.2)
    assert last[1].max() > 2.0 * STD[0]
    assert (np.abs(live[-1].mounting[0]) < 4.0 * STD[[0, 2, 1]]).all()
    np.testing.assert_allclose(
        last, np.sqrt(np.diagonal(live[-1].mounting_covariance, axis1=1, axis2=2)))
