"""Sensors that contradict the Earth's field or pass vehicles below them, in tracks and fits."""

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.calibration.doubtful_times import CONTRADICTS_EARTH_FIELD
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.stages.track.doubts import BELOW_SENSORS
from mag_tracking.stages.track.running_track import BELOW_SENSORS as PASSED_BELOW
from support import spoiler
from support.bundled import NETWORK_FILE
from support.configurations import configuration_world
from support.live_runs import fits_of
from support.random_passes import SIMULATORS
from support.spoilt_runs import findings, recorded

NAME = 'straight_car_right'
FAULTS = {
    'gain': [spoiler.transformed('mag_2', 0.533)],
    'inverted': [spoiler.transformed('mag_1', -1.0)],
    'upside down': [spoiler.transformed(None, np.diag([1.0, -1.0, -1.0]))],
    'z three times': [spoiler.transformed('mag_2', np.diag([1.0, 1.0, 3.0]))],
    'y and z exchanged': [spoiler.transformed('mag_1', np.eye(3)[[0, 2, 1]])]}
EXPLANATIONS = {'gain': 'the direction agrees', 'inverted': 'x, y and z are flipped',
                'upside down': 'y and z are flipped', 'z three times': 'of z alone',
                'y and z exchanged': 'y and z are swapped'}


@pytest.fixture(scope='module')
def network():
    return mt.read_network(NETWORK_FILE)


def run(network, *faults, part=None, changes=None):
    """(`Pipeline`, poses) of the recording with faults, in batches of `part` readings."""
    readings = spoiler.apply(recorded(NAME).readings, *faults)
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    part = part or len(readings)
    records = [r for k in range(0, len(readings), part)
               for r in pipeline.feed(readings.part(slice(k, k + part)))] + pipeline.flush()
    return pipeline, [r for r in records if isinstance(r, Track) and not r.ended], [
        r for r in records if isinstance(r, SmoothedPose)]


@pytest.fixture(scope='module')
def flags(network):
    """Flags of the poses of the recording without faults."""
    return [t.ambiguous for t in run(network)[1]]


@pytest.mark.parametrize('fault', FAULTS)
def test_all_poses_are_flagged_and_the_doctor_names_the_same_sensors(network, fault):
    pipeline, tracks, smoothed = run(network, *FAULTS[fault])
    assert tracks and all(CONTRADICTS_EARTH_FIELD in t.doubts for t in tracks)
    assert all(p.ambiguous for p in smoothed)
    found = pipeline.calibrate.comparison.inconsistencies()
    assert found and all(EXPLANATIONS[fault] in str(d) for d in found)
    doctor = findings(NAME, *FAULTS[fault])
    for d in found:
        assert any(f.startswith(f'{d.sensor}: differs')
                   and EXPLANATIONS[fault] in f and d.advice in f for f in doctor)


def test_offsets_of_uncalibrated_sensors_change_no_flag(network, flags):
    offsets = [spoiler.offset('mag_1', [4e-6, -3e-6, 5e-6]),
               spoiler.offset('mag_2', [-2e-6, 3e-6, -9e-6])]
    pipeline, tracks, _ = run(network, *offsets)
    assert not all(flags) and [t.ambiguous for t in tracks] == flags
    assert pipeline.calibrate.comparison.inconsistencies() == []


def test_the_flags_do_not_depend_on_the_batches(network):
    whole, small = (run(network, *FAULTS['gain'], part=part) for part in (None, 30))
    assert whole[0].calibrate.input_doubts() == small[0].calibrate.input_doubts()
    assert [t.doubts for t in whole[1]] == [t.doubts for t in small[1]]


def test_the_comparison_can_be_disabled(network):
    pipeline, tracks, _ = run(network, *FAULTS['gain'], changes={'survey.offset_std': 0.0})
    assert pipeline.calibrate.input_doubts() == {} and not all(t.ambiguous for t in tracks)


def test_a_fit_gives_the_reason_instead_of_an_estimate(network):
    readings = spoiler.apply(recorded(NAME).readings, *FAULTS['gain'])
    passes = fits_of(network, readings, (1, 2), NAME)
    assert passes and all(p.chosen is None and p.reported is None for p in passes)
    assert all(f.reason.startswith('mag_2: ') and not f.trusted for p in passes for f in p.fits)


@pytest.mark.parametrize('simulator', SIMULATORS)
def test_exchanged_sensors_flag_the_smoothed_poses(simulator):
    """The vehicle is mirrored to the other side of the centre, below the sensors."""
    world = configuration_world('sensors exchanged', simulator, 1)
    pipeline = Pipeline(world.network, settings_for('vehicle'))
    records = pipeline.feed(world.readings) + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track) and not r.ended]
    smoothed = [r for r in records if isinstance(r, SmoothedPose)]
    assert smoothed and all(p.ambiguous for p in smoothed)
    assert BELOW_SENSORS in tracks[-1].doubts and pipeline.track.counts[PASSED_BELOW] == 1
