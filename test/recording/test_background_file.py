"""Stored backgrounds: their file, and their use after a restart of the calibration."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.recording.background_file import (
    background_text,
    default_path,
    read_backgrounds,
    write_backgrounds,
)
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.counters import count_of
from support.networks import line_network
from support.samples import MagSample, fed

NS = 1_000_000_000
RATE, STD = 50.0, 1.2e-8
EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
SETTINGS = CalibrateSettings()
STEP = np.array([0.0, 4e-7, 0.0])


def readings(begin_s, seconds, seed, step=0.0):
    """Simulate samples of mag_1 in the Earth field plus `step` [T]."""
    rng = np.random.default_rng(seed)
    return [MagSample(int((begin_s + k / RATE) * NS), 'mag_1',
                      EARTH + step + STD * rng.standard_normal(3))
            for k in range(int(seconds * RATE))]


def network_without_backgrounds(n=2):
    """Network in which backgrounds and noise levels are unknown."""
    network = line_network(n, tilt=0.0)
    return replace(network, background=(None,) * n, noise_std=(None,) * n)


def learnt_stage():
    """Return a network, and a `Calibrate` stage after it has learnt mag_1 for 10 s."""
    network = network_without_backgrounds()
    assert network.names[0] == 'mag_1'
    stage = Calibrate(network, CalibrateSettings())
    for s in readings(1000.0, 10.0, 0):
        fed(stage, s)
    return network, stage


def write_and_read_back(path):
    """Write the background of mag_1 and read it back; return the network and the background."""
    network, stage = learnt_stage()
    write_backgrounds(path, {'mag_1': background_text(
        stage.stored('mag_1'), network, 0, SETTINGS)})
    stored, refused = read_backgrounds(path, network, SETTINGS)
    assert not refused
    return network, stored


def test_a_stored_background_is_read_back_unchanged(tmp_path):
    path = tmp_path / 'a' / 'b.json'
    network, stored = write_and_read_back(path)
    _, stage = learnt_stage()
    assert list(stored) == ['mag_1'] and stage.stored('mag_2') is None
    np.testing.assert_array_equal(stored['mag_1'].background, stage.background('mag_1'))
    np.testing.assert_array_equal(stored['mag_1'].covariance,
                                  stage.backgrounds()['mag_1'].covariance)
    assert stored['mag_1'].stamp_ns == stage.last_stamp_ns('mag_1')
    assert [p.name for p in path.parent.iterdir()] == ['b.json']


def test_the_first_reading_after_a_restart_is_calibrated(tmp_path):
    """A target that has arrived during the restart must not become part of the background."""
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, CalibrateSettings())
    stage.resume(stored)
    out = [c for s in readings(1012.0, 8.0, 1, STEP) for c in fed(stage, s)]
    assert len(out) == 8 * RATE and out[0].stamp_ns == 1012 * NS
    fields = np.array([c.field for c in out])
    np.testing.assert_allclose(fields.mean(axis=0), STEP, atol=6e-9)
    assert stage.backgrounds()['mag_1'].frozen and stage.counts['backgrounds restored'] == 1
    # The target leaves, and the background is learnt as usual.
    for s in readings(1020.0, 10.0, 2):
        out += fed(stage, s)
    assert not stage.backgrounds()['mag_1'].frozen
    # At its end, a line fitted to 10 s of readings has a standard deviation of 2 nT.
    np.testing.assert_allclose(stage.background('mag_1'), EARTH, atol=6e-9)


@pytest.mark.parametrize('begin_s, max_resume_gap_s', [
    (1009.0, 60.0), (1009.98, 60.0), (1080.0, 60.0), (1020.0, 5.0)])
def test_a_background_of_another_time_is_not_resumed(tmp_path, begin_s, max_resume_gap_s):
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, CalibrateSettings(max_resume_gap_s=max_resume_gap_s))
    stage.resume(stored)
    assert not [c for s in readings(begin_s, 2.0, 1) for c in fed(stage, s)]
    assert count_of(stage.counts, 'outdated') == 1
    assert stage.stored('mag_1') is None


@pytest.mark.parametrize('has_begun', [False, True])
def test_forget_discards_stored_backgrounds(tmp_path, has_begun):
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, SETTINGS)
    stage.resume(stored)
    if has_begun:
        fed(stage, readings(1011.0, 1.0, 1)[0])
    stage.forget()
    assert not [c for s in readings(1011.5, 2.0, 1, STEP) for c in fed(stage, s)]
    out = [c for s in readings(1013.5, 8.0, 1, STEP) for c in fed(stage, s)]
    assert np.abs(np.mean([c.field for c in out], axis=0)).max() < 6e-9


@pytest.mark.parametrize('change', [
    {'offset': (np.array([1e-6, 0.0, 0.0]), None)}, {'clock_offset': (0.1, 0.0)}])
def test_a_changed_calibration_discards_stored_backgrounds(tmp_path, change):
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, SETTINGS)
    stage.resume(stored)
    stage.update_network(replace(network, **change))
    assert not [c for s in readings(1011.0, 2.0, 1) for c in fed(stage, s)]


def test_a_sensor_moved_before_the_restart_is_relearnt(tmp_path):
    """The background is relearnt even with `relearn_s` = 0, which otherwise disables this."""
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, CalibrateSettings(relearn_s=0.0))
    stage.resume(stored)
    out = [c for s in readings(1040.0, 20.0, 1, 25.0 * STEP) for c in fed(stage, s)]
    late = np.array([c.field for c in out if c.stamp_ns > 1052 * NS])
    assert np.abs(late.mean(axis=0)).max() < 6e-9
    assert stage.backgrounds()['mag_1'].n_relearnt == 1
    # A later steady change is treated as a target, without a time limit.
    out = [c for s in readings(1060.0, 60.0, 2, 26.0 * STEP) for c in fed(stage, s)]
    np.testing.assert_allclose(np.mean([c.field for c in out], axis=0), STEP, atol=1e-8)


def test_a_confirmed_background_is_kept_without_relearning(tmp_path):
    """With `relearn_s` = 0, a target that arrives later and stays is not relearnt."""
    network, stored = write_and_read_back(tmp_path / 'kept.json')
    stage = Calibrate(network, CalibrateSettings(relearn_s=0.0))
    stage.resume(stored)
    for s in readings(1012.0, 10.0, 1):
        fed(stage, s)
    out = [c for s in readings(1022.0, 40.0, 2, STEP) for c in fed(stage, s)]
    np.testing.assert_allclose(np.mean([c.field for c in out], axis=0), STEP, atol=1.5e-8)
    assert stage.backgrounds()['mag_1'].n_relearnt == 0


@pytest.mark.parametrize('change', [
    {'offset': (np.array([1e-6, 0.0, 0.0]), None)}, {'clock_offset': (0.1, 0.0)},
    {'background': (EARTH + 5e-6, None)},
    {'positions': np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])}])
def test_a_background_of_another_network_file_is_refused(tmp_path, change):
    network, _ = write_and_read_back(tmp_path / 'kept.json')
    stored, refused = read_backgrounds(tmp_path / 'kept.json', replace(network, **change), SETTINGS)
    assert stored == {} and 'another network' in refused['mag_1']


def test_a_background_of_other_settings_is_refused(tmp_path):
    network, _ = write_and_read_back(tmp_path / 'kept.json')
    stored, refused = read_backgrounds(
        tmp_path / 'kept.json', network, CalibrateSettings(decimate_to_hz=10.0))
    assert stored == {} and 'other settings' in refused['mag_1']
    assert read_backgrounds(tmp_path / 'none.json', network, SETTINGS) == ({}, {})


@pytest.mark.parametrize('change, message', [
    (lambda c: 'not json', 'Expecting value'), (lambda c: '[' * 100_000, 'recursion'),
    (lambda c: json.dumps([1]), 'of version'),
    (lambda c: json.dumps({**c, 'version': 2}), 'version 1'),
    (lambda c: json.dumps({'version': 1}), 'of version')])
def test_an_invalid_file_is_refused(tmp_path, change, message):
    path = tmp_path / 'kept.json'
    network, _ = write_and_read_back(path)
    path.write_text(change(json.loads(path.read_text())))
    with pytest.raises(RecordingError, match=message):
        read_backgrounds(path, network, SETTINGS)


@pytest.mark.parametrize('key, value, reason', [
    ('background', [1.0, 2.0], 'not valid: the background'),
    ('covariance', [[0.0] * 3] * 3, 'definite'), ('stamp_ns', None, 'ns None'),
    ('made_of', None, 'another network'), ('covariance', ..., 'no covariance'),
    ('background', {}, 'entry is')])
def test_an_invalid_entry_affects_no_other(tmp_path, key, value, reason):
    path = tmp_path / 'kept.json'
    network, stage = learnt_stage()
    for s in readings(1000.0, 10.0, 1):
        fed(stage, replace(s, sensor='mag_2'))
    write_backgrounds(path, {name: background_text(stage.stored(name), network, j, SETTINGS)
                             for j, name in enumerate(network.names)})
    content = json.loads(path.read_text())
    content['sensors']['mag_1'][key] = value
    if value is ...:
        del content['sensors']['mag_1'][key]
    path.write_text(json.dumps(content))
    stored, refused = read_backgrounds(path, network, SETTINGS)
    assert list(stored) == ['mag_2'] and list(refused) == ['mag_1'] and reason in refused['mag_1']


def test_an_axis_without_enough_readings_is_not_stored(tmp_path):
    network = network_without_backgrounds()
    stage = Calibrate(network, SETTINGS)
    for k, s in enumerate(readings(1000.0, 10.0, 0)):
        field = s.field.copy()
        field[2] = field[2] if k in (400, 401) else np.nan
        fed(stage, replace(s, field=field))
    stored = stage.stored('mag_1')
    assert np.isnan(stored.background).tolist() == [False, False, True]
    write_backgrounds(tmp_path / 'k', {'mag_1': background_text(stored, network, 0, SETTINGS)})
    restored, refused = read_backgrounds(tmp_path / 'k', network, SETTINGS)
    assert not refused
    np.testing.assert_array_equal(restored['mag_1'].background, stored.background)


def test_an_unwritable_path_is_reported(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='directory|exists'):
        write_backgrounds(tmp_path / 'file' / 'kept.json', {})
    with pytest.raises(OutputError):
        write_backgrounds('/', {})


def test_each_network_file_and_node_has_its_own_default_path(monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    path = default_path('/a/network.yaml', '/calibration_node')
    others = {default_path('/b/network.yaml', '/calibration_node'),
              default_path('/a/network.yaml', '/north/calibration_node')}
    assert len(others | {path}) == 3
    assert {p.parent for p in others | {path}} == {tmp_path / 'mag_tracking'}
    assert path.name.startswith('network_')
    monkeypatch.delenv('ROS_HOME')
    assert default_path('network.yaml', '/n').parent == Path(
        os.path.expanduser('~/.ros/mag_tracking'))
