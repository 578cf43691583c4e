"""Pass events of single sensors: time and direction of a pass, and their uncertainties."""

import csv
import dataclasses

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.cli import main
from mag_tracking.event_records import PassEvent
from mag_tracking.inference.driving_direction import rotation_of_pass
from mag_tracking.messages.schema import pass_event_dict
from mag_tracking.physics.dipole import dipole_field
from mag_tracking.pipeline import settings_for
from mag_tracking.records import Readings
from mag_tracking.results.columns import EVENTS, names_of
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.events.stage import Events, closest_point
from mag_tracking.stages.track.manager import NO_SCALE_FRAMES
from mag_tracking.units import NS
from support import spoiler
from support.bundled import LINEARISED_ONCE, NETWORK_FILE, VEHICLES, vehicle_path
from support.counters import count_of
from support.marks import studied
from support.spoilt_runs import recorded

NETWORK = mt.read_network(NETWORK_FILE)
ONE_AXIS = 'mag_1'


def passing(rng, noise=0.0, height=0.0, left_to_right=True, n=200):
    """Simulate a dipole on a straight path; return (t, field (n, 3), time of the CPA, time scale).

    The target passes north of the sensor, and x points east. The unit of length is the lateral
    distance. The time scale is the distance at the CPA divided by the speed.
    """
    speed, t_cpa = rng.uniform(0.5, 3.0), rng.uniform(-1.0, 1.0)
    span = 6.0 * np.hypot(1.0, height) / speed
    t = np.linspace(t_cpa - span, t_cpa + span, n)
    along = speed * (t - t_cpa) * (1.0 if left_to_right else -1.0)
    r = np.column_stack([along, np.ones(n), np.full(n, height)])
    field = dipole_field(-r, rng.standard_normal(3))
    field /= np.abs(field).max()
    return t, field + noise * rng.standard_normal((n, 3)), t_cpa, np.hypot(1.0, height) / speed


@pytest.mark.parametrize('axes', ['xyz', 'xy', 'x', 'z'])
@pytest.mark.parametrize('noise', [1e-4, 0.03, 0.1])
def test_the_time_of_the_cpa_of_a_dipole_is_found(axes, noise):
    rng, ratios, errors = np.random.default_rng(0), [], []
    for _ in range(40):
        t, field, t_cpa, scale = passing(rng, noise, rng.uniform(0.0, 0.5))
        field[:, [k for k, a in enumerate('xyz') if a not in axes]] = np.nan
        if np.nanmax(np.abs(field)) < 5.0 * noise:
            continue
        found = closest_point(t, field, np.full(3, noise))
        if np.isfinite(found.time_std):
            ratios.append((found.time - t_cpa) / found.time_std)
            errors.append(abs(found.time - t_cpa) / scale)
    # A dipole has no offset of its magnetic centre, so the standard deviation is conservative.
    assert len(ratios) > 20 and np.mean(np.abs(ratios) < 3.0) > 0.95
    assert noise > 1e-3 or np.median(errors) < 0.02, np.median(errors)


@pytest.mark.parametrize('left_to_right', [True, False])
def test_the_rotation_of_the_field_gives_the_direction_for_any_moment(left_to_right):
    rng = np.random.default_rng(1)
    for _ in range(200):
        _, field, _, _ = passing(rng, 1e-6, 0.0, left_to_right)
        found = rotation_of_pass(field[:, :2], 1e-6, 50)
        assert (found.correlation < 0.0) == left_to_right
        assert found.error_probability < 1e-6


@pytest.mark.parametrize('noise', [0.1, 0.3, 0.5])
def test_the_probability_of_the_direction_is_calibrated(noise):
    """The mean probability equals the proportion of correct directions (PHD15 Paper B)."""
    rng, probability, is_correct = np.random.default_rng(2), [], []
    for _ in range(600):
        direction = bool(rng.integers(2))
        _, field, _, _ = passing(rng, noise, 0.0, direction)
        p = rotation_of_pass(field[:, :2], noise, 50).left_to_right
        probability.append(max(p, 1.0 - p))
        is_correct.append((p > 0.5) == direction)
    # 0.05 is the specified limit, to which three standard deviations of the count are added.
    assert abs(np.mean(probability) - np.mean(is_correct)) < 0.05 + 3.0 * 0.5 / np.sqrt(600)


def test_the_direction_does_not_depend_on_the_heading_of_the_sensor():
    rng = np.random.default_rng(3)
    _, field, _, _ = passing(rng, 1e-3)
    c, s = np.cos(1.1), np.sin(1.1)
    rotated = field[:, :2] @ np.array([[c, -s], [s, c]])
    assert rotation_of_pass(rotated, 1e-3, 50) == pytest.approx(
        rotation_of_pass(field[:, :2], 1e-3, 50))


def test_too_few_readings_give_no_direction_and_no_cpa():
    assert rotation_of_pass(np.zeros((3, 2)), 1.0, 1) is None
    assert rotation_of_pass(np.zeros((50, 2)), 1.0, 10) is None
    assert closest_point(np.arange(5.0), np.ones((5, 3)), np.ones(3)).time_std == np.inf
    assert np.isnan(closest_point(np.zeros(0), np.zeros((0, 3)), np.ones(3)).time)


def test_alternately_missing_axes_give_the_time_of_the_largest_field():
    t, field, _, _ = passing(np.random.default_rng(3))
    strongest = t[np.argmax(np.square(field[:, 0]) * (np.arange(len(t)) % 2))]
    field = field.copy()
    field[::2, 0] = field[1::2, 1:] = np.nan
    field[::2, 1:] *= 1e-3
    found = closest_point(t, field, np.ones(3))
    assert (found.time, found.time_std) == (strongest, np.inf) and np.isnan(found.time_scale)


def events_of(readings, network=NETWORK, batch=None):
    """Calibrate raw readings and create the events; return [PassEvent]."""
    settings = settings_for('vehicle')
    calibrate, stage = Calibrate(network, settings.calibrate), Events(
        network, settings.align, settings.detect, settings.track)
    size, out = batch or len(readings), []
    for i in range(0, len(readings), size):
        for calibrated in calibrate.feed(readings.part(slice(i, i + size))):
            out += stage.feed(calibrated)
    for calibrated in calibrate.flush():
        out += stage.feed(calibrated)
    return out + stage.flush()


def truth_of(name, sensor):
    """Ground truth: (time of the CPA [ns], whether the vehicle passed from left to right)."""
    ((stamps, position, _),) = recorded(name).truth.values()
    r = position - NETWORK.positions[NETWORK.index(sensor)]
    k = int(np.linalg.norm(r, axis=1).argmin())
    v = position[k] - position[k - 1]
    return stamps[k], r[k, 0] * v[1] - r[k, 1] * v[0] < 0.0


@pytest.mark.parametrize('name', studied(VEHICLES, kept=('straight_car_right',)))
@pytest.mark.parametrize('sensor', ['mag_1', 'mag_2'])
def test_a_single_sensor_gives_the_time_and_direction_of_a_pass(name, sensor):
    single = NETWORK.part(np.array([NETWORK.index(sensor)]))
    (event,) = events_of(spoiler.only_sensor(sensor)(recorded(name).readings), single)
    closest, left_to_right = truth_of(name, sensor)
    assert event.ended and event.number == 1 and event.axes == 'xyz'
    assert abs(event.closest_ns - closest) / 1e9 < 3.0 * event.closest_std
    assert (event.left_to_right > 0.9) if left_to_right else (event.left_to_right < 0.1)
    assert event.onset_ns <= event.peak_ns <= event.release_ns and event.energy > 0.0
    assert event.signature.shape == (33, 3)


@pytest.mark.parametrize('name', studied(VEHICLES, kept=('straight_truck_right',)))
@pytest.mark.parametrize('axis', ['x', 'z'])
def test_a_single_axis_gives_an_event_without_a_direction(name, axis):
    """The sensor with the larger signal is used, because the other signal may be too weak."""
    peak = {s: np.abs(f - np.median(f, axis=0)).max() for s in NETWORK.names for f in [
        recorded(name).readings.field[np.array(recorded(name).readings.sensor_names()) == s]]}
    sensor = max(peak, key=peak.get)
    single = NETWORK.part(np.array([NETWORK.index(sensor)]))
    readings = spoiler.apply(recorded(name).readings, spoiler.only_sensor(sensor),
                             spoiler.only_axes(axis))
    events = events_of(readings, single)
    event = max(events, key=lambda e: e.energy)
    assert len(events) <= 2 and event.axes == axis and event.left_to_right == 0.5
    assert np.isnan(event.peak).sum() == 2
    # With a single axis, the CPA of a long or turning vehicle is less accurate.
    assert abs(event.closest_ns - truth_of(name, sensor)[0]) / 1e9 < 4.0 * event.closest_std
    result = mt.track(readings, single)
    assert len(result.poses) == 0 and len(result.detections)


def test_a_single_sensor_tracks_only_with_a_prior_and_its_poses_are_ambiguous():
    single = NETWORK.part(np.array([0]))
    readings = spoiler.only_sensor('mag_1')(recorded('straight_car_right').readings)
    result = mt.track(readings, single)
    assert not len(result.poses)
    assert count_of(result.report.counts['track'], 'detections not') > 0
    result = mt.track(readings, single, settings={'track.single_sensor_prior': True})
    assert len(result.poses) and result.poses['ambiguous'].all()
    assert result.smoothed['ambiguous'].all()


def test_a_network_with_a_single_active_sensor_tracks_only_with_a_prior():
    readings = spoiler.only_sensor('mag_2')(recorded('straight_car_right').readings)
    result = mt.track(readings, NETWORK)
    assert len(result.detections) and not len(result.poses)
    assert result.report.counts['track'][NO_SCALE_FRAMES] > 10
    result = mt.track(readings, NETWORK, settings={'track.single_sensor_prior': True})
    assert len(result.poses) and result.poses['ambiguous'].all()


def test_a_track_that_begins_when_a_sensor_returns_is_ambiguous():
    readings = recorded('straight_car_right').readings
    seconds = (readings.stamp_ns - readings.stamp_ns.min()) / NS
    silent = (np.array(readings.sensor_names()) == 'mag_2') & (seconds > 4.0) & (seconds < 8.5)
    begin_ns = mt.track(readings, NETWORK, settings=LINEARISED_ONCE).poses['stamp_ns'][0]
    assert begin_ns < readings.stamp_ns[silent].max(), 'no track begins during the dropout'
    result = mt.track(readings.part(~silent), NETWORK, settings=LINEARISED_ONCE)
    assert result.report.counts['track'][NO_SCALE_FRAMES] > 0
    assert len(result.poses) and result.poses['ambiguous'].all()
    assert result.poses['stamp_ns'][0] > readings.stamp_ns[silent].max() - 0.1 * NS


def test_events_do_not_depend_on_batches():
    readings = recorded('straight_car_right').readings
    expected = events_of(readings)
    for size in (1, 37, 1000):
        found = events_of(readings, batch=size)
        for a, b in zip(*(sorted(events, key=lambda e: e.sensor) for events in (expected, found)),
                        strict=True):
            for field in dataclasses.fields(PassEvent):
                np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


@pytest.mark.parametrize('size', [1, 256, 10**6])
def test_a_looped_recording_gives_each_event_again(size):
    readings = recorded('straight_car_right').readings
    expected = {e.sensor: e for e in events_of(readings)}
    # The second part ends while the car is present.
    t = (readings.stamp_ns - readings.stamp_ns[0]) / 1e9
    joined = Readings.joined([readings, readings.part(t < 8.6), readings])
    events = events_of(joined, batch=size)
    for name, event in expected.items():
        sensor_events = [e for e in events if e.sensor == name]
        assert [e.ended for e in sensor_events] == [True, False, True]
        assert sensor_events[0].left_to_right == event.left_to_right
        assert sensor_events[0].energy == pytest.approx(event.energy)
        assert sensor_events[2].left_to_right == event.left_to_right
        assert sensor_events[1].release_ns > sensor_events[1].onset_ns \
            and sensor_events[1].energy > 0.0


@pytest.mark.parametrize('name', studied(VEHICLES, kept=('straight_car_right',)))
def test_two_horizontal_axes_give_the_direction(name):
    events = events_of(spoiler.only_axes('xy')(recorded(name).readings))
    for event in events:
        assert event.axes == 'xy'
        if event.number == 1:
            assert (event.left_to_right > 0.5) == truth_of(name, event.sensor)[1]
    assert {e.sensor for e in events} == {'mag_1', 'mag_2'}
    assert any(abs(e.left_to_right - 0.5) > 0.4 for e in events)


def test_a_long_event_does_not_depend_on_batches():
    """A target stops near the sensor for 170 s."""
    rng, n = np.random.default_rng(0), 20 * 220
    t = np.arange(n) / 20.0
    signal = 1e-6 / ((1.0 + np.exp(-np.clip((t - 20.0) / 0.3, -50, 50))) * (
        1.0 + np.exp(np.clip((t - 190.0) / 0.3, -50, 50))))
    field = np.array([2e-6, 1.5e-5, -4.9e-5]) + signal[:, None] + 1e-8 * rng.standard_normal((n, 3))
    readings = mt.readings_from_arrays(['mag_1'] * n, (t * 1e9).astype(np.int64), field)
    single = NETWORK.part(np.array([0]))
    found = [events_of(readings, single, batch) for batch in (1, 100, n)]
    for events in found[1:]:
        assert len(events) == len(found[0])
        for a, b in zip(events, found[0], strict=True):
            assert a.energy == b.energy and a.closest_ns == b.closest_ns


def test_a_field_step_or_noise_gives_a_bounded_time_of_the_cpa():
    t = np.linspace(0.0, 10.0, 200)
    step = 1e-6 * (t > 5.0)[:, None] * np.ones(3)
    for field in (step, 1e-8 * np.random.default_rng(0).standard_normal((200, 3))):
        found = closest_point(t, field + 1e-9 * np.random.default_rng(1).standard_normal((200, 3)),
                              np.full(3, 1e-9))
        assert t[0] <= found.time <= t[-1]
        assert np.isinf(found.time_std) == np.isnan(found.time_scale)
        assert np.isnan(found.time_scale) or found.time_scale <= 10.0


def test_the_event_of_a_target_that_stays_has_not_ended():
    readings = recorded('straight_car_right').readings
    t = (readings.stamp_ns - readings.stamp_ns[0]) / 1e9
    events = events_of(readings.part(t < 8.6))
    assert len(events) == 2 and not any(e.ended for e in events)


def test_replay_prints_counts_and_writes_tables(tmp_path, capsys):
    command = ['replay', str(vehicle_path('straight_car_right')), '--network', str(NETWORK_FILE),
               '--tables', 'events', '--out']
    assert main([*command, str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert 'mag_1: 1 event, mag_2: 1 event' in out and 'right (98%)' in out
    assert ' m/s' not in out and 'unique' not in out
    with open(tmp_path / 'out' / 'events.csv', newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert tuple(rows[0]) == names_of(EVENTS) and {r['sensor'] for r in rows} == {'mag_1', 'mag_2'}
    with open(tmp_path / 'out' / 'signatures.csv', newline='') as stream:
        assert len(list(csv.DictReader(stream))) == 66
    assert {p.name for p in (tmp_path / 'out').iterdir()} == {'events.csv', 'signatures.csv'}
    assert main([*command, str(vehicle_path('straight_car_right').parent)]) == 1


def test_events_from_python_match_the_command():
    result = mt.events(vehicle_path('straight_car_right'), NETWORK_FILE)
    assert result.counts() == {'mag_1': 1, 'mag_2': 1} and 'EventsResult(2 events' in repr(result)
    content = pass_event_dict(result.events[0])
    assert content['sensor'] == result.events[0].sensor and len(content['signature']) == 99
