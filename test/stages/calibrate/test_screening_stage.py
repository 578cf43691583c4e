"""Screening for spikes and stuck sensors in the calibration, and counting of held readings."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from mag_tracking.stages.stage import rejected
from support.bundled import VEHICLES, vehicle_path
from support.counters import assert_counts
from support.networks import line_network
from support.samples import MagSample, fed, flushed, recorded
from support.sensor_noise import EARTH, NS, SIGMA, noise


@pytest.mark.parametrize('name', VEHICLES)
def test_screening_rejects_nothing_in_the_bundled_recordings(name, road_network):
    stage = Calibrate(road_network, CalibrateSettings())
    for s in recorded(SampleReader(Recording(vehicle_path(name)), road_network)):
        fed(stage, s)
    flushed(stage)
    assert sum(stage.counts_of(name)['accepted'] for name in road_network.names) > 1000
    assert not {'spike', 'stuck sensor (repeated reading)'} & set(rejected(stage.counts))


def calibrate(**changes):
    network = dataclasses.replace(line_network(1, noise=SIGMA), background=(EARTH,))
    return Calibrate(network, replace(CalibrateSettings(), changes)), network


def feed(stage, y, first=0, rate=100.0):
    return [c for k, field in enumerate(y)
            for c in fed(stage, MagSample(round((first + k) * NS / rate), 'mag_1', field))]


def n_counted(stage):
    c = stage.counts_of('mag_1')
    return c['accepted'] + c['rejected']


def test_spikes_and_repeated_readings_are_rejected_and_counted():
    stage, _ = calibrate()
    y = noise(400)
    y[[100, 150, 151]] += 5e-6
    y[300:330] = y[299]
    out = feed(stage, y)
    n_stuck = stage.counts_of('mag_1')['rejected: stuck sensor (repeated reading)']
    assert rejected(stage.counts) == {'spike': 3, 'stuck sensor (repeated reading)': n_stuck}
    assert 24 <= n_stuck <= 27 and len(out) == 400 - 3 - n_stuck
    assert np.abs([c.field for c in out]).max() < 6 * SIGMA
    assert (np.diff([c.stamp_ns for c in out]) > 0).all()
    assert n_counted(stage) == 400


def test_zero_disables_spike_rejection():
    stage, _ = calibrate(spike_std=0.0)
    y = noise(100)
    y[50] += 5e-6
    assert len(feed(stage, y)) == 100 and not rejected(stage.counts)


def feed_a_spike_that_is_held(stage):
    y = noise(52)
    y[50:] += 5e-6
    assert len(feed(stage, y)) == 50


def test_readings_held_at_the_end_pass_and_are_counted():
    stage, _ = calibrate()
    feed_a_spike_that_is_held(stage)
    assert [c.stamp_ns for c in flushed(stage)] == [500_000_000, 510_000_000]
    assert stage.counts_of('mag_1') == {'accepted': 52} and flushed(stage) == []


def test_readings_held_at_a_jump_back_in_time_are_counted():
    """Regression: the held readings were lost without being counted."""
    stage, _ = calibrate()
    feed_a_spike_that_is_held(stage)
    assert len(feed(stage, noise(50), first=-1000)) == 50
    assert_counts(rejected(stage.counts), {'jumped back': 2})
    assert n_counted(stage) == 102


@pytest.mark.parametrize('attribute', ['offset', 'correction', 'clock_offset'])
def test_readings_held_at_a_new_calibration_are_counted(attribute):
    """The held readings were corrected by the previous calibration, so they are rejected."""
    stage, network = calibrate()
    feed_a_spike_that_is_held(stage)
    new = {'offset': (np.full(3, 1e-6),), 'correction': (1.01 * np.eye(3),),
           'clock_offset': (0.003,)}[attribute]
    stage.update_network(dataclasses.replace(network, **{attribute: new}))
    assert_counts(rejected(stage.counts), {'calibration changed': 2})
    out = feed(stage, noise(50), first=100)
    assert len(out) == 50 and n_counted(stage) == 102


def test_an_identical_calibration_keeps_held_readings():
    stage, network = calibrate()
    feed_a_spike_that_is_held(stage)
    stage.update_network(dataclasses.replace(network))
    assert len(feed(stage, noise(1), first=52)) == 1
    assert rejected(stage.counts) == {'spike': 2} and n_counted(stage) == 53


def test_readings_held_when_relearning_starts_are_still_screened():
    network = line_network(1, noise=SIGMA)
    stage = Calibrate(network, CalibrateSettings())
    y = noise(800)
    y[602:605] += 5e-6
    out = feed(stage, y[:604])
    stage.forget(['mag_1'])
    out += feed(stage, y[604:], first=604)
    stamps = [c.stamp_ns for c in out]
    assert (np.diff(stamps) > 0).all()
    assert stage.counts_of('mag_1') == {'accepted': 797, 'rejected': 3, 'rejected: spike': 3}
