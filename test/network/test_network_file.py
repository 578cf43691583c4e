"""Network files: values, round trips, and rejected files."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mag_tracking.errors import NetworkError, OutputError
from mag_tracking.geometry import (
    quaternion_between,
    quaternion_from_rotation_vector,
    rotation_from_quaternion,
)
from mag_tracking.network import CalibrationRecord, SensorNetwork
from mag_tracking.network.file import earth_field, read_network, write_network
from mag_tracking.network.sensor_network import MAX_SENSORS

VALID_FILE = '''
frame: map
earth_field: [2.0e-6, 1.55e-5, -4.9e-5]
sensors:
  a:
    position: [0, -4.5, 0]
    orientation: [0, 0, 0.7071067811865476, 0.7071067811865476]
    noise_std: 1.2e-8
  b:
    position: [0.0, 4.5, 0.0]
    noise_std: [1.0e-8, 2.0e-8, 3.0e-8]
    background: [1.0e-6, 0.0, 0.0]
    topic: /other/mag
'''


def parse(tmp_path, text):
    path = tmp_path / 'network.yaml'
    path.write_text(text)
    return read_network(path)


def test_a_network_file_is_read(tmp_path):
    n = parse(tmp_path, VALID_FILE)
    assert n.names == ('a', 'b') and n.topics == ('a/imu/mag', '/other/mag')
    # A rotation by 90 degrees about z maps the x axis of the sensor to the y axis of the world.
    np.testing.assert_allclose(n.R_ws[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(n.R_ws[1], np.eye(3))
    np.testing.assert_allclose(n.R_sw[0], n.R_ws[0].T)
    np.testing.assert_allclose(n.noise_std[0], 1.2e-8)
    assert n.background[0] is None and n.background[1][0] == 1e-6


CALIBRATED_FILE = """
site: {latitude: 58.4, longitude: 15.6, height: 60, date: 2026-05-01, x_azimuth_deg: 90}
sensors:
  a:
    position: [0, -4.5, 0]
    orientation_std_deg: [0.3, 0.4, 2.3]
    clock_offset: -0.0223
    offset: [1.0e-6, -2.0e-6, 3.0e-6]
    correction: [1.01, 0.02, 0.0, 0.02, 0.98, 0.0, 0.0, -0.01, 1.0]
    calibrated: {date: '2026-05-01', by: 'accelerometer and compass', clock_offset_std: 2.0e-5}
  b:
    position: [0.0, 4.5, 0.0]
    orientation_std_deg: 5
    topic: /b/field
  c:
    position: [0.0, 9.5, 0.0]
    imu_topic: /imu_of_c
    calibrated: {date: '2026-05-02', by: hand}
"""


def test_the_nominal_orientation_of_version_0_1_0_is_read(tmp_path):
    def keys(name):
        return f'{name}: [0.0, 0.0, 0.0, 1.0], {name}_std_deg: 3'

    for name in ('stated', 'nominal'):
        network = parse(tmp_path, CALIBRATED_FILE.replace('by: hand', f'by: hand, {keys(name)}'))
        record = network.calibrated[2]
        assert record.nominal == (0.0, 0.0, 0.0, 1.0)
        np.testing.assert_allclose(record.nominal_std, np.deg2rad(3.0))
    both = CALIBRATED_FILE.replace('by: hand', f'by: hand, {keys("nominal")}, {keys("stated")}')
    with pytest.raises(NetworkError, match="unknown key 'stated'"):
        parse(tmp_path, both)


def test_the_calibration_of_a_sensor_is_read(tmp_path):
    n = parse(tmp_path, CALIBRATED_FILE)
    np.testing.assert_allclose(np.degrees(n.orientation_std[0]), [0.3, 0.4, 2.3])
    np.testing.assert_allclose(np.degrees(n.orientation_std[1]), 5.0)
    assert n.orientation_std[2] is None
    np.testing.assert_array_equal(n.clock_offset, [-0.0223, 0.0, 0.0])
    np.testing.assert_array_equal(n.offset[0], [1e-6, -2e-6, 3e-6])
    # The matrix is in row-major order.
    np.testing.assert_array_equal(n.correction[0],
                                  [[1.01, 0.02, 0.0], [0.02, 0.98, 0.0], [0.0, -0.01, 1.0]])
    assert n.offset[1] is n.correction[1] is n.calibrated[1] is None
    assert n.calibrated[0] == CalibrationRecord('2026-05-01', 'accelerometer and compass', 2e-5)
    assert n.calibrated[2].by == 'hand' and np.isnan(n.calibrated[2].clock_offset_std)
    # The IMU topic is derived from a topic that follows REP-145, and is otherwise unknown.
    assert n.imu_topics == ('a/imu/data_raw', None, '/imu_of_c')


def test_the_site_determines_the_earth_field(tmp_path):
    n = parse(tmp_path, CALIBRATED_FILE)
    np.testing.assert_array_equal(
        n.earth_field, earth_field(58.4, 15.6, 60.0, 2026.0 + 120 / 365, 90.0))


def assert_equal_networks(a, b):
    """Assert that two networks are equal."""
    assert (a.names, a.topics, a.frame, a.imu_topics) == (b.names, b.topics, b.frame, b.imu_topics)
    for name in ('positions', 'earth_field', 'clock_offset'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_allclose(a.R_ws, b.R_ws, atol=1e-14)
    for name in ('noise_std', 'background', 'offset', 'correction'):
        for one, other in zip(getattr(a, name), getattr(b, name), strict=True):
            np.testing.assert_array_equal(one, other)
    for one, other in zip(a.orientation_std, b.orientation_std, strict=True):
        assert (one is None) == (other is None)
        np.testing.assert_allclose(1.0 if one is None else one, 1.0 if other is None else other,
                                   atol=1e-8)
    for one, other in zip(a.calibrated, b.calibrated, strict=True):
        np.testing.assert_equal(one and (one.date, one.by, one.clock_offset_std),
                                other and (other.date, other.by, other.clock_offset_std))


@pytest.mark.parametrize('text', [VALID_FILE, CALIBRATED_FILE])
def test_a_written_network_is_read_back(tmp_path, text):
    n = parse(tmp_path, text)
    n = replace(n, R_ws=n.R_ws @ Rotation.random(len(n), random_state=1).as_matrix())
    write_network(tmp_path / 'copy.yaml', n, 'A copy.\nOf two lines.')
    assert (tmp_path / 'copy.yaml').read_text().startswith('# A copy.\n# Of two lines.\n')
    assert_equal_networks(read_network(tmp_path / 'copy.yaml'), n)
    with pytest.raises(OutputError, match='cannot write'):
        write_network(tmp_path / 'no' / 'such' / 'folder.yaml', n)


@pytest.mark.parametrize('deg', [1e-5, 0.06, 30.0, 45.0, 180.0])
def test_any_orientation_std_of_a_survey_is_read_back(tmp_path, deg):
    """A value of 180 degrees marks an unknown heading; see survey.nominal_std_deg."""
    n = parse(tmp_path, VALID_FILE)
    n = replace(n, orientation_std=(np.deg2rad([0.3, 0.3, deg]), None))
    write_network(tmp_path / 'copy.yaml', n)
    assert_equal_networks(read_network(tmp_path / 'copy.yaml'), n)


def test_a_sensor_without_an_accelerometer_is_read_back(tmp_path):
    n = parse(tmp_path, VALID_FILE.replace('topic: /other', 'imu_topic: null\n    topic: /other'))
    assert n.imu_topics == ('a/imu/data_raw', None)
    write_network(tmp_path / 'copy.yaml', n)
    assert_equal_networks(read_network(tmp_path / 'copy.yaml'), n)


def test_a_string_with_special_characters_is_read_back(tmp_path):
    n = parse(tmp_path, VALID_FILE)
    n = replace(n, calibrated=(
        CalibrationRecord('2026-05-01', "the installer's eye: # 1", np.nan), None))
    write_network(tmp_path / 'copy.yaml', n)
    assert_equal_networks(read_network(tmp_path / 'copy.yaml'), n)


@pytest.mark.parametrize('old, new, message', [
    ('orientation_std_deg: 5', 'orientation_std_deg: 0', 'above 0'),
    ('orientation_std_deg: 5', 'orientation_std_deg: -2.0', 'above 0'),
    ('orientation_std_deg: 5', 'orientation_std_deg: [1, 2]', 'expected 1 or 3 numbers'),
    ('clock_offset: -0.0223', 'clock_offset: 4000', 'clock_offset: 4000.0 s exceeds 3600'),
    ('clock_offset: -0.0223', 'clock_offset: soon', "'soon'"),
    ('clock_offset: -0.0223', 'clock_offset: .nan', 'finite'),
    ('offset: [1.0e-6', 'offset: [1.0', 'offset: .* gauss'),
    ('[1.01, 0.02, 0.0,', '[1.01, 0.02,', 'correction: expected 9 numbers'),
    ('0.0, -0.01, 1.0]', '0.0, 0.0, 0.0]', 'singular'),
    ('imu_topic: /imu_of_c', 'imu_topic: imu/', "imu_topic: 'imu/'"),
    ('imu_topic: /imu_of_c', 'imu_topic: /imu of c', '/imu of c'),
    ('topic: /b/field', 'topic: null', 'topic: None'),
    ("date: '2026-05-02'", 'date: 2026-05-02', 'date must'),
    (', by: hand', '', 'by must'),
    ('by: hand', 'by: "\\udc80"', r"calibrated: by .*'\\udc80'"),
    ('by: hand', 'by: hand, who: me', "unknown key 'who'"),
    ("calibrated: {date: '2026-05-02', by: hand}", 'calibrated: yes', 'mapping'),
    ('site: {latitude: 58.4, ', 'site: {', 'site: latitude'),
    ('latitude: 58.4', 'latitude: 98.4', 'site: latitude: 98.4 is outside'),
    ('latitude: 58.4', 'latitude: north', "'north'"),
    ('date: 2026-05-01,', 'date: 2024-05-01,', 'site: year: 2024.33 is outside'),
    ('date: 2026-05-01,', "date: '2026-05-01',", 'site: date'),
    ('x_azimuth_deg: 90', 'x_azimuth: 90', "site: unknown key 'x_azimuth'"),
    ('site:', 'earth_field: [2.0e-6, 1.55e-5, -4.9e-5]\nsite:', 'earth_field'),
])
def test_invalid_calibrations_are_rejected(tmp_path, old, new, message):
    assert old in CALIBRATED_FILE
    with pytest.raises(NetworkError, match=message):
        parse(tmp_path, CALIBRATED_FILE.replace(old, new))


@pytest.mark.parametrize('old, new, message', [
    ('  b:', '  a:', 'duplicate key a'),
    ('/other/mag', '/a/imu/mag', 'topic /a/imu/mag'),
    ('/other/mag', '~/other', '~/other'),
    ('position: [0, -4.5, 0]', 'position: [0, -4.5]', 'sensor a: position: expected 3'),
    ('position: [0, -4.5, 0]', 'positon: [0, -4.5, 0]', "unknown key 'positon'"),
    ('position: [0, -4.5, 0]', 'position: [0, .nan, 0]', 'finite'),
    ('    position: [0, -4.5, 0]\n', '', 'sensor a: position'),
    ('1.2e-8', '-1.2e-8', 'noise_std'),
    ('1.2e-8', '1e-8', '1.0e-8'),
    ('1.2e-8', '1.0e-100', 'femtotesla'),
    ('position: [0, -4.5, 0]', 'position: [0, 1.0e+200, 0]', 'origin'),
    ('position: [0, -4.5, 0]', 'position: [0, 1.0e9, 0]', "'1.0e9'"),
    ('position: [0, -4.5, 0]', 'position: [0, 4.5, 0]', 'sensors a and b'),
    ('0.7071067811865476, 0.7', '0.1, 0.7', 'norm 1'),
    ('[2.0e-6, 1.55e-5, -4.9e-5]', '[0.02, 0.155, -0.49]', 'gauss'),
    ('frame: map', 'fram: map', 'unknown key'),
    ('frame: map', 'frame: [', 'not valid YAML'),
    ('frame: map', 'frame: "a b"', 'frame: '),
    ('  b:', '  b/c:', "'b/c'"),
    ('  b:', '  "\\ud800":', r"'\\ud800'"),
    ('background: [1.0e-6', 'background: [0.2', 'background: .*microtesla'),
    ('[2.0e-6, 1.55e-5, -4.9e-5]', '[2.0e-3, 0.0, 0.0]', 'millitesla'),
    ('position: [0, -4.5, 0]', 'position: [0, 2.0e+8, 0]', 'origin'),
    ('position: [0, -4.5, 0]', 'position: [0, 1.0e+7, 0]',
     'sensors a and b .*10,000 km'),
])
def test_invalid_networks_are_rejected(tmp_path, old, new, message):
    assert old in VALID_FILE
    with pytest.raises(NetworkError, match=message.replace('[', r'\[')):
        parse(tmp_path, VALID_FILE.replace(old, new))


def test_too_many_sensors_are_rejected():
    n = MAX_SENSORS + 1
    names = tuple(f'mag_{k}' for k in range(n))
    with pytest.raises(NetworkError, match=f'{n} .*{MAX_SENSORS}'):
        SensorNetwork(names, np.arange(3.0 * n).reshape(n, 3), np.tile(np.eye(3), (n, 1, 1)), names)


def test_missing_and_empty_files_are_rejected(tmp_path):
    with pytest.raises(NetworkError, match='cannot read'):
        read_network(tmp_path / 'nowhere.yaml')
    for text in ('', 'sensors: {}', 'sensors: [a]'):
        with pytest.raises(NetworkError):
            parse(tmp_path, text)


def test_an_unknown_sensor_is_rejected(tmp_path):
    with pytest.raises(NetworkError, match='sensor c.*a, b'):
        parse(tmp_path, VALID_FILE).index('c')


def test_rotations_agree_with_scipy():
    q = Rotation.random(20, random_state=0).as_quat()
    np.testing.assert_allclose(rotation_from_quaternion(q), Rotation.from_quat(q).as_matrix(),
                               atol=1e-14)
    v = np.vstack([np.random.default_rng(0).standard_normal((20, 3)), np.zeros(3)])
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation_vector(v)),
                               Rotation.from_rotvec(v).as_matrix(), atol=1e-14)
    for a, b in ((v[0], v[1]), (v[0], -2 * v[0]), (v[0], v[0])):
        R = rotation_from_quaternion(quaternion_between(a, b))
        np.testing.assert_allclose(R @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-12)
