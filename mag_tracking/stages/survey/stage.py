"""Survey: how each sensor of a network is turned, and how far its clock is off.

Source: T10 section 6.3: knocks that all sensors feel, accelerometer, compass.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.agreement import Disagreement, consensus, disagreements
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.clock import Lag, knock_lag, shock
from mag_tracking.calibration.orientation import (
    Orientation,
    UpDirection,
    compass_orientation,
    levelled,
    pooled_bias_std,
    up_direction,
    with_stated_heading,
)
from mag_tracking.geometry import yaw_between
from mag_tracking.network import SensorNetwork
from mag_tracking.records import AccelerationSample
from mag_tracking.stages.survey.settings import SurveySettings
from mag_tracking.units import NS

MAX_GAP_S = 3600.0
"""[s] After a longer gap, or a step back, what was collected is of another time."""

SURE_STATED = 1e-3
"""[rad] Nobody states an orientation better than this."""


@dataclass(frozen=True)
class SensorSurvey:
    """What was found of one sensor."""

    sensor: str
    orientation: Orientation | None
    """None: it stays as it was stated."""
    by: str
    """What the orientation comes from."""
    lag: Lag | None
    """Of its clock; None for the sensor that the others are compared with."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class NetworkSurvey:
    """What was found of a network."""

    network: SensorNetwork
    """With orientations and clock offsets as they were found."""
    sensors: tuple[SensorSurvey, ...]
    disagreements: tuple[Disagreement, ...]
    """Sensors that do not measure the Earth; their headings stay as stated."""
    bias_std: float
    """[T] that the compasses were counted with."""
    reference: str
    """The sensor whose clock is the network's; empty where none felt a knock with another."""
    shocks: dict[str, tuple[FloatArray, FloatArray]]
    """{sensor: (t (n,) [s], shock (n,) [m/s^2])} of those with accelerations; each by its own
    clock, from the first reading of all."""

    def warnings(self) -> list[str]:
        """What somebody should know: list of text."""
        out = [str(d) for d in self.disagreements]
        reasons = {s.sensor: s.lag.reason for s in self.sensors if s.lag and s.lag.reason}
        out += [f'{s.sensor}: {text}' for s in self.sensors for text in s.warnings]
        if self.reference:
            out += [f'{name}: clock: {reason}' for name, reason in reasons.items()]
        elif len(self.sensors) > 1:
            because = ', '.join(sorted(set(reasons.values()))) or 'too few accelerometers'
            out.append(f'clocks stay as they were: {because}')
        return out


class Survey:
    """Collects accelerations; `solve` makes orientations and clock offsets of them."""

    def __init__(self, network: SensorNetwork, settings: SurveySettings) -> None:
        self.counts: Counter[str] = Counter()
        # What an earlier survey found is no further evidence.
        self._network, self._settings = network.with_stated_orientations(), settings
        self._kept: dict[str, deque[tuple[int, FloatArray]]] = {
            name: deque(maxlen=settings.max_accelerations) for name in network.names}

    def feed(self, sample: AccelerationSample) -> list[NetworkSurvey]:
        """Take an `AccelerationSample`: []."""
        kept = self._kept.get(sample.sensor)
        if kept is None:
            self.counts[f'rejected: acceleration of unknown sensor {sample.sensor}'] += 1
        elif not np.isfinite(sample.acceleration).all():
            self.counts['rejected: acceleration is not finite'] += 1
        elif kept and not 0 < sample.stamp_ns - kept[-1][0] < MAX_GAP_S * NS:
            if abs(kept[-1][0] - sample.stamp_ns) > NS:
                kept.clear()
                kept.append((sample.stamp_ns, sample.acceleration))
                self.counts['time jumped'] += 1
            else:
                self.counts['rejected: acceleration out of order'] += 1
        else:
            kept.append((sample.stamp_ns, sample.acceleration))
            self.counts['accelerations'] += 1
        return []

    def idle(self) -> None:
        """Nothing waits."""

    def flush(self) -> list[NetworkSurvey]:
        """Nothing is held back: []."""
        return []

    def solve(self, fields: Mapping[str, FloatArray], date: str) -> NetworkSurvey:
        """What the accelerations so far and the sensors' fields say.

        Parameters
        ----------
        fields : {sensor: (3,) [T], sensor frame}
            Without a target; NaN = axis not reported. A sensor may be missing.
        date : str
            What the calibration is marked with.

        Returns
        -------
        NetworkSurvey
        """
        network, names = self._network, self._network.names
        field = np.array([fields.get(name, np.full(3, np.nan)) for name in names])
        stated_std = np.array([np.full(3, np.deg2rad(self._settings.stated_std_deg))
                               if s is None else np.maximum(s, SURE_STATED)
                               for s in network.orientation_std])
        warnings: dict[str, list[str]] = {name: [] for name in names}
        ups = [self._up(name, warnings[name]) for name in names]
        level = [levelled(up, R, std) for up, R, std in
                 zip(ups, network.R_ws, stated_std, strict=True)]
        for name, before, now, std in zip(names, network.R_ws, level, stated_std, strict=True):
            if now is not None:
                warnings[name] += _tilt_warning(before, now.R_ws, std, now.std)
        odd = self._odd(field, level, stated_std, warnings)
        bias_std, turned = self._compass(
            {j: u for j, u in enumerate(ups) if u is not None and names[j] not in
             {d.sensor for d in odd}}, field, stated_std, warnings)
        shocks = self._shocks()
        reference, lags = self._lags(shocks)
        sensors = []
        for j, name in enumerate(names):
            orientation, by = turned.get(j, (level[j], 'accelerometer, heading as stated'))
            sensors.append(SensorSurvey(
                name, orientation, 'as stated' if orientation is None else by, lags.get(name),
                tuple(warnings[name])))
        return NetworkSurvey(self._surveyed(sensors, reference, date), tuple(sensors), tuple(odd),
                             bias_std, reference, shocks)

    def _up(self, name: str, warnings: list[str]) -> UpDirection | None:
        """`UpDirection` of a sensor, or None with a warning."""
        if not self._kept[name]:
            warnings.append('no accelerations: its orientation is not surveyed')
            return None
        try:
            return up_direction(np.array([a for _, a in self._kept[name]]),
                                self._settings.accelerometer_bias)
        except ValueError as error:
            warnings.append(f'{error}: its orientation stays as stated')
            return None

    def _odd(self, field: FloatArray, level: Sequence[Orientation | None], stated_std: FloatArray,
             warnings: Mapping[str, list[str]]) -> list[Disagreement]:
        """The sensors that disagree with the Earth; [] where nothing is there to compare with."""
        network = self._network
        R = np.array([R if o is None else o.R_ws for o, R in zip(level, network.R_ws, strict=True)])
        std = np.array([s if o is None else o.std for o, s in zip(level, stated_std, strict=True)])
        try:
            earth = consensus(field, R) if network.earth_field is None else network.earth_field
        except ValueError as error:
            warnings[network.names[0]].append(str(error))
            return []
        return disagreements(network.names, field, R, std, earth, self._settings.compass_bias_std)

    def _compass(self, ups: Mapping[int, UpDirection], field: FloatArray, stated_std: FloatArray,
                 warnings: Mapping[str, list[str]]
                 ) -> tuple[float, dict[int, tuple[Orientation, str]]]:
        """(bias_std, {row: (Orientation, by)}) of the sensors that have what it takes."""
        network, bias_std = self._network, self._settings.compass_bias_std
        usable = {j: up for j, up in ups.items() if not np.isnan(field[j]).all()}
        if network.earth_field is None or not usable:
            return bias_std, {}
        found: dict[int, Orientation] = {}
        blind: dict[int, str] = {}
        # Twice: how large biases are is seen when the headings are known.
        for _ in range(2):
            found = {}
            for j, up in usable.items():
                try:
                    found[j] = compass_orientation(up, field[j], network.earth_field, bias_std,
                                                   network.R_ws[j])
                except ValueError as error:
                    blind[j] = str(error)
            bias_std = pooled_bias_std(list(found.values()), self._settings.compass_bias_std)
        for j in blind.keys() - found.keys():
            warnings[network.names[j]].append(blind[j])
        out = {}
        for j, orientation in found.items():
            both = with_stated_heading(orientation, network.R_ws[j], stated_std[j][2])
            name = network.names[j]
            if both is None:
                away = np.degrees(yaw_between(network.R_ws[j], orientation.R_ws))
                warnings[name].append(f'heads {away:+.0f} degrees from what the network file says, '
                                      'by its compass: it stays as stated')
            elif not np.isnan(orientation.rival):
                warnings[name].append('its compass allows another heading, '
                                      f'{np.degrees(orientation.rival):+.0f} degrees from this one')
            if both is not None:
                out[j] = both, 'accelerometer, compass and stated heading'
        return bias_std, out

    def _shocks(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """How each sensor was shaken."""
        kept = {name: readings for name, readings in self._kept.items() if readings}
        # From the first: seconds since 1970 leave a float few digits.
        first = min((readings[0][0] for readings in kept.values()), default=0)
        return {name: (np.array([(stamp - first) / NS for stamp, _ in readings]),
                       shock(np.array([a for _, a in readings])))
                for name, readings in kept.items()}

    def _lags(self, signals: Mapping[str, tuple[FloatArray, FloatArray]]
              ) -> tuple[str, dict[str, Lag]]:
        """(reference sensor, {sensor: Lag}) by the knocks."""
        longest = self._settings.max_clock_offset_s
        first: dict[str, Lag] = {}
        for reference, (t, s) in signals.items():
            lags = {name: knock_lag(t, s, *signals[name], longest)
                    for name in signals if name != reference}
            if any(not lag.reason for lag in lags.values()):
                return reference, lags
            first = first or lags
        return '', first

    def _surveyed(self, sensors: Sequence[SensorSurvey], reference: str,
                  date: str) -> SensorNetwork:
        """The network with what was found."""
        network = self._network
        R_ws, clock = network.R_ws.copy(), network.clock_offset.copy()
        # The reference keeps what was known of its clock: those not compared have the same zero.
        zero = clock[network.index(reference)] if reference else 0.0
        std, done = list(network.orientation_std), list(network.calibrated)
        for j, s in enumerate(sensors):
            lag = None if s.lag is None or s.lag.reason else s.lag
            if lag is not None:
                clock[j] = zero + lag.offset
            if s.orientation is not None:
                R_ws[j], std[j] = s.orientation.R_ws, s.orientation.std
            if s.orientation is not None or lag is not None or s.sensor == reference:
                lag_std = lag.std if lag is not None else 0.0 if s.sensor == reference else np.nan
                done[j] = network.calibration_record(j, date, s.by, lag_std)
        return replace(network, R_ws=R_ws, orientation_std=tuple(std), clock_offset=clock,
                       calibrated=tuple(done))


class NoiseSource(Protocol):
    """What `with_noise` asks of a `Calibrate` stage."""

    def backgrounds(self) -> Mapping[str, RunningBackground]:
        """The background of each sensor of the network, in its order."""


def with_noise(network: SensorNetwork, calibrate: NoiseSource) -> SensorNetwork:
    """The network with the noise that a `Calibrate` stage has found, where it has."""
    noise = list(network.noise_std)
    for j, background in enumerate(calibrate.backgrounds().values()):
        std = None if background.covariance is None else np.sqrt(np.diagonal(background.covariance))
        # The file wants three numbers: an axis that is not reported has none.
        if std is not None and not np.isnan(std).any():
            noise[j] = std
    return replace(network, noise_std=tuple(noise))


def _tilt_warning(stated: FloatArray, found: FloatArray, stated_std: FloatArray,
                  found_std: FloatArray) -> list[str]:
    """[text] where a sensor is tilted more than was stated, or []."""
    tilt = np.arccos(np.clip((stated.T @ [0.0, 0.0, 1.0]) @ (found.T @ [0.0, 0.0, 1.0]), -1.0, 1.0))
    allowed = 3.0 * np.hypot(stated_std[:2].max(), found_std[:2].max())
    return [f'is tilted by {np.degrees(tilt):.0f} degrees from what the network file says'] \
        if tilt > allowed else []
