"""Explanation, in one sentence, of why nothing was detected."""

import dataclasses

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.cli import main
from mag_tracking.stages.health.diagnosis import Cause
from support import spoiler
from support.bundled import NETWORK_FILE, vehicle_path
from support.spoilt_runs import recorded

NETWORK = mt.read_network(NETWORK_FILE)
QUIET = recorded('straight_car_right').readings
QUIET = QUIET.part(QUIET.stamp_ns < QUIET.stamp_ns[0] + 5_000_000_000)
CONFIGURED = dataclasses.replace(NETWORK, noise_std=(np.full(3, 1e-8),) * 2, background=tuple(
    np.median(QUIET.field[np.array(QUIET.sensor_names()) == name], axis=0)
    for name in NETWORK.names))


def reason_of(*faults, network=NETWORK, readings=None, **settings):
    readings = recorded('straight_small_left').readings if readings is None else readings
    changes = {name.replace('__', '.'): value for name, value in settings.items()}
    result = mt.track(spoiler.apply(readings, *faults), network, settings=changes)
    return result.report.no_detection_reason


def test_no_reason_is_given_after_a_detection():
    assert reason_of() is None


@pytest.mark.parametrize('expected, arguments', [
    (r'0\.\d+ times .*\(mag_1 0\.\d+, mag_2 0\.\d+\)',
     {'readings': QUIET}),
    ('noise_std of mag_1',
     {'network': dataclasses.replace(NETWORK, noise_std=(np.full(3, 3e-6),) * 2)}),
    (r'detect.background_std \(1e-05 T\)',
     {'detect__background_std': 1e-5}),
    (r'\d+ .*detect.onset_frames is 100',
     {'detect__onset_frames': 100}),
    ('mag_1, mag_2: .*calibrate.learn_s',
     {'readings': QUIET.part(slice(0, 200))}),
    ('/mag_1/imu/mag, /mag_2/imu/mag',
     {'readings': QUIET.part(slice(0, 0))})])
def test_the_reason_names_the_cause(expected, arguments):
    import re

    assert re.search(expected, reason_of(**arguments)), reason_of(**arguments)


def test_detections_without_a_track_are_explained_as_by_replay():
    readings = recorded('straight_small_left').readings
    slow = [np.flatnonzero(readings.sensor == j)[::50] for j in range(len(readings.names))]
    result = mt.track(readings.part(np.sort(np.concatenate(slow))), CONFIGURED)
    assert len(result.detections) and not result.tracks
    first, *_ = result.report.diagnoses
    assert first.serious and first.finding.cause is Cause.RATE_TOO_LOW
    assert str(first) in repr(result)
    alone = mt.track(readings, NETWORK.part(np.array([0])))
    assert alone.report.no_track_reason.startswith('no track: the scale')


def test_trusted_covariances_are_named_as_the_cause():
    reason = reason_of(spoiler.covariance(1e-2), calibrate__trust_covariances=True)
    assert 'calibrate.trust_covariances' in reason
    assert reason_of(spoiler.covariance(1e-2)) is None


def test_readings_in_a_wrong_unit_are_reported_as_too_large():
    readings = recorded('straight_small_left').readings
    reason = reason_of(readings=dataclasses.replace(readings, field=1e6 * readings.field))
    assert '2800 were rejected (above 0.001 T' in reason


def test_a_reason_is_given_if_the_scatter_is_unknown():
    """With configured backgrounds, a few readings suffice, but do not determine the scatter."""
    assert 'the threshold' in reason_of(network=CONFIGURED, readings=QUIET.part(slice(0, 40)))


def test_a_sensor_without_a_background_is_named():
    readings = recorded('straight_small_left').readings
    t = (readings.stamp_ns - readings.stamp_ns[0]) / 1e9
    is_mag_1 = np.array(readings.sensor_names()) == 'mag_1'
    reason = reason_of(readings=readings.part((is_mag_1 & (t < 5.0)) | (~is_mag_1 & (t < 1.0))))
    assert 'mag_2 had' in reason


def test_commands_print_the_reason(tmp_path, capsys):
    params = tmp_path / 'p.yaml'
    params.write_text('detect: {onset_frames: 500}')
    for command in ('replay', 'fit'):
        assert main([command, str(vehicle_path('straight_car_right')), '--network',
                     str(NETWORK_FILE), '--params', str(params), '--no-figures', '--out',
                     str(tmp_path / command)]) == 0
        assert 'detect.onset_frames is 500' in capsys.readouterr().out
