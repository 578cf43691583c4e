"""Calibration of a network from a recording: what `mag-tracking calibrate` does."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.analysis.pass_mounting import MountingEvidence, fold_mounting, with_evidence
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Settings
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import AccelerationSample, Track
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.survey.stage import NetworkSurvey, Survey, with_measured_noise

MIN_POSES = 8
"""A track with fewer tells nothing of the sensors."""


@dataclass
class Calibration:
    """What a recording told."""

    network: SensorNetwork
    """To be used from now on."""
    survey: NetworkSurvey
    """From accelerometers, compasses and knocks."""
    evidence: MountingEvidence | None
    """From the passes; None where they were not asked, or there was none."""
    levels: dict[str, FloatArray]
    """{sensor: (3,) [T], sensor frame} the field without a target."""
    rejected: dict[str, int]
    """{cause: number}."""
    without_background: tuple[str, ...]
    interrupted: bool


def calibrate(recording: Recording, network: SensorNetwork, settings: Settings, date: str,
              passes: bool = True, progress: Callable[[int], object] | None = None,
              stopped: Callable[[], bool] | None = None) -> Calibration:
    """Orientations, clock offsets and noise of a network, from one recording of it.

    The recording begins without a target, and with knocks where clocks are to be compared.

    Parameters
    ----------
    recording : Recording
    network : SensorNetwork
        As it was installed.
    settings : Settings
    date : str
        What the calibration is marked with.
    passes : bool
        Track what passes, too, and take what it tells of the orientations. Only where
        `track.mounting_std_deg` is not zero.
    progress : function, optional
        Called with the bytes done since the last call; with passes the recording is read twice.
    stopped : function, optional
        Asked after every batch of readings; when it is true, what was read so far counts.

    Returns
    -------
    Calibration

    Raises RecordingError where the recording has none of the network's topics, or no sample.
    """
    levels, survey, calibrated, interrupted = _surveyed(
        recording, network, settings, date, progress, stopped)
    if not calibrated.counts.total():
        raise RecordingError(f'{recording.path} has no sample of the network')
    found = with_measured_noise(survey.network, calibrated)
    evidence = None
    # A sensor that cannot be right would spoil what passes tell of the others.
    if passes and not interrupted and settings.track.mounting_std_deg \
            and not survey.disagreements:
        tracks, interrupted = _passes(recording, found, settings, progress, stopped)
        if tracks:
            prior = np.array([
                np.full(3, np.deg2rad(settings.track.mounting_std_deg)) if s is None else s
                for s in found.orientation_std])
            evidence = fold_mounting(found, prior, tracks)
            found = _marked(with_evidence(found, evidence), found, date, evidence.n_tracks)
    waiting = tuple(name for name in network.names if name not in levels)
    return Calibration(found, survey, evidence, levels, rejected(calibrated.counts), waiting,
                       interrupted)


def _surveyed(recording: Recording, network: SensorNetwork, settings: Settings, date: str,
              progress: Callable[[int], object] | None, stopped: Callable[[], bool] | None,
              ) -> tuple[dict[str, FloatArray], NetworkSurvey, Calibrate, bool]:
    """First reading: (levels, NetworkSurvey, Calibrate, interrupted)."""
    reader = SampleReader(recording, network)
    # What the file says of backgrounds and noise is not what the sensors say now.
    untold = replace(network, background=(), noise_std=())
    stage, survey = Calibrate(untold, settings.calibrate), Survey(network, settings.survey)
    levels: dict[str, FloatArray] = {}
    interrupted = False
    try:
        for record in until_stopped(reader.readings_and_accelerations, progress, stopped):
            if isinstance(record, AccelerationSample):
                survey.feed(record)
                continue
            stage.feed(record)
            # The first that is known: later a target may stand there.
            levels.update({name: stage.background(name) for name in record.names
                           if name not in levels and stage.backgrounds()[name].certain})
    except ReadingStopped:
        interrupted = True
    stage.counts.update({f'rejected: {cause}': n for cause, n in reader.rejected.items()})
    stage.counts.update({k: n for k, n in survey.counts.items() if k.startswith('rejected: ')})
    return levels, survey.solve(levels, date), stage, interrupted


def _passes(recording: Recording, network: SensorNetwork, settings: Settings,
            progress: Callable[[int], object] | None, stopped: Callable[[], bool] | None,
            ) -> tuple[list[Track], bool]:
    """Second reading: (the last certain pose of each track, interrupted)."""
    reader, pipeline = SampleReader(recording, network), Pipeline(network, settings)
    poses: dict[int, tuple[int, Track]] = {}
    interrupted = False

    def take(records: Iterable[object]) -> None:
        for record in records:
            if isinstance(record, Track) and not record.ended and not record.ambiguous:
                n = poses[record.id][0] + 1 if record.id in poses else 1
                poses[record.id] = n, record

    try:
        for readings in until_stopped(reader.readings, progress, stopped):
            take(pipeline.feed(readings))
    except ReadingStopped:
        interrupted = True
    take(pipeline.flush())
    return [track for n, track in poses.values() if n >= MIN_POSES], interrupted


def _marked(network: SensorNetwork, surveyed: SensorNetwork, date: str,
            n_tracks: int) -> SensorNetwork:
    """The `network` whose calibration says that passes are in it; before them it was `surveyed`."""
    passes = f'{n_tracks} pass{"es" if n_tracks > 1 else ""}'
    return replace(network, calibrated=tuple(
        surveyed.marked(j, date, f'as stated; {passes}') if c is None
        else replace(c, date=date, by=f'{c.by}; {passes}')
        for j, c in enumerate(surveyed.calibrated)))
