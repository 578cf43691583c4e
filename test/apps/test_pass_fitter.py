"""Joint fit of vehicles that pass at the same time."""

from functools import cache

import numpy as np
import pytest

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.fit import PassTracks, ground_prior
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD
from support.busy_fits import assigned_fits, fits_of_recording, fits_of_world
from support.busy_worlds import busy
from support.live_runs import fits_of
from support.passes import ROAD
from support.random_passes import SIMULATORS
from support.track_records import NS, track_pose


@cache
def fit_pair(scenario, simulator):
    """Fit a pair of vehicles; return (fitted passes, `World`)."""
    world = busy(scenario, 2, simulator, 3, n=1)
    return fits_of_world(world, (2, 3)), world


@pytest.mark.parametrize('simulator', SIMULATORS)
@pytest.mark.parametrize('scenario', ['meeting', 'following'])
def test_two_vehicles_are_fitted_together(scenario, simulator):
    passes, world = fit_pair(scenario, simulator)
    assert [fit.label for fit in passes] == ['pass 1, vehicle 1', 'pass 1, vehicle 2']
    matches = assigned_fits(passes, [(world.t, position) for position in world.positions])
    assert sorted(match.vehicle for match in matches) == [0, 1]
    for match in matches:
        assert '2 vehicles' in match.fitted_pass.notes[-1]
        # Three standard deviations are allowed, because a driver may brake.
        found, std = match.fitted_pass.chosen.speed
        assert abs(found - match.speed) < max(0.1 * match.speed, 3.0 * std)


def test_a_stopped_run_returns_no_fits():
    world = busy('meeting', 2, 'clouds', 3, n=1)
    assert fits_of(world.network, world.readings, (1, 2), stopped=lambda: True) == []


@pytest.mark.study
@pytest.mark.parametrize('name', ['meeting_2_sensors', 'following_2_sensors'])
def test_every_vehicle_of_a_recording_is_fitted(name):
    """All sixteen directions are correct; 90 % of the speeds are within 10 %."""
    passes, matches = fits_of_recording(name)
    speed_errors = np.array([match.fitted_pass.chosen.speed[0] / match.speed - 1.0
                             for match in matches])
    assert len(matches) == len(passes) == 16
    assert (np.abs(speed_errors) < 0.1).mean() >= 0.9, np.round(speed_errors, 2)


def pass_of(begin, end):
    """Create `PassData` with zero fields from `begin` to `end` [s]."""
    t = np.arange(0.0, end - begin, 0.1)
    n = len(t)
    return PassData(ROAD, round(begin * NS), np.tile(t, 2), np.repeat([0, 1], n),
                    np.zeros((2 * n, 3)), np.tile(1e-16 * np.eye(3), (2 * n, 1, 1)))


def crossing(number, at, y, v, n=5, std=0.1):
    """Poses of a track that crosses x = 0 at time `at` [s]; the covariance is smallest there."""
    return [track_pose(at + 0.2 * k, 0.2 * k * v, y, v, id=number,
                       covariance=(std + 0.1 * abs(k))**2 * np.eye(6))
            for k in range(-n, n + 1)]


def in_order(*tracks):
    """Records of several tracks in chronological order."""
    return sorted((record for track in tracks for record in track), key=lambda r: r.stamp_ns)


def test_a_vehicle_belongs_to_the_pass_with_its_smallest_covariance():
    tracks = PassTracks(settings_for('vehicle').track)
    # The third vehicle belongs to the next pass, which begins before the first pass ends.
    tracks.add([object(), *in_order(crossing(1, 3.0, -1.7, 10.0), crossing(2, 4.0, 1.7, -12.0),
                                    crossing(3, 8.0, -1.7, 14.0, n=20))])
    paths = tracks.paths(pass_of(0.0, 6.0))
    np.testing.assert_allclose(sorted(paths[:, 3]), [-12.0, 10.0])
    for path in paths:
        # The position is the position at the start of the pass.
        at = 3.0 if path[3] > 0.0 else 4.0
        np.testing.assert_allclose(path[:2], [-at * path[3], -np.sign(path[3]) * 1.7])
    np.testing.assert_allclose(tracks.paths(pass_of(5.0, 12.0))[:, 3], [14.0])
    assert tracks.paths(pass_of(12.0, 13.0)).shape == (0, 6)


def test_a_vehicle_with_two_tracks_counts_once():
    tracks = PassTracks(settings_for('vehicle').track)
    tracks.add(in_order(crossing(1, 3.0, -1.7, 10.0), [track_pose(4.1, 11.0, id=1, ended=True)],
                        crossing(2, 3.2, -1.5, 10.5, std=0.4)))
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 6.0))[:, 3], [10.0])


def test_a_track_that_ends_at_its_smallest_covariance_is_a_vehicle():
    tracks = PassTracks(settings_for('vehicle').track)
    approaching = crossing(1, 3.0, -1.7, 10.0)[:6]
    tracks.add(approaching)
    assert len(tracks.paths(pass_of(0.0, 3.1))) == 0
    tracks.add([track_pose(3.2, 2.0, id=1, ended=True)])
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 3.5))[:, 3], [10.0])
    # A returned track is not returned again.
    assert len(tracks.paths(pass_of(0.0, 3.5))) == 0


def test_poses_before_a_time_jump_belong_to_no_pass():
    tracks = PassTracks(settings_for('vehicle').track)
    tracks.add(crossing(1, 30.0, -1.7, 10.0))
    tracks.add(crossing(2, 3.0, 1.7, -12.0))
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 40.0))[:, 3], [-12.0])


def test_magnets_are_not_vehicles():
    tracks = PassTracks(settings_for('magnet').track)
    tracks.add(in_order(crossing(1, 3.0, -1.7, 10.0), crossing(2, 4.0, 1.7, -12.0)))
    assert len(tracks.paths(pass_of(0.0, 6.0))) == 0


def test_the_ground_prior_combines_the_heights_of_all_kinds():
    settings = settings_for('vehicle', {
        f'track.vehicle.kinds.{kind}.{column}': value for kind, height in (
            ('small', 0.4), ('car', 0.4), ('truck', 1.0))
        for column, value in (('height', height), ('height_std', 0.3))})
    ground = ground_prior(settings.track)
    # Variance of the means plus mean of the variances.
    assert ground.height == pytest.approx((0.6, np.sqrt(0.08 + 0.09)))
    assert ground.climb_std == CLIMB_STD
