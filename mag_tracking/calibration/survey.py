"""Survey: estimate the orientation and clock offset of each sensor of a network.

It follows T10 section 6.3: knocks that all sensors measure give the clock offsets; accelerometers
and the field of the Earth give the orientations.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.agreement import (
    COMPASS_BIAS_STD,
    FieldInconsistency,
    SurveySettings,
    consensus,
    disagreements,
)
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.clock import Lag, knock_lag, shock
from mag_tracking.calibration.orientation import (
    Orientation,
    UpDirection,
    compass_orientation,
    levelled,
    pooled_bias_std,
    up_direction,
    with_nominal_heading,
)
from mag_tracking.geometry import yaw_between
from mag_tracking.network import SensorNetwork
from mag_tracking.records import AccelerationSample
from mag_tracking.units import NS

MAX_GAP_S = 3600.0
"""[s] Maximum gap between accelerations of one recording; earlier readings are discarded."""

ACCELEROMETER_BIAS = 0.05
"""[m/s²] Bias of an accelerometer, per axis; it tilts the estimated vertical by 0.3 degrees."""

MAX_CLOCK_OFFSET_S = 0.5
"""[s] Maximum offset between two clocks, and minimum interval between knocks."""

MAX_ACCELERATIONS = 60_000
"""Maximum number of stored readings per accelerometer, which bounds the memory."""

MIN_NOMINAL_STD = 1e-3
"""[rad] Minimum standard deviation of an orientation in the network file."""


@dataclass(frozen=True)
class SensorSurvey:
    """Result of the survey for one sensor."""

    sensor: str
    orientation: Orientation | None
    """Surveyed orientation; None if the orientation in the network file is retained."""
    by: str
    """Source of the orientation."""
    lag: Lag | None
    """Offset of the sensor clock; None for the reference clock and without accelerations."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class NetworkSurvey:
    """Result of the survey for a network."""

    network: SensorNetwork
    """Network with the surveyed orientations and clock offsets."""
    sensors: tuple[SensorSurvey, ...]
    disagreements: tuple[FieldInconsistency, ...]
    """Sensors whose field differs from the field of the Earth; their headings are nominal."""
    bias_std: float
    """[T] Standard deviation of the compass biases."""
    reference: str
    """Name of the sensor with the reference clock; empty if no two measured the same knock."""
    shocks: dict[str, tuple[FloatArray, FloatArray]]
    """{sensor: (t (n,) [s], shock (n,) [m/s²])} with times by the clock of each sensor, relative to
    the first reading of any sensor."""

    def warnings(self) -> list[str]:
        """Warnings about the fields, orientations and clocks of the sensors."""
        out = [str(d) for d in self.disagreements]
        reasons = {s.sensor: s.lag.reason for s in self.sensors if s.lag and s.lag.reason}
        out += [f'{s.sensor}: {text}' for s in self.sensors for text in s.warnings]
        if self.reference:
            out += [f'{name}: clock: {reason}' for name, reason in reasons.items()]
        elif len(self.sensors) > 1:
            causes = ', '.join(sorted(set(reasons.values()))) or 'too few accelerometers'
            out.append(f'clock offsets are unchanged: {causes}')
        return out


class Survey:
    """Collects accelerations, from which `solve` computes orientations and clock offsets."""

    def __init__(self, network: SensorNetwork, settings: SurveySettings) -> None:
        self.counts: Counter[str] = Counter()
        # The result of an earlier survey is not additional evidence.
        self._network, self._settings = network.with_nominal_orientations(), settings
        self._accelerations: dict[str, deque[tuple[int, FloatArray]]] = {
            name: deque(maxlen=MAX_ACCELERATIONS) for name in network.names}

    def feed(self, sample: AccelerationSample) -> list[NetworkSurvey]:
        """Add an acceleration, or reject and count it if it is invalid; return an empty list."""
        recorded = self._accelerations.get(sample.sensor)
        if recorded is None:
            self.counts[f'rejected: acceleration of unknown sensor {sample.sensor}'] += 1
        elif not np.isfinite(sample.acceleration).all():
            self.counts['rejected: acceleration is not finite'] += 1
        elif recorded and not 0 < sample.stamp_ns - recorded[-1][0] < MAX_GAP_S * NS:
            if abs(recorded[-1][0] - sample.stamp_ns) > NS:
                recorded.clear()
                recorded.append((sample.stamp_ns, sample.acceleration))
                self.counts['time jumped'] += 1
            else:
                self.counts['rejected: acceleration out of order'] += 1
        else:
            recorded.append((sample.stamp_ns, sample.acceleration))
            self.counts['accelerations'] += 1
        return []

    def idle(self) -> None:
        """Do nothing: no work is deferred."""

    def flush(self) -> list[NetworkSurvey]:
        """Return an empty list: no record is buffered."""
        return []

    def solve(self, fields: Mapping[str, FloatArray], date: str) -> NetworkSurvey:
        """Compute orientations and clock offsets from fields and the accelerations added so far.

        `fields` (3,) [T, sensor frame] are measured without a target, NaN for an unreported axis;
        sensors may be missing. `date` is entered in the calibration records.
        """
        network, names = self._network, self._network.names
        field = np.array([fields.get(name, np.full(3, np.nan)) for name in names])
        nominal_std = np.array([np.full(3, np.deg2rad(self._settings.nominal_std_deg))
                               if s is None else np.maximum(s, MIN_NOMINAL_STD)
                               for s in network.orientation_std])
        warnings: dict[str, list[str]] = {name: [] for name in names}
        up_directions = [self._estimate_up(name, warnings[name]) for name in names]
        orientations = [levelled(up, R, std) for up, R, std in
                        zip(up_directions, network.R_ws, nominal_std, strict=True)]
        for name, before, surveyed, std in zip(
                names, network.R_ws, orientations, nominal_std, strict=True):
            if surveyed is not None:
                warnings[name] += _tilt_warning(before, surveyed.R_ws, std, surveyed.std)
        inconsistent = self._disagreements(field, orientations, nominal_std, warnings)
        faulty = {d.sensor for d in inconsistent}
        bias_std, oriented = self._compass(
            {j: up for j, up in enumerate(up_directions) if up is not None
             and names[j] not in faulty}, field, nominal_std, warnings)
        shocks = self._shocks()
        reference, lags = self._lags(shocks)
        sensors = []
        for j, name in enumerate(names):
            orientation = oriented.get(j, orientations[j])
            by = 'nominal orientation' if orientation is None else \
                f'accelerometer, {"compass and " if j in oriented else ""}nominal heading'
            sensors.append(SensorSurvey(name, orientation, by, lags.get(name),
                                        tuple(warnings[name])))
        return NetworkSurvey(self._updated_network(sensors, reference, date), tuple(sensors),
                             tuple(inconsistent), bias_std, reference, shocks)

    def _estimate_up(self, name: str, warnings: list[str]) -> UpDirection | None:
        """Estimate the vertical in the frame of a sensor; None, with a warning, if unavailable."""
        if not self._accelerations[name]:
            warnings.append('no accelerations; the orientation is not surveyed')
            return None
        try:
            return up_direction(np.array([a for _, a in self._accelerations[name]]),
                                ACCELEROMETER_BIAS)
        except ValueError as error:
            warnings.append(f'{error}; the orientation in the network file is retained')
            return None

    def _disagreements(self, field: FloatArray, orientations: Sequence[Orientation | None],
                       nominal_std: FloatArray, warnings: Mapping[str, list[str]]
                       ) -> list[FieldInconsistency]:
        """Find the sensors whose field contradicts that of the Earth; warn if that is unknown."""
        network = self._network
        R = np.array([R if o is None else o.R_ws
                      for o, R in zip(orientations, network.R_ws, strict=True)])
        std = np.array([s if o is None else o.std
                        for o, s in zip(orientations, nominal_std, strict=True)])
        try:
            earth = consensus(field, R) if network.earth_field is None else network.earth_field
        except ValueError as error:
            warnings[network.names[0]].append(str(error))
            return []
        return disagreements(network.names, field, R, std, earth, COMPASS_BIAS_STD,
                             self._settings.offset_std)

    def _compass(self, ups: Mapping[int, UpDirection], field: FloatArray, nominal_std: FloatArray,
                 warnings: Mapping[str, list[str]]) -> tuple[float, dict[int, Orientation]]:
        """Std of the compass biases [T], and {sensor index: orientation from the compass}."""
        network, bias_std = self._network, COMPASS_BIAS_STD
        usable = {j: up for j, up in ups.items() if not np.isnan(field[j]).all()}
        if network.earth_field is None or not usable:
            return bias_std, {}
        estimates: dict[int, Orientation] = {}
        failures: dict[int, str] = {}
        # Two passes, because the biases can be estimated only when the headings are known.
        for _ in range(2):
            estimates = {}
            for j, up in usable.items():
                try:
                    estimates[j] = compass_orientation(up, field[j], network.earth_field, bias_std,
                                                       network.R_ws[j])
                except ValueError as error:
                    failures[j] = str(error)
            bias_std = pooled_bias_std(list(estimates.values()), COMPASS_BIAS_STD)
        for j in failures.keys() - estimates.keys():
            warnings[network.names[j]].append(failures[j])
        out = {}
        for j, orientation in estimates.items():
            fused = with_nominal_heading(orientation, network.R_ws[j], nominal_std[j][2])
            if fused is None:
                difference = np.degrees(yaw_between(network.R_ws[j], orientation.R_ws))
                warnings[network.names[j]].append(
                    f'the compass heading differs by {difference:+.0f} degrees from the network '
                    'file, whose heading is retained')
                continue
            out[j] = fused
            if not np.isnan(orientation.rival):
                warnings[network.names[j]].append(
                    'the compass allows another heading, which differs by '
                    f'{np.degrees(orientation.rival):+.0f} degrees')
        return bias_std, out

    def _shocks(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Mechanical shock of each sensor over time, as in `NetworkSurvey.shocks`."""
        recorded = {name: readings for name, readings in self._accelerations.items() if readings}
        # Times are relative to the first reading, because seconds since 1970 lose digits in a
        # float.
        first = min((readings[0][0] for readings in recorded.values()), default=0)
        return {name: (np.array([(stamp - first) / NS for stamp, _ in readings]),
                       shock(np.array([a for _, a in readings])))
                for name, readings in recorded.items()}

    def _lags(self, signals: Mapping[str, tuple[FloatArray, FloatArray]]
              ) -> tuple[str, dict[str, Lag]]:
        """Find the reference sensor, '' if none, and estimate the lags of others from knocks."""
        first_lags: dict[str, Lag] = {}
        for reference, (t, s) in signals.items():
            lags = {name: knock_lag(t, s, *signals[name], MAX_CLOCK_OFFSET_S)
                    for name in signals if name != reference}
            if any(not lag.reason for lag in lags.values()):
                return reference, lags
            first_lags = first_lags or lags
        return '', first_lags

    def _updated_network(self, sensors: Sequence[SensorSurvey], reference: str,
                         date: str) -> SensorNetwork:
        """Create a network with the surveyed orientations and clock offsets."""
        network = self._network
        R_ws, clock = network.R_ws.copy(), network.clock_offset.copy()
        # The reference clock keeps its offset, so that the offsets of clocks that were not compared
        # remain valid.
        reference_offset = clock[network.index(reference)] if reference else 0.0
        std, calibrated = list(network.orientation_std), list(network.calibrated)
        for j, s in enumerate(sensors):
            lag = None if s.lag is None or s.lag.reason else s.lag
            if lag is not None:
                clock[j] = reference_offset + lag.offset
            if s.orientation is not None:
                R_ws[j], std[j] = s.orientation.R_ws, s.orientation.std
            if s.orientation is not None or lag is not None or s.sensor == reference:
                lag_std = lag.std if lag is not None else 0.0 if s.sensor == reference else np.nan
                calibrated[j] = network.calibration_record(j, date, s.by, lag_std)
        return replace(network, R_ws=R_ws, orientation_std=tuple(std), clock_offset=clock,
                       calibrated=tuple(calibrated))


def with_measured_noise(network: SensorNetwork,
                        backgrounds: Mapping[str, RunningBackground]) -> SensorNetwork:
    """Network with the noise of the backgrounds of its sensors, if known for all axes."""
    noise = list(network.noise_std)
    for j, background in enumerate(backgrounds.values()):
        std = None if background.covariance is None else np.sqrt(np.diagonal(background.covariance))
        # The network file requires all three axes, but an axis that is not reported has no noise.
        if std is not None and not np.isnan(std).any():
            noise[j] = std
    return replace(network, noise_std=tuple(noise))


def _tilt_warning(R: FloatArray, surveyed: FloatArray, std: FloatArray,
                  surveyed_std: FloatArray) -> list[str]:
    """List with a warning if a surveyed tilt differs significantly from the network file."""
    tilt = np.arccos(np.clip((R.T @ [0.0, 0.0, 1.0]) @ (surveyed.T @ [0.0, 0.0, 1.0]), -1.0, 1.0))
    limit = 3.0 * np.hypot(std[:2].max(), surveyed_std[:2].max())
    return [f'the tilt differs by {np.degrees(tilt):.0f} degrees from the network file'] \
        if tilt > limit else []
