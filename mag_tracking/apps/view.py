"""Tracking of a recording in real time, shown on a live page."""

import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings, Step
from mag_tracking.recording.message_block import Progress
from mag_tracking.recording.reader import Recording
from mag_tracking.records import Readings, SmoothedPose
from mag_tracking.report.page import NOTE, WARNING, Note, Table
from mag_tracking.run import RecordingSource, Source, run
from mag_tracking.units import NS
from mag_tracking.web.live_scene import LiveScene

BATCH_S = 0.05
MAX_WAIT_S = 5.0
"""Maximum wait during a gap in a recording [s]."""
HEALTH_INTERVAL_S = 1.0


def view(recording: Recording, network: SensorNetwork, settings: Settings, scene: LiveScene,
         rate: float, stopped: Callable[[], bool]) -> None:
    """Track a recording in real time (`rate` 1) until it ends or `stopped()` returns true."""
    source, pipeline = _PacedSource(recording, network, rate, stopped), Pipeline(network, settings)
    run(source, pipeline, [_SceneSink(scene, pipeline, source, stopped)], stopped=stopped)


class _PacedSource(RecordingSource):
    """Readings of a recording in batches of about `BATCH_S`, at the pace of their log times."""

    def __init__(self, recording: Recording, network: SensorNetwork, rate: float,
                 stopped: Callable[[], bool]) -> None:
        super().__init__(recording, network, by_message=True)
        self._rate, self._stopped = rate, stopped

    def batches(self, progress: Progress | None = None) -> Iterator[tuple[Readings, int | None]]:
        due, last_log_ns = time.monotonic(), None
        for readings, log_ns in _joined(self.reader.readings_as_received(progress)):
            # Log times set the pace, because one wrong sensor timestamp could stop the playback.
            step_s = 0.0 if last_log_ns is None else (log_ns - last_log_ns) / NS
            due, last_log_ns = due + min(max(step_s, 0.0), MAX_WAIT_S) / self._rate, log_ns
            while time.monotonic() < due and not self._stopped():
                time.sleep(min(0.05, max(0.0, due - time.monotonic())))
            if self._stopped():
                return
            yield readings, log_ns


def _joined(messages: Iterable[tuple[Readings, int]]) -> Iterator[tuple[Readings, int]]:
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


class _SceneSink(RecordReceiver):
    """Adds frames, poses, tracks smoothed over their whole length, and the health to a scene."""

    def __init__(self, scene: LiveScene, pipeline: Pipeline, source: Source,
                 stopped: Callable[[], bool]) -> None:
        self._scene, self._pipeline, self._source = scene, pipeline, source
        self._stopped, self.add_frame, self.add_track = stopped, scene.add_frame, scene.add_track
        self._health_due, self._smoothed = 0.0, dict[int, list[FloatArray]]()

    def add(self, step: Step) -> None:
        self._smoothed.clear()
        self.receive(step.records)
        for track_id, points in self._smoothed.items():
            self._scene.add_smoothed(track_id, np.array(points))
        if step.is_last:
            self._update_health([] if self._stopped() else [Note(NOTE, 'end of the recording')])
        elif time.monotonic() >= self._health_due:
            self._health_due = time.monotonic() + HEALTH_INTERVAL_S
            self._update_health([])

    def add_smoothed(self, pose: SmoothedPose) -> None:
        if pose.complete:
            self._smoothed.setdefault(pose.id, []).append(pose.position)

    def _update_health(self, notes: list[Note]) -> None:
        pipeline, source = self._pipeline, self._source
        not_used = {**source.rejected, **pipeline.rejections()}
        notes = [*notes,
                 *(Note(WARNING, f'no messages on {topic}') for topic in source.missing_topics()),
                 *(Note(WARNING, f'{cause}: {n}') for cause, n in not_used.items())]
        if pipeline.track.clock_warning:
            notes.append(Note(WARNING, pipeline.track.clock_warning))
        rows: list[list[str | float | None]] = []
        for name, background in pipeline.calibrate.backgrounds().items():
            state = ('stuck' if background.stuck else 'doubtful' if background.doubtful else
                     'ready' if background.ready else 'learning')
            counts = pipeline.calibrate.counts_of(name)
            rows.append([name, state, counts['accepted'], counts['rejected']])
        self._scene.set_health(notes, [Table('Sensors', ['sensor', 'background', 'readings used',
                                                         'rejected'], rows)])
