"""Description of files that are not recordings: what they contain, and how to convert them."""

import re
import zipfile
from pathlib import Path
from typing import NamedTuple

HEAD_SIZE = 4096
_IMPORT = 'then use `mag-tracking import`'
_TO_CSV = f'No command reads it: write the field and its time to a CSV file, {_IMPORT}'


class _Kind(NamedTuple):
    description: str
    advice: str
    magic: bytes = b''
    """Bytes by which it is recognised."""
    offset: int = 0
    """Position of these bytes."""


# In order of precedence.
_BINARY = (
    _Kind('a ULog file of PX4', 'No command reads it: run `ulog2csv FILE` of pyulog, then '
          '`mag-tracking import` with the table of sensor_mag or vehicle_magnetometer, --unit '
          'gauss and --time-unit us', b'ULog\x01\x12\x35'),
    _Kind('a DataFlash log of ArduPilot', 'No command reads it: run `mavlogdump.py --types MAG '
          '--format csv FILE > mag.csv` of pymavlink, then `mag-tracking import` with --unit '
          'mgauss and --time-unit us', b'\xa3\x95\x80'),
    _Kind('a MATLAB file of version 7.3 (HDF5)', _TO_CSV + ', for example with writetable in '
          'MATLAB', b'MATLAB 7.3 MAT-file'),
    _Kind('a MATLAB file', _TO_CSV + ', for example with writetable in MATLAB', b'MATLAB '),
    _Kind('an HDF5 file', _TO_CSV + ', for example with h5py', b'\x89HDF\r\n\x1a\n'),
    _Kind('an HDF5 file', _TO_CSV + ', for example with h5py', b'\x89HDF\r\n\x1a\n', 512),
    _Kind('a Parquet table', _TO_CSV + ', for example with pandas.read_parquet and to_csv',
          b'PAR1'),
    _Kind('an Arrow table', _TO_CSV + ', for example with pandas.read_feather and to_csv',
          b'ARROW1'),
    _Kind('a NumPy array', _TO_CSV + ', for example with numpy.savetxt', b'\x93NUMPY'),
    _Kind('an old Excel workbook', 'No command reads it: save the sheet as CSV, ' + _IMPORT,
          b'\xd0\xcf\x11\xe0'),
    _Kind('a ROS 1 bag of an unsupported version', 'Convert it with `rosbag fix`',
          b'#ROS'),
    _Kind('compressed with gzip', 'Decompress it with `gunzip FILE`', b'\x1f\x8b'),
    _Kind('compressed with zstd', 'Decompress it with `unzstd FILE`', b'\x28\xb5\x2f\xfd'),
    _Kind('compressed with lz4', 'Decompress it with `unlz4 FILE`', b'\x04\x22\x4d\x18'),
    _Kind('compressed with bzip2', 'Decompress it with `bunzip2 FILE`', b'BZh'),
    _Kind('compressed with xz', 'Decompress it with `unxz FILE`', b'\xfd7zXZ\0'),
    _Kind('a 7-Zip archive', 'Unpack it', b'7z\xbc\xaf\x27\x1c'),
    _Kind('a tar archive', 'Unpack it with `tar xf FILE`', b'ustar', 257),
)
_TEXT = (
    (re.compile(rb'^\s*Format\s+IAGA-2002', re.M | re.I), _Kind(
        'an IAGA-2002 file of an observatory', 'Remove the marks at the ends of its lines (`sed '
        '"s/|$//" FILE > field.txt`), then run `mag-tracking import field.txt --unit nT --columns '
        'time=DATE+TIME x=NAMEX y=NAMEY z=NAMEZ` with the names of its columns')),
    (re.compile(rb'^FMT\s*,', re.M), _Kind(
        'a text log of ArduPilot', 'No command reads it: extract its MAG lines as CSV, '
        + _IMPORT)),
    (re.compile(rb'^rosbag2_bagfile_information:', re.M), _Kind(
        'the metadata of a rosbag2 folder', 'Give the folder that contains it')),
    (re.compile(rb'^sensors:\s*$', re.M), _Kind(
        'a network file', 'Give a recording here, and the network file with --network')),
    (re.compile(rb'\A\s*[\[{]'), _Kind('a JSON file', _TO_CSV)),
    (re.compile(rb'\A\s*<'), _Kind('an XML or HTML file', _TO_CSV)),
    (re.compile(rb'[0-9][,;\t ]+[-+.0-9]'), _Kind(
        'a table as text', 'Convert it with `mag-tracking import FILE`')),
    (re.compile(rb''), _Kind('a text file without a table', 'Give a recording')),
)
_UNKNOWN = _Kind('of an unknown format', 'Recordings are .mcap, .db3 and .bag files and rosbag2 '
                 'folders; tables are converted with `mag-tracking import`')


def describe_file(path: Path) -> str:
    """Sentences that name a file that is no recording, its kind, and the program to read it."""
    kind = _kind_of(path)
    return f'{path} is not a recording but {kind.description}. {kind.advice}'.replace(
        'FILE', str(path))


def binary_kind(path: Path) -> str:
    """Kind of a binary file and the program to read it; empty for text and unknown formats."""
    kind = _kind_of(path)
    return '' if kind in (_UNKNOWN, *(k for _, k in _TEXT)) else \
        f'{kind.description}. {kind.advice}'.replace('FILE', str(path))


def _kind_of(path: Path) -> _Kind:
    with open(path, 'rb') as stream:
        head = stream.read(HEAD_SIZE)
    for kind in _BINARY:
        if head[kind.offset:].startswith(kind.magic):
            return kind
    if head.startswith(b'PK\x03\x04'):
        return _kind_of_zip(path)
    # A telemetry log of MAVLink: stamps [us], big endian, and the marker of the packets.
    if head[8:9] in (b'\xfd', b'\xfe') and 10**15 < int.from_bytes(head[:8], 'big') < 10**16:
        return _Kind('a telemetry log of MAVLink', 'No command reads it: run `mavlogdump.py '
                     '--types RAW_IMU,SCALED_IMU2,SCALED_IMU3 --format csv FILE` of pymavlink, '
                     + _IMPORT)
    # UTF-16 begins with a byte order mark; its zeros are dropped.
    is_utf16 = head.startswith((b'\xff\xfe', b'\xfe\xff'))
    if not is_utf16 and sum(b < 9 or 13 < b < 32 for b in head) > len(head) // 50:
        return _UNKNOWN
    text = head.replace(b'\0', b'').removeprefix(b'\xef\xbb\xbf')
    return next(kind for pattern, kind in _TEXT if pattern.search(text))


def _kind_of_zip(path: Path) -> _Kind:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return _Kind('a damaged ZIP archive', 'Copy it again')
    if any(name.startswith('xl/') for name in names):
        return _Kind('an Excel workbook', 'No command reads it: save the sheet as CSV, ' + _IMPORT)
    if names and all(name.endswith('.npy') for name in names):
        return _Kind('an archive of NumPy arrays', _TO_CSV + ', for example with numpy.savetxt')
    return _Kind('a ZIP archive', 'Unpack it with `unzip FILE`')
