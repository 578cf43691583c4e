"""Repair of truncated and damaged recordings."""

import io
import struct
import zlib

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from mag_tracking.cli import main
from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.messages.types import MAGNETIC_FIELD, definition
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.repair import finish_file, repair
from support.recorded_numbers import TOPIC, S, by_rosbags, field, numbers, started

# Not run in parallel with tests that load the machine.
pytestmark = pytest.mark.alone


def unfinished_recording(tmp_path, tick=True):
    """Record two topics; return the bytes of the file before and after it was finished."""
    recorder, _ = started(tmp_path / 'source')
    recorder.add_topic('/other', MAGNETIC_FIELD, definition(MAGNETIC_FIELD))
    for k in range(200):
        recorder.write(TOPIC, field(k), k)
        recorder.write('/other', field(k), k)
        recorder.tick(S + k * S // 100)
    unfinished = (tmp_path / 'source' / 'source_0.mcap').read_bytes()
    recorder.close()
    return unfinished, (tmp_path / 'source' / 'source_0.mcap').read_bytes()


def test_repair_recovers_a_file_truncated_at_any_byte(tmp_path):
    unfinished, finished = unfinished_recording(tmp_path)
    assert finished.startswith(unfinished)
    data = finished[:-8]
    last = [c for c in make_reader(io.BytesIO(finished)).get_summary().chunk_indexes
            if c.chunk_start_offset < len(unfinished)][-1]
    last_chunk_end = last.chunk_start_offset + last.chunk_length
    file = tmp_path / 'cut' / 'x_0.mcap'
    file.parent.mkdir()
    for cut in sorted({*np.linspace(60, len(data), 60, dtype=int), last_chunk_end,
                       last_chunk_end + 9, len(unfinished), len(data)}):
        file.write_bytes(data[:cut])
        before = {t: numbers(file, t)[0] for t in (TOPIC, '/other')}
        reports = []
        if not any(before.values()):
            with pytest.raises(RecordingError, match='nothing recovered'):
                repair(file.parent, reports.append)
            continue
        assert repair(file.parent, reports.append) == 1
        with open(file, 'rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            for topic, found in before.items():
                assert [stamp_ns_of(m) for _, _, m in reader.iter_messages([topic])] == found
        for topic, found in before.items():
            assert [k for _, k in by_rosbags(file.parent, topic)] == found
        cut_file = file.with_name('x_0.mcap.cut')
        kept = cut_file.read_bytes() if cut_file.exists() else b''
        assert any(f'bytes: {len(kept)}' in line for line in reports) == bool(kept)
        if cut <= len(unfinished):
            head = file.read_bytes()
            assert head.startswith(data[:cut - len(kept)]) and data[:cut].endswith(kept)
        cut_file.unlink(missing_ok=True)
        repaired = file.read_bytes()
        start, _, crc = struct.unpack('<QQI', repaired[-28:-8])
        assert crc == zlib.crc32(repaired[start:-12])
        if last_chunk_end <= cut <= len(unfinished):
            # The rebuilt indexes of the last chunk equal the original indexes.
            assert repaired.startswith(unfinished)
        assert repair(file.parent) == 0 and file.read_bytes() == repaired


@pytest.mark.parametrize('compression', list(CompressionType))
def test_repair_saves_the_beginning_of_a_cut_chunk(compression, tmp_path):
    path = tmp_path / 'a.mcap'
    with open(path, 'wb') as stream:
        writer = Writer(stream, chunk_size=1 << 30, compression=compression)
        writer.start('ros2')
        channel = writer.register_channel('/x', 'json', 0)
        rng = np.random.default_rng(0)
        for k in range(4000):
            writer.add_message(channel, k, rng.bytes(200) + struct.pack('<I', k), k)
        writer.finish()
    data = path.read_bytes()
    entry, = make_reader(io.BytesIO(data)).get_summary().chunk_indexes
    for share, least in ((0.0, 0), (0.5, 0.3), (0.95, 0.7)):
        cut = data[:entry.chunk_start_offset + 60 + int(share * entry.compressed_size)]
        path.write_bytes(cut)
        n_before, reports = len(list(Recording(path).messages())), []
        if not n_before:
            assert main(['repair', str(path)]) == 1
            continue
        assert n_before >= least * 4000 and repair(path, reports.append) == 1
        assert any(f'{n_before}' in line for line in reports)
        with open(path, 'rb') as stream:
            found = [m for _, _, m in make_reader(stream, validate_crcs=True).iter_messages()]
        assert [struct.unpack('<I', m.data[-4:])[0] for m in found] == list(range(n_before))
        assert [m.log_time for m in found] == list(range(n_before))
        repaired = Recording(path)
        assert not repaired.losses and len(list(repaired.messages())) == n_before
        # The original end is kept beside the file.
        kept = (tmp_path / 'a.mcap.cut').read_bytes()
        assert cut.endswith(kept) and len(kept) > entry.compressed_size * share
        (tmp_path / 'a.mcap.cut').unlink()


def test_nothing_recovered_is_an_error(tmp_path, capsys):
    unfinished, _ = unfinished_recording(tmp_path)
    path = tmp_path / 'a.mcap'
    path.write_bytes(unfinished[:50])
    assert main(['repair', str(path)]) == 1
    assert 'nothing recovered' in capsys.readouterr().err


def stamp_ns_of(message):
    """Decode the timestamp [ns] at the start of a serialised magnetic field."""
    sec, nanosec = struct.unpack_from('<iI', message.data, 4)
    return sec * S + nanosec


def test_repair_keeps_the_order_of_many_files(tmp_path):
    recorder, _ = started(tmp_path / 'a', split_ns=S)
    for k in range(24):
        recorder.write(TOPIC, field(k), k)
        recorder.tick(2 * (k + 2) * S)
    recorder.close()
    assert (tmp_path / 'a' / 'a_11.mcap').exists()
    metadata = tmp_path / 'a' / 'metadata.yaml'
    original = yaml.safe_load(metadata.read_text())
    metadata.unlink()
    assert repair(tmp_path / 'a') == 0 and numbers(tmp_path / 'a')[0] == list(range(24))
    assert yaml.safe_load(metadata.read_text()) == original


@pytest.mark.parametrize('name', ['a_0.mcap', 'a_12.mcap'])
def test_an_empty_file_after_a_crash_affects_no_other_file(tmp_path, name):
    """The empty file is the first file, or a later file that had just been created."""
    recorder, _ = started(tmp_path / 'a', split_ns=S)
    for k in range(24):
        recorder.write(TOPIC, field(k), k)
        recorder.tick(2 * (k + 2) * S)
    recorder.close()
    kept = sorted(set(range(24)) - set(numbers(tmp_path / 'a' / name)[0]))
    assert len(kept) < 24
    (tmp_path / 'a' / name).write_bytes(b'')
    (tmp_path / 'a' / 'metadata.yaml').unlink()
    recording = Recording(tmp_path / 'a')
    assert len(list(recording.messages())) == len(kept)
    assert recording.losses == {f'empty files ({name})': 1}
    reports = []
    repair(tmp_path / 'a', reports.append)
    (report,) = reports
    assert report.startswith(f'{tmp_path / "a" / name} is empty')
    assert numbers(tmp_path / 'a')[0] == kept


def test_repair_skips_and_reports_a_damaged_chunk(tmp_path):
    unfinished, finished = unfinished_recording(tmp_path)
    file = tmp_path / 'x.mcap'
    damaged = bytearray(unfinished)
    middle = make_reader(io.BytesIO(finished)).get_summary().chunk_indexes[2]
    damaged[middle.chunk_start_offset + middle.chunk_length // 2] ^= 0xFF
    file.write_bytes(damaged)
    before, reports = numbers(file)[0], []
    assert 0 < len(before) < 200
    assert repair(file, reports.append) == 1
    assert any('skipped: 1' in line for line in reports), reports
    # The message indexes of the damaged chunk do not belong to the chunk before it.
    with open(file, 'rb') as stream:
        entries = make_reader(stream).get_summary().chunk_indexes
    for entry in entries:
        end = entry.chunk_start_offset + entry.chunk_length
        assert all(end <= offset < end + entry.message_index_length
                   for offset in entry.message_index_offsets.values())
    assert [k for _, k in by_rosbags(file)] == before


def test_damaged_chunks_of_a_file_with_an_index_are_reported(tmp_path, capsys):
    _, finished = unfinished_recording(tmp_path)
    damaged, file = bytearray(finished), tmp_path / 'x' / 'x_0.mcap'
    middle = make_reader(io.BytesIO(finished)).get_summary().chunk_indexes[2]
    damaged[middle.chunk_start_offset + middle.chunk_length // 2] ^= 0xFF
    file.parent.mkdir()
    file.write_bytes(damaged)
    assert main(['repair', str(file.parent)]) == 1
    printed = capsys.readouterr()
    assert '(x_0.mcap' in printed.out and 'restored' in printed.out
    assert 'nothing recovered' in printed.err
    assert file.read_bytes() == damaged and (file.parent / 'metadata.yaml').exists()


def test_a_recording_in_progress_is_not_repaired(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.write(TOPIC, field(0), 1)
    with pytest.raises(OutputError, match='a_0.mcap is'):
        repair(tmp_path / 'a')
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [0] and repair(tmp_path / 'a') == 0


def test_repair_refuses_files_that_are_no_recording(tmp_path):
    with pytest.raises(RecordingError, match='contains no .mcap file'):
        repair(tmp_path / 'nothing')
    (tmp_path / 'x.mcap').write_text('nonsense of some length')
    with pytest.raises(RecordingError, match='x.mcap'):
        finish_file(tmp_path / 'x.mcap')
    assert (tmp_path / 'x.mcap').read_text() == 'nonsense of some length'


@pytest.mark.parametrize('qos', ['a: [', '[' * 80 + ']' * 80, '\n'.join(
    ['a0: &a0 [1, 1, 1, 1]'] + [f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]'
                                for k in range(1, 30)])])
def test_repair_refuses_a_topic_whose_qos_is_not_yaml(tmp_path, qos):
    with open(tmp_path / 'x_0.mcap', 'wb') as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema('std_msgs/msg/Header', 'ros2msg', b'')
        writer.register_channel('/x', 'cdr', schema, {'offered_qos_profiles': qos})
        writer.add_message(1, 1, b'\0\1\0\0', 1)
        writer.finish()
    with pytest.raises(RecordingError, match='offered_qos_profiles of /x'):
        repair(tmp_path)
    assert not (tmp_path / 'metadata.yaml').exists()
