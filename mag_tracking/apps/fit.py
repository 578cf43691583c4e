"""Passes of vehicles in a recording: their measurements, the tracks during them, and their fits."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion, correlated_motion
from mag_tracking.analysis.fitted_pass import FittedPass, choose_order
from mag_tracking.analysis.joint_fit import GroundPrior, are_separate, fit_targets, path_from
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.apps.readings import UserSource, network_of, source_of
from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND, are_doubtful
from mag_tracking.calibration.reading_faults import saturated_readings, with_margin
from mag_tracking.errors import SettingsError, UnknownTrackError
from mag_tracking.geometry import propagated_path
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Step, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.records import Detection, FieldFrame, Readings, Track
from mag_tracking.results.columns import FITS, names_of
from mag_tracking.results.dataframes import dataframe
from mag_tracking.results.fit_folder import pass_rows
from mag_tracking.run import DisplayedResult, RunReport, progress_bar, run
from mag_tracking.stages.track.doubts import MEANINGS
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PAD_S = 1.0
"""Duration of the background included before the onset of a detection [s]."""
MAX_PLATEAU_S = 0.5
"""Maximum time for which a target that passes saturates a sensor [s]."""
MAX_PASS_S = 60.0
"""Maximum duration of a pass; a longer detection is truncated [s]."""
MAX_TRAILER_DISTANCE = 8.0
"""Maximum distance between a car and its trailer [m]."""

Pass: TypeAlias = tuple[PassData, tuple[str, ...]]
"""Measurements of a pass, and notes for the user."""


class PassCollector:
    """Extracts passes, from `PAD_S` before the onset of a detection to its release, from steps."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._network, self._calibrate = pipeline.network, pipeline.calibrate
        self._max_field = pipeline.settings.calibrate.max_field
        # Raw and calibrated readings, in network time, from `PAD_S` before the onset or, without a
        # detection, before the latest frame.
        self._raw: deque[Readings] = deque()
        self._calibrated: deque[Readings] = deque()
        self._onset_ns: int | None = None
        self._last_ns: int | None = None

    def passes(self, step: Step) -> list[Pass]:
        """Passes that end with a step."""
        passes, readings = [], step.readings
        if len(readings) and (self._calibrate.n_held
                              or any(isinstance(r, Readings) for r in step.records)):
            network = self._network
            sensor = readings.rows({name: j for j, name in enumerate(network.names)})
            self._raw.append(Readings(network.names, sensor,
                                      readings.stamp_ns - network.clock_offset_ns[sensor],
                                      readings.field))
        for record in step.records:
            if isinstance(record, Readings):
                self._calibrated.append(record)
            elif isinstance(record, Detection) and record.onset:
                self._onset_ns = record.stamp_ns
            elif isinstance(record, Detection) and self._onset_ns is not None:
                passes.append(self._cut(self._onset_ns, record.stamp_ns))
            elif isinstance(record, FieldFrame):
                passes += self._add_frame(record)
        if step.is_last and self._onset_ns is not None and self._last_ns is not None:
            passes.append(self._cut(self._onset_ns, self._last_ns,
                                    'the recording ends before the target has passed'))
        return passes

    def _add_frame(self, frame: FieldFrame) -> list[Pass]:
        """Truncate a pass that is too long at a frame, and forget earlier readings."""
        passes = []
        if self._onset_ns is not None and frame.stamp_ns - self._onset_ns > MAX_PASS_S * NS:
            passes.append(self._cut(self._onset_ns, frame.stamp_ns, 'the detection lasts for more '
                                    f'than {MAX_PASS_S:.0f} s; the remainder is not used'))
        self._last_ns = frame.stamp_ns
        begin = (frame.stamp_ns if self._onset_ns is None else self._onset_ns) - PAD_S * NS
        for buffer in (self._raw, self._calibrated):
            while buffer and buffer[0].stamp_ns.max() < begin:
                buffer.popleft()
        return passes

    def _cut(self, onset_ns: int, end_ns: int, *remarks: str) -> Pass:
        """End the current pass at `end_ns`; its notes include `remarks`."""
        begin = onset_ns - int(PAD_S * NS)
        readings = Readings.joined(self._calibrated)
        readings = readings.part((begin <= readings.stamp_ns) & (readings.stamp_ns <= end_ns))
        readings = readings.part(np.lexsort((readings.stamp_ns, readings.sensor)))
        sensor, field, raw = readings.sensor, readings.field.copy(), self._raw_fields(readings)
        covariance = np.full((len(sensor), 3, 3), np.nan)
        notes = list(remarks)
        for j in np.unique(sensor):
            rows = np.flatnonzero(sensor == j)
            if readings.covariance is not None:
                covariance[rows] = _common_covariance(readings.covariance[rows])
            interval_s = float(np.median(np.diff(readings.stamp_ns[rows]))) / NS \
                if len(rows) > 1 else np.inf
            raw[rows] = np.where(np.isnan(field[rows]), np.nan, raw[rows])
            is_saturated = saturated_readings(raw[rows], MAX_PLATEAU_S / interval_s)
            field[rows] = np.where(with_margin(is_saturated), np.nan, field[rows])
            for a, saturated in enumerate(is_saturated.T):
                if saturated.any():
                    notes.append(f'{self._network.names[j]}: {"xyz"[a]} was saturated in '
                                 f'{saturated.sum()} of {len(rows)} samples at '
                                 f'{raw[rows[saturated][0], a]:.3g} T; these values and the '
                                 'adjacent ones are not used')
        self._onset_ns = None
        t = (readings.stamp_ns - begin) / NS
        return PassData(self._network, begin, t, sensor, field, covariance,
                        doubt=self._doubt_at(onset_ns)), tuple(notes)

    def _doubt_at(self, stamp_ns: int) -> str:
        """Reason why the readings of a sensor are wrong at a time; empty if none is known.

        A doubtful background is no reason, because the background of a fit is free.
        """
        for reason, by_sensor in self._calibrate.input_doubts().items():
            names = [name for name, times in by_sensor.items() if are_doubtful(times, stamp_ns)]
            if names and reason != DOUBTFUL_BACKGROUND:
                return f'{", ".join(names)}: {MEANINGS[reason]}'
        return ''

    def _raw_fields(self, calibrated: Readings) -> FloatArray:
        """Raw fields (n, 3) [T] of calibrated readings; NaN if the raw reading is unavailable."""
        raw = Readings.joined(self._raw)
        row_of: dict[tuple[int, int], int] = {}
        for k, key in enumerate(zip(raw.sensor.tolist(), raw.stamp_ns.tolist(), strict=True)):
            # The calibration accepts the first usable reading of a timestamp.
            if np.nanmax(np.abs(raw.field[k]), initial=0.0) <= self._max_field:
                row_of.setdefault(key, k)
        # Row -1 contains NaN.
        rows = [row_of.get(key, -1) for key in zip(
            calibrated.sensor.tolist(), calibrated.stamp_ns.tolist(), strict=True)]
        fields: FloatArray = np.concatenate([raw.field, np.full((1, 3), np.nan)])[rows]
        return fields


def _common_covariance(covariances: FloatArray) -> FloatArray:
    """Replace covariances (n, 3, 3) by the first one if they vary only because the noise is being
    learnt; those of a coarse sensor differ much."""
    traces = np.nansum(np.einsum('kii->ki', covariances), axis=1)
    if traces.max() > 2.0 * traces.min():
        return covariances
    common: FloatArray = np.broadcast_to(covariances[0], covariances.shape)
    return common


class _Pose(NamedTuple):
    """Position and velocity of a track at one time."""

    stamp_ns: int
    path: FloatArray
    """(6,) position [m] and velocity [m/s], world frame."""
    variance: float
    """Trace of the covariance of the position [m²]."""


class PassTracks:
    """Determines the targets in each pass from the records of a tracker."""

    def __init__(self, settings: TrackSettings) -> None:
        self._is_for_vehicles = settings.target == 'vehicle'
        # {track id: pose of smallest variance in earlier passes, followed by all later poses}.
        self._poses: dict[int, list[_Pose]] = {}
        self._ended: set[int] = set()
        self._last_stamp_ns = 0

    def add(self, records: Iterable[object]) -> None:
        """Store the poses and the ends of tracks from the outputs of a tracker."""
        for record in records:
            if not isinstance(record, Track):
                continue
            if record.stamp_ns < self._last_stamp_ns:
                # The time jumped back: earlier poses belong to another pass.
                self._poses.clear()
                self._ended.clear()
            self._last_stamp_ns = record.stamp_ns
            if record.ended:
                self._ended.add(record.id)
            else:
                self._poses.setdefault(record.id, []).append(_Pose(
                    record.stamp_ns, np.concatenate([record.position, record.velocity]),
                    float(np.trace(record.covariance[:3, :3]))))

    def paths(self, data: PassData) -> FloatArray:
        """Position and velocity (K, 6) [m, m/s] of each vehicle in a pass when `data.t` is zero.

        A vehicle belongs to the pass that contains its pose of smallest variance. Overlapping
        tracks are of one vehicle, found again; the one of smallest variance is used. Passes must be
        in order.
        """
        end_ns = data.stamp_ns + int(NS * data.t.max())
        candidates = sorted((pose for pose in self._poses_of_smallest_variance(end_ns)
                             if pose.stamp_ns >= data.stamp_ns), key=lambda pose: pose.variance)
        paths: list[FloatArray] = []
        for pose in candidates:
            path = propagated_path(pose.path, (data.stamp_ns - pose.stamp_ns) / NS)
            if self._is_for_vehicles and all(are_separate(data, (path, other)) for other in paths):
                paths.append(path)
        return np.array(paths).reshape(-1, 6)

    def _poses_of_smallest_variance(self, end_ns: int) -> list[_Pose]:
        """Take the pose with the smallest variance up to `end_ns` of each track, and drop the
        others; the latest pose has it while a vehicle approaches, which is omitted."""
        selected = []
        for track, poses in list(self._poses.items()):
            earlier = [pose for pose in poses if pose.stamp_ns <= end_ns]
            later = poses[len(earlier):]
            best = min(earlier, key=lambda pose: pose.variance, default=None)
            if best is None:
                continue
            has_ended = track in self._ended and not later
            if best is not earlier[-1] or has_ended:
                selected.append(best)
            self._poses[track] = [best, *later]
            if has_ended:
                del self._poses[track]
                self._ended.remove(track)
        return selected


def ground_prior(settings: TrackSettings) -> GroundPrior:
    """Prior of the height and vertical speed of vehicles from tracker settings."""
    height, std = np.array([(k.height, k.height_std) for k in settings.vehicle.kinds]).T
    height_std = float(np.sqrt(height.var() + np.square(std).mean()))
    return GroundPrior((float(height.mean()), height_std), CLIMB_STD)


class PassFitter:
    """Sink that fits every pass with each number of dipoles in `orders` and passes the results to
    `report`; `cpa_range` is (range, std) [m] at the closest point of a single sensor."""

    def __init__(self, recording: str, pipeline: Pipeline, orders: Sequence[int],
                 cpa_range: tuple[float, float] | None, report: Callable[[FittedPass], object],
                 stopped: Callable[[], bool] | None = None) -> None:
        self._recording, self._collector = recording, PassCollector(pipeline)
        track = pipeline.settings.track
        self._tracks, self._ground = PassTracks(track), ground_prior(track)
        self._orders, self._cpa_range = tuple(orders), cpa_range
        self._report, self._n_passes = report, 0
        self._stopped = stopped or (lambda: False)

    def add(self, step: Step) -> None:
        """Fit the passes that end with a step, until `stopped` returns true."""
        if not step.is_last:
            # A vehicle that still approaches at the end of the source does not belong to a pass.
            self._tracks.add(step.records)
        for data, notes in self._collector.passes(step):
            fits = []
            for n_dipoles in self._orders:
                if self._stopped():
                    return
                fits.append(fit_pass(data, n_dipoles, self._cpa_range))
            self._n_passes += 1
            vehicles = fitted_vehicles(
                self._recording, self._n_passes, data, fits, self._tracks.paths(data),
                self._ground, self._orders, notes, self._stopped)
            if self._stopped():
                return
            for vehicle in vehicles:
                self._report(vehicle)


def fitted_vehicles(recording: str, number: int, data: PassData, single_fits: Sequence[PassFit],
                    paths: FloatArray, ground: GroundPrior, orders: Sequence[int],
                    notes: tuple[str, ...],
                    stopped: Callable[[], bool] | None = None) -> list[FittedPass]:
    """Fit the vehicles in detection `number` (from 1), jointly if there are several.

    `paths` (K, 6) [m, m/s] are those of the tracked vehicles when `data.t` is zero; `orders` are
    for several vehicles. The result is invalid after `stopped` has returned true.
    """
    vehicles = fit_targets(data, single_fits, paths, ground, orders, stopped)
    if len(vehicles) == 1:
        return [FittedPass(recording, number, vehicles[0], notes, correlated_motion(data))]
    chosen = [fit for fit in map(choose_order, vehicles) if fit is not None]
    notes = (*notes, f'{len(vehicles)} vehicles were fitted together; the fitted field of the '
                     'other vehicles was subtracted from the measurements')
    if not are_separate(data, [path_from(data, fit) for fit in chosen], MAX_TRAILER_DISTANCE):
        notes = (*notes, f'the vehicles are less than {MAX_TRAILER_DISTANCE:.0f} m apart: they may '
                         'be parts of one vehicle')
    return [FittedPass(recording, number, fits, notes, CorrelatedMotion(
        'several vehicles passed together'), k, len(vehicles))
        for k, fits in enumerate(vehicles, 1)]


@dataclass(frozen=True, eq=False)
class FitResult(DisplayedResult):
    """Fitted passes of a recording."""

    passes: tuple[FittedPass, ...]
    """One entry per pass and vehicle."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes."""

    def __repr__(self) -> str:
        notes = self.report.warnings()
        return (f'FitResult({quantity(len(self.passes), "pass", "passes")}'
                + (f'; {"; ".join(notes)}' if notes else '') + ')')

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the fits to a table, which requires pandas.

        Returns
        -------
        pandas.DataFrame
            One row per pass and number of dipoles, with the columns of `fits.csv`.
        """
        rows = [row for fitted in self.passes for row in pass_rows(fitted)]
        # A fit without an estimate has an empty string in this column.
        return dataframe(FITS, {c: [np.nan if c == 'ambiguous' and row[c] == '' else row[c]
                                    for row in rows] for c in names_of(FITS)})

    def figure(self, number: int = 0) -> 'Figure':
        """Draw the measured and fitted field of a pass.

        Parameters
        ----------
        number : int, optional
            Index in `passes`.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        UnknownTrackError
            If there is no such pass, or nothing could be fitted to it.
        """
        # Imported here because it loads matplotlib.
        from mag_tracking.apps.fit_report import pass_figure

        drawn = self.passes[number].drawn if 0 <= number < len(self.passes) else None
        if drawn is None:
            raise UnknownTrackError(f'no fit of pass {number}; passes: {len(self.passes)}')
        return pass_figure(drawn, self.passes[number].label)


def fit(source: UserSource, network: SensorNetwork | str | PathLike[str],
        settings: Mapping[str, Any] | None = None, orders: Sequence[int] = (1, 2, 3, 4),
        cpa_range: tuple[float, float] | None = None, time_unit: str | None = None) -> FitResult:
    """Fit every pass in a recording as a row of dipoles at constant velocity.

    Up to three simultaneous vehicles are fitted together.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        As for `track`.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.
    orders : sequence of int
        Numbers of dipoles to try, 1 to 8.
    cpa_range : (range, std), m, optional
        Range at the closest point of approach, only for a network of one sensor; see
        `analysis.pass_fit.fit_pass`.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        As for `track`.

    Returns
    -------
    FitResult

    Raises
    ------
    ReadingsError
        If a table or arrays are incomplete, not in order, or of a wrong type.
    RecordingError, NetworkError
        As for `track`.
    SettingsError
        If a setting or an argument is invalid.
    """
    network = network_of(network)
    check_orders('orders', orders)
    check_cpa_range('cpa_range', cpa_range, network)
    passes: list[FittedPass] = []
    opened = source_of(source, network, time_unit)
    pipeline = Pipeline(network, settings_for('vehicle', settings), 'track')
    fitter = PassFitter(opened.stem, pipeline, orders, cpa_range, passes.append)
    with progress_bar(opened, leave=False) as bar:
        report = run(opened, pipeline, [fitter], bar.update)
    return FitResult(tuple(passes), report)


def check_orders(name: str, orders: Sequence[int]) -> None:
    """Raise SettingsError unless the numbers of dipoles are distinct and from 1 to 8."""
    if not len(orders) or min(orders) < 1 or max(orders) > 8 or len(set(orders)) < len(orders):
        raise SettingsError(f'{name}: expected different numbers from 1 to 8, got {list(orders)}')


def check_cpa_range(name: str, cpa_range: Sequence[float] | None, network: SensorNetwork) -> None:
    """Raise SettingsError unless (range, std) [m] are positive and there is a single sensor."""
    if cpa_range is None:
        return
    if len(network) > 1:
        raise SettingsError(f'{name}: only for a single sensor; the {len(network)} sensors of the '
                            'network already determine the scale')
    if len(cpa_range) != 2 or not (np.isfinite(cpa_range).all() and min(cpa_range) > 0.0):
        raise SettingsError(f'{name}: expected two positive numbers, got {list(cpa_range)}')
