"""Vehicles that are seen at once: tracked, and fitted together."""

from functools import cache

import numpy as np
import pytest

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.pass_fitter import PassFitter
from mag_tracking.apps.pass_tracks import PassTracks, ground_prior
from mag_tracking.pipeline import settings_for
from support.busy_fits import fits_of_recording, fits_of_world, with_vehicles
from support.busy_worlds import busy
from support.passes import ROAD
from support.random_passes import SIMULATORS
from support.track_records import NS, track_pose


@cache
def fitted(how, simulator):
    """(fitted passes, `World`) of one pair."""
    a_world = busy(how, 2, simulator, 3, n=1)
    return fits_of_world(a_world, (2, 3)), a_world


@pytest.mark.parametrize('simulator', SIMULATORS)
@pytest.mark.parametrize('how', ['meeting', 'following'])
def test_two_vehicles_are_fitted_together(how, simulator):
    passes, a_world = fitted(how, simulator)
    assert [one.label for one in passes] == ['pass 1, vehicle 1', 'pass 1, vehicle 2']
    right = with_vehicles(passes, [(a_world.t, position) for position in a_world.positions])
    assert sorted(of.vehicle for of in right) == [0, 1]
    for of in right:
        assert '2 vehicles were fitted together' in of.one.notes[-1]
        # 10 %, or what is said of it: a driver may brake.
        found, std = of.one.chosen.speed
        assert abs(found - of.speed) < max(0.1 * of.speed, 3.0 * std)


def test_a_run_that_is_stopped_ends():
    a_world = busy('meeting', 2, 'clouds', 3, n=1)
    fitter = PassFitter('x', a_world.network, settings_for('vehicle'), (1, 2))
    assert [*fitter.feed(a_world.readings, lambda: True), *fitter.flush(lambda: True)] == []


@pytest.mark.study
@pytest.mark.parametrize('name', ['meeting_2_sensors', 'following_2_sensors'])
def test_every_vehicle_of_a_recording_is_fitted(name):
    """All sixteen, each in its direction; nine of ten speeds within 10 %."""
    passes, right = fits_of_recording(name)
    off = np.array([of.one.chosen.speed[0] / of.speed - 1.0 for of in right])
    assert len(right) == len(passes) == 16
    assert (np.abs(off) < 0.1).mean() >= 0.9, np.round(off, 2)


def pass_of(begin, end):
    """`PassData` from one time to another [s]."""
    t = np.arange(0.0, end - begin, 0.1)
    n = len(t)
    return PassData(ROAD, round(begin * NS), np.tile(t, 2), np.repeat([0, 1], n),
                    np.zeros((2 * n, 3)), np.tile(1e-16 * np.eye(3), (2 * n, 1, 1)))


def crossing(number, at, y, v, n=5, std=0.1):
    """Poses of a track that is surest at a time [s], when it is at the origin."""
    return [track_pose(at + 0.2 * k, 0.2 * k * v, y, v, id=number,
                       covariance=(std + 0.1 * abs(k))**2 * np.eye(6))
            for k in range(-n, n + 1)]


def in_time(*tracks):
    """The records of some tracks as a tracker gives them."""
    return sorted((record for track in tracks for record in track), key=lambda r: r.stamp_ns)


def test_vehicles_of_a_pass_are_those_that_are_surest_in_it():
    tracks = PassTracks(settings_for('vehicle').track)
    # The third one is of the next pass, which begins while this one is still seen.
    tracks.add([object(), *in_time(crossing(1, 3.0, -1.7, 10.0), crossing(2, 4.0, 1.7, -12.0),
                                    crossing(3, 8.0, -1.7, 14.0, n=20))])
    paths = tracks.paths(pass_of(0.0, 6.0))
    np.testing.assert_allclose(sorted(paths[:, 3]), [-12.0, 10.0])
    for path in paths:
        # Where it is when the pass begins.
        at = 3.0 if path[3] > 0.0 else 4.0
        np.testing.assert_allclose(path[:2], [-at * path[3], -np.sign(path[3]) * 1.7])
    np.testing.assert_allclose(tracks.paths(pass_of(5.0, 12.0))[:, 3], [14.0])
    assert tracks.paths(pass_of(12.0, 13.0)).shape == (0, 6)


def test_a_vehicle_that_was_lost_and_found_is_one():
    tracks = PassTracks(settings_for('vehicle').track)
    tracks.add(in_time(crossing(1, 3.0, -1.7, 10.0), [track_pose(4.1, 11.0, id=1, ended=True)],
                        crossing(2, 3.2, -1.5, 10.5, std=0.4)))
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 6.0))[:, 3], [10.0])


def test_a_vehicle_is_one_whose_track_ended_when_it_was_surest():
    tracks = PassTracks(settings_for('vehicle').track)
    coming = crossing(1, 3.0, -1.7, 10.0)[:6]
    tracks.add(coming)
    assert len(tracks.paths(pass_of(0.0, 3.1))) == 0
    tracks.add([track_pose(3.2, 2.0, id=1, ended=True)])
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 3.5))[:, 3], [10.0])
    # It is forgotten then.
    assert len(tracks.paths(pass_of(0.0, 3.5))) == 0


def test_poses_from_before_a_jump_of_the_time_are_of_no_pass():
    tracks = PassTracks(settings_for('vehicle').track)
    tracks.add(crossing(1, 30.0, -1.7, 10.0))
    tracks.add(crossing(2, 3.0, 1.7, -12.0))
    np.testing.assert_allclose(tracks.paths(pass_of(0.0, 40.0))[:, 3], [-12.0])


def test_magnets_are_no_vehicles():
    tracks = PassTracks(settings_for('magnet').track)
    tracks.add(in_time(crossing(1, 3.0, -1.7, 10.0), crossing(2, 4.0, 1.7, -12.0)))
    assert len(tracks.paths(pass_of(0.0, 6.0))) == 0


def test_the_ground_is_that_of_the_settings():
    settings = settings_for('vehicle', {
        'track.vehicle.heights': [0.4, 0.4, 1.0], 'track.vehicle.height_stds': [0.3, 0.3, 0.3],
        'track.vehicle.climb_std': 0.2})
    ground = ground_prior(settings.track)
    # The spread of the means, and that of each.
    assert ground.height == pytest.approx((0.6, np.sqrt(0.08 + 0.09)))
    assert ground.climb_std == 0.2
