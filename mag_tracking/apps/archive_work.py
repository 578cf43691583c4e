"""The tasks of an archive: cut a recording, track its stretches, join the tables.

Each task leaves a folder in that of its recording and does nothing where it is there, so that it
may be run again at any time.
"""

import copy
import json
import pickle
import secrets
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.archive_health import HealthRows
from mag_tracking.apps.archive_segments import SegmentWriter, read_segment
from mag_tracking.apps.archive_tracks import TRACKED, SegmentTables
from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.arrays import IntArray
from mag_tracking.errors import OutputError
from mag_tracking.files import replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.recording.archive_folder import common_columns, join_tables, recording_key
from mag_tracking.recording.archive_tables import TABLES
from mag_tracking.recording.parquet_table import TableWriter
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.clock_comparison import ClockComparison
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.rigid_pass import RigidPass

N_DIPOLES = 3
"""Number of dipoles of the rows that passes are fitted with."""

KNOWN, TRACKED_FILE = 'known.json', 'tracked.pickle'
"""Files in which a task leaves its result for the next one, beside the tables."""


@dataclass(frozen=True)
class Job:
    """One recording of an archive."""

    recording: Path
    work: Path
    """The folder of results that are not complete."""
    folder: Path
    """The folder of the archive."""
    network: SensorNetwork
    settings: Settings

    @property
    def cut(self) -> Path:
        """The folder of what `cut` leaves: stretches, health, and what is known."""
        return self.work / 'cut'

    def segment(self, k: int) -> Path:
        """The folder of what `track_segment` leaves."""
        return self.work / f'stretch-{k}'


class RecordedEvidence(ClockComparison):
    """Notes the passes that it counts.

    Attributes
    ----------
    passes : list of (RigidPass, IntArray)
    was_apart : bool
        Whether clocks were ever apart: then what was tracked depends on the passes before.
    """

    def __init__(self, n_sensors: int) -> None:
        super().__init__(n_sensors)
        self.passes: list[tuple[RigidPass, IntArray]] = []
        self.was_apart = False

    def add(self, found: RigidPass, rows: IntArray) -> None:
        """Count a pass of the sensors `rows`."""
        super().add(found, rows)
        self.passes.append((found, rows))
        self.was_apart |= self.apart is not None


@dataclass
class _Tracked:
    """The result of `track_segment` beside its tables."""

    n_tracks: int
    n_passes: int
    evidence: RecordedEvidence = field(repr=False)


def cut(job: Job) -> dict[str, Any]:
    """Read the recording: its stretches go to files, its health to a table.

    Returns the columns of the recording itself.

    Raises
    ------
    MagTrackingError
        If the recording cannot be read, or something cannot be written.
    """
    if not job.cut.exists():
        with _attempt(job.cut) as folder:
            with TableWriter(folder / 'health.parquet', TABLES['health']) as table:
                known = _Cut(job, folder, table).read()
            replace_text(folder / KNOWN, json.dumps(known))
    read: dict[str, Any] = json.loads((job.cut / KNOWN).read_text())
    return read


@contextmanager
def _attempt(final: Path) -> Iterator[Path]:
    """A folder to write to, which gets the name `final` when all is in it.

    Another attempt at the same task may be going on, on a worker that was taken for lost or for a
    run that was killed: whichever is the first counts, and both have the same. Raises OutputError.
    """
    draft = final.with_name(f'.{secrets.token_hex(8)}.{final.name}')
    with _written(final):
        draft.mkdir()
    try:
        yield draft
        if not final.exists():
            with _written(final):
                draft.rename(final)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Errors of the system name what could not be written, unless it is there by now."""
    try:
        yield
    except OSError as error:
        if not path.exists():
            raise OutputError(f'cannot write {path}: {error.strerror}') from error


class _Cut:
    """Reads a recording once, with the stages before the tracker."""

    def __init__(self, job: Job, folder: Path, health: TableWriter) -> None:
        self._recording, self._path = Recording(job.recording), job.recording
        self._reader = SampleReader(self._recording, job.network)
        self._passes = PassCollector(job.network, job.settings, self._see)
        prescan_of(self._recording, job.network, job.settings.calibrate).apply(
            self._passes.calibrate)
        self._writer = SegmentWriter(folder, job.settings.track.lookback_s)
        self._health, self._health_table = HealthRows(job.recording, job.network), health
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._n_passes = 0

    def read(self) -> dict[str, Any]:
        """Write stretches and health; the columns of the recording itself."""
        for readings in self._reader.readings():
            self._add(self._passes.feed(readings))
        self._add(self._passes.flush())
        self._writer.close()
        if self._last_ns is not None:
            self._add_health(self._health.rows(self._last_ns, self._passes.calibrate))
        missing = self._reader.missing_topics()
        return {
            **common_columns(self._path, self._first_ns), 'end_ns': self._last_ns,
            'frames': self._writer.n_frames, 'stretches': self._writer.n_segments,
            'size': self._recording.size, 'lost': _text(self._recording.losses),
            'rejected': _text(self._reader.rejected + Counter(self._passes.rejected)),
            'missing_topics': ' '.join(missing),
            'no_detection_reason': self._passes.no_detection_reason(missing) or ''}

    def _see(self, frame: FieldFrame) -> None:
        """Take a frame with its verdict."""
        self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
        self._last_ns = frame.stamp_ns
        self._writer.add_frame(frame, self._passes.calibrate.doubtful_intervals())
        self._add_health(self._health.due(frame.stamp_ns, self._passes.calibrate))

    def _add(self, passes: Iterable[tuple[PassData, tuple[str, ...]]]) -> None:
        """Take the passes that are over."""
        for data, notes in passes:
            self._n_passes += 1
            self._writer.add_pass(self._n_passes, data, notes)

    def _add_health(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Take rows of the sensors."""
        for row in rows:
            self._health_table.add(row)


def track_segment(job: Job, k: int) -> None:
    """Track a stretch and fit its passes: its tables. Raises OutputError."""
    if not job.segment(k).exists():
        with _attempt(job.segment(k)) as folder:
            _track_into(folder, job, k, RecordedEvidence(len(job.network)))


def _track_into(folder: Path, job: Job, k: int, evidence: RecordedEvidence) -> None:
    """Track a stretch by the `evidence` on the clocks of those before it; its tables."""
    tracker = TrackManager(job.network, job.settings.track, evidence)
    with SegmentTables(job.recording, {name: folder / f'{name}.parquet' for name in TRACKED},
                       N_DIPOLES, job.settings.track) as tables:
        for piece in read_segment(job.cut / f'stretch-{k}.pickle'):
            tables.track(piece, tracker)
        tables.finish(tracker)
    with _written(folder / TRACKED_FILE), open(folder / TRACKED_FILE, 'wb') as stream:
        pickle.dump(_Tracked(tables.n_tracks, tables.n_passes, evidence), stream)


def join(job: Job) -> dict[str, Any]:
    """Put the tables of the stretches together; what is known of the recording.

    Where the clocks of the sensors are apart, a stretch depends on the passes of those before it,
    and is tracked once more.

    Raises OutputError.
    """
    known = cut(job)
    name, evidence = recording_key(job.recording), RecordedEvidence(len(job.network))
    folders, shifts, n_tracks, n_passes = [], [], 0, 0
    with tempfile.TemporaryDirectory(dir=job.work, prefix='.again.') as again:
        for k in range(known['stretches']):
            folder = job.segment(k)
            found = _tracked(folder)
            evidence.passes = []
            together = copy.deepcopy(evidence)
            for one in found.evidence.passes:
                together.add(*one)
            if k and (together.was_apart or found.evidence.was_apart):
                folder = Path(again) / f'stretch-{k}'
                folder.mkdir()
                _track_into(folder, job, k, evidence)
                found = _tracked(folder)
                together = found.evidence
            evidence = together
            folders.append(folder)
            shifts.append(n_tracks)
            n_tracks += found.n_tracks
            n_passes += found.n_passes
        for table in TRACKED:
            join_tables([folder / f'{table}.parquet' for folder in folders],
                        shifts if table != 'passes' else [0] * len(shifts), table, job.folder, name)
    join_tables([job.cut / 'health.parquet'], [0], 'health', job.folder, name)
    return {**known, 'tracks': n_tracks, 'passes': n_passes, 'error': ''}


def _tracked(folder: Path) -> _Tracked:
    """The result of `track_segment` in a folder, beside its tables."""
    with open(folder / TRACKED_FILE, 'rb') as stream:
        tracked: _Tracked = pickle.load(stream)
    return tracked


def _text(counts: Mapping[str, int]) -> str:
    """Causes and numbers."""
    return '; '.join(f'{n} {cause}' for cause, n in counts.items())
