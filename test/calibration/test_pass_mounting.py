"""Fusion of the mounting angles estimated by several tracks."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mag_tracking.calibration.orientation import (
    MountingEvidence,
    fuse_mounting,
    with_pass_mounting,
)
from mag_tracking.geometry import rotation_about_z
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from mag_tracking.simulation.scenario import Path
from support.bundled import POINT
from support.networks import line_network
from support.samples import one, simulate
from support.scenario import point_body
from support.track_runs import drive

NETWORK = line_network(3, tilt=0.6)
PRIOR = np.deg2rad([[0.3, 0.3, 2.0], [1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])


@dataclass
class SimulatedTracks:
    """Tracks with linear measurements of the rotation of each sensor, and their joint estimate."""

    tracks: list
    truth: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def simulated_tracks(n_tracks, seed=0, noise=0.01, std_ratio=1.0, axes=3, network=NETWORK,
                     prior=PRIOR):
    """Simulate tracks that measure `axes` directions with noise of std `noise` [rad].

    The tracks assume `std_ratio` times this standard deviation. The oracle is the joint
    least-squares solution of all measurements.
    """
    rng = np.random.default_rng(seed)
    n = len(network)
    truth = prior * rng.standard_normal((n, 3))
    rows = [[(np.eye(3) / prior[j], np.zeros(3))] for j in range(n)]
    tracks = []
    for k in range(n_tracks):
        mounting, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
        for j in range(n):
            A = rng.standard_normal((axes, 3)) / noise
            y = A @ truth[j] + rng.standard_normal(axes)
            A, y = A / std_ratio, y / std_ratio
            rows[j].append((A, y))
            P = np.linalg.inv(np.diag(prior[j]**-2.0) + A.T @ A)
            # The angles rotate the field in the sensor frame; the sensor has the inverse rotation.
            R_sw = network.R_sw[j]
            mounting[j], covariance[j] = -R_sw @ (P @ A.T @ y), R_sw @ P @ R_sw.T
        tracks.append(SimpleNamespace(id=k + 1, mounting=mounting, mounting_covariance=covariance))
    mean, joint = np.empty((n, 3)), np.empty((n, 3, 3))
    for j in range(n):
        A, y = (np.concatenate(part) for part in zip(*rows[j], strict=True))
        mean[j] = np.linalg.lstsq(A, y, rcond=None)[0]
        joint[j] = np.linalg.inv(A.T @ A)
    return SimulatedTracks(tracks, truth, mean, joint)


@pytest.mark.parametrize('axes', [1, 2, 3])
@pytest.mark.parametrize('n_tracks', [1, 2, 7])
def test_fused_tracks_equal_one_joint_estimate(n_tracks, axes):
    # The assumed noise is too large, so the covariance is not inflated.
    t = simulated_tracks(n_tracks, noise=0.01, std_ratio=3.0, axes=axes)
    e = fuse_mounting(NETWORK, PRIOR, t.tracks)
    assert e.n_tracks == n_tracks
    np.testing.assert_allclose(e.rotation, t.mean, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(e.covariance, t.covariance, rtol=1e-6, atol=1e-12)


def test_order_of_the_tracks_has_no_effect():
    t = simulated_tracks(6)
    a, b = (fuse_mounting(NETWORK, PRIOR, tracks) for tracks in (t.tracks, t.tracks[::-1]))
    for name in ('rotation', 'covariance', 'scatter'):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-9)


def test_without_tracks_the_prior_remains():
    e = fuse_mounting(NETWORK, PRIOR, [])
    assert e.n_tracks == 0 and not e.rotation.any() and np.isnan(e.scatter).all()
    np.testing.assert_allclose(np.sqrt(np.einsum('jii->ji', e.covariance)), PRIOR)
    assert np.isnan(fuse_mounting(NETWORK, PRIOR, simulated_tracks(1).tracks).scatter).all()


def test_a_track_without_information_has_no_effect():
    """The linearised covariance of a track without information may slightly exceed the prior."""
    prior = np.einsum('jik,jk,jlk->jil', NETWORK.R_sw, PRIOR**2, NETWORK.R_sw)
    uninformative = SimpleNamespace(id=9, mounting=np.zeros((3, 3)),
                                    mounting_covariance=1.02 * prior)
    e = fuse_mounting(NETWORK, PRIOR, [uninformative, uninformative])
    np.testing.assert_allclose(e.covariance, np.array([np.diag(s**2) for s in PRIOR]),
                               rtol=1e-6, atol=1e-15)
    assert np.abs(e.rotation).max() < 1e-9


def scatter_and_nees(n_runs, n_tracks, **kwargs):
    """Scatter and NEES of the rotation of each run and sensor, each (n_runs * n_sensors,)."""
    out, nees = [], []
    for seed in range(n_runs):
        t = simulated_tracks(n_tracks, seed, **kwargs)
        e = fuse_mounting(NETWORK, PRIOR, t.tracks)
        out += e.scatter.tolist()
        errors = e.rotation - t.truth
        nees += [d @ np.linalg.solve(C, d) for d, C in zip(errors, e.covariance, strict=True)]
    return np.array(out), np.array(nees)


def test_scatter_of_consistent_tracks_is_about_one():
    # The tracks are far more accurate than the prior, which therefore has no effect.
    scatter, nees = scatter_and_nees(60, 5, noise=1e-4)
    freedom = 3 * (5 - 1)
    low, high = chi2.ppf([0.001, 0.999], freedom * len(scatter)) / (freedom * len(scatter))
    print(f'scatter {scatter.mean():.3f}, NEES {nees.mean() / 3:.3f}')
    assert low < scatter.mean() < high
    # A scatter above one inflates the covariance; a scatter below one does not reduce it.
    assert 0.6 < nees.mean() / 3 < chi2.ppf(0.999, 3 * len(nees)) / (3 * len(nees))


@pytest.mark.parametrize('n_tracks', [2, 5])
def test_scatter_of_consistent_weak_tracks_is_not_above_one(n_tracks):
    """A prior with as much information as a track, or more, adds no scatter."""
    scatter, _ = scatter_and_nees(80, n_tracks, noise=0.15)
    freedom = 3 * (n_tracks - 1)
    high = chi2.ppf(0.999, freedom * len(scatter)) / (freedom * len(scatter))
    print(f'{n_tracks} weak tracks: scatter {scatter.mean():.3f}')
    assert scatter.mean() < high


def test_covariance_of_overconfident_tracks_is_inflated():
    scatter, nees = scatter_and_nees(60, 5, noise=1e-3, std_ratio=0.2)
    assert scatter.mean() == pytest.approx(25.0, rel=0.1)
    # The normalised errors have Student's t distribution with 12 degrees of freedom; without
    # inflation, the value would be 25.
    assert 0.6 < nees.mean() / 3 < 1.5
    t = simulated_tracks(5, 3, noise=1e-3, std_ratio=0.2)
    e = fuse_mounting(NETWORK, PRIOR, t.tracks)
    ratio = np.trace(e.covariance, axis1=1, axis2=2) / np.trace(t.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(ratio, e.scatter, rtol=0.02)


def test_a_track_of_another_network_is_rejected():
    t = simulated_tracks(2)
    t.tracks[1].mounting = t.tracks[1].mounting[:2]
    with pytest.raises(ValueError, match='track 2 .* 2 sensors, expected 3'):
        fuse_mounting(NETWORK, PRIOR, t.tracks)


def test_network_is_rotated_about_the_world_axes():
    rotation = np.deg2rad([[0.0, 0.0, 6.0], [2.0, 0.0, 0.0], [1.0, -2.0, 3.0]])
    C = np.tile(np.diag(np.deg2rad([1.0, 2.0, 3.0])**2), (3, 1, 1))
    corrected = with_pass_mounting(NETWORK, MountingEvidence(rotation, C, np.full(3, np.nan), 1))
    np.testing.assert_allclose(corrected.R_ws[0],
                               rotation_about_z(np.deg2rad(6.0)) @ NETWORK.R_ws[0])
    np.testing.assert_allclose(corrected.R_ws,
                               Rotation.from_rotvec(rotation).as_matrix() @ NETWORK.R_ws)
    np.testing.assert_allclose(corrected.orientation_std[2], np.deg2rad([1.0, 2.0, 3.0]))
    assert corrected.names == NETWORK.names and corrected.earth_field is NETWORK.earth_field


CHANGES = {**POINT, 'track.field_error': 0.0, 'track.vehicle.kinds.car.near_field_length': 0.0,
           'track.mounting_std_deg': 5.0}


@pytest.fixture(scope='module')
def rotated_sensor_passes():
    """Simulate passes with one sensor rotated by 6 degrees: (network, true R_ws, evidence)."""
    nominal = line_network(4, tilt=0.5)
    R_ws = nominal.R_ws.copy()
    R_ws[1] = rotation_about_z(np.deg2rad(6.0)) @ R_ws[1]
    tracks = []
    for k, (start, heading, hard) in enumerate((
            ([-60.0, -1.2], 0.0, [600.0, -300.0, 160.0]),
            ([70.0, 1.2], np.pi, [-300.0, 500.0, -250.0]))):
        samples, *_ = simulate(
            replace(nominal, R_ws=R_ws),
            point_body(hard, 5.0, 0.5), Path(np.array(start), heading, 10.0), 50.0, 12.0,
            np.random.default_rng(k))
        pipeline = Pipeline(nominal, settings_for('vehicle', CHANGES))
        records = [r for s in samples for r in pipeline.feed(one(s))]
        tracks.append([r for r in records if isinstance(r, Track) and not r.ended][-1])
    prior = np.full((4, 3), np.deg2rad(5.0))
    return nominal, R_ws, fuse_mounting(nominal, prior, tracks)


def test_passes_correct_the_orientation_of_a_rotated_sensor(rotated_sensor_passes):
    nominal, truth, evidence = rotated_sensor_passes
    corrected = with_pass_mounting(nominal, evidence)
    before, after = (Rotation.from_matrix(truth @ np.swapaxes(R, 1, 2)).as_rotvec()
                     for R in (nominal.R_ws, corrected.R_ws))
    print(np.degrees(evidence.rotation).round(2), np.degrees(after).round(2),
          np.degrees(corrected.orientation_std).round(2))
    # The correction about the vertical is towards the truth.
    assert evidence.rotation[1, 2] > np.deg2rad(3.0)
    assert abs(after[1, 2]) < 0.5 * abs(before[1, 2])
    # The corrections of the other sensors are small, and all errors agree with their stds.
    assert np.abs(evidence.rotation[[0, 2, 3]]).max() < 3.0 * np.deg2rad(5.0) / 3.0
    assert np.abs(after / np.array(corrected.orientation_std)).max() < 4.0
    assert np.array(corrected.orientation_std)[:, 2].max() < np.deg2rad(5.0)


def test_a_track_without_mounting_angles_is_rejected():
    network = line_network(2)
    tracks, *_ = drive(network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
                       Path(np.array([-70.0, -1.2]), 0.0, 10.0),
                       changes={'track.mounting_std_deg': 0.0})
    with pytest.raises(ValueError, match='angles of 0 sensors, expected 2'):
        fuse_mounting(network, np.full((2, 3), 0.1), tracks[:1])
