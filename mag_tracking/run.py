"""One way to play readings through the stages: a source, a pipeline, sinks and one report."""

import html
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, NoReturn, Protocol, TypeAlias

from tqdm.auto import tqdm

from mag_tracking.analysis.track_errors import Truth
from mag_tracking.errors import MissingDependencyError, OutputError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Step
from mag_tracking.recording.message_block import Progress, ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.prescan import Prescan, prescan
from mag_tracking.stages.health import findings
from mag_tracking.stages.health.clocks import ClockSpan
from mag_tracking.stages.health.diagnosis import Cause, Diagnosis, Finding, ranked
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.track.manager import NO_SCALE, NO_SCALE_FRAMES

if TYPE_CHECKING:
    import pandas as pd

ARRAY_BATCH = 4096
"""Number of readings per batch when arrays are processed, to bound the memory for outputs."""
MAX_ROWS = 20
"""Maximum number of rows of a table in a notebook."""


class RecordingSource:
    """Readings of a recording in the order of logging; with `by_message`, each message is a batch.

    `name` is for messages, `stem` for tables and files. The accounts cover what was read so far:
    `rejected` messages without a usable reading by cause, `lost` unreadable parts by damage, and
    the `clocks` of the sensors, with timestamps and log times.
    """

    def __init__(self, recording: Recording, network: SensorNetwork, truth: str | None = None,
                 by_message: bool = False) -> None:
        self.recording, self.name = recording, recording.path.name
        self.stem = recording.path.resolve().stem
        self._network, self._by_message = network, by_message
        self.reader = SampleReader(recording, network, truth)
        self.rejected: Mapping[str, int] = self.reader.rejected
        self.lost: Mapping[str, int] = recording.losses
        self.clocks: Mapping[str, ClockSpan] = self.reader.clocks

    def truth(self) -> dict[str, Truth]:
        """True poses so far, by target."""
        return self.reader.truth_arrays()

    def missing_topics(self) -> Sequence[str]:
        """List the topics of the network that are not in the recording."""
        return self.reader.missing_topics()

    def beginning(self) -> 'RecordingSource':
        """Open the recording again, because losses are counted whenever a recording is read."""
        return RecordingSource(Recording(self.recording.path), self._network)

    def batches(self, progress: Progress | None = None) -> Iterator[tuple[Readings, int | None]]:
        """Iterate over batches of messages, or over single messages with their log times [ns]."""
        if self._by_message:
            yield from self.reader.readings_as_received(progress)
        else:
            for readings in self.reader.readings(progress):
                yield readings, None


@dataclass
class ArraySource:
    """Readings in memory, and the account of the recording from which they were read."""

    readings: Readings
    rejected: Mapping[str, int] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    topics: Sequence[str] = ()
    """Topics of the network that were not recorded."""
    true_poses: dict[str, Truth] = field(default_factory=dict)
    name = stem = 'readings'
    clocks: ClassVar[Mapping[str, ClockSpan]] = {}

    def truth(self) -> dict[str, Truth]:
        """True poses, by target."""
        return self.true_poses

    def missing_topics(self) -> Sequence[str]:
        """List the topics of the network that were not recorded."""
        return self.topics

    def beginning(self) -> 'ArraySource':
        """Return this source, which counts nothing."""
        return self

    def batches(self, progress: Progress | None = None) -> Iterator[tuple[Readings, int | None]]:
        """Iterate over batches of at most `ARRAY_BATCH` readings."""
        for i in range(0, len(self.readings), ARRAY_BATCH):
            yield self.readings.part(slice(i, i + ARRAY_BATCH)), None


Source: TypeAlias = RecordingSource | ArraySource


class Sink(Protocol):
    """Receiver of the results of a run."""

    def add(self, step: Step, /) -> None:
        """Add the results of a batch.

        Parameters
        ----------
        step : Step

        Raises
        ------
        OutputError, OSError
            If the results cannot be written. The other sinks still receive the rest.
        """


class Failure(NamedTuple):
    """Sink that could not write its results, and did not receive the rest."""

    sink: Sink
    error: OutputError


@dataclass(frozen=True)
class RunReport:
    """Losses, rejections and missing topics of a run, with their causes."""

    counts: dict[str, dict[str, int]]
    """{stage: {event: number}}."""
    rejected: dict[str, int]
    """Readings that were not used: {cause: number}."""
    lost: dict[str, int]
    """Unreadable parts of the source: {damage: number}."""
    missing_topics: tuple[str, ...]
    """Topics of the network without messages."""
    sensors_without_background: tuple[str, ...]
    """Sensors that were not used because their background was not learnt. To use them, record a
    quiet interval, or set `background` and `noise_std` in the network file."""
    no_detection_reason: str | None
    """Explanation of why nothing was detected; None if a target was detected or not searched."""
    no_track_reason: str | None
    """Explanation of why a detected target was not tracked; None if unknown."""
    diagnoses: tuple[Diagnosis, ...]
    """Faults of the source, the sensors and the stages, the most important first."""
    prescan: Prescan
    """Result of the first pass over the source."""
    interrupted: bool = False
    """Whether the caller stopped the run; the results then cover only a part of the source."""
    failures: tuple[Failure, ...] = ()
    """Sinks that could not write their results."""

    def warnings(self) -> list[str]:
        """One line per diagnosis, missing track, rejection, loss and failure.

        Returns
        -------
        list of str
        """
        not_used = [*self.rejected.items(), *self.lost.items()]
        return [*map(str, self.diagnoses),
                *([self.no_track_reason] if self.no_track_reason else []),
                *(f'not used: {n} {cause}' for cause, n in not_used),
                *(f'incomplete results: {failure.error}' for failure in self.failures)]

    def has_failed(self, sink: Sink) -> bool:
        """Whether a sink could not write its results.

        Parameters
        ----------
        sink : Sink

        Returns
        -------
        bool
        """
        return any(failure.sink is sink for failure in self.failures)


def run(source: Source, pipeline: Pipeline, sinks: Sequence[Sink],
        progress: Progress | None = None, stopped: Callable[[], bool] | None = None,
        look_ahead: bool = True) -> RunReport:
    """Play a source through a pipeline that has processed nothing into sinks.

    With `look_ahead`, the source is read twice: first up to `LOOK_AHEAD_S`, to find the backgrounds
    of sensors near a target that is present at the start. If a sink cannot write its results, the
    others receive the rest. `progress` is called with the number of bytes read since the last call.
    `stopped` is called after every batch and every progress report; when it returns true, reading
    ends, and the sinks still receive what the stages have buffered. Raises RecordingError if the
    source cannot be read, OutputError if all sinks have failed.
    """
    first_pass = prescan_of(source, pipeline, stopped) if look_ahead else Prescan({}, {}, {})
    first_pass.apply(pipeline.calibrate)
    remaining, interrupted = list(sinks), False
    failures: list[Failure] = []

    def add(step: Step) -> None:
        for sink in list(remaining):
            try:
                sink.add(step)
            except (OutputError, OSError) as error:
                remaining.remove(sink)
                failures.append(Failure(sink, output_error(error, sink)))
        if sinks and not remaining:
            raise failures[0].error

    try:
        for readings, received_ns in until_stopped(source.batches, progress, stopped):
            add(Step(readings, received_ns, pipeline.feed(readings)))
    except ReadingStopped:
        interrupted = True
    add(Step(Readings.joined([]), None, pipeline.drain()))
    add(Step(Readings.joined([]), None, pipeline.close(), is_last=True))
    return replace(report_of(source, pipeline, first_pass, interrupted), failures=tuple(failures))


def output_error(error: OutputError | OSError, sink: object) -> OutputError:
    """Error of a sink; a full disk names no file, so the folder of the sink is named."""
    if isinstance(error, OutputError):
        return error
    place = error.filename or getattr(sink, 'folder', '')
    return OutputError(f'cannot write{f" to {place}" if place else ""}: {error.strerror or error}')


def prescan_of(source: Source, pipeline: Pipeline,
               stopped: Callable[[], bool] | None = None) -> Prescan:
    """Find the backgrounds of sensors if a target is present at the start of a source."""
    source = source.beginning()

    def batches() -> Iterator[Readings]:
        with suppress(ReadingStopped):
            for readings, _ in until_stopped(source.batches, None, stopped):
                yield readings

    found = prescan(batches(), pipeline.network, pipeline.settings.calibrate)
    return replace(found, clocks=dict(source.clocks))


def report_of(source: Source, pipeline: Pipeline, first_pass: Prescan,
              interrupted: bool) -> RunReport:
    """Report on a source that the pipeline has processed."""
    counts, missing = pipeline.counts(), tuple(source.missing_topics())
    not_used = dict(Counter(source.rejected) + Counter(pipeline.rejections()))
    # Of an interrupted run, the rest may contain what is missing.
    reason = None if interrupted or 'detect' not in counts else findings.no_detection_reason(
        pipeline.network, pipeline.calibrate, pipeline.detect, missing, not_used)
    found = [*findings.source_findings(source.name, source.lost, source.rejected),
             *findings.sensor_findings(pipeline.network, pipeline.calibrate,
                                       pipeline.settings.track, missing, source.clocks)]
    for stage, counts_of_stage in counts.items():
        if stage != 'calibrate' and (causes := rejected(counts_of_stage)):
            found.append(Finding(False, stage, ', '.join(
                f'{cause}: {n}' for cause, n in causes.items()), 'run mag-tracking doctor',
                Cause.REJECTED))
    if reason:
        found.append(Finding(False, 'detect', 'nothing was detected with the settings for a '
                             f'{pipeline.settings.track.target}: {reason}',
                             'run mag-tracking doctor', Cause.NO_DETECTION))
    return RunReport(counts, not_used, dict(source.lost), missing,
                     tuple(pipeline.calibrate.unready()), reason,
                     no_track_reason(counts.get('track', {})), tuple(ranked(found)), first_pass,
                     interrupted)


def no_track_reason(counts: Mapping[str, int]) -> str | None:
    """Explain, from the counts of the tracker, why a single sensor tracked nothing, else None."""
    if counts.get(NO_SCALE, 0) or counts.get(NO_SCALE_FRAMES, 0) and not counts.get('tracks', 0):
        return ('no track: the scale is not observable with a single sensor. Use `mag-tracking '
                'replay --tables events` to describe the passes without scale, or set '
                'track.single_sensor_prior: true if the vehicles match the settings')
    return None


def progress_bar(source: Source, leave: bool = True) -> 'tqdm[NoReturn]':
    """Progress bar of the bytes of a recording in a terminal or notebook; hidden for arrays."""
    size = source.recording.size if isinstance(source, RecordingSource) else None
    return tqdm(total=size, unit='B', unit_scale=True, desc=source.name, leave=leave,
                disable=True if size is None else None)


class DisplayedResult:
    """Result that a notebook shows as its summary and the first rows of its table."""

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the result to a table."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        summary = f'<p>{html.escape(repr(self))}</p>'
        try:
            return summary + self.to_dataframe().to_html(max_rows=MAX_ROWS)
        except MissingDependencyError:
            return summary
