"""network.yaml: what it means, and what becomes of a faulty one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mag_tracking.errors import NetworkError, OutputError
from mag_tracking.geometry import (
    quaternion_between,
    quaternion_from_rotation_vector,
    rotation_from_quaternion,
)
from mag_tracking.io.network_file import read_network, write_network

GOOD = '''
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


def read(tmp_path, text):
    path = tmp_path / 'network.yaml'
    path.write_text(text)
    return read_network(path)


def test_a_good_file(tmp_path):
    n = read(tmp_path, GOOD)
    assert n.names == ('a', 'b') and n.topics == ('/a/imu/mag', '/other/mag')
    # A quarter turn about z takes the sensor's x to the world's y.
    np.testing.assert_allclose(n.R_ws[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(n.R_ws[1], np.eye(3))
    np.testing.assert_allclose(n.R_sw[0], n.R_ws[0].T)
    np.testing.assert_allclose(n.noise_std[0], 1.2e-8)
    assert n.background[0] is None and n.background[1][0] == 1e-6


def test_what_is_written_reads_back(tmp_path):
    n = read(tmp_path, GOOD)
    q = np.array([[0, 0, 0.7071067811865476, 0.7071067811865476], [0, 0, 0, 1.0]])
    write_network(tmp_path / 'copy.yaml', n, q, 'A copy.')
    c = read_network(tmp_path / 'copy.yaml')
    assert (c.names, c.topics, c.frame) == (n.names, n.topics, n.frame)
    for name in ('positions', 'R_ws', 'earth_field'):
        np.testing.assert_array_equal(getattr(c, name), getattr(n, name))
    np.testing.assert_array_equal(c.noise_std, n.noise_std)
    with pytest.raises(OutputError, match='cannot write'):
        write_network(tmp_path / 'no' / 'such' / 'folder.yaml', n, q)


@pytest.mark.parametrize('old, new, message', [
    ('  b:', '  a:', 'a is there twice'),
    ('/other/mag', '/a/imu/mag', 'topic /a/imu/mag is that of two sensors'),
    ('/other/mag', 'other', 'must begin with /'),
    ('position: [0, -4.5, 0]', 'position: [0, -4.5]', 'sensor a: position: expected 3'),
    ('position: [0, -4.5, 0]', 'positon: [0, -4.5, 0]', "unknown key 'positon'"),
    ('position: [0, -4.5, 0]', 'position: [0, .nan, 0]', 'not a finite number'),
    ('    position: [0, -4.5, 0]\n', '', 'sensor a: position is missing'),
    ('1.2e-8', '-1.2e-8', 'noise_std must be above a femto'),
    ('1.2e-8', '1e-8', 'write numbers as 1.0e-8'),
    ('1.2e-8', '1.0e-100', 'above a femtotesla'),
    ('position: [0, -4.5, 0]', 'position: [0, 1.0e+200, 0]', 'nowhere on Earth'),
    ('position: [0, -4.5, 0]', 'position: [0, 1.0e9, 0]', "'1.0e9' is text"),
    ('position: [0, -4.5, 0]', 'position: [0, 4.5, 0]', 'sensors a and b are both at'),
    ('0.7071067811865476, 0.7', '0.1, 0.7', 'needs norm 1'),
    ('[2.0e-6, 1.55e-5, -4.9e-5]', '[0.02, 0.155, -0.49]', 'microtesla or gauss'),
    ('frame: map', 'fram: map', 'unknown key'),
    ('frame: map', 'frame: [', 'not YAML'),
    ('frame: map', 'frame: "a b"', 'frame: expected a name'),
    ('  b:', '  b/c:', "'b/c' is no name for a sensor"),
    ('background: [1.0e-6', 'background: [0.2', 'background: .* is it in microtesla'),
    ('[2.0e-6, 1.55e-5, -4.9e-5]', '[2.0e-3, 0.0, 0.0]', 'more than a millitesla'),
    ('position: [0, -4.5, 0]', 'position: [0, 2.0e+8, 0]', 'nowhere on Earth'),
])
def test_faults_are_named(tmp_path, old, new, message):
    assert old in GOOD
    with pytest.raises(NetworkError, match=message.replace('[', r'\[')):
        read(tmp_path, GOOD.replace(old, new))


def test_missing_and_empty_files(tmp_path):
    with pytest.raises(NetworkError, match='cannot read'):
        read_network(tmp_path / 'nowhere.yaml')
    for text in ('', 'sensors: {}', 'sensors: [a]'):
        with pytest.raises(NetworkError):
            read(tmp_path, text)


def test_an_unknown_sensor_is_named(tmp_path):
    with pytest.raises(NetworkError, match='unknown sensor c; the network has a, b'):
        read(tmp_path, GOOD).index('c')


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
