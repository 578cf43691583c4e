"""The records of what happened: passes described by one sensor, and disturbances."""

from dataclasses import dataclass

from mag_tracking.arrays import FloatArray

SIGNATURE_SPAN = 4.0
"""[time scales] A signature reaches so far to both sides of the closest point."""


@dataclass(frozen=True, slots=True)
class PassEvent:
    """A pass described by one sensor alone, which cannot observe the scale."""

    sensor: str
    number: int
    """Counts the events of this sensor, from 1."""
    ended: bool
    """The target was gone again; else the readings ended before."""
    onset_ns: int
    release_ns: int
    """The last time at which it was loud."""
    peak_ns: int
    peak: FloatArray
    """(3,) [T] largest field, sensor frame; NaN = missing axis."""
    energy: float
    """[T^2 s] from onset to release, over all axes."""
    axes: str
    """Those that were measured, such as 'xy'."""
    noise_std: FloatArray
    """(3,) [T] of one reading."""
    closest_ns: int
    """Time of the closest point, if the target was a dipole on a straight line."""
    closest_std: float
    """[s] of it; inf where the field does not tell."""
    time_scale: float
    """[s] range at the closest point over the speed; NaN where the field does not tell."""
    left_to_right: float
    """Probability that it moved from left to right, seen from the sensor towards the target; 0.5
    without two horizontal axes."""
    signature: FloatArray
    """(33, 3) [T] field, at equal steps from -4 to 4 time scales about the closest point."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A field that something else than a target explains better, from its onset on."""

    stamp_ns: int
    """The latest time that is known of it."""
    id: int
    """Counts the disturbances, from 1."""
    ended: bool
    """The network was quiet again, or the frames ended; else it goes on."""
    begin_ns: int
    largest: float
    """[T] Size of the largest field at a sensor."""
    sensors: tuple[str, ...]
    """Those that felt it, the strongest first."""
    uniform: float
    """Probability that one field over the network made it, and not one at each sensor."""
    track_id: int
    """The latest track that it made ambiguous."""
