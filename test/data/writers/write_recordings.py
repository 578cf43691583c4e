"""Write the recordings in this folder with libraries that the project does not use.

usage: pip install foxglove-sdk==0.30.3 pybag-sdk==0.13.0; python write_recordings.py

Each file holds 80 magnetic fields of two sensors, 10 ms apart, in chunks of 3 KB.
"""

import struct
from pathlib import Path

import foxglove
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from pybag.mcap_writer import McapFileWriter
from pybag.ros2.humble import builtin_interfaces, geometry_msgs, sensor_msgs, std_msgs

HERE = Path(__file__).parent
EPOCH_NS, STEP_NS, N, CHUNK = 1_790_000_000 * 10**9, 10_000_000, 80, 3000
TYPE = 'sensor_msgs/msg/MagneticField'
DEFINITION = '''std_msgs/Header header
geometry_msgs/Vector3 magnetic_field
float64[9] magnetic_field_covariance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
'''


def readings():
    """Yield (time [ns], sensor, field [T])."""
    for k in range(N):
        name = f'mag_{k % 2 + 1}'
        yield EPOCH_NS + k * STEP_NS, name, (1e-5 + 1e-9 * k, -2e-5, 4e-5 - 1e-9 * k * k)


def cdr(time_ns, name, field):
    """Serialise sensor_msgs/MagneticField."""
    text = name.encode() + b'\0'
    head = struct.pack('<iII', time_ns // 10**9, time_ns % 10**9, len(text)) + text
    return b'\0\1\0\0' + head + bytes(-len(head) % 8) + struct.pack('<12d', *field, *[0.0] * 9)


def write_foxglove(path, compression):
    """Write one file with foxglove-sdk."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, allow_overwrite=True, context=context,
                            writer_options=MCAPWriteOptions(
                                compression=compression, chunk_size=CHUNK, profile='ros2')):
        schema = foxglove.Schema(name=TYPE, encoding='ros2msg', data=DEFINITION.encode())
        channels = {name: foxglove.Channel(f'/{name}/imu/mag', schema=schema,
                                           message_encoding='cdr', context=context)
                    for name in ('mag_1', 'mag_2')}
        for time_ns, name, field in readings():
            channels[name].log(cdr(time_ns, name, field), log_time=time_ns)


def write_pybag(path, **options):
    """Write one file with pybag-sdk."""
    with McapFileWriter.open(path, **options) as writer:
        for time_ns, name, field in readings():
            stamp = builtin_interfaces.Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
            writer.write_message(f'/{name}/imu/mag', time_ns, sensor_msgs.MagneticField(
                header=std_msgs.Header(stamp=stamp, frame_id=name),
                magnetic_field=geometry_msgs.Vector3(**dict(zip('xyz', field, strict=True))),
                magnetic_field_covariance=[0.0] * 9))


if __name__ == '__main__':
    for path in HERE.glob('*.mcap'):
        path.unlink()
    write_foxglove(HERE / 'foxglove_zstd.mcap', MCAPCompression.Zstd)
    write_foxglove(HERE / 'foxglove_lz4.mcap', MCAPCompression.Lz4)
    write_pybag(HERE / 'pybag_plain.mcap', chunk_size=CHUNK, chunk_compression='none')
    write_pybag(HERE / 'pybag_lz4.mcap', chunk_size=CHUNK, chunk_compression='lz4')
