"""Disturbances: fields that start a track but that no target explains."""

import dataclasses
import functools

import numpy as np
import pytest

from mag_tracking.event_records import Disturbance
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.disturbances import Disturbances, UnexplainedField
from mag_tracking.stages.track.evidence import UNEXPLAINED
from mag_tracking.stages.track.manager import TrackManager
from support.situations import simulated_world, verdict
from support.track_runs import magnet_frames


def outputs(name, simulator='clouds', seed=0, parts=1):
    """(`Pipeline`, its outputs) for a situation whose readings are fed in `parts` batches."""
    world = simulated_world(name, simulator, seed)
    pipeline = Pipeline(world.network, settings_for('vehicle'))
    out = []
    for which in np.array_split(np.arange(len(world.readings)), parts):
        out += pipeline.feed(world.readings.part(which))
    return pipeline, out + pipeline.flush()


@functools.cache
def outputs_of(name, simulator='clouds'):
    return outputs(name, simulator)


@pytest.mark.parametrize('name', ['a temperature step', 'a tram line switched', 'a sensor knocked'])
def test_a_disturbance_is_found_and_ends(name):
    pipeline, out = outputs_of(name, 'boxes')
    found = [r for r in out if isinstance(r, Disturbance)]
    # A disturbance is published when it is found and when it has ended, or only when it has ended.
    assert found and {d.id for d in found if d.ended} == {d.id for d in found}
    tracks = {r.id: r for r in out if isinstance(r, Track)}
    for d in found:
        assert d.begin_ns <= d.stamp_ns and d.track_id in tracks
        assert d.largest > 1e-8 and d.sensors
    assert all(r.ambiguous for r in out if isinstance(r, Track))
    assert found[0].begin_ns <= min(r.stamp_ns for r in out if isinstance(r, Track))


def test_a_temperature_step_ends_the_track_before_the_field_is_quiet_again():
    pipeline, out = outputs_of('a temperature step', 'boxes')
    assert pipeline.track.counts[f'tracks ended: {UNEXPLAINED}'] >= 1
    first, last = [r for r in out if isinstance(r, Disturbance)][:2]
    assert not first.ended and last.ended and last.id == first.id
    assert last.stamp_ns > first.stamp_ns and last.largest >= first.largest


def test_a_car_is_not_a_disturbance():
    assert not [r for r in outputs('a car')[1] if isinstance(r, Disturbance)]


@pytest.mark.study
def test_a_car_that_stops_is_not_a_disturbance():
    assert not [r for r in outputs('stops for 20 s')[1] if isinstance(r, Disturbance)]


def test_disturbances_do_not_depend_on_batches():
    whole, parts = (outputs('a tram line switched', parts=n)[1] for n in (1, 37))
    assert [dataclasses.astuple(r) for r in whole if isinstance(r, Disturbance)] == [
        dataclasses.astuple(r) for r in parts if isinstance(r, Disturbance)]


@pytest.mark.study
def test_pulsations_are_uniform_over_the_network_and_slow_ramps_are_not():
    def uniform(name, simulator):
        return [r.uniform for r in outputs_of(name, simulator)[1]
                if isinstance(r, Disturbance) and r.ended]
    assert np.median(uniform('pulsations of 20 nT', 'clouds')) > 0.5
    assert np.median(uniform('slow ramps', 'boxes')) < 0.5


def test_a_disturbance_grows_and_reaches_other_sensors_until_it_ends():
    disturbances = Disturbances(('a', 'b'))
    quiet = FieldFrame(0, np.array([[3e-8, 0, 0], [0, 0, 0]]),
                       np.tile(1e-18 * np.eye(3), (2, 1, 1)), np.ones(2, dtype=int), np.zeros(2))
    found = UnexplainedField(1, 0, np.array([2e-8, 0.0]), np.array([True, False]), 0.1)
    first, = disturbances.begin(found, 10)
    assert (first.largest, first.sensors, first.ended) == (2e-8, ('a',), False)
    disturbances.feed(quiet)
    disturbances.feed(dataclasses.replace(quiet, field=quiet.field[::-1]))
    last, = disturbances.end(20)
    assert (last.id, last.largest, last.stamp_ns, last.ended) == (1, 3e-8, 20, True)
    assert sorted(last.sensors) == ['a', 'b']
    assert disturbances.end(30) == []


def test_a_car_tracked_during_a_disturbance_does_not_enlarge_it():
    _, out = outputs_of('a temperature step', 'boxes')
    last = [r for r in out if isinstance(r, Disturbance)][-1]
    largest = {False: 0.0, True: 0.0}
    tracked = {r.stamp_ns for r in out if isinstance(r, Track) and r.id != last.track_id}
    for frame in (r for r in out if isinstance(r, FieldFrame)):
        is_tracked = frame.stamp_ns in tracked
        size = float(np.linalg.norm(frame.field, axis=1).max())
        largest[is_tracked] = max(largest[is_tracked], size)
    # The frame in which the track of the car starts is still counted.
    assert last.largest < 0.7 * largest[True] and last.ended


def test_poses_of_a_magnet_at_rest_are_unambiguous():
    network, frames, _ = magnet_frames(n=1)
    rng = np.random.default_rng(0)
    manager = TrackManager(network, settings_for('magnet').track)
    poses = []
    for k in range(100):
        noisy = frames[0].field + 1e-7 * rng.standard_normal(frames[0].field.shape)
        poses += manager.feed(dataclasses.replace(frames[0], stamp_ns=k * 100_000_000,
                                                  field=noisy))
    assert len(poses) == 100 and not any(p.ambiguous for p in poses)


def test_a_bicycle_has_no_unambiguous_poses():
    assert verdict('a bicycle', 'boxes', 0).n_unflagged == 0
