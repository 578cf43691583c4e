"""Disturbances: fields that start a track, but that no target explains."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.event_records import Disturbance
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.records import FieldFrame

FALSE_ALARM_PROBABILITY = 1e-6
"""Probability that the noise of a sensor alone marks it as affected in a frame."""


@dataclass(frozen=True)
class UnexplainedField:
    """Field of a track that no target explains."""

    track_id: int
    """Identifier of the track."""
    begin_ns: int
    """Start of the track [ns]."""
    largest: FloatArray
    """Largest field measured by each sensor, (n_sensors,) T."""
    sensed: BoolArray
    """Whether each sensor sensed the field, (n_sensors,)."""
    uniform: float
    """Probability of a common field over the network."""


class Disturbances:
    """Disturbance in progress, from the end of its first track to the release of the detection."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._next_id = 1
        self._current: Disturbance | None = None
        self._largest: FloatArray = np.zeros(len(names))
        self._sensed: BoolArray = np.zeros(len(names), dtype=bool)

    def begin(self, found: UnexplainedField, stamp_ns: int) -> list[Disturbance]:
        """Start a disturbance after an unexplained track and return its record, or extend the
        current one."""
        if self._current is not None:
            self._largest = np.maximum(self._largest, found.largest)
            self._sensed |= found.sensed
            self._current = replace(self._current, uniform=found.uniform, track_id=found.track_id)
            return []
        self._largest, self._sensed = found.largest.copy(), found.sensed.copy()
        self._current = Disturbance(stamp_ns, self._next_id, False, found.begin_ns,
                                    float(self._largest.max()), self._sensors(), found.uniform,
                                    found.track_id)
        self._next_id += 1
        return [self._current]

    def feed(self, frame: FieldFrame) -> None:
        """Update the current disturbance, if any, with a frame that belongs to no track.

        The disturbance may grow stronger and affect additional sensors.
        """
        if self._current is not None:
            energy, n_axes = whitened_energy(frame.field, frame.covariance)
            self._largest = np.maximum(self._largest, field_magnitudes(frame))
            self._sensed |= energy > chdtri(np.maximum(n_axes, 1), FALSE_ALARM_PROBABILITY)

    def end(self, stamp_ns: int) -> list[Disturbance]:
        """Return the closing record of the disturbance in progress, if any, at the release of the
        detection or at a gap in the frames."""
        if self._current is None:
            return []
        last, self._current = self._current, None
        return [replace(last, stamp_ns=stamp_ns, ended=True, largest=float(self._largest.max()),
                        sensors=self._sensors())]

    def _sensors(self) -> tuple[str, ...]:
        """Names of the affected sensors, strongest field first."""
        order = np.argsort(-self._largest, kind='stable')
        return tuple(self._names[j] for j in order if self._sensed[j])


def field_magnitudes(frame: FieldFrame) -> FloatArray:
    """Magnitude (n_sensors,) of the field of a frame, T; 0 if the reading is missing."""
    magnitude: FloatArray = np.sqrt(np.nansum(np.square(frame.field), axis=1))
    return magnitude
