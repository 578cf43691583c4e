"""Disturbances: what is left of tracks that something else explained better."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.event_records import Disturbance
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from mag_tracking.stages.track.evidence import UNEXPLAINED
from support.situations import made, verdict


def outputs(name, simulator='clouds', seed=0, parts=1):
    """(`Pipeline`, its outputs) of a situation, fed in a number of parts."""
    world = made(name, simulator, seed)
    pipeline = Pipeline(world.network, settings_for('vehicle'))
    out = []
    for which in np.array_split(np.arange(len(world.readings)), parts):
        out += pipeline.feed(world.readings.part(which))
    return pipeline, out + pipeline.flush()


@pytest.mark.parametrize('name', ['a temperature step', 'a tram line switched', 'a sensor knocked'])
def test_a_disturbance_is_found_and_ends(name):
    pipeline, out = outputs(name)
    found = [r for r in out if isinstance(r, Disturbance)]
    # Each is said once when it is found and once when it has ended, or only then.
    assert found and {d.id for d in found if d.ended} == {d.id for d in found}
    tracks = {r.id: r for r in out if isinstance(r, Track)}
    for d in found:
        assert d.begin_ns <= d.stamp_ns and d.track_id in tracks
        assert d.largest > 1e-8 and d.sensors
    assert all(r.ambiguous for r in tracks.values())
    # In all of the frames from its beginning to its end no pose was sure.
    assert found[0].begin_ns <= min(r.stamp_ns for r in out if isinstance(r, Track))
    assert pipeline.track.counts[f'tracks ended: {UNEXPLAINED}'] <= len(tracks)


def test_a_temperature_step_ends_the_track_before_the_field_is_quiet_again():
    pipeline, out = outputs('a temperature step', 'boxes')
    assert pipeline.track.counts[f'tracks ended: {UNEXPLAINED}'] >= 1
    first, last = [r for r in out if isinstance(r, Disturbance)][:2]
    assert not first.ended and last.ended and last.id == first.id
    assert last.stamp_ns > first.stamp_ns and last.largest >= first.largest


def test_a_car_is_no_disturbance():
    assert not [r for r in outputs('a car')[1] if isinstance(r, Disturbance)]


def test_a_car_that_stops_is_no_disturbance():
    assert not [r for r in outputs('stops for 20 s')[1] if isinstance(r, Disturbance)]


def test_disturbances_do_not_depend_on_how_readings_are_split():
    whole, parts = (outputs('a tram line switched', parts=n)[1] for n in (1, 37))
    assert [dataclasses.astuple(r) for r in whole if isinstance(r, Disturbance)] == [
        dataclasses.astuple(r) for r in parts if isinstance(r, Disturbance)]


def test_two_sensors_tell_a_tram_from_a_temperature():
    """One field over the network, or one at each sensor."""
    def uniform(name):
        return [r.uniform for r in outputs(name)[1] if isinstance(r, Disturbance) and r.ended]
    assert min(uniform('a storm')) > 0.5
    assert max(uniform('slow ramps')) < 0.5


def test_a_bicycle_is_felt_by_one_sensor_and_never_sure():
    assert verdict('a bicycle', 'boxes', 0).n_sure == 0
