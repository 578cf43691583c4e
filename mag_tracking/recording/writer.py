"""Writer of MCAP recordings that rosbag2 can play."""

from collections import Counter
from collections.abc import Collection
from os import PathLike
from pathlib import Path

import yaml
from mcap.writer import CompressionType, Writer

from mag_tracking.errors import OutputError
from mag_tracking.files import checked_path, new_binary_file, new_text_file
from mag_tracking.messages.shapes import MessageDict
from mag_tracking.messages.types import definition, encoder

MAX_TOPICS = 2000
"""Maximum number of topics; twice the maximum number of sensors. The time to write and to read
`metadata.yaml` grows with their number."""


def check_no_other_recording(path: Path) -> None:
    """Raise OutputError if the folder of a new MCAP file has a `metadata.yaml` that does not list
    it."""
    metadata = path.parent / 'metadata.yaml'
    try:
        # Only a regular file is read: a pipe or a device could block.
        if metadata.is_file() and f'- {path.name}\n' not in metadata.read_text(
                encoding='utf-8', errors='replace'):
            raise OutputError(f'{path.parent} contains another recording (its metadata.yaml does '
                              f'not list {path.name}): choose another folder')
    except OSError as error:
        raise OutputError(f'cannot read {metadata}: {error.strerror}') from error


class RecordingWriter:
    """Writes messages to an MCAP file that rosbag2 can play; a context manager.

    A `metadata.yaml` in the same folder makes the folder a rosbag2 recording. Small chunks limit
    the loss in a crash. `latched` are the topics with transient local durability. Parent folders
    are created; raises OutputError if the folder contains another recording.
    """

    def __init__(self, path: str | PathLike[str], latched: Collection[str] = ()) -> None:
        self._latched = frozenset(latched)
        self.path = checked_path(path, OutputError)
        check_no_other_recording(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = new_binary_file(self.path)
        except OSError as error:
            raise OutputError(f'cannot write {self.path}: {error.strerror}') from error
        self._writer = Writer(self._stream, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='mag_tracking')
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: Counter[str] = Counter()
        self._sequence: Counter[str] = Counter()
        self._first: int | None = None
        self._last: int | None = None

    def __enter__(self) -> 'RecordingWriter':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, topic: str, type_name: str, message: MessageDict, time_ns: int) -> None:
        """Append a message with its fields and log time.

        Raises RecordingError if the definition of the type is unknown, OutputError beyond
        `MAX_TOPICS`.
        """
        if topic not in self._channels:
            self._open_channel(topic, type_name)
        self._writer.add_message(
            self._channels[topic][0], log_time=time_ns, publish_time=time_ns,
            sequence=self._sequence[topic], data=encoder(type_name)(message))
        self._sequence[topic] += 1
        self._counts[topic] += 1
        self._first = time_ns if self._first is None else min(self._first, time_ns)
        self._last = time_ns if self._last is None else max(self._last, time_ns)

    def _open_channel(self, topic: str, type_name: str) -> None:
        """Register the schema and the channel of a topic; raises OutputError."""
        if len(self._channels) == MAX_TOPICS:
            raise OutputError(f'{self.path}: the recording would have more than {MAX_TOPICS} '
                              f'topics; the next one is {topic}')
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', definition(type_name).encode())
        channel = self._writer.register_channel(
            topic, 'cdr', self._schemas[type_name],
            {'offered_qos_profiles': offered_qos(latched=topic in self._latched)})
        self._channels[topic] = channel, type_name

    def close(self) -> None:
        """Complete the file and write `metadata.yaml`."""
        if self._stream.closed:
            return
        self._writer.finish()
        self._stream.close()
        first, last = self._first or 0, self._last or 0
        metadata = {'rosbag2_bagfile_information': {
            'version': 9, 'storage_identifier': 'mcap',
            'duration': {'nanoseconds': last - first},
            'starting_time': {'nanoseconds_since_epoch': first},
            'message_count': sum(self._counts.values()),
            'topics_with_message_count': [
                {'topic_metadata': {'name': t, 'type': type_name, 'serialization_format': 'cdr',
                                    'offered_qos_profiles': yaml.safe_load(offered_qos(
                                        latched=t in self._latched)),
                                    'type_description_hash': ''},
                 'message_count': self._counts[t]}
                for t, (_, type_name) in self._channels.items()],
            'compression_format': '', 'compression_mode': '',
            'relative_file_paths': [self.path.name],
            'files': [{'path': self.path.name,
                       'starting_time': {'nanoseconds_since_epoch': first},
                       'duration': {'nanoseconds': last - first},
                       'message_count': sum(self._counts.values())}],
            'custom_data': None, 'ros_distro': 'jazzy'}}
        with new_text_file(self.path.parent / 'metadata.yaml') as stream:
            yaml.safe_dump(metadata, stream, sort_keys=False)


OFFERED_QOS = '''- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: automatic
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
'''
"""Default QoS profile of a topic: reliable and volatile, depth 10."""


def offered_qos(reliable: bool = True, latched: bool = False) -> str:
    """QoS profile of a topic as rosbag2 writes it in `offered_qos_profiles`, YAML.

    Without `reliable` it is best-effort, without `latched` volatile.
    """
    text = OFFERED_QOS if reliable else OFFERED_QOS.replace('reliability: reliable',
                                                            'reliability: best_effort')
    return text.replace('durability: volatile', 'durability: transient_local') if latched else text
