"""Comparison of the backgrounds of a network with the Earth's field while they are learnt."""

from collections.abc import Iterable

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration import agreement
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, shifted, updated
from mag_tracking.network import SensorNetwork
from mag_tracking.stages.health.diagnosis import Cause, Finding

MIN_CHANGE = 1e-7
"""[T] Change of a background after which it is compared again; harmful faults exceed 1e-5."""


def compared_with_earth(network: SensorNetwork, survey: agreement.SurveySettings,
                        levels: FloatArray) -> list[agreement.FieldInconsistency]:
    """Find the sensors whose `levels` (n, 3) [T] without a target contradict the Earth's field, or,
    if it is unknown, their median; raises ValueError if fewer than three then report all axes."""
    std = np.array([np.full(3, np.deg2rad(survey.nominal_std_deg)) if s is None else s
                    for s in network.orientation_std])
    earth_field = agreement.consensus(levels, network.R_ws) if network.earth_field is None \
        else network.earth_field
    return agreement.disagreements(network.names, levels, network.R_ws, std, earth_field,
                                   agreement.COMPASS_BIAS_STD, survey.offset_std)


def earth_field_findings(inconsistencies: Iterable[agreement.FieldInconsistency]) -> list[Finding]:
    """Findings about sensors that contradict the Earth's field; serious if the sensor misleads."""
    return [Finding(d.misleads, d.sensor, str(d).removeprefix(f'{d.sensor} ')
                    + ('; all its tracks are ambiguous' if d.misleads else ''), d.advice,
                    Cause.CONTRADICTS_EARTH) for d in inconsistencies]


class FieldComparison:
    """Times at which the background of a sensor contradicts the Earth's field."""

    def __init__(self, network: SensorNetwork, survey: agreement.SurveySettings) -> None:
        self._survey = survey
        self._found: dict[str, agreement.FieldInconsistency] = {}
        # Intervals of each sensor that was compared.
        self._times: dict[str, DoubtfulTimes] = {}
        self.use(network)

    def use(self, network: SensorNetwork) -> None:
        """Compare with another calibration of the same sensors from now on."""
        self._network = network
        self._levels = np.full((len(network), 3), np.nan)

    def update(self, j: int, level: FloatArray, first_ns: int, last_ns: int) -> None:
        """Compare the background (3,) [T] of sensor `j`, with readings from `first_ns` to
        `last_ns`, if it has changed; the first one also holds for the readings before it."""
        previous = self._levels[j]
        if not self._survey.offset_std or (
                (np.abs(level - previous) <= MIN_CHANGE)
                | (np.isnan(level) & np.isnan(previous))).all():
            return
        self._levels[j] = level
        try:
            found = {d.sensor: d for d in compared_with_earth(
                self._network, self._survey, self._levels) if d.misleads}
        except ValueError:
            # Too few sensors are known yet.
            return
        for name, known in zip(self._network.names, ~np.isnan(self._levels).all(axis=1),
                               strict=True):
            if known:
                self._times[name] = updated(
                    self._times.get(name, ()), last_ns if name in self._times else first_ns,
                    name in found)
        self._found |= found

    def doubtful_times(self) -> dict[str, DoubtfulTimes]:
        """Intervals in which a background contradicted the Earth's field, by sensor."""
        return {name: times for name, times in self._times.items() if times}

    def times_of(self, sensor: str) -> DoubtfulTimes:
        """Intervals in which the background of a sensor contradicted the Earth's field."""
        return self._times.get(sensor, ())

    def shift(self, sensor: str, ns: int) -> None:
        """Shift the intervals of a sensor by a change of its clock offset."""
        if sensor in self._times:
            self._times[sensor] = shifted(self._times[sensor], ns)

    def inconsistencies(self) -> list[agreement.FieldInconsistency]:
        """Latest misleading inconsistency of each sensor, in the order of the network."""
        return [self._found[name] for name in self._network.names if name in self._found]
