"""Marks and repetitions are left out by the calibration, live and offline, with their numbers."""

import dataclasses

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.apps.doctor import Doctor
from mag_tracking.calibration.sensor_state import N_WINDOW
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Readings, Track
from mag_tracking.stages.calibrate.prescan import prescan
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.diagnosis import Cause, ranked
from mag_tracking.units import NS
from support.bundled import NETWORK_FILE
from support.spoilt_runs import recorded

NETWORK = mt.read_network(NETWORK_FILE)
SETTINGS = settings_for('vehicle')
RECORDING = 'straight_car_right'


def repeated(n, sensors):
    """Every `n`-th reading of some sensors is published `n` times, newly stamped."""
    def modify(readings):
        field, is_measured = readings.field.copy(), np.ones(len(readings), dtype=bool)
        for j in sensors:
            rows = np.flatnonzero(readings.sensor == j)
            source = rows[np.arange(len(rows)) // n * n]
            field[rows], is_measured[rows] = field[source], rows == source
        return dataclasses.replace(readings, field=field, covariance=None), \
            dataclasses.replace(readings, covariance=None).part(is_measured)
    return modify


def marked(value, every, axes=(0, 1, 2)):
    """Every `every`-th reading of each sensor is `value` on some axes."""
    def modify(readings):
        field, without = readings.field.copy(), readings.field.copy()
        for j in range(len(readings.names)):
            rows = np.flatnonzero(readings.sensor == j)[every - 1::every]
            field[rows[:, None], list(axes)] = value
            without[rows[:, None], list(axes)] = np.nan
        return dataclasses.replace(readings, field=field, covariance=None), \
            dataclasses.replace(readings, field=without, covariance=None)
    return modify


FAULTS = {'mark of zero': marked(0.0, 25), 'huge mark': marked(1e296, 2),
          'mark on z': marked(9.9999e-5, 40, (2,)), 'repeated': repeated(5, (0, 1)),
          'one repeated': repeated(3, (1,))}
"""{name: function that returns readings with a fault, and the same readings without the faulty
ones}."""


def closest_pose(readings, is_live):
    """Pose nearest to the sensors, of the longest track."""
    pipeline, tracks = Pipeline(NETWORK, SETTINGS), []
    if not is_live:
        prescan([readings], NETWORK, SETTINGS.calibrate).apply(pipeline.calibrate)
    for part in np.array_split(np.arange(len(readings)), 200):
        tracks += [r for r in pipeline.feed(readings.part(part)) if isinstance(r, Track)]
    poses = [t for t in tracks if t.position is not None]
    return min(poses, key=lambda t: np.hypot(*t.position[:2]))


@pytest.mark.parametrize('fault', FAULTS)
def test_the_track_of_a_recording_is_that_of_the_other_readings(fault):
    faulty, others = FAULTS[fault](recorded(RECORDING).readings)
    found, expected = closest_pose(faulty, False), closest_pose(others, False)
    assert found.stamp_ns == expected.stamp_ns and found.ambiguous == expected.ambiguous
    np.testing.assert_allclose(found.position, expected.position, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('fault', FAULTS)
def test_live_readings_give_the_same_track_after_the_fault_is_found(fault):
    faulty, others = FAULTS[fault](recorded(RECORDING).readings)
    found, expected = closest_pose(faulty, True), closest_pose(others, True)
    deviation = np.sqrt(np.diagonal(found.covariance)[:3] + np.diagonal(expected.covariance)[:3])
    assert (np.abs(found.position - expected.position) < 3.0 * deviation).all()
    assert not found.ambiguous


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('fault, cause, words', [
    ('mark of zero', Cause.NO_READING_MARK, ('value 0 nT',)),
    ('huge mark', Cause.NO_READING_MARK, ('value 1e+296 T',)),
    ('mark on z', Cause.NO_READING_MARK, ('z = 99999 nT',)),
    ('repeated', Cause.REPEATED, ('repeated 5 times', 'at 20 Hz', 'at 100 Hz')),
    ('one repeated', Cause.REPEATED, ('repeated 3 times', 'at 33.3 Hz', 'at 100 Hz'))])
@pytest.mark.parametrize('is_live', [True, False])
def test_the_doctor_names_the_fault_and_nothing_else(fault, cause, words, is_live):
    readings, _ = FAULTS[fault](recorded(RECORDING).readings)
    doctor = Doctor(Pipeline(NETWORK, SETTINGS, 'calibrate'))
    if not is_live:
        prescan([readings], NETWORK, SETTINGS.calibrate).apply(doctor.calibrate)
    for k in range(0, len(readings), 50):
        doctor.feed(readings.part(slice(k, k + 50)))
    diagnoses = ranked(doctor.findings())
    faulty = ('mag_2',) if fault == 'one repeated' else ('mag_1', 'mag_2')
    assert [(d.finding.subject, d.finding.cause) for d in diagnoses] == [
        (name, cause) for name in faulty], [str(d) for d in diagnoses]
    assert all(word in d.finding.fault for d in diagnoses for word in words)
    for health in doctor.sensors.values():
        assert 9e1 < health.rate < 1.1e2 and 2e-5 < np.linalg.norm(health.field) < 7e-5
        assert (health.noise_std < 4e-8).all()


def test_the_rate_of_the_measurements_is_too_low_despite_the_repetitions():
    readings = recorded(RECORDING).readings
    rows = [np.flatnonzero(readings.sensor == j)[::5] for j in range(len(readings.names))]
    readings, _ = repeated(10, (0, 1))(readings.part(np.sort(np.concatenate(rows))))
    doctor = Doctor(Pipeline(NETWORK, SETTINGS, 'calibrate'))
    doctor.feed(readings)
    for diagnosis in ranked(doctor.findings()):
        assert diagnosis.finding.cause is Cause.REPEATED
        assert '2 Hz' in str(diagnosis)


def test_the_number_of_marks_is_that_of_the_recording():
    readings, _ = marked(9.9999e-5, 40)(recorded(RECORDING).readings)
    pipeline = Pipeline(NETWORK, SETTINGS)
    prescan([readings], NETWORK, SETTINGS.calibrate).apply(pipeline.calibrate)
    pipeline.feed(readings)
    for j, name in enumerate(NETWORK.names):
        assert pipeline.calibrate.driver_faults.n_marked(name) == (readings.sensor == j).sum() // 40
    assert any('99999 nT' in cause for cause in pipeline.rejections())


@pytest.mark.parametrize('window', range(4, 9))
def test_marks_are_found_in_every_later_window(window):
    """Windows without a jump are not searched."""
    rng, n = np.random.default_rng(0), 10 * N_WINDOW
    field = 1e-6 * np.array([2.0, 15.5, -49.0]) + rng.normal(0.0, 2e-8, (n, 3))
    field[window * N_WINDOW + 100:window * N_WINDOW + 300:20] = 9.9999e-5
    stamps = 1_790_000_000 * NS + 10_000_000 * np.arange(n)
    calibrate = Calibrate(NETWORK, SETTINGS.calibrate)
    calibrate.feed(Readings(('mag_1',), np.zeros(n, dtype=np.int64), stamps, field))
    assert calibrate.driver_faults.of('mag_1').marks.tolist() == [[9.9999e-5] * 3]
