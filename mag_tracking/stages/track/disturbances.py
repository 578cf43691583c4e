"""Disturbances: what is left of tracks that something else explained better than a target."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.event_records import Disturbance
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.records import FieldFrame

FALSE_ALARM = 1e-6
"""Probability that a sensor is taken to feel a disturbance when a frame of it is noise."""


@dataclass(frozen=True)
class UnexplainedField:
    """The field during a track that no target explained."""

    track_id: int
    begin_ns: int
    largest: FloatArray
    """(n_sensors,) [T] size of the largest field at each sensor."""
    sensed: BoolArray
    """(n_sensors,) which of them sensed it."""
    uniform: float


class Disturbances:
    """Follows one disturbance at a time, from the end of its first track to the release."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._next_id = 1
        self._current: Disturbance | None = None
        self._largest: FloatArray = np.zeros(len(names))
        self._sensed: BoolArray = np.zeros(len(names), dtype=bool)

    def begin(self, found: UnexplainedField, stamp_ns: int) -> list[Disturbance]:
        """A track was `UnexplainedField`: the record of a new disturbance, or none where one goes on."""
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
        """Take a frame of the disturbance alone: it may be larger now, and reach other sensors."""
        if self._current is not None:
            energy, n_axes = whitened_energy(frame.field, frame.covariance)
            self._largest = np.maximum(self._largest, field_magnitudes(frame))
            self._sensed |= energy > chdtri(np.maximum(n_axes, 1), FALSE_ALARM)

    def end(self, stamp_ns: int) -> list[Disturbance]:
        """The network is quiet again, or nothing is known of it any more."""
        if self._current is None:
            return []
        last, self._current = self._current, None
        return [replace(last, stamp_ns=stamp_ns, ended=True, largest=float(self._largest.max()),
                        sensors=self._sensors())]

    def _sensors(self) -> tuple[str, ...]:
        """Names of those that sensed it, the strongest first."""
        order = np.argsort(-self._largest, kind='stable')
        return tuple(self._names[j] for j in order if self._sensed[j])


def field_magnitudes(frame: FieldFrame) -> FloatArray:
    """(n_sensors,) [T] size of the field of a frame; 0 where it is missing."""
    size: FloatArray = np.sqrt(np.nansum(np.square(frame.field), axis=1))
    return size
