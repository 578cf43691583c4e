"""Compressed parts that expand beyond the limit are counted as damaged, in bounded memory."""

import tracemalloc

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Message, Schema
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from mag_tracking.errors import SettingsError
from mag_tracking.messages.types import MAGNETIC_FIELD, definition
from mag_tracking.recording.expansion import (
    DECODE_ERRORS,
    LARGEST_CHUNK_VARIABLE,
    expanded,
    expanded_message,
)
from mag_tracking.recording.mcap_file import MAGIC
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.repair import repair

LIMIT = 1_000_000
EXPANDED = 64 << 20
"""Size of highly compressible input, bytes."""


@pytest.fixture(autouse=True)
def limit(monkeypatch):
    monkeypatch.setenv(LARGEST_CHUNK_VARIABLE, str(LIMIT / 1e6))


def serialised(*records):
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def messages(n, size=100, channel=1):
    return serialised(*(Message(channel_id=channel, sequence=k, log_time=k, publish_time=k,
                                data=bytes(size)) for k in range(n)))


def zstd_of(data, states_size):
    parameters = zstandard.ZstdCompressor(write_content_size=states_size)
    return parameters.compress(data)


def lz4_of(data, states_size):
    return lz4.frame.compress(data, store_size=states_size)


def write(path, compression, content, has_summary, declared=1000):
    """Write a file whose second of three chunks has the given compressed content."""
    definitions = (Schema(1, definition(MAGNETIC_FIELD).encode(), 'ros2msg', MAGNETIC_FIELD),
                   Channel(1, '/mag_1/imu/mag', 'cdr', {}, 1))
    out, indexes, good = MAGIC + serialised(Header('ros2', ''), *definitions), [], messages(10)
    for kind, data, size in (('', good, len(good)), (compression, content, declared),
                             ('', good, len(good))):
        chunk = serialised(Chunk(kind, data, 9, 0, 0, size))
        indexes.append(ChunkIndex(len(chunk), len(out), kind, len(data), 9, 0, {}, 0, size))
        out += chunk
    out += serialised(DataEnd(0))
    summary = serialised(*definitions, *indexes) if has_summary else b''
    path.write_bytes(out + summary + serialised(Footer(len(out) if has_summary else 0, 0, 0))
                     + MAGIC)


def assert_counted(recording, n_expected):
    """Check that the intact messages are read in little memory and one chunk is counted."""
    tracemalloc.start()
    n = sum(1 for _ in recording.messages())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert n in n_expected and peak < EXPANDED / 4
    (loss, count), = recording.losses.items()
    assert count == 1 and loss.startswith('damaged')
    return loss


@pytest.mark.parametrize('has_summary', [True, False])
@pytest.mark.parametrize('declared', [1000, EXPANDED, 2**63])
@pytest.mark.parametrize('compression, content', [
    ('zstd', zstd_of(bytes(EXPANDED), True)), ('zstd', zstd_of(bytes(EXPANDED), False)),
    ('lz4', lz4_of(bytes(EXPANDED), True)), ('lz4', lz4_of(bytes(EXPANDED), False)),
    ('', bytes(2 * LIMIT))], ids=['zstd', 'zstd_unsized', 'lz4', 'lz4_unsized', 'none'])
def test_a_chunk_beyond_the_limit_is_counted(compression, content, declared, has_summary,
                                             tmp_path):
    path = tmp_path / 'a.mcap'
    write(path, compression, content, has_summary, declared)
    loss = assert_counted(Recording(path), [20])
    assert '1 MB' in loss and LARGEST_CHUNK_VARIABLE in loss
    if not has_summary:
        assert repair(path, print) == 1
        assert len(list(Recording(path).messages())) == 20


def test_a_chunk_below_the_limit_is_read(tmp_path):
    content = messages(100, LIMIT // 200)
    for compression, data in (('zstd', zstd_of(content, False)), ('lz4', lz4_of(content, False)),
                              ('', content)):
        write(tmp_path / 'a.mcap', compression, data, True)
        recording = Recording(tmp_path / 'a.mcap')
        assert len(list(recording.messages())) == 120 and not recording.losses


@pytest.mark.parametrize('content', [
    messages(LIMIT // 40, 0), serialised(Channel(1, '', '', {}, 0)) * 140_000],
    ids=['messages', 'channels'])
def test_a_chunk_of_too_many_records_is_counted(content, monkeypatch, tmp_path):
    """The positions of many empty records take more memory than the records."""
    monkeypatch.setenv(LARGEST_CHUNK_VARIABLE, str(max(1.0, len(content) / 1e6)))
    write(tmp_path / 'a.mcap', 'zstd', zstd_of(content, True), True)
    recording = Recording(tmp_path / 'a.mcap')
    n = len(list(recording.messages()))
    assert n == 20 and sum(recording.losses.values()) == 1


@pytest.mark.parametrize('compression', [None, *Ros1Writer.CompressionFormat])
def test_a_chunk_of_a_ros1_bag_beyond_the_limit_is_counted(compression, monkeypatch, tmp_path):
    monkeypatch.setenv(LARGEST_CHUNK_VARIABLE, '4')
    path, types = tmp_path / 'a.bag', get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        topic = writer.add_connection('/x', 'std_msgs/msg/UInt8MultiArray', typestore=types)
        for k in range(30):
            # A chunk ends after 1 MB: the large message has up to three others in its chunk.
            writer.write(topic, k, bytes(EXPANDED if k == 15 else 300_000))
    recording = Recording(path)
    loss = assert_counted(recording, range(26, 30))
    assert '4 MB' in loss
    assert sum(1 for _ in recording.messages(start_ns=20)) == 10


def test_a_message_beyond_the_limit_is_empty():
    assert expanded_message(zstd_of(bytes(LIMIT), True)) == bytes(LIMIT)
    for compress in (zstd_of, lz4_of):
        assert expanded_message(compress(bytes(EXPANDED), False)) == b''


def test_random_input_raises_only_decode_errors():
    rng = np.random.default_rng(0)
    content, n_refused = bytes(1000) + rng.bytes(1000), 0
    for compression, compress in (('zstd', zstd_of), ('lz4', lz4_of)):
        for _ in range(200):
            data = bytearray(compress(content, True))
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            try:
                expanded(compression, bytes(data), LIMIT)
            except DECODE_ERRORS:
                n_refused += 1
    assert n_refused > 0


@pytest.mark.parametrize('value', ['0', '-1', 'x', 'inf', 'nan'])
def test_an_invalid_limit_is_named(value, monkeypatch, tmp_path):
    write(tmp_path / 'a.mcap', '', messages(1), True)
    monkeypatch.setenv(LARGEST_CHUNK_VARIABLE, value)
    with pytest.raises(SettingsError, match=LARGEST_CHUNK_VARIABLE):
        Recording(tmp_path / 'a.mcap')
