"""Tracking of many or long recordings on a cluster into one dataset."""

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
from mag_tracking.recording.archive_folder import ArchiveFolder, common_columns, recording_state
from mag_tracking.recording.parquet_table import import_pyarrow
from mag_tracking.recording.reader import SUFFIXES

_Cluster = Cluster[tuple[str, Job]]

METADATA = 'metadata.yaml'
"""File that marks a folder as a recording."""


@dataclass
class ArchiveRun:
    """Results of a run."""

    done: list[Path] = field(default_factory=list)
    """Recordings tracked in this run."""
    already_done: list[Path] = field(default_factory=list)
    """Recordings tracked by an earlier run."""
    failed: dict[Path, str] = field(default_factory=dict)
    """{recording: reason} of the recordings that were not tracked."""
    tracks: int = 0
    """Number of tracks in the recordings tracked in this run."""
    passes: int = 0
    """Number of fitted passes in the recordings tracked in this run."""
    lost_workers: int = 0
    """Number of workers lost; their tasks were repeated."""
    interrupted: bool = False
    """Whether the run was stopped before all recordings were tracked."""


def recordings_of(names: Iterable[str | PathLike[str]]) -> list[Path]:
    """Find the recordings given by folders, patterns and paths.

    Folders are searched recursively; a folder with a metadata.yaml is a recording.

    Parameters
    ----------
    names : iterable of path
        Recordings, folders and glob patterns.

    Returns
    -------
    list of Path
        Each recording once, in order.

    Raises
    ------
    RecordingError
        If a name matches no recording.
    """
    found: dict[Path, None] = {}
    for name in names:
        path = checked_path(name, RecordingError)
        here = [path] if path.exists() else [Path(p) for p in sorted(
            glob.glob(str(path), recursive=True))]
        recordings = [r for p in here for r in _recordings_at(p, set())]
        if not recordings:
            raise RecordingError(f'{path}: no recording found ({", ".join(SUFFIXES)})')
        found.update(dict.fromkeys(recordings))
    # A pattern may match a recording and the files in it.
    return [path for path in found if path.parent not in found]


def _recordings_at(path: Path, seen: set[Path]) -> list[Path]:
    """Recordings at or below a path, without folders already `seen`.

    An unreadable folder is included, so that it is reported as a failed recording.
    """
    path = path.resolve()
    if not path.is_dir():
        return [path] if path.is_file() and path.suffix.lower() in SUFFIXES else []
    if path in seen:
        return []
    seen.add(path)
    try:
        entries = sorted(path.iterdir())
        if (path / METADATA).exists():
            return [path]
    except OSError:
        return [path]
    return [r for p in entries if not p.name.startswith('.') for r in _recordings_at(p, seen)]


def size_of(recording: Path) -> int:
    """Return the size of a recording.

    Parameters
    ----------
    recording : Path

    Returns
    -------
    int, bytes
        0 if the recording is not readable.
    """
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
    """Track recordings into a dataset; recordings tracked by an earlier run are skipped.

    The rows equal those of a separate replay of each recording.

    Parameters
    ----------
    recordings : iterable of str or path
        Recordings, folders and glob patterns.
    network : SensorNetwork or path of a network file
    settings : Settings
    out : path
        Folder of the dataset; `recording.archive_folder` describes its content.
    workers : int
        Number of processes on this machine.
    scheduler : str, optional
        Address of a Dask scheduler, such as tcp://10.0.0.5:8786, used instead of `workers`. Its
        workers need this package, and the recordings and `out` under the same paths.
    progress : function, optional
        Called with the size of each completed recording in bytes.
    stopped : function, optional
        Called several times per second; the run ends when it returns true. A later run continues.
    report : function, optional
        Called with a line for the user for each recording that fails.

    Returns
    -------
    ArchiveRun

    Raises
    ------
    RecordingError
        If there is no recording.
    OutputError
        If the dataset cannot be written, or has other settings or another version.
    ClusterError
        If the scheduler does not respond or has no workers.
    MissingDependencyError
        If Dask or pyarrow is not installed.
    """
    import_pyarrow()
    network, paths, run = network_of(network), recordings_of(recordings), ArchiveRun()
    folder = checked_path(out, OutputError).resolve()
    paths = [path for path in paths if folder not in path.parents]
    with ArchiveFolder(folder, _configuration(network, settings)) as dataset:
        todo: list[Path] = []
        for path in paths:
            known = dataset.done(path)
            if known is None:
                todo.append(path)
            else:
                run.already_done.append(path)
                if progress is not None:
                    progress(known['size'])
        try:
            if todo:
                with _Cluster(workers, scheduler) as cluster:
                    _Scheduler(dataset, cluster, network, settings, run, progress, report).work(
                        todo, stopped or (lambda: False))
                    run.lost_workers = cluster.n_lost
        finally:
            dataset.write_recordings([*dataset.known(), *(
                common_columns(path, None) | {'error': why} for path, why in run.failed.items())])
    return run


def _configuration(network: SensorNetwork, settings: Settings) -> dict[str, Any]:
    """Settings that all runs into a folder must share, JSON-ready."""
    def plain(value: Any) -> Any:
        return value.tolist() if hasattr(value, 'tolist') else str(value)
    text = json.dumps(dataclasses.asdict(network), default=plain, sort_keys=True)
    return {'network': hashlib.sha256(text.encode()).hexdigest(), 'n_dipoles': N_DIPOLES,
            'settings': dataclasses.asdict(settings)}


class _Scheduler:
    """Submits the tasks of all recordings to a cluster, each after those it depends on."""

    def __init__(self, dataset: ArchiveFolder, cluster: _Cluster, network: SensorNetwork,
                 settings: Settings, run: ArchiveRun, progress: Callable[[int], object] | None,
                 report: Callable[[str], object] | None) -> None:
        self._dataset, self._cluster, self._run = dataset, cluster, run
        self._network, self._settings = network, settings
        self._progress, self._report = progress or (lambda _: None), report or (lambda _: None)
        self._segments: Counter[Path] = Counter()
        self._states: dict[Path, list[list[Any]]] = {}

    def work(self, todo: Sequence[Path], stopped: Callable[[], bool]) -> None:
        """Track the recordings, a few at a time to bound the number of intermediate files."""
        queued = list(reversed(todo))
        while queued or self._cluster.n_running:
            while queued and self._n_started() < 2 * self._cluster.n_workers + 1:
                self._start(queued.pop())
            if stopped():
                self._run.interrupted = True
                return
            for (kind, job), result in self._cluster.finished():
                self._on_finished(kind, job, result)

    def _n_started(self) -> int:
        """Number of recordings that have tasks."""
        return len({job.recording for _, job in self._cluster.keys()})

    def _start(self, path: Path) -> None:
        """Submit the first task of a recording."""
        try:
            self._states[path] = recording_state(path)
        except OSError as error:
            self._fail(path, f'cannot read the recording: {error.strerror}')
            return
        job = Job(path, self._dataset.begin(path, self._states[path]), self._dataset.path,
                  self._network, self._settings)
        self._cluster.submit(('cut', job), 0, cut, job)

    def _on_finished(self, kind: str, job: Job, result: Any) -> None:
        """Process the result of a task and submit the tasks that depend on it."""
        path = job.recording
        if isinstance(result, OutputError | ClusterError):
            raise result
        if path in self._run.failed:
            return
        if isinstance(result, BaseException):
            self._fail(path, str(result) if isinstance(result, MagTrackingError)
                       else f'{type(result).__name__}: {result}')
        elif kind == 'join':
            self._dataset.complete(path, job.work, self._states[path], result)
            self._run.done.append(path)
            self._run.tracks += result['tracks']
            self._run.passes += result['passes']
            self._progress(result['size'])
        else:
            if kind == 'cut':
                self._segments[path] = result['segments']
                for k in range(result['segments']):
                    self._cluster.submit(('track', job), 1, track_segment, job, k)
            else:
                self._segments[path] -= 1
            if not self._segments[path]:
                self._cluster.submit(('join', job), 2, join, job)

    def _fail(self, path: Path, why: str) -> None:
        """Record and report a failed recording; the others continue."""
        self._run.failed[path] = why
        self._report(f'{path.name}: {why}')
