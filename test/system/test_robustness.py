"""Regression tests for faults found in reviews."""

import dataclasses
import json

import numpy as np
import pytest

from mag_tracking.apps.replay import replay
from mag_tracking.cli import main
from mag_tracking.errors import NetworkError, OutputError
from mag_tracking.messages.schema import odometry_dict, pose_covariance
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Detection, FieldFrame, Track
from mag_tracking.results import result_folder
from mag_tracking.simulation.scenario import Path
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import AlignSettings, CalibrateSettings
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.track.manager import TrackManager
from support.bundled import NETWORK_FILE, QUICK, vehicle_path
from support.calibration_runs import EARTH, SIGMA, feed, running, sample, stage
from support.counters import assert_counts, count_of
from support.marks import studied
from support.networks import line_network
from support.samples import MagSample, fed, one, recorded
from support.scenario import point_body
from support.track_runs import drive, magnet_frames

NAME = 'straight_car_right'


def test_a_replay_does_not_overwrite_its_recording(tmp_path, road_network):
    path = tmp_path / 'tracks.mcap'
    path.write_bytes(vehicle_path(NAME).read_bytes())
    with pytest.raises(OutputError, match='recording'):
        replay(Recording(path), road_network, settings_for('vehicle'), tmp_path)
    assert path.read_bytes() == vehicle_path(NAME).read_bytes()
    (tmp_path / 'links').mkdir()
    link = tmp_path / 'links' / 'tracks.mcap'
    link.symlink_to(path)
    with pytest.raises(OutputError, match='recording'):
        replay(Recording(link), road_network, settings_for('vehicle'), tmp_path / 'links')
    with RecordingWriter(tmp_path / 'other' / 'a.mcap'):
        pass
    with pytest.raises(OutputError, match='another recording'):
        RecordingWriter(tmp_path / 'other' / 'b.mcap')


def test_recordings_of_the_same_name_are_refused(tmp_path, capsys):
    (tmp_path / 'b').mkdir()
    other = tmp_path / 'b' / f'{NAME}.mcap'
    other.write_bytes(vehicle_path(NAME).read_bytes())
    assert main(['replay', str(vehicle_path(NAME)), str(other), '--network', str(NETWORK_FILE),
                 '--out', str(tmp_path / 'out')]) == 1
    assert 'several recordings' in capsys.readouterr().err


def test_a_looped_recording_gives_the_same_track_again(road_network):
    samples = recorded(SampleReader(Recording(vehicle_path(NAME)), road_network))
    pipeline = Pipeline(road_network, settings_for('vehicle'))
    loops = []
    for _ in range(2):
        tracks = [r for s in samples for r in pipeline.feed(one(s)) if isinstance(r, Track)]
        loops.append([t for t in tracks if not t.ended])
    # The restart changes the phase of the frame grid, so frames at the end may differ.
    assert abs(len(loops[0]) - len(loops[1])) <= 1
    a, b = ({t.stamp_ns: t.position for t in loop} for loop in loops)
    common = sorted(set(a) & set(b))
    assert len(common) >= len(a) - 2
    np.testing.assert_allclose([a[k] for k in common], [b[k] for k in common], rtol=1e-9)


@pytest.mark.parametrize('step', [0.0, 2e-6])
def test_a_stuck_sensor_is_not_learnt_and_a_coarse_one_is_not_noiseless(step):
    b = running()
    rng = np.random.default_rng(0)
    for t in np.arange(0, 10, 0.01):
        value = EARTH + SIGMA * rng.standard_normal(3)
        b.add(t, np.round(value / step) * step if step else EARTH)
    # A coarse sensor is as accurate as its steps; a sensor that never changes may be stuck.
    assert b.ready == (step > 0.0) and b.stuck == (step == 0.0)
    assert not step or (np.sqrt(b.covariance.diagonal()) > step / 4.0).all()


def test_a_sensor_that_gets_stuck_keeps_its_noise():
    b = running(memory=3.0)
    feed(b, np.arange(0, 6, 0.01))
    for t in np.arange(6, 20, 0.01):
        b.add(t, EARTH)
    assert np.diagonal(b.covariance).min() > 0.5 * (SIGMA**2).min()


def test_a_missing_covariance_between_nodes_is_replaced_or_rejected():
    align = Align(line_network(1), AlignSettings())
    out = [f for k in range(30) for f in align.feed(one(
        MagSample(k * 10_000_000, 'mag_1', np.zeros(3), None)))]
    np.testing.assert_allclose(out[0].covariance[0], 1.44e-16 * np.eye(3) / 8)
    align = Align(dataclasses.replace(line_network(1), noise_std=(None,)), AlignSettings())
    align.feed(one(MagSample(0, 'mag_1', np.zeros(3), None)))
    align.feed(one(MagSample(1, 'mag_1', np.full(3, np.inf), None)))
    finite, unknown = sorted(rejected(align.counts))
    assert 'finite' in finite and 'noise_std' in unknown


def test_an_axis_with_occasional_dropouts_is_learnt():
    b = running()
    rng = np.random.default_rng(0)
    for k, t in enumerate(np.arange(0, 20, 0.01)):
        value = EARTH + SIGMA * rng.standard_normal(3)
        if k % 37 == 0:
            value[0] = np.nan
        b.add(t, value)
    assert np.isfinite(b.covariance).all()
    assert np.abs((b.level(20.0) - EARTH) / SIGMA).max() < 0.5
    np.testing.assert_allclose(np.sqrt(np.diagonal(b.covariance)), SIGMA, rtol=0.1)


def test_a_present_axis_never_has_an_unknown_covariance():
    """Two axes are learnt, then a third axis begins to report and is held back and counted."""
    network = dataclasses.replace(line_network(2), noise_std=(None, None))
    s = Calibrate(network, CalibrateSettings())
    rng = np.random.default_rng(0)
    out = []
    for k in range(1000):
        field = EARTH + SIGMA * rng.standard_normal(3)
        if k < 800:
            field[2] = np.nan
        out += fed(s, sample(0.01 * k, field))
    for r in out:
        present = ~np.isnan(r.field)
        assert present.any() and np.isfinite(r.covariance[np.ix_(present, present)]).all()
    assert count_of(s.counts, 'axes held') > 0


def test_a_corrupt_timestamp_rejects_a_single_sample():
    s = stage()
    for t in (1.0, 1.1, 3601.0, 1.2, 1.3):
        fed(s, sample(t))
    assert_counts(rejected(s.counts), {'ahead': 1})
    assert s.counts['calibrated'] == 4
    # A real gap is confirmed by the next sample.
    assert fed(s, sample(7200.0)) == [] and len(fed(s, sample(7200.1))) == 1


def test_the_background_of_a_slow_sensor_is_learnt():
    b = running(learn=20.0)
    feed(b, np.arange(0, 120, 0.5))
    assert b.ready and not b.frozen


@pytest.mark.parametrize('seed', studied(range(3), kept=(0,)))
def test_a_pass_causes_no_second_detection(seed):
    """A background learnt in three seconds remains valid during a whole pass."""
    network = dataclasses.replace(line_network(2), noise_std=(None, None))
    tracks, pipeline, _ = drive(network, point_body([200.0, -150.0, 80.0], 5.0, 0.5),
                                Path(np.array([-80.0, -1.2]), 0.0, 10.0), duration=30.0, seed=seed)
    assert pipeline.detect.counts['onsets'] == 1


@pytest.mark.parametrize('content, message', [
    (b'sensors: {"m\xff": 1}', 'not valid YAML'),
    (b'sensors:\n  "m 1": {position: [0, 0, 0]}', 'm 1'),
    (b'sensors:\n  1abc: {position: [0, 0, 0]}', '1abc'),
    (b'frame:\nsensors:\n  a: {position: [0, 0, 0]}', 'frame: '),
    (b'sensors:\n  a: {position: [0, 0, 0], noise_std: 12.0}', 'millitesla'),
    (b'sensors:\n  a: {position: [0, 0, 0], background: [15.0, 0, 0]}', 'microtesla'),
    (b'sensors:\n  a: {position: [0, 0, ' + b'9' * 400 + b']}', 'finite'),
    (b'sensors:\n  [a]: {position: [0, 0, 0]}', 'valid key'),
])
def test_invalid_network_files_are_refused(tmp_path, content, message):
    path = tmp_path / 'network.yaml'
    path.write_bytes(content)
    with pytest.raises(NetworkError, match=message):
        read_network(path)


def test_a_full_disk_is_reported(tmp_path, capsys, monkeypatch):
    out = tmp_path / 'out'
    monkeypatch.setattr(result_folder, 'new_text_file', lambda *_, **__: open('/dev/full', 'w'))
    assert main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE),
                 '--out', str(out), '--no-figures']) == 1
    assert 'No space' in capsys.readouterr().err


def test_a_summary_with_non_finite_numbers_is_valid_json(tmp_path):
    with result_folder.ResultFolder(tmp_path, line_network(2)) as folder:
        folder.write_summary({'a': float('nan'), 'b': [1.0, float('inf')]})
    assert json.loads((tmp_path / 'summary.json').read_text()) == {'a': None, 'b': [1.0, None]}


def test_the_existence_probability_of_a_target_decreases_without_a_signal():
    network = line_network(2)
    stage_ = TrackManager(network, settings_for('vehicle').track)
    rng = np.random.default_rng(0)
    C = np.repeat(1.44e-16 * np.eye(3)[None] / 8, 2, axis=0)
    tracks = []
    for k in range(40):
        y = 1.2e-8 / np.sqrt(8) * rng.standard_normal((2, 3))
        tracks += stage_.feed(FieldFrame(k * 80_000_000, y, C, np.full(2, 8), np.zeros(2),
                                         True, 6.0, 6))
    assert [t for t in tracks if isinstance(t, Track)][-1].existence < 0.5


def test_the_pose_covariance_matches_sampled_states():
    """Position, rotation and cross terms are compared with states sampled from the track's
    Gaussian."""
    network, frames, _ = magnet_frames(4)
    stage_ = TrackManager(network, settings_for('magnet').track)
    track = [t for f in frames for t in stage_.feed(f)][-1]
    bank = stage_.bank
    rng = np.random.default_rng(1)
    x = rng.multivariate_normal(bank.x[0, :12], bank.P[0, :12, :12], 200_000)
    m = track.moment
    # Rotation of m to the sampled moment, to first order.
    w = np.cross(m, x[:, 6:9]) / (m @ m)
    sampled = np.cov(np.hstack([x[:, :3], w]).T)
    published = pose_covariance(track).copy()
    published[3:, 3:] -= np.pi**2 * np.outer(m, m) / (m @ m)
    sd = np.sqrt(np.diagonal(sampled))
    assert np.abs((sampled - published) / np.outer(sd, sd)).max() < 0.03
    # The cross terms are large enough to reveal a wrong sign.
    assert np.abs(published[:3, 3:] / np.outer(sd[:3], sd[3:])).max() > 0.1


def test_the_odometry_twist_is_in_the_child_frame():
    tracks, _, _ = drive(line_network(2), point_body([200.0, -150.0, 80.0], 5.0, 0.5),
                         Path(np.array([1.2, -70.0]), np.pi / 2, 10.0),
                         {'track.vehicle.arrival_names': ['south'],
                          'track.vehicle.arrival_headings_deg': [90.0]})
    live = [t for t in tracks if not t.ended]
    track = live[len(live) // 2]
    twist = odometry_dict(track, 'map', 'c')['twist']
    speed = np.hypot(*track.velocity[:2])
    assert twist['twist']['linear']['x'] == pytest.approx(speed)
    assert twist['twist']['linear']['y'] == pytest.approx(0.0, abs=1e-9)
    u = track.velocity[:2] / speed
    C = np.array(twist['covariance']).reshape(6, 6)
    assert C[0, 0] == pytest.approx(u @ track.covariance[3:5, 3:5] @ u, rel=1e-6)


def test_detection_ids_count_the_onsets(road_network):
    pipeline = Pipeline(road_network, settings_for('vehicle', QUICK))
    samples = recorded(SampleReader(Recording(vehicle_path(NAME)), road_network))
    events = [(r.id, r.onset) for s in samples for r in pipeline.feed(one(s))
              if isinstance(r, Detection)]
    assert events == [(1, True), (1, False)]
