"""Configuration for robot_localization: an EKF is as accurate as the published poses it fuses.

`robot_localization` is not available from PyPI. A filter of filterpy replaces it, with the motion
model and the noise of `config/robot_localization.yaml`.
"""

import numpy as np
import pytest
import yaml
from filterpy.kalman import KalmanFilter

from mag_tracking.analysis.track_errors import interpolate_truth
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Track
from support.bundled import ROOT, VEHICLES, vehicle_path

CONFIGURATION = ROOT / 'config' / 'robot_localization.yaml'
INITIAL_SPEED_STD = 30.0
"""[m/s] Initial standard deviation of the velocity, which is unknown at the first pose."""


def settings():
    """Parameters of the EKF."""
    return yaml.safe_load(CONFIGURATION.read_text())['ekf_filter_node']['ros__parameters']


def poses_of(name, network):
    """([(stamp_ns, position (2,), covariance (2, 2)) on ~/pose], true positions) of a recording."""
    pipeline = Pipeline(network, settings_for('vehicle', {'track.ambiguous_poses': 'hold'}))
    reader = SampleReader(Recording(vehicle_path(name)), network)
    tracks = [t for batch in reader.readings() for t in pipeline.feed(batch)
              if isinstance(t, Track) and not t.ended and t.topic_uncertainty is not None]
    (truth,) = reader.truth_arrays().values()
    return ([(t.stamp_ns, t.position[:2], t.topic_uncertainty.covariance[:2, :2])
             for t in tracks], interpolate_truth(truth, [t.stamp_ns for t in tracks])[:, :2])


def fuse(poses, noise):
    """Fuse poses with an EKF (x, y, vx, vy; `noise` (4,) per second); return positions (n, 2)."""
    ekf, out, last_ns = KalmanFilter(dim_x=4, dim_z=2), [], None
    ekf.H = np.eye(2, 4)
    for stamp_ns, position, R in poses:
        if last_ns is None:
            ekf.x = np.r_[position, 0.0, 0.0]
            ekf.P = np.diag([0.0, 0.0, INITIAL_SPEED_STD**2, INITIAL_SPEED_STD**2])
            ekf.P[:2, :2] = R
        else:
            dt = (stamp_ns - last_ns) / 1e9
            ekf.F = np.eye(4) + dt * np.eye(4, k=2)
            ekf.predict(Q=dt * np.diag(noise))
            ekf.update(position, R=R)
        out.append(ekf.x[:2].copy())
        last_ns = stamp_ns
    return np.array(out)


def errors(names, road_network):
    """{recording: (errors of the EKF (n,), errors of the published poses (n,))} [m]."""
    noise = np.diagonal(np.reshape(settings()['process_noise_covariance'], (15, 15)))[[0, 1, 6, 7]]
    found = {}
    for name in names:
        poses, true = poses_of(name, road_network)
        published = np.array([position for _, position, _ in poses])
        found[name] = [np.hypot(*(p - true).T) for p in (fuse(poses, noise), published)]
    return found


@pytest.mark.parametrize('names', [
    ('junction_rear_turns_right', 'straight_car_fast_left'),
    pytest.param(VEHICLES, marks=pytest.mark.study)], ids=['two', 'all'])
def test_an_ekf_that_fuses_the_published_pose_is_not_less_accurate(names, road_network):
    found = errors(names, road_network)
    both = [np.concatenate(e) for e in zip(*found.values(), strict=True)]
    rms = [np.sqrt(np.nanmean(e**2)) for e in both]
    print(f'{len(both[0])} poses of {len(found)} recordings: RMS error of the EKF {rms[0]:.2f} m, '
          f'of the published poses {rms[1]:.2f} m')
    for name, pair in found.items():
        print(f'  {name}', *(f'{np.sqrt(np.nanmean(e**2)):.2f} m' for e in pair))
    assert rms[0] <= rms[1]


def test_the_configuration_is_complete():
    """robot_localization would refuse or silently ignore wrong lengths, frames and states."""
    parameters = settings()
    assert len(parameters['pose0_config']) == 15 and parameters['pose0_config'][:2] == [True, True]
    assert len(parameters['process_noise_covariance']) == 225
    assert parameters['world_frame'] == parameters['odom_frame'] == 'map'
    assert len({parameters[f'{name}_frame'] for name in ('map', 'odom', 'base_link')}) == 3
    assert parameters['pose0'] == 'tracker_node/pose'
