"""Survey of a network: orientations, clock offsets and warnings from accelerations and fields."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mag_tracking.calibration import survey as survey_stage
from mag_tracking.calibration.agreement import SurveySettings
from mag_tracking.calibration.survey import Survey
from mag_tracking.geometry import rotation_about_z
from mag_tracking.network import CalibrationRecord, SensorNetwork
from mag_tracking.network.file import read_network, write_network
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import AccelerationSample, Readings
from support.bundled import vehicle_path
from support.counters import assert_counts
from support.samples import recorded, samples_of

EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
DATE = '2026-05-01'
START_NS = 1_790_000_000_000_000_000
ROTATIONS = (Rotation.identity(), Rotation.from_euler('zyx', [-3.0, 2.0, 1.5], True),
             Rotation.from_euler('zyx', [4.0, -1.0, -2.5], True))
CLOCK_OFFSETS = np.array([0.0, 0.0213, -0.0087])


def nominal(n=3, earth=EARTH, **changes):
    """Create the network before the survey: all sensors are upright, with x to the east."""
    names = tuple(f'mag_{i + 1}' for i in range(n))
    return SensorNetwork(names, np.arange(3.0 * n).reshape(n, 3), np.tile(np.eye(3), (n, 1, 1)),
                         tuple(f'/{name}/imu/mag' for name in names), earth_field=earth, **changes)


def readings_of(rotation, offset_s, knocks=(1.2, 2.1), seed=0, noise=0.02, duration=4.0):
    """Simulate accelerations of a rotated sensor, as [(timestamp [ns], (3,) [m/s²])]."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 0.01) + 0.01 * rng.random()
    level = sum((8.0 * np.exp(-np.abs(t - k) / 0.03) for k in knocks), 0.0 * t)
    a = rotation.inv().apply(np.array([0.0, 0.0, 9.81]) + level[:, None] * [0.3, 0.5, -0.4])
    a += noise * rng.standard_normal(a.shape)
    return [(START_NS + round((s + offset_s) * 1e9), v) for s, v in zip(t, a, strict=True)]


def surveyed(network=None, rotations=ROTATIONS, change=None, fields=None, settings=None,
             knocks=None):
    """Survey rotated sensors; return (NetworkSurvey, Survey).

    `change` modifies {name: readings} before the survey.
    """
    network = nominal(len(rotations)) if network is None else network
    readings = {name: readings_of(R, offset_s, (1.2, 2.1) if knocks is None else knocks, seed)
                for seed, (name, R, offset_s) in
                enumerate(zip(network.names, rotations, CLOCK_OFFSETS, strict=False))}
    if change is not None:
        change(readings)
    survey = Survey(network, settings or SurveySettings())
    for name, accelerations in readings.items():
        for stamp, a in accelerations:
            assert survey.feed(AccelerationSample(stamp, name, a)) == []
    if fields is None:
        fields = {name: R.inv().apply(EARTH) for name, R in
                  zip(network.names, rotations, strict=True)}
    return survey.solve(fields, DATE), survey


def warnings(result):
    """Return {sensor: warnings} for the sensors with warnings."""
    return {s.sensor: s.warnings for s in result.sensors if s.warnings}


def test_orientations_and_clock_offsets_are_found():
    result, survey = surveyed()
    assert survey.flush() == [] and dict(survey.counts) == {'accelerations': 1200}
    assert warnings(result) == {} and result.disagreements == ()
    assert result.reference == 'mag_1' and result.sensors[0].lag is None
    for j, R in enumerate(ROTATIONS):
        error = Rotation.from_matrix(result.network.R_ws[j] @ R.as_matrix().T).as_rotvec()
        # The tilt is the mean of 400 readings; the heading is biased towards the network file.
        assert np.abs(error[:2]).max() < 1e-3
        std = result.network.orientation_std[j]
        # Three sensors that agree reduce the compass uncertainty below its prior.
        assert abs(error[2]) < std[2] < np.deg2rad(2.5)
        np.testing.assert_allclose(std[:2], 0.05 / 9.81, rtol=0.01)
        assert result.network.clock_offset[j] == pytest.approx(CLOCK_OFFSETS[j], abs=1e-3)
        record = result.network.calibrated[j]
        assert (record.date, record.by) == (DATE, 'accelerometer, compass and nominal heading')
        assert record.clock_offset_std < 1e-3
    assert result.bias_std < 6e-7
    t, s = result.shocks['mag_2']
    assert len(t) == len(s) == 400 and abs(t[0]) < 0.05 and s.max() > 4.0


def test_the_nominal_heading_is_weighted_by_its_standard_deviation():
    for deg, low, high in ((0.06, 0.0, 0.05), (60.0, 3.9, 4.1)):
        network = nominal(orientation_std=(np.deg2rad([5.0, 5.0, deg]),) * 3)
        rotations = (*ROTATIONS[:2], Rotation.from_euler('z', 4.0, True))
        result, _ = surveyed(network, rotations if deg > 1.0 else (ROTATIONS[0],) * 3)
        R = result.network.R_ws[2]
        assert low <= abs(np.degrees(np.arctan2(R[1, 0], R[0, 0]))) <= high
        assert np.degrees(result.network.orientation_std[2][2]) < 1.1 * min(deg, 2.3)


@pytest.mark.parametrize('yaw', [20.0, 45.0, 90.0, -150.0])
def test_an_unknown_heading_is_found(yaw):
    """If nominal_std_deg is 180 degrees, the heading in the network file has no weight."""
    rotations = (ROTATIONS[0], Rotation.from_euler('z', yaw, True), ROTATIONS[2])
    result, _ = surveyed(rotations=rotations, settings=SurveySettings(nominal_std_deg=180.0))
    R = result.network.R_ws[1]
    assert np.degrees(np.arctan2(R[1, 0], R[0, 0])) == pytest.approx(yaw, abs=0.5)


def test_a_survey_without_a_heading_can_be_written(tmp_path):
    """The network has neither an Earth field nor a known heading."""
    result, _ = surveyed(nominal(earth=None), settings=SurveySettings(nominal_std_deg=180.0))
    write_network(tmp_path / 'network.yaml', result.network)
    assert read_network(tmp_path / 'network.yaml').names == result.network.names


def test_tilt_and_clock_offset_are_found_without_an_earth_field():
    result, _ = surveyed(nominal(earth=None))
    assert warnings(result) == {}
    for s, R in zip(result.sensors, ROTATIONS, strict=True):
        assert s.by == 'accelerometer, nominal heading'
        np.testing.assert_allclose(s.orientation.R_ws.T[:, 2], R.as_matrix()[2], atol=1e-3)
        assert np.degrees(s.orientation.std[2]) == pytest.approx(5.0)
    assert result.network.clock_offset[1] == pytest.approx(CLOCK_OFFSETS[1], abs=1e-3)
    # With two sensors, it is unknown which sensor is correct.
    result, _ = surveyed(nominal(2, earth=None), ROTATIONS[:2])
    assert 'three sensors' in result.sensors[0].warnings[0]


def test_a_sensor_without_accelerations_keeps_its_nominal_orientation():
    result, _ = surveyed(change=lambda readings: readings.pop('mag_2'))
    ((sensor, (text,)),) = warnings(result).items()
    assert sensor == 'mag_2' and text.startswith('no accelerations')
    s = result.sensors[1]
    assert (s.orientation, s.by, s.lag) == (None, 'nominal orientation', None)
    np.testing.assert_array_equal(result.network.R_ws[1], np.eye(3))
    assert result.network.orientation_std[1] is result.network.calibrated[1] is None
    assert 'mag_2' not in result.shocks and result.network.clock_offset[1] == 0.0


def test_a_survey_without_data_keeps_the_network():
    result = Survey(nominal(2), SurveySettings()).solve({}, DATE)
    assert result.reference == '' and result.shocks == {} and result.disagreements == ()
    assert set(warnings(result)) == {'mag_1', 'mag_2'}
    np.testing.assert_array_equal(result.network.R_ws, nominal(2).R_ws)


def changed(name, function):
    """Create a `change` for `surveyed` that applies a function to one sensor's accelerations."""
    def change(readings):
        readings[name] = [(stamp, function(a)) for stamp, a in readings[name]]
    return change


def test_accelerations_in_g_are_reported():
    result, _ = surveyed(change=changed('mag_3', lambda a: a / 9.81))
    assert list(warnings(result)) == ['mag_3']
    assert 'unit g?' in result.sensors[2].warnings[0]
    assert result.sensors[2].orientation is None
    # The knocks still give the clock offset.
    assert result.network.clock_offset[2] == pytest.approx(CLOCK_OFFSETS[2], abs=1e-3)


def test_clock_offsets_are_unchanged_without_a_knock():
    network = nominal(clock_offset=np.array([0.0, 0.5, -0.5]))
    result, _ = surveyed(network, knocks=())
    assert result.reference == ''
    assert ['reference' in text for text in result.warnings()] == [True]
    np.testing.assert_array_equal(result.network.clock_offset, [0.0, 0.5, -0.5])
    assert np.isnan(result.network.calibrated[1].clock_offset_std)


def test_a_sensor_that_measured_no_knock_is_reported():
    def quiet(readings):
        readings['mag_1'] = readings_of(ROTATIONS[0], 0.0, ())
    result, _ = surveyed(change=quiet)
    # Another sensor becomes the reference.
    assert result.reference == 'mag_2'
    assert 'sensor' in result.sensors[0].lag.reason
    assert result.network.clock_offset[2] == pytest.approx(
        CLOCK_OFFSETS[2] - CLOCK_OFFSETS[1], abs=1e-3)
    assert np.isnan(result.network.calibrated[0].clock_offset_std)
    assert result.network.calibrated[1].clock_offset_std == 0.0


def test_known_clock_offsets_keep_their_common_reference():
    """mag_1 has no accelerations, so its offset relative to the other sensors must not change."""
    network = nominal(clock_offset=CLOCK_OFFSETS)
    result, _ = surveyed(network, change=lambda readings: readings.pop('mag_1'))
    offset = result.network.clock_offset
    np.testing.assert_allclose(offset - offset[0], CLOCK_OFFSETS, atol=1e-3)


def test_a_tilted_sensor_is_reported_and_levelled():
    rotations = (ROTATIONS[0], Rotation.from_euler('x', 30.0, True), ROTATIONS[2])
    result, _ = surveyed(rotations=rotations)
    ((sensor, (text,)),) = warnings(result).items()
    assert sensor == 'mag_2' and 'tilt' in text and '30 degrees' in text
    np.testing.assert_allclose(result.network.R_ws[1], rotations[1].as_matrix(), atol=0.04)
    # The Earth field is compared in the surveyed orientation, not in the nominal orientation.
    assert result.disagreements == ()
    assert result.sensors[1].by == 'accelerometer, compass and nominal heading'


def test_a_compass_heading_far_from_the_nominal_heading_is_reported():
    rotations = (ROTATIONS[0], Rotation.from_euler('z', 25.0, True), ROTATIONS[2])
    result, _ = surveyed(rotations=rotations)
    ((sensor, (text,)),) = warnings(result).items()
    assert sensor == 'mag_2' and 'heading' in text and '+25 degrees' in text
    np.testing.assert_allclose(result.network.R_ws[1], np.eye(3), atol=2e-3)
    assert np.degrees(result.network.orientation_std[1][2]) == pytest.approx(5.0)
    assert result.sensors[1].by == 'accelerometer, nominal heading'


def test_a_sensor_with_a_flipped_axis_keeps_its_nominal_heading():
    fields = {name: R.inv().apply(EARTH) for name, R in
              zip(('mag_1', 'mag_2', 'mag_3'), ROTATIONS, strict=True)}
    fields['mag_3'] = fields['mag_3'] * [1.0, 1.0, -1.0]
    result, _ = surveyed(fields=fields)
    (d,) = result.disagreements
    assert (d.sensor, d.explanations) == ('mag_3', ('z is flipped',))
    R = result.network.R_ws[2]
    assert abs(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])) < 2e-3
    # The tilt is taken from the accelerometer, which is valid.
    np.testing.assert_allclose(R[2], ROTATIONS[2].as_matrix()[2], atol=1e-3)
    assert result.sensors[2].by == 'accelerometer, nominal heading'
    assert result.sensors[1].by == 'accelerometer, compass and nominal heading'
    assert result.bias_std < 6e-7


def test_a_vertical_field_gives_one_warning_per_sensor():
    fields = {name: R.inv().apply([0.0, 0.0, -5e-5]) for name, R in
              zip(('mag_1', 'mag_2', 'mag_3'), ROTATIONS, strict=True)}
    result, _ = surveyed(nominal(earth=np.array([0.0, 0.0, -5e-5])), fields=fields)
    for s in result.sensors:
        assert s.by == 'accelerometer, nominal heading'
        assert len(s.warnings) == 1 and 'heading is' in s.warnings[0]


@pytest.mark.parametrize('nominal_yaw', [0.0, 165.0, 180.0, 190.0])
@pytest.mark.parametrize('offset_deg', [-3.0, 2.0])
def test_the_nominal_heading_decides_between_two_headings_that_fit(nominal_yaw, offset_deg):
    """mag_2 has one horizontal axis, nearly perpendicular to the field, so two headings fit."""
    yaw = nominal_yaw + offset_deg
    network = nominal()
    network.R_ws[1] = rotation_about_z(np.deg2rad(nominal_yaw))
    rotations = (ROTATIONS[0], Rotation.from_euler('z', yaw, True), ROTATIONS[2])
    fields = {name: R.inv().apply(EARTH) for name, R in zip(network.names, rotations, strict=True)}
    fields['mag_2'] = fields['mag_2'] * [1.0, np.nan, np.nan]
    result, _ = surveyed(network, rotations, fields=fields)
    assert result.sensors[1].by == 'accelerometer, compass and nominal heading'
    error = np.degrees(Rotation.from_matrix(
        result.network.R_ws[1] @ rotations[1].as_matrix().T).as_rotvec())
    assert np.abs(error).max() < 2.0
    assert 'another heading' in result.sensors[1].warnings[0]


def test_invalid_accelerations_are_counted_and_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(survey_stage, 'MAX_ACCELERATIONS', 100)
    survey = Survey(nominal(2), SurveySettings())
    for stamp, sensor, a in ((1, 'mag_9', [0, 0, 9.8]), (1, 'mag_1', [0, np.nan, 9.8]),
                             (2, 'mag_1', [0, np.inf, 9.8]), (3, 'mag_1', [0, 0, 9.8]),
                             (3, 'mag_1', [0, 0, 9.8]), (2, 'mag_1', [0, 0, 9.8])):
        survey.feed(AccelerationSample(stamp, sensor, np.array(a, dtype=float)))
    assert_counts(survey.counts, {'mag_9': 1, 'finite': 2, 'accelerations': 1, 'order': 2})
    for k in range(250):
        survey.feed(AccelerationSample(10 + k, 'mag_1', np.array([0.0, 0.0, 9.81])))
    assert len(survey.solve({}, DATE).shocks['mag_1'][0]) == 100


def test_a_jump_back_in_time_discards_earlier_accelerations():
    def loops(readings):
        readings['mag_2'] = ([(stamp + 60_000_000_000, a + [3.0, 0.0, -0.5])
                              for stamp, a in readings['mag_2']] + readings['mag_2'])
    result, survey = surveyed(change=loops)
    assert survey.counts['time jumped'] == 1
    assert len(result.shocks['mag_2'][0]) == 400
    np.testing.assert_allclose(result.network.R_ws[1][2], ROTATIONS[1].as_matrix()[2], atol=1e-3)
    assert result.network.clock_offset[1] == pytest.approx(CLOCK_OFFSETS[1], abs=1e-3)


def test_calibration_records_are_replaced_for_surveyed_sensors_only():
    earlier = CalibrationRecord('2025-01-01', 'by hand', np.nan)
    result, _ = surveyed(nominal(calibrated=(earlier,) * 3),
                         change=lambda readings: readings.pop('mag_3'))
    assert [c.date for c in result.network.calibrated] == [DATE, DATE, '2025-01-01']
    assert result.network.calibrated[2] is earlier


def imu_network(**changes):
    """Network with the two sensors and IMU topics of the bundled recordings."""
    return replace(nominal(2), imu_topics=tuple(f'/mag_{i}/imu/data_raw' for i in (1, 2)),
                   **changes)


def read(network):
    reader = SampleReader(Recording(vehicle_path('straight_car_right')), network)
    return reader, list(reader.readings_and_accelerations())


def test_fields_and_accelerations_are_read_together():
    reader, records = read(imu_network())
    samples = [r for r in records if isinstance(r, AccelerationSample)]
    assert {r.sensor for r in samples} == {'mag_1', 'mag_2'}
    assert np.linalg.norm(np.median([r.acceleration for r in samples], axis=0)) == pytest.approx(
        9.81, abs=0.1)
    fields = samples_of(*(r for r in records if isinstance(r, Readings)))
    alone = recorded(reader)
    assert [(r.stamp_ns, r.sensor) for r in fields] == [(r.stamp_ns, r.sensor) for r in alone]
    _, without_imu = read(replace(imu_network(), imu_topics=(None, None)))
    assert sum(map(len, without_imu)) == len(fields)


def test_an_accelerometer_that_two_sensors_share_serves_both():
    """The network has two magnetometers on one board with one accelerometer."""
    _, records = read(replace(imu_network(), imu_topics=('/mag_1/imu/data_raw',) * 2))
    samples = [r.sensor for r in records if isinstance(r, AccelerationSample)]
    assert samples.count('mag_1') == samples.count('mag_2') > 0


def test_sensors_on_their_side_are_surveyed():
    """The network file also describes the sensors as lying on their side."""
    side = Rotation.from_euler('x', 90.0, True)
    rotations = tuple(R * side for R in ROTATIONS)
    network = replace(nominal(), R_ws=np.tile(side.as_matrix(), (3, 1, 1)))
    result, _ = surveyed(network, rotations)
    assert warnings(result) == {}
    for R, truth in zip(result.network.R_ws, rotations, strict=True):
        error = Rotation.from_matrix(R @ truth.as_matrix().T).as_rotvec()
        assert np.abs(error[:2]).max() < 1e-3 and abs(error[2]) < np.deg2rad(1.5)


def test_the_result_rotates_with_the_world_frame():
    Rz = rotation_about_z(1.1)
    original, _ = surveyed()
    network = replace(nominal(), R_ws=Rz @ nominal().R_ws, earth_field=Rz @ EARTH)
    rotations = tuple(Rotation.from_matrix(Rz @ R.as_matrix()) for R in ROTATIONS)
    fields = {name: R.inv().apply(EARTH) for name, R in
              zip(network.names, ROTATIONS, strict=True)}
    other, _ = surveyed(network, rotations, fields=fields)
    np.testing.assert_allclose(other.network.R_ws, Rz @ original.network.R_ws, atol=1e-3)
    np.testing.assert_allclose(other.network.orientation_std, original.network.orientation_std,
                               rtol=1e-2)


def test_clocks_decades_apart_do_not_fill_the_memory():
    def of_1970(readings):
        readings['mag_2'] = [(stamp - START_NS, a) for stamp, a in readings['mag_2']]
    result, _ = surveyed(change=of_1970)
    assert result.reference == 'mag_1' and result.sensors[2].lag.reason == ''
    assert '1.79e+09 s' in result.sensors[1].lag.reason
    assert result.network.clock_offset[1] == 0.0


def test_the_result_of_an_earlier_survey_is_not_counted_as_evidence():
    """A survey with the same readings, starting from the first result, reproduces that result."""
    first, _ = surveyed(nominal(orientation_std=(np.deg2rad([4.0, 4.0, 6.0]),) * 3))
    second, _ = surveyed(first.network)
    for name in ('R_ws', 'clock_offset'):
        np.testing.assert_allclose(getattr(second.network, name), getattr(first.network, name),
                                   atol=1e-12)
    np.testing.assert_allclose(second.network.orientation_std, first.network.orientation_std)
    np.testing.assert_allclose(second.network.calibrated[0].nominal_std, np.deg2rad([4, 4, 6]))


def test_large_biases_increase_the_heading_uncertainty():
    fields = {f'mag_{j + 1}': R.inv().apply(EARTH) + 2e-6 * R.inv().apply([0.0, 0.0, 1.0])
              for j, R in enumerate(ROTATIONS)}
    biased, _ = surveyed(fields=fields)
    unbiased, _ = surveyed()
    assert biased.bias_std > 1.3 * unbiased.bias_std
    for a, b in zip(biased.network.orientation_std, unbiased.network.orientation_std, strict=True):
        assert a[2] > 1.1 * b[2]
