"""Asynchronous sensors: each sensor measures the target at its own sampling time."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.simulation.scenario import Path
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.target import target_of
from support.bundled import POINT
from support.counters import count_of
from support.networks import line_network
from support.samples import one, simulate
from support.scenario import point_body
from support.track_runs import magnet_frames


@pytest.mark.parametrize('target', ['vehicle', 'magnet'])
def test_derivatives_match_finite_differences_at_the_times_of_the_sensors(target):
    network = line_network(3)
    settings = settings_for(target, {
        'track.mounting_std_deg': 3.0, 'track.model_error_time_s': 0.0}).track
    model = target_of(settings, network).model
    rng = np.random.default_rng(1)
    n_t = len(model.state_names)
    x = np.zeros((1, n_t + 18))
    x[0, :n_t] = rng.standard_normal(n_t)
    x[0, n_t:n_t + 9] = 0.05 * rng.standard_normal(9)
    offset = np.array([-0.03, 0.0, 0.05])
    observation = BankFilter(network, model, settings).observation

    def fields(x):
        return observation.fields(x, offset, np.zeros((1, 1)), 0.0)
    H = fields(x)[1][0]
    for k in range(n_t):
        e = np.zeros_like(x)
        e[0, k] = 1e-5
        numeric = (fields(x + e)[0] - fields(x - e)[0])[0] / 2e-5
        scale = np.abs(numeric).max() + np.abs(H[:, :, :n_t]).max() * 1e-3
        np.testing.assert_allclose(H[:, :, k], numeric, atol=1e-6 * scale)


def errors_of_fast_passes(compensated):
    """(mean NEES, RMS error [m]) of passes at 20 m/s; two sensors sample at 12.5 Hz, 40 ms apart.

    Unless `compensated`, the tracker is not given the time offsets of the sensors.
    """
    network = line_network(2)
    nees, squares = [], []
    for seed in range(6):
        samples, t, position, _ = simulate(
            network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
            Path(np.array([-140.0, 1.2 if seed % 2 else -1.2]), 0.0, 20.0), 100.0, 12.0,
            np.random.default_rng(seed))
        slow = [s for s in samples if round(s.stamp_ns / 1e7) % 8 == (
            0 if s.sensor == 'mag_1' else 4)]
        pipeline = Pipeline(network, settings_for('vehicle', {
            **POINT, 'track.vehicle.speeds': [20.0], 'track.mounting_std_deg': 0.0,
            'track.field_error': 0.01, 'track.vehicle.kinds.car.near_field_length': 0.0}))
        feed = pipeline.track.feed
        if not compensated:
            pipeline.track.feed = lambda f, feed=feed: feed(
                replace(f, time_offset=0.0 * f.time_offset))
        for track in (r for s in slow for r in pipeline.feed(one(s))):
            if isinstance(track, Track) and not track.ended:
                q = np.array([np.interp(track.stamp_ns / 1e9, t, position[:, k]) for k in (0, 1)])
                if np.hypot(*q) < 8.0:
                    e = track.position[:2] - q
                    nees.append(e @ np.linalg.solve(track.covariance[:2, :2], e) / 2)
                    squares.append(e @ e)
    assert len(nees) > 30
    return np.mean(nees), np.sqrt(np.mean(squares))


@pytest.mark.study
def test_tracks_of_slow_asynchronous_sensors_are_consistent():
    with_offsets, without = errors_of_fast_passes(True), errors_of_fast_passes(False)
    print(f'with time offsets: NEES {with_offsets[0]:.2f}, RMS {with_offsets[1]:.2f} m; '
          f'without: {without[0]:.2f}, {without[1]:.2f} m')
    assert with_offsets[0] < 1.6
    assert with_offsets[0] < 0.5 * without[0]
    assert with_offsets[1] < without[1]


def rotating_magnet(offset, rate=0.4, n=60, dt=0.27):
    """(network, frames, positions (n, 3) [m]) of a magnet that circles and rotates above nine
    sensors."""
    network, still, _ = magnet_frames(1)
    rng = np.random.default_rng(3)

    def state(t):
        return (np.array([0.06 * np.cos(rate * t), 0.06 * np.sin(rate * t), 0.06]),
                0.3 * np.array([np.sin(rate * t), 0.0, np.cos(rate * t)]))

    frames = []
    for k in range(n):
        y = 1e-7 * rng.standard_normal((9, 3))
        for j in range(9):
            r, m = state(dt * k + offset[j])
            y[j] += network.R_sw[j] @ dipole_field(network.positions[j] - r, m)
        frames.append(FieldFrame(round(dt * 1e9 * k), y, still[0].covariance,
                                 np.ones(9, dtype=int), offset, True, 1e6, 27))
    return network, frames, np.array([state(dt * k)[0] for k in range(n)])


def errors_of(network, frames, truth):
    """(position errors [m], NEES per axis) of the tracks, without the first ten frames."""
    stage = TrackManager(network, settings_for('magnet').track)
    tracks = [t for f in frames for t in stage.feed(f)]
    e = (np.array([t.position for t in tracks]) - truth)[10:]
    nees = [a @ np.linalg.solve(t.covariance[:3, :3], a) / 3
            for a, t in zip(e, tracks[10:], strict=True)]
    return np.linalg.norm(e, axis=1), np.array(nees)


def test_poses_of_a_rotating_magnet_are_accurate_and_consistent():
    """The magnet rotates by six degrees per frame. A first-order rotation would increase the moment
    in every frame."""
    error, nees = errors_of(*rotating_magnet(np.zeros(9)))
    assert error.max() < 0.5e-3
    assert nees.max() < 3.0


def test_a_magnet_above_sensors_that_are_read_sequentially_is_tracked():
    """A sensor is read every 30 ms. In a frame of nine readings the magnet moves by 6 mm and
    rotates by 6 degrees."""
    network, frames, truth = rotating_magnet(0.03 * (np.arange(9) - 4))
    error, nees = errors_of(network, frames, truth)
    without_offsets, _ = errors_of(
        network, [replace(f, time_offset=0.0 * f.time_offset) for f in frames], truth)
    print(f'median {1e3 * np.median(error):.2f} mm; without time offsets '
          f'{1e3 * np.median(without_offsets):.2f} mm')
    assert np.median(error) < 0.3e-3
    assert nees.mean() < 1.5
    assert np.median(error) < 0.2 * np.median(without_offsets)
    stage = TrackManager(network, settings_for('magnet').track)
    for frame in frames:
        track = stage.feed(frame)[-1]
    # Each sensor's field is predicted at its own time.
    assert np.abs(track.predicted - frame.field).max() < 0.02 * np.abs(frame.field).max()


@pytest.mark.parametrize('gap_s', [2.0, 5.0, 15.0])
def test_a_magnet_is_found_again_after_a_long_gap(gap_s):
    """Wrong poses are ambiguous. Three frames after the gap, all poses are correct and
    unambiguous."""
    network, frames, truth = rotating_magnet(np.zeros(9), n=40 + round(gap_s / 0.1), dt=0.1)
    keep = np.r_[0:20, -20:0]
    frames, truth = [frames[k] for k in keep], truth[keep]
    stage = TrackManager(network, settings_for('magnet').track)
    for k, (frame, r) in enumerate(zip(frames, truth, strict=True)):
        tracks = stage.feed(frame)
        live = [t for t in tracks if isinstance(t, Track) and not t.ended]
        wrong = [t for t in live if np.linalg.norm(t.position - r) > max(
            1e-3, 5.0 * np.sqrt(np.trace(t.covariance[:3, :3])))]
        assert all(t.ambiguous for t in wrong)
        if k > 22:
            assert len(live) == 1 and not wrong and not live[0].ambiguous
    assert stage.counts['frames'] == 40


def tracks_after_random_fields(manager, sizes):
    """`Track`s from ten frames with a constant field, followed by frames with random fields whose
    RMS values [T] are `sizes`."""
    C = np.repeat(1e-16 * np.eye(3)[None], 2, axis=0)
    rng = np.random.default_rng(1)
    records = []
    for k, size in enumerate([1e-7] * 10 + sizes):
        y = np.ones((2, 3)) if k < 10 else rng.standard_normal((2, 3))
        y *= size / np.sqrt(np.mean(y**2))
        records += manager.feed(FieldFrame(80_000_000 * k, y, C, np.full(2, 8), np.zeros(2), True,
                                           1e3, 6))
    return [t for t in records if isinstance(t, Track)]


def test_a_vehicle_that_the_field_contradicts_is_lost_and_not_restarted():
    stage = TrackManager(line_network(2), settings_for('vehicle').track)
    tracks = tracks_after_random_fields(stage, [1e-4] * 10 + [1.9e-4] * 10)
    assert stage.counts['tracks ended: target lost'] == 1
    assert tracks[-1].ended and tracks[-2].ambiguous
    assert stage.counts['tracks'] == 1 and stage.bank is None


@pytest.mark.parametrize('lookback_s', [1.0, 0.0])
def test_twice_the_field_of_a_lost_vehicle_starts_an_ambiguous_track(lookback_s):
    """The field of a departing vehicle only decreases. A field that is twice as strong must
    therefore belong to another target."""
    stage = TrackManager(line_network(2), settings_for(
        'vehicle', {'track.lookback_s': lookback_s}).track)
    tracks = tracks_after_random_fields(stage, [1e-4] * 19 + [2.1e-4])
    assert stage.counts['tracks'] == 2
    assert count_of(stage.counts, 'larger field') == 1
    assert tracks[-1].id == 2 and tracks[-1].ambiguous
