"""Files that are not recordings are named by their content, with what reads them."""

import gzip
import io
import lzma
import sqlite3
import tarfile
import zipfile

import lz4.frame
import numpy as np
import pandas as pd
import pytest
import zstandard
from scipy.io import savemat

from mag_tracking.cli import main
from mag_tracking.errors import RecordingError
from mag_tracking.recording.reader import Recording
from support.bundled import NETWORK_FILE, vehicle_path

TABLE = b'time,x,y,z\n0.0,1.5e-5,2e-6,4e-5\n0.1,1.5e-5,2e-6,4e-5\n'
IAGA = b''' Format                 IAGA-2002                                    |
 Source of Data         GFZ                                          |
 IAGA CODE              NGK                                          |
DATE       TIME         DOY     NGKX      NGKY      NGKZ      NGKF   |
2026-01-01 00:00:00.000 001     18770.10   1250.00  45600.00  49330.00
'''


def buffered(write):
    """Bytes that a function writes to a stream."""
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def zipped(**files):
    def write(stream):
        with zipfile.ZipFile(stream, 'w') as archive:
            for name, content in files.items():
                archive.writestr(name.replace('__', '/'), content)
    return buffered(write)


def tarred(stream):
    with tarfile.open(fileobj=stream, mode='w') as archive:
        archive.addfile(tarfile.TarInfo('a.csv'), io.BytesIO())


HDF5 = b'\x89HDF\r\n\x1a\n' + bytes(100)
KINDS = {
    'csv': (TABLE, 'table', 'mag-tracking import'),
    'tsv': (TABLE.replace(b',', b'\t'), 'table', 'mag-tracking import'),
    'decimal_comma': (b't;x\n0,1;2,5\n', 'table', 'mag-tracking import'),
    'utf16': ('t,x\n0.1,2.5\n'.encode('utf-16'), 'table', 'mag-tracking import'),
    'no_header': (b'0.1 2.5 3.5 4.5\n0.2 2.5 3.5 4.5\n', 'table', 'mag-tracking import'),
    'iaga': (IAGA, 'IAGA-2002', 'mag-tracking import'),
    'ulog': (b'ULog\x01\x12\x35\x01' + bytes(50), 'ULog', 'ulog2csv'),
    'dataflash': (b'\xa3\x95\x80\x80\x59FMT\0BBnNZ' + bytes(60), 'DataFlash', 'mavlogdump.py'),
    'dataflash_text': (b'FMT, 128, 89, FMT, BBnNZ, Type,Length\n', 'ArduPilot', 'MAG'),
    'tlog': ((1_790_000_000 * 10**6).to_bytes(8, 'big') + b'\xfd\x09' + bytes(30), 'MAVLink',
             'mavlogdump.py'),
    'mat5': (buffered(lambda s: savemat(s, {'field': np.eye(3)})), 'MATLAB', 'writetable'),
    'mat73': (b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(512) + HDF5, '7.3', 'writetable'),
    'hdf5': (HDF5, 'HDF5', 'h5py'),
    'npy': (buffered(lambda s: np.save(s, np.eye(3))), 'NumPy', 'savetxt'),
    'npz': (buffered(lambda s: np.savez(s, a=np.eye(3))), 'NumPy', 'savetxt'),
    'parquet': (buffered(pd.DataFrame({'t': [1.0]}).to_parquet), 'Parquet', 'read_parquet'),
    'xlsx': (zipped(xl__workbook='x'), 'Excel', 'save the sheet as CSV'),
    'zip': (zipped(**{'a.csv': TABLE}), 'ZIP', 'unzip'),
    'gzip': (gzip.compress(TABLE), 'gzip', 'gunzip'),
    'zstd': (zstandard.compress(TABLE), 'zstd', 'unzstd'),
    'lz4': (lz4.frame.compress(TABLE), 'lz4', 'unlz4'),
    'xz': (lzma.compress(TABLE), 'xz', 'unxz'),
    'tar': (buffered(tarred), 'tar', 'tar xf'),
    'json': (b'{"field": [1, 2, 3]}', 'JSON', 'CSV'),
    'html': (b'<!DOCTYPE html>', 'HTML', 'CSV'),
    'network': (NETWORK_FILE.read_bytes(), 'network file', '--network'),
    'metadata': (b'rosbag2_bagfile_information:\n  version: 9\n', 'rosbag2', 'folder'),
    'old_bag': (b'#ROSBAG V1.2\n', 'ROS 1 bag', 'rosbag fix'),
    'prose': (b'This is a protocol of a measurement.\n', 'text', 'recording'),
    'noise': (np.random.default_rng(0).bytes(5000), 'unknown', '.mcap'),
}


@pytest.mark.parametrize('suffix', ['', '.mcap', '.bin', '.db3'])
@pytest.mark.parametrize('kind', KINDS)
def test_a_file_is_named_by_its_content(kind, suffix, tmp_path):
    content, name, advice = KINDS[kind]
    path = tmp_path / f'file{suffix}'
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=name) as error:
        Recording(path)
    assert str(path) in str(error.value) and advice in str(error.value)


def test_every_command_names_the_file(tmp_path, capsys):
    path = tmp_path / 'field.csv'
    path.write_bytes(TABLE)
    network = ['--network', str(NETWORK_FILE)]
    out = ['--out', str(tmp_path / 'o')]
    for command in (['info'], ['doctor', *network], ['replay', *network, '--tables', 'events'],
                    ['replay', *network, *out], ['fit', *network, *out],
                    ['replay', *network, '--tables', 'passages', *out],
                    ['calibrate', 'network', *network, '--out', str(tmp_path / 'n.yaml')],
                    ['repair']):
        assert main([*command, str(path)]) == 1
        error = capsys.readouterr().err
        assert 'table' in error and 'mag-tracking import' in error, (command, error)


def test_a_recording_is_read_under_any_name(tmp_path):
    path = tmp_path / 'log.bin'
    path.write_bytes(vehicle_path('straight_car_right').read_bytes())
    assert len(list(Recording(path).messages())) == 3938


@pytest.mark.parametrize('statement', [
    'UPDATE messages SET data = NULL WHERE id % 4 = 1',
    'UPDATE messages SET timestamp = NULL WHERE id % 4 = 1',
    "UPDATE messages SET data = 'text' WHERE id % 4 = 1",
    'UPDATE topics SET name = NULL', 'UPDATE topics SET type = NULL',
    'UPDATE topics SET offered_qos_profiles = NULL',
    'UPDATE topics SET serialization_format = NULL'])
def test_null_in_a_database_is_counted_or_named(statement, tmp_path, capsys):
    path = tmp_path / 'a.db3'
    with sqlite3.connect(path) as database:
        database.executescript('''
            CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,
                                serialization_format TEXT, offered_qos_profiles TEXT);
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                                  data BLOB);
            INSERT INTO topics VALUES(1, '/mag_1/imu/mag', 'sensor_msgs/msg/MagneticField', 'cdr',
                                      '');''')
        database.executemany('INSERT INTO messages VALUES(?, 1, ?, ?)', [
            (k, 10**9 + k, b'\0\1\0\0') for k in range(100)])
        database.execute(statement)
    database.close()
    status = main(['info', str(path)])
    out, error = capsys.readouterr()
    assert 'Traceback' not in error
    if status == 0 and 'messages SET' in statement:
        assert 'NULL' in out and ': 25' in out
        assert len(list(Recording(path).messages())) == 75
    elif status:
        assert str(path) in error and error.count('\n') == 1


def test_a_folder_without_a_recording_names_its_file(tmp_path):
    (tmp_path / 'field.csv').write_bytes(TABLE)
    with pytest.raises(RecordingError, match='no recording.*field.csv.*table'):
        Recording(tmp_path)


def test_messages_in_a_write_ahead_log_are_not_lost_silently(tmp_path):
    path = tmp_path / 'a.db3'
    database = sqlite3.connect(path)
    database.executescript('''
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,
                            serialization_format TEXT, offered_qos_profiles TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                              data BLOB);
        INSERT INTO topics VALUES(1, '/x', 'std_msgs/msg/String', 'cdr', '');
        PRAGMA journal_mode = WAL;''')
    with database:
        database.execute("INSERT INTO messages VALUES(1, 1, 5, x'00010000')")
    # As after a crash: the log exists, because the database is still open.
    recording = Recording(path)
    assert len(list(recording.messages())) == 0
    (loss,) = recording.losses
    assert 'a.db3-wal' in loss and 'wal_checkpoint' in loss
    database.close()
    recording = Recording(path)
    assert len(list(recording.messages())) == 1 and not recording.losses
