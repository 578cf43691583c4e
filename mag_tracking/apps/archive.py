"""Parallel tracking of many or long recordings; the results form one dataset."""

import dataclasses
import glob
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from mag_tracking.apps.archive_work import N_DIPOLES, Job, cut, join, track_segment
from mag_tracking.apps.cluster import Cluster
from mag_tracking.apps.readings import network_of
from mag_tracking.errors import ClusterError, MagTrackingError, OutputError, RecordingError
from mag_tracking.files import checked_path
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.recording.reader import SUFFIXES
from mag_tracking.results.archive_folder import ArchiveFolder, common_columns, recording_state
from mag_tracking.results.parquet_table import import_pyarrow

_Cluster = Cluster[tuple[str, Job]]

METADATA = 'metadata.yaml'


@dataclass
class ArchiveRun:
    """Results of an archive run; the numbers are those of the recordings tracked in this run."""

    done: list[Path] = field(default_factory=list)
    tracked_earlier: list[Path] = field(default_factory=list)
    failed: dict[Path, str] = field(default_factory=dict)
    """{recording: reason}."""
    tracks: int = 0
    passes: int = 0
    """Number of fitted passes, one per vehicle."""
    lost_workers: int = 0
    interrupted: bool = False


def recordings_of(names: Iterable[str | PathLike[str]]) -> list[Path]:
    """Resolve paths, folders (searched recursively) and glob patterns to recordings, each once;
    raises RecordingError if a name matches none."""
    selected: dict[Path, None] = {}
    for name in names:
        path = checked_path(name, RecordingError)
        matches = [path] if path.exists() else map(Path, sorted(
            glob.glob(str(path), recursive=True)))
        recordings = [r for p in matches for r in _recordings_at(p, set())]
        if not recordings:
            raise RecordingError(f'{path}: no recording found; supported file types: '
                                 f'{", ".join(SUFFIXES)}')
        selected.update(dict.fromkeys(recordings))
    # A pattern may match both a recording and the files inside it.
    return [path for path in selected if path.parent not in selected]


def _recordings_at(path: Path, visited: set[Path]) -> list[Path]:
    """Recordings at or below a path, without folders of `visited`; unreadable ones are included."""
    path = path.resolve()
    if not path.is_dir():
        return [path] if path.is_file() and path.suffix.lower() in SUFFIXES else []
    if path in visited:
        return []
    visited.add(path)
    try:
        entries = sorted(path.iterdir())
        if (path / METADATA).exists():
            return [path]
    except OSError:
        return [path]
    return [r for p in entries if not p.name.startswith('.') for r in _recordings_at(p, visited)]


def size_of(recording: Path) -> int:
    """Size of a recording in bytes; 0 if it is not readable."""
    try:
        return sum(size for _, size, _ in recording_state(recording))
    except OSError:
        return 0


def archive(recordings: Iterable[str | PathLike[str]],
            network: SensorNetwork | str | PathLike[str], settings: Settings,
            out: str | PathLike[str], workers: int = 1, scheduler: str | None = None,
            progress: Callable[[int], object] | None = None,
            stopped: Callable[[], bool] | None = None,
            report: Callable[[str], object] | None = None) -> ArchiveRun:
    """Track recordings, also in folders and by glob patterns, and write the results to a dataset.

    Recordings that an earlier run has tracked are skipped unless they have changed. `progress` is
    called with the size in bytes of each completed or skipped recording, and `report` with a
    message for each recording that fails and each damaged file. The run ends when `stopped` returns
    true.

    Raises RecordingError if a name matches nothing, OutputError if the dataset is in use or was
    created with another network, other settings or another version of the tables, ClusterError if
    the scheduler does not respond or has no workers.
    """
    import_pyarrow()
    network, paths = network_of(network), recordings_of(recordings)
    folder = checked_path(out, OutputError).resolve()
    progress, report = progress or (lambda _: None), report or (lambda _: None)
    with ArchiveFolder(folder, _configuration(network, settings)) as dataset:
        tasks = _Scheduler(dataset, network, settings, progress, report)
        remaining = [path for path in paths
                     if folder not in path.parents and not tasks.is_done(path)]
        run = tasks.result
        try:
            if remaining:
                with _Cluster(workers, scheduler) as cluster:
                    tasks.run(remaining, cluster, stopped or (lambda: False))
                    run.lost_workers = cluster.n_lost
        finally:
            dataset.write_recordings([*dataset.summaries(report), *(
                common_columns(path, None) | {'error': reason}
                for path, reason in run.failed.items())])
    return run


def _configuration(network: SensorNetwork, settings: Settings) -> dict[str, Any]:
    """Return the JSON-compatible configuration that all runs into a folder must share."""
    def json_value(value: Any) -> Any:
        return value.tolist() if hasattr(value, 'tolist') else str(value)
    network_json = json.dumps(dataclasses.asdict(network), default=json_value, sort_keys=True)
    return {'network': hashlib.sha256(network_json.encode()).hexdigest(), 'n_dipoles': N_DIPOLES,
            'settings': dataclasses.asdict(settings)}


@dataclass
class _Scheduler:
    """Submits the tasks of all recordings to a cluster, each task after its dependencies."""

    dataset: ArchiveFolder
    network: SensorNetwork
    settings: Settings
    progress: Callable[[int], object]
    report: Callable[[str], object]
    result: ArchiveRun = field(default_factory=ArchiveRun)
    n_unfinished: Counter[Path] = field(default_factory=Counter)
    """Number of segments that are not tracked yet."""
    states: dict[Path, list[list[Any]]] = field(default_factory=dict)

    def is_done(self, path: Path) -> bool:
        """Whether an earlier run has tracked a recording, which is then added to the result."""
        try:
            summary = self.dataset.done(path)
        except OutputError as error:
            self.report(f'{error}; {path.name} is tracked again')
            return False
        if summary is None:
            return False
        self.result.tracked_earlier.append(path)
        self.progress(summary['size'])
        return True

    def run(self, recordings: Sequence[Path], cluster: _Cluster,
            stopped: Callable[[], bool]) -> None:
        """Track recordings until all are processed or `stopped()` returns true; at most two per
        worker, plus one, at a time, which limits the size of the intermediate files."""
        queued = list(reversed(recordings))
        while queued or cluster.n_running:
            while queued and len({job.recording for _, job in cluster.keys()}) \
                    < 2 * cluster.n_workers + 1:
                self._start(queued.pop(), cluster)
            if stopped():
                self.result.interrupted = True
                return
            for (kind, job), result in cluster.finished():
                self._on_finished(kind, job, result, cluster)

    def _start(self, path: Path, cluster: _Cluster) -> None:
        """Submit the first task of a recording, or report the recording as unreadable."""
        try:
            state = self.states[path] = recording_state(path)
        except OSError as error:
            self._fail(path, f'cannot read the recording: {error.strerror}')
            return
        job = Job(path, self.dataset.begin(path, state), self.dataset.path, self.network,
                  self.settings)
        cluster.submit(('cut', job), 0, cut, job)

    def _on_finished(self, kind: str, job: Job, result: Any, cluster: _Cluster) -> None:
        """Record a result and submit the tasks that need it; raises OutputError, ClusterError."""
        path = job.recording
        if isinstance(result, OutputError | ClusterError):
            raise result
        if path in self.result.failed:
            return
        if isinstance(result, BaseException):
            self._fail(path, str(result) if isinstance(result, MagTrackingError)
                       else f'{type(result).__name__}: {result}')
        elif kind == 'join':
            self.dataset.complete(path, job.work_folder, self.states[path], result)
            self.result.done.append(path)
            self.result.tracks += result['tracks']
            self.result.passes += result['passes']
            self.progress(result['size'])
        else:
            if kind == 'cut':
                self.n_unfinished[path] = result['segments']
                for k in range(result['segments']):
                    cluster.submit(('track', job), 1, track_segment, job, k)
            else:
                self.n_unfinished[path] -= 1
            if not self.n_unfinished[path]:
                cluster.submit(('join', job), 2, join, job)

    def _fail(self, path: Path, reason: str) -> None:
        self.result.failed[path] = reason
        self.report(f'{path.name}: {reason}')
