"""Import of tables of magnet poses, and rejection of invalid tables."""

import pytest

from mag_tracking.errors import RecordingError
from mag_tracking.recording.pose_table import import_pose_table
from mag_tracking.recording.reader import Recording

HEADER = ('id,timestamp,Bx,By,Bz,sensor_x,sensor_y,sensor_z,sensor_ox,sensor_oy,sensor_oz,'
          'm_x,m_y,m_z,m_ox,m_oy,m_oz\n')
ROW = '1,0.5,10,20,30,0,0,0,0,0,0,5,5,50,0,0,0\n'


def import_tables(folder, table, background):
    """Write and import a pose table and a table of backgrounds; return the result."""
    (folder / 'poses.csv').write_text(table)
    (folder / 'background.csv').write_text(background)
    return import_pose_table(folder / 'poses.csv', folder / 'background.csv', folder / 'out', 1e-6)


def test_a_pose_table_becomes_a_recording(tmp_path):
    recording, network, n = import_tables(tmp_path, HEADER + ROW, '1,2,3\n')
    assert n == 1 and network.is_file()
    assert {m.topic for m in Recording(recording).messages()} == {
        '/mag_1/imu/mag', '/ground_truth/magnet/pose'}


def test_semicolons_and_decimal_commas_give_the_same_recording(tmp_path):
    fields = []
    for change in (str, lambda text: text.replace(',', ';').replace('.', ',')):
        recording, network, _ = import_tables(
            tmp_path, change(HEADER + ROW.replace('10,', '10.25,')), change('# B\n1.5,2,3\n'))
        fields.append([m.data for m in Recording(recording).messages()])
        assert '1.5e-06' in network.read_text()
    assert fields[0] == fields[1]


@pytest.mark.parametrize('table, background, message', [
    ('', '1,2,3\n', 'poses.csv'), (HEADER, '1,2,3\n', 'poses.csv'),
    (HEADER.replace('Bz', 'Bw') + ROW, '1,2,3\n', 'column Bz'),
    (HEADER + ROW.replace('30', 'x'), '1,2,3\n', "row 2: Bz is 'x'"),
    (HEADER + '1,0.5\n', '1,2,3\n', 'row 2: expected 17 columns, got 2'),
    (HEADER + ROW + ROW.replace('50', 'inf'), '1,2,3\n', 'row 3: m_z'),
    (HEADER + '1.5' + ROW[1:], '1,2,3\n', 'id contains'),
    (HEADER + '1e30' + ROW[1:], '1,2,3\n', 'id contains'),
    (HEADER + ROW.replace('0.5', '-5'), '1,2,3\n', 'timestamp contains'),
    (HEADER + ROW.replace('0.5', '1e300'), '1,2,3\n', 'timestamp contains'),
    (HEADER + ROW, '1,2,nan\n', 'background.csv: row 1: Bz'),
    (HEADER + ROW, '1,2\n', 'background.csv: row 1: expected 3 columns, got 2'),
    (HEADER + ROW, '1,2,3\n4,5,6\n', r'background.csv has 2, .* has 1$')])
def test_an_invalid_pose_table_is_refused(tmp_path, table, background, message):
    with pytest.raises(RecordingError, match=message):
        import_tables(tmp_path, table, background)
