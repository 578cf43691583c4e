"""Tracking of a recording in real time, shown on a live page."""

import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from mag_tracking.apps.prescan import prescan_of
from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Output, Pipeline, Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.report.page import NOTE, WARNING, Note, Table
from mag_tracking.units import NS
from mag_tracking.web.live_scene import LiveScene

BATCH_S = 0.05
"""Duration of a batch of readings [s]."""
MAX_WAIT_S = 5.0
"""Maximum wait during a gap in a recording [s]."""
HEALTH_INTERVAL_S = 1.0
"""Interval between updates of the sensor health [s]."""


def view(recording: Recording, network: SensorNetwork, settings: Settings, scene: LiveScene,
         rate: float, stopped: Callable[[], bool]) -> None:
    """Track a recording in real time (`rate` 1) until it ends or `stopped()` returns true.

    `scene` receives frames, tracks and the state of the sensors; `stopped` is called several times
    per second.
    """
    reader, pipeline = SampleReader(recording, network), Pipeline(network, settings)
    prescan_of(recording, network, settings.calibrate, stopped).apply(pipeline.calibrate)
    playback_due, last_log_ns, health_due = time.monotonic(), None, 0.0
    for readings, log_ns in _batches(reader.readings_as_received()):
        # Log times set the pace, because one wrong sensor timestamp could stop the playback.
        step_s = 0.0 if last_log_ns is None else (log_ns - last_log_ns) / NS
        playback_due, last_log_ns = playback_due + min(max(step_s, 0.0), MAX_WAIT_S) / rate, log_ns
        while time.monotonic() < playback_due and not stopped():
            time.sleep(min(0.05, max(0.0, playback_due - time.monotonic())))
        if stopped():
            return
        _add_records(scene, pipeline.feed(readings))
        if time.monotonic() >= health_due:
            health_due = time.monotonic() + HEALTH_INTERVAL_S
            _update_health(scene, pipeline, reader, [])
    _add_records(scene, pipeline.flush())
    _update_health(scene, pipeline, reader, [Note(NOTE, 'end of the recording')])


def _batches(messages: Iterable[tuple[Readings, int]]) -> Iterator[tuple[Readings, int]]:
    """Yield batches of about `BATCH_S`, each with the log time of its last message [ns]."""
    batch: list[Readings] = []
    begin_ns = log_ns = 0
    for readings, log_ns in messages:
        if not batch:
            begin_ns = log_ns
        batch.append(readings)
        if not 0 <= log_ns - begin_ns < BATCH_S * NS:
            yield Readings.joined(batch), log_ns
            batch = []
    if batch:
        yield Readings.joined(batch), log_ns


def _add_records(scene: LiveScene, records: Iterable[Output]) -> None:
    """Add frames, poses and tracks smoothed over their whole length to the scene."""
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


def _update_health(scene: LiveScene, pipeline: Pipeline, reader: SampleReader,
                   notes: list[Note]) -> None:
    """Update the notes and the table of sensors."""
    rejected = {**reader.rejected, **pipeline.rejections()}
    notes = [*notes,
             *(Note(WARNING, f'no messages on {topic}') for topic in reader.missing_topics()),
             *(Note(WARNING, f'{cause}: {n}') for cause, n in rejected.items())]
    if pipeline.track.clock_warning:
        notes.append(Note(WARNING, pipeline.track.clock_warning))
    rows: list[list[str | float | None]] = []
    for name, background in pipeline.calibrate.backgrounds().items():
        state = ('stuck' if background.stuck else 'doubtful' if background.doubtful else 'ready'
                 if background.ready else 'learning')
        counts = pipeline.calibrate.counts_of(name)
        rows.append([name, state, counts['accepted'], counts['rejected']])
    scene.set_health(notes, [Table('Sensors', ['sensor', 'background', 'readings used',
                                               'rejected'], rows)])
