"""Stays: events of vehicles that stand beside a sensor until their field is its background.

The calibration learns their field as the new background (`calibrate.relearn_s`): the calibrated
field steps to zero, and the event ends although the vehicle has not left. When it leaves, the field
steps to the opposite, until it is learnt or another vehicle takes the place. Both events are
joined, and so are those of a weak field whose detection is interrupted.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RelearntBackground
from mag_tracking.event_records import PassEvent
from mag_tracking.records import Readings
from mag_tracking.units import NEVER, NS

N_READINGS = 5
"""Number of readings from which the field before a change of the background is determined."""
MIN_FIELD_STDS = 3.0
"""Minimum magnitude of this field, in standard deviations of the noise."""
MAX_DIFFERENCE = 0.15
"""Maximum relative difference between the field of a departure and that of the arrival."""
MIN_REMAINING = 0.5
"""Minimum field at the end of an event, relative to its peak, for the vehicle to be present."""
MIN_OPPOSITE = 0.5
"""Minimum fraction of the readings of an event with the opposite field of a departed vehicle."""
MAX_GAP_S, MAX_GAP_INTERVALS = 5.0, 3.0
"""[s] Maximum gap between events of one vehicle, to which intervals between readings are added."""
MIN_APPROACH = 0.3
"""Minimum approach to the free field when a vehicle leaves, relative to the change."""
MAX_OPEN = 8
"""Maximum number of vehicles that stand beside a sensor; the oldest is reported as not ended."""


class _Stay(NamedTuple):
    """Arrival of a parked vehicle and its field (3,) [T], which has become the background."""

    arrival: PassEvent
    level: FloatArray


class _Held(NamedTuple):
    """End of an event (None if complete) at which a vehicle's field (3,) [T] remained."""

    event: PassEvent | None
    level: FloatArray
    release_ns: int


class Stays:
    """Joins the arrivals and departures of vehicles that park beside one sensor with the field
    `free_field` (3,) [T] without a vehicle, NaN if unknown."""

    def __init__(self, free_field: FloatArray) -> None:
        self._free_field = free_field
        self.first_ns = NEVER
        self._open: list[_Stay] = []
        self._held: _Held | None = None

    def add(self, event: PassEvent, readings: Readings,
            relearnt: Sequence[RelearntBackground]) -> list[PassEvent]:
        """Add an event, with all its `readings`, and return the completed events; a departure
        completes the event of the arrival, or one that begins with the first reading
        (`first_ns`)."""
        end_ns = int(readings.stamp_ns[-1])
        change = max((c for c in relearnt if event.onset_ns < c.stamp_ns <= end_ns),
                     key=_size, default=None)
        stamps = readings.stamp_ns
        # A detection ends with the first quiet reading.
        fields = readings.field[stamps > event.release_ns][:N_READINGS] if change is None \
            else readings.field[stamps < change.stamp_ns][-N_READINGS:]
        level: FloatArray = np.nan_to_num(
            (fields if len(fields) else readings.field[-1:]).mean(axis=0))
        noise = float(np.nanmax(event.noise_std))
        tolerance = MAX_DIFFERENCE * float(np.linalg.norm(level)) + MIN_FIELD_STDS * noise
        held, self._held, out = self._held, None, []
        if held is not None:
            interval_ns = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
            gap_ns = MAX_GAP_S * NS + MAX_GAP_INTERVALS * interval_ns
            if event.onset_ns - held.release_ns > gap_ns \
                    or np.linalg.norm(held.level - level) > tolerance:
                out += [held.event] if held.event is not None else []
            elif held.event is not None:
                event = replace(event, onset_ns=held.event.onset_ns,
                                energy=held.event.energy + event.energy)
            else:
                self._held = held._replace(release_ns=event.release_ns)
                return []
        if not event.ended:
            return [*out, event]
        if change is None:
            fields = readings.field[(event.onset_ns <= stamps) & (stamps <= event.release_ns)]
            return out + self._unchanged(event, np.nan_to_num(fields), level, tolerance)
        return out + self._changed(event, level, tolerance, noise, change, change is relearnt[0])

    def _unchanged(self, event: PassEvent, fields: FloatArray, level: FloatArray,
                   tolerance: float) -> list[PassEvent]:
        """Events completed by an event during which the background did not change, with readings
        `fields` (n, 3) [T] and the field `level` (3,) [T] after its end."""
        remains = np.linalg.norm(level) > MIN_REMAINING * np.linalg.norm(np.nan_to_num(event.peak))
        for k in reversed(range(len(self._open))):
            stay = self._open[k]
            is_opposite = np.linalg.norm(fields + stay.level, axis=1) <= max(
                tolerance, MAX_DIFFERENCE * float(np.linalg.norm(stay.level)))
            if np.mean(is_opposite) > MIN_OPPOSITE:
                self._open.pop(k)
                if remains:
                    self._held = _Held(None, level, event.release_ns)
                else:
                    self._open.append(stay._replace(
                        arrival=replace(event, onset_ns=event.release_ns)))
                return [_until(stay, event.onset_ns, True)]
        if remains:
            self._held = _Held(event, level, event.release_ns)
            return []
        return [event]

    def _changed(self, event: PassEvent, level: FloatArray, tolerance: float, noise: float,
                 change: RelearntBackground, is_first: bool) -> list[PassEvent]:
        """Events completed if the background changed, with the field `level` (3,) [T] before."""
        for k in reversed(range(len(self._open))):
            if np.linalg.norm(self._open[k].level + level) <= tolerance:
                return [_until(self._open.pop(k), event.onset_ns, True)]
        if change.has_departed or np.linalg.norm(level) < MIN_FIELD_STDS * noise:
            return [event]
        before, after = (float(np.linalg.norm(np.nan_to_num(background - self._free_field)))
                         for background in (change.before, change.after))
        if is_first and before - after > MIN_APPROACH * _size(change):
            return [replace(event, onset_ns=self.first_ns, release_ns=event.onset_ns)]
        self._open.append(_Stay(event, level))
        if len(self._open) > MAX_OPEN:
            return [_until(self._open.pop(0), event.release_ns, False)]
        return []

    def flush(self, last_ns: int) -> list[PassEvent]:
        """Return the events of vehicles that have not left by the last reading, as not ended."""
        stays, self._open = self._open, []
        held, self._held = self._held, None
        return [*([held.event] if held is not None and held.event is not None else []),
                *(_until(stay, last_ns, False) for stay in stays)]


def _size(change: RelearntBackground) -> float:
    """Magnitude of a change of the background [T]."""
    return float(np.linalg.norm(np.nan_to_num(change.after - change.before)))


def _until(stay: _Stay, release_ns: int, ended: bool) -> PassEvent:
    """Event of a stay that lasts until `release_ns` [ns]."""
    rest_s = max(release_ns - stay.arrival.release_ns, 0) / NS
    return replace(stay.arrival, release_ns=release_ns, ended=ended,
                   energy=stay.arrival.energy + float(stay.level @ stay.level) * rest_s)
