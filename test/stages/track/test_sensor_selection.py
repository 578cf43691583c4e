"""Sensor selection: in a large network, a track uses the nearest sensors as it moves."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.simulation.scenario import Path
from mag_tracking.stages.track import manager, target, track_bank
from mag_tracking.stages.track.doubts import DOUBTFUL_BACKGROUND
from mag_tracking.stages.track.plausibility import Approach
from mag_tracking.stages.track.sensor_selection import (
    exchange_sensor_states,
    nearest_sensors,
    part_of_frame,
)
from mag_tracking.stages.track.smoothing import NOT_SMOOTHED
from support.bundled import POINT
from support.counters import count_of
from support.networks import line_network
from support.samples import one, simulate
from support.scenario import point_body


def bank_of(rng, n_hyp, n_t, n_own, n_sensors):
    """`FilterBank` of random hypotheses in which all states are correlated."""
    n_x = n_t + (n_own + 3) * n_sensors
    A = rng.standard_normal((n_hyp, n_x, n_x))
    bank = FilterBank.from_targets(np.zeros((n_hyp, n_t)), np.zeros((n_hyp, n_t, n_t)),
                                   np.zeros(n_hyp, dtype=int), n_sensors, 1.0,
                                   np.zeros((n_sensors, n_own, n_own)))
    bank.x, bank.P = rng.standard_normal((n_hyp, n_x)), A @ np.swapaxes(A, 1, 2)
    return bank


@pytest.mark.parametrize('n_own', [0, 3, 6])
def test_states_of_common_sensors_are_retained(n_own):
    rng = np.random.default_rng(n_own)
    before, after = np.array([2, 5, 7]), np.array([5, 6, 7, 9])
    bank = bank_of(rng, 4, 8, n_own, 3)
    x, P = bank.x.copy(), bank.P.copy()
    prior = np.array([np.diag(np.arange(1.0, n_own + 1.0)) * (j + 1) for j in range(4)])
    exchange_sensor_states(bank, before, after, prior.reshape(4, n_own, n_own), 0.25)
    n_x = 8 + (n_own + 3) * 4
    assert bank.x.shape == (4, n_x) and bank.P.shape == (4, n_x, n_x)
    assert np.isnan(bank.nis).all() and bank.nis.shape == (4, 4)

    def columns_of(j, n):
        return [*range(8 + n_own * j, 8 + n_own * (j + 1)),
                *range(8 + n_own * n + 3 * j, 8 + n_own * n + 3 * j + 3)]
    old = [*range(8), *columns_of(1, 3), *columns_of(2, 3)]
    new = [*range(8), *columns_of(0, 4), *columns_of(2, 4)]
    np.testing.assert_array_equal(bank.x[:, new], x[:, old])
    np.testing.assert_array_equal(bank.P[np.ix_(range(4), new, new)],
                                  P[np.ix_(range(4), old, old)])
    for k in (1, 3):
        here = columns_of(k, 4)
        others = [i for i in range(n_x) if i not in here]
        assert not bank.x[:, here].any() and not bank.P[np.ix_(range(4), here, others)].any()
        expected = np.diag([*np.diagonal(prior[k]), *[0.0625] * 3])
        np.testing.assert_array_equal(bank.P[0][np.ix_(here, here)], expected)
    np.testing.assert_array_equal(bank.P, np.swapaxes(bank.P, 1, 2))


def test_nearest_sensors_are_horizontal_and_in_network_order():
    positions = np.array([[0.0, 0.0, 9.0], [5.0, 0.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 0.5, 0.0]])
    assert nearest_sensors(positions, np.array([0.2, 0.0]), 2).tolist() == [0, 2]
    assert nearest_sensors(positions, np.array([9.0, 0.0]), 3).tolist() == [0, 1, 2]


def test_a_part_of_a_network_has_the_properties_of_its_sensors():
    network = dataclasses.replace(line_network(5), clock_offset=np.arange(5.0))
    part = network.part(np.array([1, 4]))
    assert part.names == ('mag_2', 'mag_5') and part.topics == ('/mag_2/imu/mag', '/mag_5/imu/mag')
    np.testing.assert_array_equal(part.positions, network.positions[[1, 4]])
    np.testing.assert_array_equal(part.clock_offset, [1.0, 4.0])
    assert len(part.noise_std) == len(part.calibrated) == 2
    assert part.earth_field is network.earth_field


def drive(network, changes, speed=20.0, seed=1):
    """(records, pipeline, function from time [s] to true position) of a point that passes the
    network."""
    farthest = float(network.positions[:, 0].max())
    path = Path(np.array([-60.0, -1.5]), 0.0, speed)
    samples, *_ = simulate(network, point_body([200.0, -150.0, 80.0], 5.0, 0.5), path, 50.0,
                           (farthest + 120.0) / speed, np.random.default_rng(seed))
    pipeline = Pipeline(network, settings_for('vehicle', {**POINT, **changes}))
    records = [r for s in samples for r in pipeline.feed(one(s))] + pipeline.flush()
    return records, pipeline, lambda t: path.start + [speed * t, 0.0]


def test_a_target_is_tracked_along_forty_sensors():
    """A track along 180 m uses six of forty sensors at a time; its errors match the covariance."""
    network = line_network(40, tilt=0.02)
    records, pipeline, truth = drive(network, {'track.max_sensors': 6})
    live = [r for r in records if isinstance(r, Track) and not r.ended]
    assert len({t.id for t in live}) == 1
    inside = [t for t in live if 0.0 < truth(t.stamp_ns / 1e9)[0] < 171.0]
    assert len(inside) > 80
    e = np.array([t.position[:2] - truth(t.stamp_ns / 1e9) for t in inside])
    nees = [v @ np.linalg.solve(t.covariance[:2, :2], v) for v, t in zip(e, inside, strict=True)]
    print(f'rms {np.sqrt((e**2).sum(axis=1).mean()):.2f} m, mean NEES {np.mean(nees):.2f} of 2')
    assert np.sqrt((e**2).sum(axis=1).mean()) < 0.5
    assert np.mean(nees) < 4.0
    assert count_of(pipeline.counts()['track'], 'handed over') >= 10
    frames = {r.stamp_ns: r for r in records if isinstance(r, FieldFrame)}
    for t in inside:
        assert t.predicted.shape == (40, 3) and t.mounting.shape == (40, 3)
        used = ~np.isnan(t.nis_by_sensor)
        assert used.sum() <= 6 and (~np.isnan(t.predicted[used])).all()
        # One of the two nearest sensors with an estimated background is used.
        present = np.flatnonzero(frames[t.stamp_ns].n_samples)
        nearest = present[np.argsort(np.abs(network.positions[present, 0] - t.position[0]))]
        assert used[nearest[:2]].any()
    assert not [r for r in records if isinstance(r, SmoothedPose) and r.complete]
    assert pipeline.counts()['track'][NOT_SMOOTHED] == 1


@pytest.mark.parametrize('limit', [8, 16])
def test_further_sensors_join_after_the_frames_before_the_detection(monkeypatch, limit):
    """A start with all sensors would take seconds and gigabytes."""
    network, runs = line_network(12, tilt=0.02), []
    for n in (1000, 4):
        monkeypatch.setattr(manager, 'sensors_at_start', lambda *_, n=n: n)
        records, pipeline, truth = drive(network, {'track.max_sensors': limit})
        live = [r for r in records if isinstance(r, Track) and not r.ended]
        inside = [t for t in live if 0.0 < truth(t.stamp_ns / 1e9)[0] < 45.0]
        e = np.array([t.position[:2] - truth(t.stamp_ns / 1e9) for t in inside])
        nees = [v @ np.linalg.solve(t.covariance[:2, :2], v)
                for v, t in zip(e, inside, strict=True)]
        assert len(inside) > 20 and np.mean(nees) < 4.0
        assert max(np.count_nonzero(~np.isnan(t.nis_by_sensor)) for t in live) == min(limit, 12)
        smoothed = [r for r in records if isinstance(r, SmoothedPose) and r.complete]
        if limit == 16:
            assert count_of(pipeline.track.counts, 'handed over') == 0
            assert [p.stamp_ns for p in smoothed] == [t.stamp_ns for t in live]
            errors = [np.linalg.norm(p.position[:2] - truth(p.stamp_ns / 1e9)) for p in smoothed
                      if 0.0 < truth(p.stamp_ns / 1e9)[0] < 45.0]
            assert np.sqrt(np.mean(np.square(errors))) < 0.3
        runs.append(inside)
    assert len(runs[0]) == len(runs[1])
    distances = [(a.position[:2] - b.position[:2]) @ np.linalg.solve(
        a.covariance[:2, :2], a.position[:2] - b.position[:2])
            for a, b in zip(*runs, strict=True)]
    assert np.mean(distances) < 1.0


@pytest.fixture(scope='module')
def frames():
    """(network, frames) of a point target that passes twelve sensors."""
    network = line_network(12, tilt=0.02)
    found = [r for r in drive(network, {})[0] if isinstance(r, FieldFrame)]
    return network, found


def track_frames(frames, changes, doubtful=None, start=slice(None)):
    """(`TrackManager`, live tracks) after the frames have been fed."""
    network, all_frames = frames
    tracker, tracks = manager.TrackManager(network, settings_for('vehicle', changes).track), []
    tracker.set_input_doubts({DOUBTFUL_BACKGROUND: doubtful or {}})
    for frame in all_frames[start]:
        tracks += [r for r in tracker.feed(frame) if isinstance(r, Track) and not r.ended]
    return tracker, tracks


def test_sensors_that_join_without_measurements_change_nothing(monkeypatch, frames):
    """The states are predicted only once to the frame in which the sensors join."""
    network, all_frames = frames
    first = next(f for f in all_frames if f.target_present)
    near = nearest_sensors(network.positions, network.positions[
        np.argmax(np.linalg.norm(np.nan_to_num(first.field), axis=1)), :2], 4)
    far = np.setdiff1d(np.arange(12), near)
    silent = [dataclasses.replace(
        f, field=np.where(np.isin(np.arange(12), far)[:, None], np.nan, f.field),
        n_samples=np.where(np.isin(np.arange(12), far), 0, f.n_samples)) for f in all_frames]
    monkeypatch.setattr(manager, 'sensors_at_start', lambda *_: 4)
    runs = [track_frames((network, silent), {**POINT, 'track.relinearise_window_s': 0.0,
                                             'track.max_sensors': limit})[1] for limit in (4, 12)]
    for a, b in zip(*(tracks[:3] for tracks in runs), strict=True):
        np.testing.assert_allclose(b.position, a.position, atol=1e-6)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-6, atol=1e-9)


def test_no_hypothesis_is_dropped_without_frames_before_the_detection(monkeypatch,
                                                                      frames):
    """The ranking of the hypotheses is unknown until the other sensors join."""
    monkeypatch.setattr(manager, 'sensors_at_start', lambda *_: 4)
    for name, value in (('WIDER_BYTES', 1), ('MIN_HYPOTHESES', 20)):
        monkeypatch.setattr(target, name, value)
    first = next(k for k, f in enumerate(frames[1]) if f.target_present)
    tracker, _ = track_frames(frames, {}, start=slice(first, first + 1))
    assert len(tracker.bank) == track_bank.MAX_INITIAL_HYPOTHESES
    _, tracks = track_frames(frames, POINT, start=slice(first, None))
    used = [np.count_nonzero(~np.isnan(t.nis_by_sensor)) for t in tracks]
    assert used[0] <= 4 < max(used)


def test_the_approach_is_checked_with_the_same_sensors_in_all_frames(monkeypatch, frames):
    monkeypatch.setattr(manager, 'sensors_at_start', lambda *_: 4)
    n_sensors, add = set(), Approach.add
    monkeypatch.setattr(Approach, 'add', lambda self, frame: (
        n_sensors.add(len(frame.field)), add(self, frame))[1])
    for limit, expected in ((16, {12}), (8, {8})):
        n_sensors.clear()
        track_frames(frames, {**POINT, 'track.max_sensors': limit})
        assert n_sensors == expected


def test_the_first_pose_is_flagged_for_a_sensor_that_joins_with_it(monkeypatch, frames):
    network, all_frames = frames
    first = next(f for f in all_frames if f.target_present)
    far = network.names[int(np.nanargmin(np.linalg.norm(first.field, axis=1)))]
    for n in (1000, 4):
        monkeypatch.setattr(manager, 'sensors_at_start', lambda *_, n=n: n)
        tracker, tracks = track_frames(frames, POINT, {far: ((0, 2**62),)})
        assert DOUBTFUL_BACKGROUND in tracks[0].doubts
        assert count_of(tracker.counts, 'doubtful_background') == 1


def test_a_network_of_at_most_max_sensors_is_used_completely():
    network = line_network(6, tilt=0.02)
    limited, unlimited = ([r for r in drive(network, {'track.max_sensors': n})[0]
                           if isinstance(r, Track)] for n in (6, 1000))
    assert len(limited) == len(unlimited) > 20
    for a, b in zip(limited, unlimited, strict=True):
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.predicted, b.predicted)


def test_a_part_of_a_frame_has_the_rows_of_its_sensors():
    network = line_network(4)
    _, pipeline, _ = drive(network, {})
    frame = next(r for r in drive(network, {})[0] if hasattr(r, 'n_samples'))
    part = part_of_frame(frame, np.array([0, 3]))
    np.testing.assert_array_equal(part.field, frame.field[[0, 3]])
    np.testing.assert_array_equal(part.covariance, frame.covariance[[0, 3]])
    assert part.stamp_ns == frame.stamp_ns and part.target_present == frame.target_present
