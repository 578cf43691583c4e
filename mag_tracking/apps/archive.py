"""Many recordings, or long ones, tracked on a cluster into one dataset."""

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
from mag_tracking.recording.archive_folder import ArchiveFolder, stamped, state_of
from mag_tracking.recording.parquet_table import import_pyarrow
from mag_tracking.recording.reader import SUFFIXES

_Cluster = Cluster[tuple[str, Job]]

METADATA = 'metadata.yaml'
"""A folder that has one is a recording."""


@dataclass
class ArchiveRun:
    """The results of a run."""

    done: list[Path] = field(default_factory=list)
    """Recordings that were tracked."""
    already_done: list[Path] = field(default_factory=list)
    """Those that an earlier run had tracked."""
    failed: dict[Path, str] = field(default_factory=dict)
    """{recording: why it was not tracked}."""
    tracks: int = 0
    passes: int = 0
    """Numbers of tracks and fitted passes, of the recordings that were tracked now."""
    lost_workers: int = 0
    """How often a worker was lost; its tasks were run again."""
    interrupted: bool = False


def recordings_of(names: Iterable[str | PathLike[str]]) -> list[Path]:
    """The recordings that folders, patterns and paths name, each once, in order.

    A folder is searched with all that are in it; one with a metadata.yaml is a recording.

    Raises
    ------
    RecordingError
        If a name has no recording.
    """
    found: dict[Path, None] = {}
    for name in names:
        path = checked_path(name, RecordingError)
        here = [path] if path.exists() else [Path(p) for p in sorted(
            glob.glob(str(path), recursive=True))]
        recordings = [r for p in here for r in _recordings_at(p, set())]
        if not recordings:
            raise RecordingError(f'{path}: there is no recording ({", ".join(SUFFIXES)})')
        found.update(dict.fromkeys(recordings))
    # A pattern may name a recording and the files in it.
    return [path for path in found if path.parent not in found]


def _recordings_at(path: Path, seen: set[Path]) -> list[Path]:
    """The recordings at a path: itself, or what is in it; folders that were `seen` are left out.

    A folder that cannot be read is among them, and fails as one.
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
    """Bytes of the files of a recording; 0 where it cannot be read, and will fail."""
    try:
        return sum(size for _, size, _ in state_of(recording))
    except OSError:
        return 0


def archive(recordings: Iterable[str | PathLike[str]],
            network: SensorNetwork | str | PathLike[str], settings: Settings,
            out: str | PathLike[str], workers: int = 1, scheduler: str | None = None,
            progress: Callable[[int], object] | None = None,
            stopped: Callable[[], bool] | None = None,
            report: Callable[[str], object] | None = None) -> ArchiveRun:
    """Track recordings into a dataset; those that an earlier run has tracked are left alone.

    The rows are those of a replay of each recording by itself.

    Parameters
    ----------
    recordings : iterable of str or path
        Recordings, folders of them, and patterns.
    network : SensorNetwork or path of a network file
    settings : Settings
    out : path
        The folder of the dataset; `recording.archive_folder` says what is in it.
    workers : int
        Processes on this machine.
    scheduler : str, optional
        Address of a Dask scheduler, such as tcp://10.0.0.5:8786, whose workers have this package,
        and see the recordings and `out` under the same paths; in place of `workers`.
    progress : function, optional
        Called with the bytes of each recording when it is done.
    stopped : function, optional
        Asked several times a second; when it is true the run ends, and another one goes on.
    report : function, optional
        Takes a line for the user, of each recording that fails.

    Returns
    -------
    ArchiveRun

    Raises
    ------
    RecordingError
        If there is no recording.
    OutputError
        If the dataset cannot be written, is of other settings, or of another version.
    ClusterError
        If the scheduler does not answer, or has no worker.
    MissingDependencyError
        If Dask or pyarrow is not installed.
    """
    import_pyarrow()
    network, paths, run = network_of(network), recordings_of(recordings), ArchiveRun()
    folder = checked_path(out, OutputError).resolve()
    paths = [path for path in paths if folder not in path.parents]
    with ArchiveFolder(folder, _head(network, settings)) as dataset:
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
                stamped(path, None) | {'error': why} for path, why in run.failed.items())])
    return run


def _head(network: SensorNetwork, settings: Settings) -> dict[str, Any]:
    """The settings that all runs into a folder share, JSON-ready."""
    def plain(value: Any) -> Any:
        return value.tolist() if hasattr(value, 'tolist') else str(value)
    text = json.dumps(dataclasses.asdict(network), default=plain, sort_keys=True)
    return {'network': hashlib.sha256(text.encode()).hexdigest(), 'n_dipoles': N_DIPOLES,
            'settings': dataclasses.asdict(settings)}


class _Scheduler:
    """Gives the tasks of all recordings to a cluster, each when those before it are done."""

    def __init__(self, dataset: ArchiveFolder, cluster: _Cluster, network: SensorNetwork,
                 settings: Settings, run: ArchiveRun, progress: Callable[[int], object] | None,
                 report: Callable[[str], object] | None) -> None:
        self._dataset, self._cluster, self._run = dataset, cluster, run
        self._network, self._settings = network, settings
        self._progress, self._report = progress or (lambda _: None), report or (lambda _: None)
        self._segments: Counter[Path] = Counter()
        self._states: dict[Path, list[list[Any]]] = {}

    def work(self, todo: Sequence[Path], stopped: Callable[[], bool]) -> None:
        """Track the recordings; a few at a time, which bounds the files that wait."""
        waiting = list(reversed(todo))
        while waiting or self._cluster.n_running:
            while waiting and self._n_begun() < 2 * self._cluster.n_workers + 1:
                self._begin(waiting.pop())
            if stopped():
                self._run.interrupted = True
                return
            for (kind, job), result in self._cluster.finished():
                self._take(kind, job, result)

    def _n_begun(self) -> int:
        """Recordings that have tasks."""
        return len({job.recording for _, job in self._cluster.keys()})

    def _begin(self, path: Path) -> None:
        """Cut a recording."""
        try:
            self._states[path] = state_of(path)
        except OSError as error:
            self._fail(path, f'cannot read it: {error.strerror}')
            return
        job = Job(path, self._dataset.begin(path, self._states[path]), self._dataset.path,
                  self._network, self._settings)
        self._cluster.submit(('cut', job), 0, cut, job)

    def _take(self, kind: str, job: Job, result: Any) -> None:
        """A task is done: what follows from it."""
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
                self._segments[path] = result['stretches']
                for k in range(result['stretches']):
                    self._cluster.submit(('track', job), 1, track_segment, job, k)
            else:
                self._segments[path] -= 1
            if not self._segments[path]:
                self._cluster.submit(('join', job), 2, join, job)

    def _fail(self, path: Path, why: str) -> None:
        """A recording that cannot be tracked: the others go on."""
        self._run.failed[path] = why
        self._report(f'{path.name}: {why}')
