"""Tables of magnet poses: reading and validation."""

import numpy as np
import pytest

from mag_tracking.errors import RecordingError
from mag_tracking.recording.pose_table import read_pose_table, read_sensor_positions
from support.real_board import board_of_41


@pytest.fixture(scope='module')
def recorded():
    """Network, fields, magnet positions and magnet axes of the board with 41 sensors."""
    return board_of_41()


def test_the_table_of_the_real_board_is_read(recorded):
    network, field, positions, axes = recorded
    assert network.positions.shape == (41, 3) and field.shape == (324, 41, 3)
    assert positions.shape == axes.shape == (324, 3)
    np.testing.assert_array_equal(field[0, 0], [2.6284356e-5, 1.07037293e-6, -2.0510074e-5])
    np.testing.assert_allclose(network.positions[25], [0.0225, 0.0225, 0.0])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, rtol=1e-14)


HEADER = 'mag_mz0,x0,y0,z0,mag_x0,mag_y0,mag_z0,mag_mx0,mag_my0\n'


def test_columns_are_found_by_name_and_axes_may_be_missing(tmp_path):
    path = tmp_path / 'poses.csv'
    path.write_text(HEADER + '0.8,1e-6,,nan,1,2,3,0.6,0\n')
    field, positions, axes = read_pose_table(path)
    np.testing.assert_array_equal(field, [[[1e-6, np.nan, np.nan]]])
    np.testing.assert_array_equal(positions, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(axes, [[0.6, 0.0, 0.8]])


@pytest.mark.parametrize('content, message', [
    (HEADER, 'no rows'), ('', 'no rows'),
    ('a,b\n1,2\n', 'column x0 is missing'),
    (HEADER.replace('y0,z0', 'z0', 1) + '1,0,0,0,0,0,0,0\n', 'column y0 is missing'),
    (HEADER.replace('mag_y0', 'mag_x0') + '1,0,0,0,0,0,0,0,0\n', 'column mag_x0'),
    (HEADER + '1,0,0,0,0,0,0,0\n', 'row 2: expected 9 columns, got 8'),
    (HEADER + '1,0,0,0,0,0,0,0,0\n1,0,spam,0,0,0,0,0,0\n', "row 3: y0 is 'spam'"),
    (HEADER + '1,0,0,0,,0,0,0,0\n', 'row 2: mag_x0'),
    (HEADER + '1,inf,0,0,0,0,0,0,0\n', 'row 2: x0'),
    (HEADER + '0.9,0,0,0,0,0,0,0,0\n', 'row 2: mag_mx0..mag_mz0 has length 0.9')])
def test_an_invalid_table_is_refused(tmp_path, content, message):
    path = tmp_path / 'poses.csv'
    path.write_text(content)
    with pytest.raises(RecordingError, match=message) as caught:
        read_pose_table(path)
    assert 'poses.csv' in str(caught.value)


@pytest.mark.parametrize('content, message', [
    ('# x,y,z\n', 'no rows'), ('# x,y,z\n1,2\n', 'row 2: .*got 2'),
    ('1,2,a\n', "row 1: z is 'a'"), ('1,nan,2\n', 'row 1: y')])
def test_invalid_sensor_positions_are_refused(tmp_path, content, message):
    path = tmp_path / 'sensors.csv'
    path.write_text(content)
    with pytest.raises(RecordingError, match=message):
        read_sensor_positions(path)
    with pytest.raises(RecordingError, match='cannot read'):
        read_sensor_positions(tmp_path / 'none.csv')
