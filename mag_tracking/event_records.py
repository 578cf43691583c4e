"""Event records: passes described by one sensor, disturbances, vehicles that crossed a line."""

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


@dataclass(frozen=True, slots=True)
class VehiclePassage:
    """A vehicle that crossed a counting line, from its whole track."""

    stamp_ns: int
    """When its middle was on the line."""
    number: int
    """Counts the passages of all lines, from 1, in order of time."""
    line: str
    track_id: int
    forward: bool
    """Whether it moved in the forward direction of the line."""
    direction_error: float
    """Probability that the direction is wrong, by the rotation of the field at each sensor beside
    its path and not by the track; NaN where that tells nothing or another vehicle was near."""
    position: FloatArray
    """(3,) [m] on the line, world."""
    lateral: float
    """[m] to the left of the line's middle, seen in its forward direction."""
    velocity: FloatArray
    """(3,) [m/s], world."""
    speed: float
    """[m/s], horizontal."""
    speed_std: float
    heading_std: float
    """[rad] of the direction of `velocity`."""
    length: float
    """[m] of the row of dipoles that it is taken for; 0 for a point."""
    length_std: float
    """[m]; 0 for a point."""
    moment: FloatArray
    """(3,) [A m^2], world."""
    moment_covariance: FloatArray
    """(3, 3)."""
    vehicle_class: str
    """The most probable class, or `unknown`."""
    class_probabilities: FloatArray
    """(n_classes,) in the order of `traffic.class_names`."""
    headway: float
    """[s] since the passage before in the same direction; NaN of the first one."""
    ambiguous: bool
    """Whether the track is doubtful at the line."""
    doubts: tuple[str, ...]
    """Why: names of `stages.traffic.stage`."""


@dataclass(frozen=True, slots=True)
class TrafficCount:
    """Vehicles of one direction and class in an interval."""

    forward: bool
    vehicle_class: str
    count: int
    ambiguous: int
    """Number of ambiguous passages among them."""
    mean_speed: float
    """[m/s]"""
    mean_headway: float
    """[s]; NaN where none is known."""


@dataclass(frozen=True, slots=True)
class TrafficSummary:
    """Traffic across one line in one interval."""

    begin_ns: int
    end_ns: int
    line: str
    observed_s: float
    """[s] of the interval that are covered by frames."""
    counts: tuple[TrafficCount, ...]
    """One for each direction and class that was observed."""
