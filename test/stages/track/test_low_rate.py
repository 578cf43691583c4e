"""No track is claimed while the sensors are too slow to show a pass."""

from dataclasses import replace

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import LATERAL_STD
from mag_tracking.stages.track.manager import TOO_SLOW
from mag_tracking.stages.track.plausibility import low_rate_fault, required_rate
from support.bundled import NETWORK_FILE
from support.networks import line_network
from support.spoiler import apply, thinned
from support.spoilt_runs import recorded

NETWORK = mt.read_network(NETWORK_FILE)
SETTINGS = settings_for('vehicle').track
RECORDING = 'straight_car_right'


def scaled(network, factor):
    return replace(network, positions=factor * network.positions)


def tracked(*faults):
    """Track a bundled pass of a car, recorded at 100 Hz, with `faults`."""
    return mt.track(apply(recorded(RECORDING).readings, *faults), NETWORK)


def test_the_required_rate_is_proportional_to_the_speed():
    fast = settings_for('vehicle', {'track.vehicle.speeds': (10.0, 20.0, 40.0)}).track
    assert required_rate(NETWORK, fast) == pytest.approx(2.0 * required_rate(NETWORK, SETTINGS))


def test_the_required_rate_decreases_with_the_distance_of_the_sensors():
    rates = [required_rate(scaled(NETWORK, factor), SETTINGS) for factor in (0.7, 1.0, 1.5, 2.0)]
    assert (np.diff(rates) < 0.0).all()


@pytest.mark.parametrize('n', [1, 2, 6])
def test_a_vehicle_at_the_required_rate_moves_less_than_its_distance(n):
    """Half of the rate resolves frequencies at which the field of the pass is below 5 %."""
    network = line_network(n)
    rate = required_rate(network, SETTINGS)
    distance = np.hypot(4.5, LATERAL_STD)
    assert np.exp(-np.pi * rate * distance / 10.0) < 0.05


def test_a_magnet_may_be_measured_at_any_rate():
    settings = settings_for('magnet').track
    assert low_rate_fault(1e-3, NETWORK, settings) is None


def test_a_low_rate_is_described_with_both_numbers():
    required = required_rate(NETWORK, SETTINGS)
    assert low_rate_fault(required, NETWORK, SETTINGS) is None
    assert low_rate_fault(np.nan, NETWORK, SETTINGS) is None
    fault = low_rate_fault(0.5, NETWORK, SETTINGS)
    assert '0.5 Hz' in fault and '20 m' in fault and f'{np.ceil(10 * required) / 10:g} Hz' in fault


@pytest.mark.parametrize('every', [50, 100, 400])
def test_no_track_is_claimed_at_a_low_rate(every):
    result = tracked(thinned(every))
    assert not result.tracks and not result.report.counts['track'].get('tracks', 0)


@pytest.mark.parametrize('every', [10, 20, 30])
def test_tracks_above_the_required_rate_are_right_or_ambiguous(every):
    assert 100.0 / every > required_rate(NETWORK, SETTINGS)
    result = tracked(thinned(every))
    assert len(result.tracks) == 1 and not result.report.counts['track'].get(TOO_SLOW, 0)
    errors = replace(result, truth=recorded(RECORDING).truth).errors()
    assert errors['anees'] < 3.0 or result.poses['ambiguous'].all()


def test_a_slow_sensor_beside_a_fast_one_is_not_enough():
    """Of two sensors, one is fast and one is slow: range and moment are not observable."""
    readings = recorded(RECORDING).readings
    slow = np.flatnonzero(readings.sensor == 1)
    keep = np.ones(len(readings), dtype=bool)
    keep[np.setdiff1d(slow, slow[::100])] = False
    network = replace(NETWORK, noise_std=(np.full(3, 1.2e-8),) * 2, background=tuple(
        np.median(readings.field[readings.sensor == j][:200], axis=0) for j in range(2)))
    result = mt.track(readings.part(keep), network)
    assert result.detections['onset'].any() and not result.tracks
    assert result.report.counts['track'][TOO_SLOW]


def test_a_track_at_a_rate_that_falls_is_ambiguous():
    """After the closest point, only one reading in 100 arrives."""
    source = recorded(RECORDING)
    _, poses, _ = next(iter(source.truth.values()))
    truth_ns = next(iter(source.truth.values()))[0]
    closest_ns = truth_ns[np.argmin(np.linalg.norm(poses[:, :2], axis=1))]
    keep = source.readings.stamp_ns < closest_ns
    for j in range(2):
        late = np.flatnonzero((source.readings.sensor == j) & ~keep)
        keep[late[::100]] = True
    result = mt.track(source.readings.part(keep), NETWORK)
    late_poses = result.poses[result.poses['stamp_ns'] > closest_ns + 1_500_000_000]
    assert late_poses['ambiguous'].all()
    assert not len(late_poses) or doubts.FRAMES_TOO_LONG in late_poses['doubts'][-1]
