"""Track a recording at its original speed and show it on a live page."""

import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from mag_tracking.apps.first_pass import first_pass_of
from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Output, Pipeline, Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.report.page import NOTE, WARNING, Note, Table
from mag_tracking.units import NS
from mag_tracking.web.live_scene import LiveScene

PART_S = 0.05
"""[s] Duration of a batch of readings."""
HEALTH_S = 1.0
"""[s] Interval of health updates."""


def view(recording: Recording, network: SensorNetwork, settings: Settings, scene: LiveScene,
         rate: float, stopped: Callable[[], bool]) -> None:
    """Track a recording in real time until it ends or `stopped()` returns True.

    Parameters
    ----------
    recording : Recording
    network : SensorNetwork
    settings : Settings
    scene : LiveScene
        Receives frames and tracks.
    rate : float
        Playback speed; 1 is real time.
    stopped : function
        Called several times per second.

    Raises RecordingError.
    """
    reader, pipeline = SampleReader(recording, network), Pipeline(network, settings)
    first_pass_of(recording, network, settings.calibrate, stopped).apply(pipeline.calibrate)
    begin_ns, began, health_due = None, time.monotonic(), 0.0
    for readings in _parts(reader.readings()):
        latest_ns = int(readings.stamp_ns.max())
        begin_ns = latest_ns if begin_ns is None else begin_ns
        due = began + (latest_ns - begin_ns) / NS / rate
        while time.monotonic() < due and not stopped():
            time.sleep(min(0.05, max(0.0, due - time.monotonic())))
        if stopped():
            return
        _take(scene, pipeline.feed(readings))
        if time.monotonic() >= health_due:
            health_due = time.monotonic() + HEALTH_S
            _tell_health(scene, pipeline, reader, [])
    _take(scene, pipeline.flush())
    _tell_health(scene, pipeline, reader, [Note(NOTE, 'the recording has ended')])


def _parts(batches: Iterable[Readings]) -> Iterator[Readings]:
    """Batches of at most `PART_S`, in recorded order."""
    for readings in batches:
        part = (np.maximum.accumulate(readings.stamp_ns) - readings.stamp_ns[0]) // int(PART_S * NS)
        edges = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(readings)]
        for begin, end in zip(edges, edges[1:], strict=False):
            yield readings.part(slice(begin, end))


def _take(scene: LiveScene, records: Iterable[Output]) -> None:
    """Add frames and tracks to the scene."""
    smoothed: dict[int, list[FloatArray]] = {}
    for record in records:
        if isinstance(record, FieldFrame):
            scene.add_frame(record)
        elif isinstance(record, Track):
            scene.add_track(record)
        elif isinstance(record, SmoothedPose) and record.complete:
            smoothed.setdefault(record.id, []).append(record.position)
    for track_id, points in smoothed.items():
        scene.add_smoothed(track_id, np.array(points))


def _tell_health(scene: LiveScene, pipeline: Pipeline, reader: SampleReader,
                 notes: list[Note]) -> None:
    """Update rejections and the sensor table."""
    rejected = {**reader.rejected, **pipeline.rejections()}
    notes = [*notes, *(Note(WARNING, f'nothing on {topic}') for topic in reader.missing_topics()),
             *(Note(WARNING, f'{cause}: {n}') for cause, n in rejected.items())]
    if pipeline.track.clocks_apart:
        notes.append(Note(WARNING, pipeline.track.clocks_apart))
    rows: list[list[str | float | None]] = []
    for name, background in pipeline.calibrate.backgrounds().items():
        state = ('stuck' if background.stuck else 'doubtful' if background.doubtful else 'ready'
                 if background.ready else 'learning')
        counts = pipeline.calibrate.counts_of(name)
        rows.append([name, state, counts['accepted'], counts['rejected']])
    scene.set_health(notes, [Table('Sensors', ['sensor', 'background', 'readings used',
                                               'rejected'], rows)])
