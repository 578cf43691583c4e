"""Recordings of several writers, intact, cut and damaged, give what the `mcap` library reads."""

import io
import shutil
from collections import Counter
from itertools import product

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from mag_tracking.messages.types import MAGNETIC_FIELD, definition, encoder
from mag_tracking.recording.mcap_file import MAGIC
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.writer import RecordingWriter
from support.bundled import ROOT

BUNDLED = {path.stem: path for path in sorted((ROOT / 'test/data/writers').glob('*.mcap'))}
EPOCH_NS, STEP_NS, N = 1_790_000_000 * 10**9, 10_000_000, 80
CHUNK = 3000
N_OWN = 21_000
"""Number of messages in three chunks of the product's own writer."""


def samples():
    """Messages (topic, log time [ns], CDR bytes) of two sensors."""
    for k in range(N):
        name, time_ns = f'mag_{k % 2 + 1}', EPOCH_NS + k * STEP_NS
        yield f'/{name}/imu/mag', time_ns, encoder(MAGNETIC_FIELD)({
            'header': {'stamp': {'sec': time_ns // 10**9, 'nanosec': time_ns % 10**9},
                       'frame_id': name},
            'magnetic_field': {'x': 1e-5 + 1e-9 * k, 'y': -2e-5, 'z': 4e-5}})


def write_by_mcap(path, **options):
    """Write the samples with the library `mcap`."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, chunk_size=CHUNK, **options)
        writer.start('ros2')
        schema = writer.register_schema(MAGNETIC_FIELD, 'ros2msg',
                                        definition(MAGNETIC_FIELD).encode())
        channels = {}
        for topic, time_ns, data in samples():
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()


def write_own(path):
    """Write the samples with the product, in chunks as after a crash."""
    with RecordingWriter(path) as writer:
        for k in range(N_OWN):
            time_ns = EPOCH_NS + k * STEP_NS
            writer.write(f'/mag_{k % 2 + 1}/imu/mag', MAGNETIC_FIELD, {
                'header': {'stamp': {'sec': time_ns // 10**9, 'nanosec': time_ns % 10**9}},
                'magnetic_field': {'x': 1e-5 + 1e-12 * k, 'y': k % 7, 'z': 4e-5}}, time_ns)


WRITERS = {
    'own': write_own,
    **{f'mcap_{c.name.lower()}': lambda path, c=c: write_by_mcap(path, compression=c)
       for c in CompressionType},
    **{name: lambda path, source=source: shutil.copy(source, path)
       for name, source in BUNDLED.items()}}


@pytest.fixture(scope='module', params=WRITERS)
def written(request, tmp_path_factory):
    """A file, its messages as read by `mcap`, and the messages of each chunk."""
    path = tmp_path_factory.mktemp('writer') / 'a.mcap'
    WRITERS[request.param](path)
    data = path.read_bytes()
    return data, oracle(data), chunks_of(data)


def oracle(data, start=None):
    """Messages (topic, log time [ns], bytes) as the library `mcap` reads them, sorted."""
    reader = NonSeekingReader(io.BytesIO(data)) if start is None else make_reader(io.BytesIO(data))
    return sorted((c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages(
        starting_at=start))


def chunks_of(data):
    """Chunk indexes and the messages of each chunk, [(index, number of messages, times)]."""
    out, stream = [], io.BytesIO(data)
    for entry in make_reader(stream).get_summary().chunk_indexes:
        stream.seek(entry.chunk_start_offset)
        chunk = next(iter(StreamReader(stream, skip_magic=True, emit_chunks=True).records))
        out.append((entry, [m.log_time for m in breakup_chunk(chunk) if isinstance(m, Message)]))
    assert len(out) >= 3
    return out


def read(data, folder, start=None):
    """Messages (topic, log time [ns], bytes) as the product reads them, sorted; and the losses."""
    path = folder / 'read.mcap'
    path.write_bytes(data)
    recording = Recording(path)
    times = [m.log_time_ns for m in recording.messages()]
    assert times == sorted(times)
    # A second pass over the same object finds the same.
    losses = Counter(recording.losses)
    found = sorted((m.topic, m.log_time_ns, m.data) for m in recording.messages(start_ns=start))
    assert recording.losses == losses
    assert recording.losses or recording.message_counts.total() in (0, len(times))
    return found, losses


def test_an_intact_file_is_read_from_any_time(written, tmp_path):
    data, expected, chunks = written
    assert len(expected) in (N, N_OWN)
    assert read(data, tmp_path) == (expected, {})
    for _, times in chunks:
        for start in (times[0], times[len(times) // 2], times[-1] + 1):
            found, losses = read(data, tmp_path, start)
            assert found == oracle(data, start) and not losses


@pytest.mark.parametrize('place', [0.0, 0.4, 0.99])
def test_a_flipped_bit_loses_only_its_chunk(written, place, tmp_path):
    data, expected, chunks = written
    for entry, times in chunks:
        damaged = bytearray(data)
        # The content of a chunk is its end.
        begin = entry.chunk_start_offset + entry.chunk_length - entry.compressed_size
        damaged[begin + int(place * entry.compressed_size)] ^= 0x10
        start = times[-1] + 1
        found, losses = read(damaged, tmp_path)
        lost = set(times)
        assert found == [m for m in expected if m[1] not in lost]
        assert sum(losses.values()) == 1 and next(iter(losses)).startswith('damaged segments')
        found, _ = read(damaged, tmp_path, start)
        assert found == [m for m in expected if m[1] >= start]


def test_damage_beside_the_content_of_chunks_loses_no_message(written, tmp_path):
    """The header of a chunk repeats what the index states; message indexes are not needed."""
    data, expected, chunks = written
    for entry, _ in chunks:
        for position in (entry.chunk_start_offset + 9, entry.chunk_start_offset + 25,
                         entry.chunk_start_offset + entry.chunk_length + 12):
            damaged = bytearray(data)
            damaged[position] ^= 0x10
            assert read(damaged, tmp_path) == (expected, {})


def test_a_cut_file_is_read_up_to_its_end(written, tmp_path):
    data, expected, chunks = written
    times = sorted(m[1] for m in expected)
    for entry, _ in chunks:
        n_before = sum(len(t) for e, t in chunks
                       if e.chunk_start_offset < entry.chunk_start_offset)
        n_chunk = len(next(t for e, t in chunks if e is entry))
        begin = entry.chunk_start_offset
        for cut in (begin, begin + 5, begin + 40, begin + entry.chunk_length // 2,
                    begin + entry.chunk_length):
            found, losses = read(data[:cut], tmp_path)
            # The beginning of a cut chunk is read as far as its compression permits.
            assert n_before <= len(found) <= n_before + n_chunk
            assert [m[1] for m in sorted(found, key=lambda m: m[1])] == times[:len(found)]
            assert set(found) <= set(expected) and losses
    assert len(read(data[:-1], tmp_path)[0]) == len(expected)


@pytest.mark.parametrize('chunking, index, repeat, statistics', list(product(
    [True, False], [IndexType.ALL, IndexType.NONE, IndexType.CHUNK], [True, False],
    [True, False])))
def test_a_file_without_parts_of_its_summary_is_read(chunking, index, repeat, statistics,
                                                     tmp_path):
    write_by_mcap(tmp_path / 'a.mcap', use_chunking=chunking, index_types=index,
                  repeat_channels=repeat, repeat_schemas=repeat, use_statistics=statistics,
                  use_summary_offsets=False)
    data = (tmp_path / 'a.mcap').read_bytes()
    assert read(data, tmp_path) == (sorted(samples()), {})
    start = EPOCH_NS + 50 * STEP_NS
    assert read(data, tmp_path, start)[0] == sorted(s for s in samples() if s[1] >= start)
    recording = Recording(tmp_path / 'a.mcap')
    assert set(recording.types.values()) == {MAGNETIC_FIELD} and len(recording.types) == 2
    assert (recording.start_ns, recording.end_ns) == (EPOCH_NS, EPOCH_NS + (N - 1) * STEP_NS)


def serialised(*records):
    """Bytes of records."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def mixed(has_summary):
    """A file with its definitions and some of its messages outside of its chunks."""
    topics = ('/mag_1/imu/mag', '/mag_2/imu/mag')
    definitions = (Schema(1, definition(MAGNETIC_FIELD).encode(), 'ros2msg', MAGNETIC_FIELD),
                   *(Channel(k + 1, topic, 'cdr', {}, 1) for k, topic in enumerate(topics)))
    out, indexes = MAGIC + serialised(Header('ros2', 'test'), *definitions), []
    messages = [Message(channel_id=topics.index(topic) + 1, sequence=k, log_time=time_ns,
                        publish_time=time_ns, data=data)
                for k, (topic, time_ns, data) in enumerate(samples())]
    for first in range(0, N, 10):
        part = messages[first:first + 10]
        content, times = serialised(*part), (part[-1].log_time, part[0].log_time)
        if first // 10 % 3:
            chunk = serialised(Chunk('', content, *times, 0, len(content)))
            indexes.append(ChunkIndex(len(chunk), len(out), '', len(content), times[0], 0, {},
                                      times[1], len(content)))
        out += chunk if first // 10 % 3 else content
    out += serialised(DataEnd(0))
    summary = serialised(*definitions, Statistics(
        0, 2, {1: N // 2, 2: N // 2}, len(indexes), N, messages[-1].log_time, EPOCH_NS, 0, 1),
        *indexes)
    if not has_summary:
        return out + serialised(Footer(0, 0, 0)) + MAGIC
    return out + summary + serialised(Footer(len(out), 0, 0)) + MAGIC


@pytest.mark.parametrize('has_summary', [True, False])
def test_records_outside_of_chunks_are_read(has_summary, tmp_path):
    data = mixed(has_summary)
    assert oracle(data) == sorted(samples())
    assert read(data, tmp_path) == (sorted(samples()), {})


def test_a_damaged_summary_loses_no_message(written, tmp_path):
    data, expected, _ = written
    summary_begin = data.index(b'\x0f\x04\0\0\0\0\0\0\0')
    for position in np.linspace(summary_begin + 13, len(data) - 9, 25, dtype=int):
        damaged = bytearray(data)
        damaged[position] ^= 0x10
        found, _ = read(damaged, tmp_path)
        assert found == expected


@pytest.mark.parametrize('changes', [
    {'chunk_start_offset': 2**64 - 1}, {'chunk_start_offset': 0}, {'chunk_length': 2**63},
    {'message_index_length': 2**63}, {'message_index_length': 0}])
def test_a_wrong_index_loses_no_message(changes, tmp_path):
    """The entry of the second chunk is wrong, in a summary without a CRC."""
    write_by_mcap(tmp_path / 'a.mcap')
    data = (tmp_path / 'a.mcap').read_bytes()
    summary = make_reader(io.BytesIO(data)).get_summary()
    for name, value in changes.items():
        setattr(summary.chunk_indexes[1], name, value)
    end = data.index(serialised(DataEnd(0))[:9]) + 13
    changed = data[:end] + serialised(
        *summary.schemas.values(), *summary.channels.values(), summary.statistics,
        *summary.chunk_indexes) + serialised(Footer(end, 0, 0)) + MAGIC
    found, losses = read(changed, tmp_path)
    assert found == sorted(samples()) and not losses
