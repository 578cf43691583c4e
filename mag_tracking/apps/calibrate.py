"""Calibration of a network from a recording, by tumbling, or with a magnet above a board."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration import network_geometry, orientation
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit, fit_ellipsoid
from mag_tracking.calibration.network_fit import ASSUMED_NOISE, GeometrySettings
from mag_tracking.calibration.survey import NetworkSurvey, Survey, with_measured_noise
from mag_tracking.errors import NetworkError, RecordingError
from mag_tracking.network import CalibrationRecord, SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings
from mag_tracking.quantities import quantity
from mag_tracking.recording.message_block import ReadingStopped, until_stopped
from mag_tracking.recording.pose_table import read_pose_table, read_readings, read_sensor_positions
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import AccelerationSample, Track
from mag_tracking.run import RecordingSource, Source, run
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.stage import rejected

MIN_POSES = 8
"""Minimum number of unambiguous poses of a track; shorter tracks are not used."""
MIN_ROTATION_STD = 1e-7
"""Standard deviation below which an orientation is considered fixed, not estimated [rad]."""
FIRST_ROW = 2
"""Row number of the first pose in the table; the header is row 1."""


@dataclass
class Calibration:
    """Calibrated network, with the results from accelerometers, compasses and knocks."""

    network: SensorNetwork
    survey: NetworkSurvey
    evidence: orientation.MountingEvidence | None
    """Orientations from passing targets; None if no pass was used."""
    rejected: dict[str, int]
    """Rejected samples: {cause: number}."""
    without_background: tuple[str, ...]
    interrupted: bool


def calibrate(recording: Recording, network: SensorNetwork, settings: Settings, date: str,
              passes: bool = True, progress: Callable[[int], object] | None = None,
              stopped: Callable[[], bool] | None = None) -> Calibration:
    """Estimate orientations, clock offsets (from knocks) and noise of a network from a recording.

    `passes` refines the orientations with passing targets in a second pass over the recording,
    unless `track.mounting_std_deg` is zero or a sensor contradicts the Earth's field. Raises
    RecordingError if the recording has no samples of the network.
    """
    levels, survey, stage, interrupted = _survey_recording(
        recording, network, settings, date, progress, stopped)
    if not stage.counts.total():
        raise RecordingError(f'{recording.path}: no samples from the sensors of the network')
    surveyed = calibrated = with_measured_noise(survey.network, stage.backgrounds())
    evidence = None
    # A faulty sensor would bias the orientations of the other sensors.
    if passes and not interrupted and settings.track.mounting_std_deg \
            and not survey.disagreements:
        passed = _PassTracks()
        # The backgrounds are those of the survey.
        interrupted = run(RecordingSource(recording, network), Pipeline(
            surveyed, settings, 'track'), [passed], progress, stopped, look_ahead=False).interrupted
        if tracks := passed.tracks():
            prior = np.array([
                np.full(3, np.deg2rad(settings.track.mounting_std_deg)) if s is None else s
                for s in surveyed.orientation_std])
            evidence = orientation.fuse_mounting(surveyed, prior, tracks)
            used = quantity(evidence.n_tracks, 'pass', 'passes')
            fused = orientation.with_pass_mounting(surveyed, evidence)
            calibrated = replace(fused, calibrated=tuple(
                surveyed.calibration_record(j, date, f'nominal orientation; {used}')
                if record is None else replace(record, date=date, by=f'{record.by}; {used}')
                for j, record in enumerate(surveyed.calibrated)))
    return Calibration(calibrated, survey, evidence, rejected(stage.counts),
                       tuple(name for name in network.names if name not in levels), interrupted)


def sensor_rows(network: SensorNetwork) -> Iterator[
        tuple[str, float, float, float, float, float, FloatArray | None, str]]:
    """Name, tilt, heading and its std [deg], clock offset and its std [s], noise (3,) [T] and
    source of the calibration of each sensor; NaN if unknown."""
    for j, (name, R, std) in enumerate(zip(network.names, network.R_ws, network.orientation_std,
                                           strict=True)):
        record = network.calibrated[j]
        clock_std = np.nan if record is None else record.clock_offset_std
        # The heading is that of the sensor's x axis in the horizontal plane.
        yield (name, float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0)))),
               float(np.degrees(np.arctan2(R[1, 0], R[0, 0]))),
               np.nan if std is None else float(np.degrees(std[2])),
               np.nan if np.isnan(clock_std) else float(network.clock_offset[j]), clock_std,
               network.noise_std[j], 'nominal orientation' if record is None else record.by)


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
        if not track.ended and not track.ambiguous:
            self._poses[track.id] = self._poses.get(track.id, (0, track))[0] + 1, track

    def tracks(self) -> list[Track]:
        """Last unambiguous pose of each track with at least `MIN_POSES` of them."""
        return [track for n, track in self._poses.values() if n >= MIN_POSES]


def tumble(source: Source, network: SensorNetwork, sensors: Collection[str], date: str,
           field_magnitude: float | None = None, progress: Callable[[int], object] | None = None,
           stopped: Callable[[], bool] | None = None,
           ) -> tuple[SensorNetwork, dict[str, EllipsoidFit], dict[str, FloatArray]]:
    """Estimate the hard and soft iron of `sensors` (default: all) that were rotated.

    Without `field_magnitude` [T], the mean gain is not calibrated. The results are the network with
    the corrections that converged, the fits, and the readings (n, 3) [T, sensor frame].
    """
    rows = {name: network.index(name) for name in tuple(sensors) or network.names}
    collected: dict[str, list[FloatArray]] = {name: [np.empty((0, 3))] for name in rows}
    with suppress(ReadingStopped):
        for batch, _ in until_stopped(source.batches, progress, stopped):
            row = batch.rows(rows)
            row[np.isinf(batch.field).any(axis=1)] = -1
            for name, j in rows.items():
                collected[name].append(batch.field[row == j])
    readings: dict[str, FloatArray] = {name: np.concatenate(r) for name, r in collected.items()}
    fits = {name: fit_ellipsoid(r, field_magnitude) for name, r in readings.items()}
    columns = {key: list(getattr(network, key)) for key in (
        'offset', 'correction', 'background', 'noise_std', 'calibrated')}
    for name, j in rows.items():
        fit, record = fits[name], network.calibrated[j]
        if not fit.converged:
            continue
        columns['offset'][j], columns['correction'][j] = fit.offset, fit.correction
        # Background and noise refer to uncorrected readings; both will be learnt again.
        columns['background'][j] = columns['noise_std'][j] = None
        columns['calibrated'][j] = _calibration_record(
            network, j, date, f'{"nominal orientation" if record is None else record.by}; tumbled '
            f'with a residual of {100 * fit.residual:.1f} % of the field')
    return _with_columns(network, columns), fits, readings


def _calibration_record(network: SensorNetwork, j: int, date: str, by: str
                        ) -> CalibrationRecord:
    """Record of a calibration of sensor `j` that does not measure the clock offset."""
    record = network.calibrated[j]
    return network.calibration_record(
        j, date, by, np.nan if record is None else record.clock_offset_std)


def _with_columns(network: SensorNetwork, columns: dict[str, list[Any]],
                  **arrays: FloatArray) -> SensorNetwork:
    """Replace attributes of a network that have one value per sensor."""
    changes: dict[str, Any] = {name: tuple(column) for name, column in columns.items()}
    return replace(network, **(changes | arrays))


@dataclass(frozen=True)
class GeometrySurvey:
    """Result of the geometry calibration of a board."""

    nominal: SensorNetwork
    """Network before the calibration, including the assumed noise."""
    network: SensorNetwork
    """Calibrated network; invalid if the estimation has not converged."""
    geometry: network_geometry.NetworkGeometry
    rows: IntArray
    """(K,) table rows of the poses used."""
    suspect_rows: tuple[int, ...]
    """Table rows of inconsistent poses."""
    n_poses: int
    silent_axes: tuple[tuple[str, str], ...]
    """(sensor, axes without readings) for each sensor that reports some axes but not all."""

    @property
    def rotation_angle(self) -> FloatArray:
        """Angle between nominal and estimated orientation of each sensor, (n,) rad."""
        trace: FloatArray = np.einsum('nij,nij->n', self.nominal.R_ws, self.network.R_ws)
        return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def board_of(path: str | PathLike[str]) -> SensorNetwork:
    """Network of sensors `mag_0`, `mag_1`, ..., aligned with the axes, from a CSV table of
    positions x, y, z [m]."""
    positions = read_sensor_positions(path)
    names = tuple(f'mag_{j}' for j in range(len(positions)))
    try:
        return SensorNetwork(names, positions, np.tile(np.eye(3), (len(names), 1, 1)),
                             tuple(f'/{name}/imu/mag' for name in names))
    except NetworkError as error:
        raise NetworkError(f'{path}: {error}') from error


def survey_geometry(table: str | PathLike[str], network: SensorNetwork, moment: float,
                    settings: GeometrySettings, date: str,
                    box: tuple[Sequence[float], Sequence[float]] | None = None,
                    noise_std: float | None = None) -> GeometrySurvey:
    """Estimate the geometry of a network from its readings for many poses of a magnet.

    The sensors are in the order of the columns of `table`; `moment` is in A m². With the corners
    `box` (low, high) [m] around the magnet, the poses are estimated. `noise_std` [T], by default
    `ASSUMED_NOISE`, is that of sensors without a configured noise; it is stored only if given.
    Raises RecordingError if the table does not match the network or does not suffice.
    """
    if box is None:
        readings, positions, axes = read_pose_table(table)
    else:
        readings = read_readings(table)
    if readings.shape[1] != len(network):
        raise RecordingError(f'{table}: readings of {quantity(readings.shape[1], "sensor")}, but '
                             f'the network has {len(network)}')
    if noise_std is not None:
        network = _with_noise(network, noise_std)
    nominal = _with_noise(network, ASSUMED_NOISE)
    field = _corrected(nominal, readings)
    is_missing = np.isnan(field)
    # Poses without readings are removed here or, for unknown poses, by the estimation.
    used = np.arange(len(field)) if box is not None else np.flatnonzero(
        ~is_missing.all(axis=(1, 2)))
    try:
        if box is not None:
            low, high = (np.asarray(corner, dtype=float) for corner in box)
            geometry = network_geometry.calibrate_geometry_blind(
                nominal, field, moment, low, high, settings)
        else:
            geometry = network_geometry.calibrate_geometry(
                nominal, field[used], positions[used], axes[used], moment, settings)
    except ValueError as error:
        raise RecordingError(f'{table}: {error}') from error
    method = f'magnet, {len(geometry.rows)} {"unknown" if box is not None else "tracked"} poses'
    is_silent: BoolArray = np.all(is_missing, axis=0)
    silent_axes = tuple((name, ' and '.join(np.array(list('xyz'))[silent]))
                        for name, silent in zip(network.names, is_silent, strict=True)
                        if silent.any() and not silent.all())
    return GeometrySurvey(
        nominal, _calibrated_network(network, geometry, date, method), geometry,
        used[geometry.rows] + FIRST_ROW,
        tuple(int(used[k]) + FIRST_ROW for k in geometry.suspect_poses), len(field), silent_axes)


def _with_noise(network: SensorNetwork, noise_std: float) -> SensorNetwork:
    """Return `network` with `noise_std` [T] for sensors whose noise is unknown."""
    return replace(network, noise_std=tuple(
        np.full(3, float(noise_std)) if std is None else std for std in network.noise_std))


def _corrected(network: SensorNetwork, readings: FloatArray) -> FloatArray:
    """Apply offsets and corrections to readings (K, n, 3), as the stage Calibrate."""
    field = np.array(readings, dtype=float)
    for j, (offset, C) in enumerate(zip(network.offset, network.correction, strict=True)):
        if offset is not None:
            field[:, j] -= offset
        if C is not None:
            is_missing = np.isnan(field[:, j])
            # A corrected axis is missing if any axis that contributes to it is missing.
            field[:, j] = np.where(is_missing @ (C != 0.0).T, np.nan,
                                   np.where(is_missing, 0.0, field[:, j]) @ C.T)
    return field


def _calibrated_network(network: SensorNetwork, geometry: network_geometry.NetworkGeometry,
                        date: str, method: str) -> SensorNetwork:
    """Network with the estimated positions, orientations, gains and biases.

    A reading is gain * field + bias. The stage Calibrate applies the correction before it removes
    the background, so the stored background and noise refer to corrected readings. A sensor without
    readings is not changed.
    """
    estimated = geometry.network
    columns = {name: list(getattr(network, name)) for name in (
        'noise_std', 'background', 'correction', 'orientation_std', 'calibrated')}
    for j, gain in enumerate(geometry.gain):
        if np.isnan(geometry.bias[j]).all():
            continue
        correction, background = network.correction[j], estimated.background[j]
        columns['correction'][j] = (np.eye(3) if correction is None else correction) / gain
        columns['background'][j] = None if background is None else background / gain
        if network.noise_std[j] is not None:
            columns['noise_std'][j] = network.noise_std[j] / abs(gain)
        # The ten parameters of a sensor are bias, gain, rotation and position.
        rotation = slice(10 * j + 4, 10 * j + 7)
        R = estimated.R_ws[j]
        # About the world axes.
        std = np.sqrt(np.diagonal(R @ geometry.covariance[rotation, rotation] @ R.T))
        if (std > MIN_ROTATION_STD).all():
            columns['orientation_std'][j] = std
        columns['calibrated'][j] = _calibration_record(network, j, date, method)
    return _with_columns(network, columns, positions=estimated.positions, R_ws=estimated.R_ws)
