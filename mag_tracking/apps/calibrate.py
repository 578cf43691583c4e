"""Calibration of a network from a recording, for the command `mag-tracking calibrate network`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.orientation import (
    MountingEvidence,
    fuse_mounting,
    with_pass_mounting,
)
from mag_tracking.calibration.survey import NetworkSurvey, Survey, with_measured_noise
from mag_tracking.errors import RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings
from mag_tracking.quantities import quantity
from mag_tracking.recording.message_block import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import AccelerationSample, Track
from mag_tracking.run import RecordingSource, run
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.stage import rejected

MIN_POSES = 8
"""Minimum number of unambiguous poses of a track; shorter tracks are not used."""


@dataclass
class Calibration:
    """Result of the calibration of a network."""

    network: SensorNetwork
    """Calibrated network."""
    survey: NetworkSurvey
    """Results from accelerometers, compasses and knocks."""
    evidence: MountingEvidence | None
    """Orientations from passing targets; None if no pass was used."""
    levels: dict[str, FloatArray]
    """{sensor: (3,) field without a target, T, sensor frame}."""
    rejected: dict[str, int]
    """Rejected samples: {cause: number}."""
    without_background: tuple[str, ...]
    """Sensors whose background was not learnt."""
    interrupted: bool
    """Whether the calibration was stopped before the end of the recording."""


def calibrate(recording: Recording, network: SensorNetwork, settings: Settings, date: str,
              passes: bool = True, progress: Callable[[int], object] | None = None,
              stopped: Callable[[], bool] | None = None) -> Calibration:
    """Estimate orientations, clock offsets (from knocks) and noise of a network from a recording.

    The recording must start without a target near the sensors. `passes` refines the nominal
    orientations with passing targets, which reads the recording twice; it is omitted if
    `track.mounting_std_deg` is zero or a sensor contradicts the Earth's field. Raises
    RecordingError if the recording has no samples of the network.
    """
    levels, survey, stage, interrupted = _survey_recording(
        recording, network, settings, date, progress, stopped)
    if not stage.counts.total():
        raise RecordingError(f'{recording.path}: no samples from the sensors of the network')
    calibrated_network = with_measured_noise(survey.network, stage.backgrounds())
    evidence = None
    # A faulty sensor would bias the orientations of the other sensors.
    if passes and not interrupted and settings.track.mounting_std_deg \
            and not survey.disagreements:
        passed = _PassTracks()
        # The backgrounds are those of the survey.
        interrupted = run(RecordingSource(recording, network), Pipeline(
            calibrated_network, settings, 'track'), [passed], progress, stopped,
            look_ahead=False).interrupted
        if tracks := passed.tracks():
            prior = np.array([
                np.full(3, np.deg2rad(settings.track.mounting_std_deg)) if s is None else s
                for s in calibrated_network.orientation_std])
            evidence = fuse_mounting(calibrated_network, prior, tracks)
            calibrated_network = _with_pass_records(
                with_pass_mounting(calibrated_network, evidence), calibrated_network, date,
                evidence.n_tracks)
    without_background = tuple(name for name in network.names if name not in levels)
    return Calibration(calibrated_network, survey, evidence, levels, rejected(stage.counts),
                       without_background, interrupted)


def _survey_recording(recording: Recording, network: SensorNetwork, settings: Settings, date: str,
                      progress: Callable[[int], object] | None,
                      stopped: Callable[[], bool] | None,
                      ) -> tuple[dict[str, FloatArray], NetworkSurvey, Calibrate, bool]:
    """Survey a network from a recording; return (backgrounds, survey, stage, interrupted)."""
    reader = SampleReader(recording, network)
    # Backgrounds and noise in the network file may be outdated; they are learnt again.
    cleared_network = replace(network, background=(), noise_std=())
    stage, survey = Calibrate(cleared_network, settings.calibrate), Survey(network, settings.survey)
    levels: dict[str, FloatArray] = {}
    interrupted = False
    try:
        for record in until_stopped(reader.readings_and_accelerations, progress, stopped):
            if isinstance(record, AccelerationSample):
                survey.feed(record)
                continue
            stage.feed(record)
            # The first background that is not doubtful is used, because a target may stop near the
            # sensor later.
            levels.update({name: stage.background(name) for name in record.names
                           if name not in levels and stage.backgrounds()[name].certain})
    except ReadingStopped:
        interrupted = True
    stage.counts.update({f'rejected: {cause}': n for cause, n in reader.rejected.items()})
    stage.counts.update({k: n for k, n in survey.counts.items() if k.startswith('rejected: ')})
    return levels, survey.solve(levels, date), stage, interrupted


class _PassTracks(RecordReceiver):
    """Counts the unambiguous poses of each track, and keeps the last one."""

    def __init__(self) -> None:
        self._poses: dict[int, tuple[int, Track]] = {}

    def add_track(self, track: Track) -> None:
        """Count a pose."""
        if not track.ended and not track.ambiguous:
            self._poses[track.id] = self._poses.get(track.id, (0, track))[0] + 1, track

    def tracks(self) -> list[Track]:
        """Last unambiguous pose of each track with at least `MIN_POSES` of them."""
        return [track for n, track in self._poses.values() if n >= MIN_POSES]


def _with_pass_records(network: SensorNetwork, surveyed: SensorNetwork, date: str,
                       n_tracks: int) -> SensorNetwork:
    """Return `network` with the calibration records of `surveyed`, plus date and number of
    passes."""
    passes = quantity(n_tracks, 'pass', 'passes')
    return replace(network, calibrated=tuple(
        surveyed.calibration_record(j, date, f'nominal orientation; {passes}') if record is None
        else replace(record, date=date, by=f'{record.by}; {passes}')
        for j, record in enumerate(surveyed.calibrated)))
