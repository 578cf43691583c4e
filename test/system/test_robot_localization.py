"""The recipe for robot_localization: another EKF that takes our pose is not worse than we are.

`robot_localization` cannot be had from PyPI. filterpy's filter takes its place, with the motion
model and the noise that `config/robot_localization.yaml` gives that EKF.
"""

import numpy as np
import pytest
import yaml
from filterpy.kalman import KalmanFilter

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Track
from mag_tracking.report.metrics import interpolate_truth
from support.bundled import ROOT, VEHICLES, vehicle_path

RECIPE = ROOT / 'config' / 'robot_localization.yaml'
FIRST_SPEED_STD = 30.0
"""[m/s] Nothing is known of the velocity at the first pose."""


def recipe():
    """Parameters of the EKF."""
    return yaml.safe_load(RECIPE.read_text())['ekf_filter_node']['ros__parameters']


def poses_of(name, network):
    """(messages on ~/pose as (stamp_ns, (2,), (2, 2)), truth at these times) of a recording."""
    pipeline = Pipeline(network, settings_for('vehicle', {'track.ambiguous_poses': 'hold'}))
    reader = SampleReader(Recording(vehicle_path(name)), network)
    tracks = [t for batch in reader.readings() for t in pipeline.feed(batch)
              if isinstance(t, Track) and not t.ended and t.topic_uncertainty is not None]
    (truth,) = reader.truth_arrays().values()
    return ([(t.stamp_ns, t.position[:2], t.topic_uncertainty.covariance[:2, :2])
             for t in tracks], interpolate_truth(truth, [t.stamp_ns for t in tracks])[:, :2])


def filtered(poses, noise):
    """Positions (n, 2) of an EKF of x, y, vx, vy that takes poses; `noise` (4,) a second."""
    ekf, out, last_ns = KalmanFilter(dim_x=4, dim_z=2), [], None
    ekf.H = np.eye(2, 4)
    for stamp_ns, position, R in poses:
        if last_ns is None:
            ekf.x = np.r_[position, 0.0, 0.0]
            ekf.P = np.diag([0.0, 0.0, FIRST_SPEED_STD**2, FIRST_SPEED_STD**2])
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
    """{recording: (errors of the EKF (n,), ours (n,))} [m]."""
    noise = np.diagonal(np.reshape(recipe()['process_noise_covariance'], (15, 15)))[[0, 1, 6, 7]]
    found = {}
    for name in names:
        poses, true = poses_of(name, road_network)
        ours = np.array([position for _, position, _ in poses])
        found[name] = [np.hypot(*(p - true).T) for p in (filtered(poses, noise), ours)]
    return found


@pytest.mark.parametrize('names', [
    ('junction_rear_turns_right', 'straight_car_fast_left'),
    pytest.param(VEHICLES, marks=pytest.mark.study)], ids=['two', 'all'])
def test_an_ekf_that_takes_our_pose_is_not_worse_than_we_are(names, road_network):
    found = errors(names, road_network)
    both = [np.concatenate(e) for e in zip(*found.values(), strict=True)]
    rms = [np.sqrt(np.nanmean(e**2)) for e in both]
    print(f'{len(both[0])} poses of {len(found)} recordings: RMS error of the EKF {rms[0]:.2f} m, '
          f'ours {rms[1]:.2f} m')
    for name, pair in found.items():
        print(f'  {name}', *(f'{np.sqrt(np.nanmean(e**2)):.2f} m' for e in pair))
    assert rms[0] <= rms[1]


def test_the_recipe_is_complete():
    """What robot_localization refuses or silently ignores: lengths, frames, states."""
    given = recipe()
    assert len(given['pose0_config']) == 15 and given['pose0_config'][:2] == [True, True]
    assert len(given['process_noise_covariance']) == 225
    assert given['world_frame'] == given['odom_frame'] == 'map'
    assert len({given[f'{name}_frame'] for name in ('map', 'odom', 'base_link')}) == 3
    assert given['pose0'] == 'tracker_node/pose'
