"""Event records: single-sensor passes, disturbances, vehicle passages and traffic summaries.

Times are in nanoseconds since 1970.
"""

from dataclasses import dataclass

from mag_tracking.arrays import FloatArray

SIGNATURE_SPAN = 4.0
"""Half the duration of a signature about the closest point, in units of `PassEvent.time_scale`."""


@dataclass(frozen=True, slots=True)
class PassEvent:
    """Pass of a target, estimated from the readings of a single sensor.

    The record contains no lengths, because a single sensor does not observe the spatial scale.
    """

    sensor: str
    number: int
    """Consecutive number of the event, counted from 1 for each sensor."""
    ended: bool
    """True if the target has left the range of the sensor. False if the readings ended earlier."""
    onset_ns: int
    release_ns: int
    """End of the detection: the release minus the hold time, or the last reading if not `ended`."""
    peak_ns: int
    peak: FloatArray
    """Reading with the largest field magnitude, (3,) T, sensor frame. NaN for a missing axis."""
    energy: float
    """Energy of the field from onset to release, summed over all axes, T² s."""
    axes: str
    """Measured axes, such as 'xy'."""
    noise_std: FloatArray
    """Median noise standard deviation of the readings, (3,) T. NaN for a missing axis."""
    closest_ns: int
    """Time of the closest point of approach of a dipole on a straight line; if it is unobservable,
    that of the largest field."""
    closest_std: float
    """Standard deviation of `closest_ns`, s. inf if unobservable."""
    time_scale: float
    """Range at the closest point divided by the speed, s. NaN if unobservable."""
    left_to_right: float
    """Probability that the target moved from left to right, as seen from the sensor. 0.5 if
    unobservable, for example because only one horizontal axis is measured."""
    signature: FloatArray
    """Field at 33 equidistant times from -4 to 4 time scales about the closest point, (33, 3) T,
    sensor frame. NaN outside the readings, or if `time_scale` is NaN."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A change of the field that no target explains, although it started a track."""

    stamp_ns: int
    """Time at which the disturbance was identified or, if `ended`, at which it ended."""
    id: int
    ended: bool
    """True if the network is quiet again or the frames have ended; False while it continues."""
    begin_ns: int
    largest: float
    """Largest magnitude of the field at any sensor, T."""
    sensors: tuple[str, ...]
    """Names of the affected sensors, in descending order of the field magnitude."""
    uniform: float
    """Probability of one common field across the network, as opposed to one at each sensor."""
    track_id: int
    """Number of the latest track that the disturbance has made ambiguous."""


@dataclass(frozen=True, slots=True)
class VehiclePassage:
    """Passage of a vehicle across a counting line, estimated from the whole track."""

    stamp_ns: int
    """Time at which the middle of the vehicle was on the line, ns since 1970."""
    number: int
    """Number of the passage, from 1, in chronological order over all lines."""
    line: str
    track_id: int
    forward: bool
    """Whether the vehicle moved in the forward direction of the line."""
    direction_error: float
    """Probability that the direction is wrong, from the rotation of the field at each sensor near
    the path, independently of the track. NaN if inconclusive or another vehicle was nearby."""
    position: FloatArray
    """Position of the crossing, (3,) m, world frame."""
    lateral: float
    """Distance of `position` from the middle of the line, m. Positive to the left when forward."""
    velocity: FloatArray
    """Velocity, (3,) m/s, world frame."""
    speed: float
    """Horizontal speed, m/s."""
    speed_std: float
    heading_std: float
    """Standard deviation of the heading, rad."""
    length: float
    """Length of the row of dipoles that models the vehicle, m. 0 for a point target."""
    length_std: float
    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    moment_covariance: FloatArray
    """Covariance of `moment`, (3, 3) (A m²)², world frame."""
    vehicle_class: str
    """Most probable class. `unknown` if the vehicle is improbable under every class."""
    class_probabilities: FloatArray
    """Probability of each class, (n_classes,), in the order of `traffic.classes.names`."""
    headway: float
    """Time since the previous passage across this line in this direction, s. NaN for the first
    passage, or if the passages are not in chronological order."""
    ambiguous: bool
    doubts: tuple[str, ...]
    """Reasons why the passage is ambiguous: names from `stages.traffic.stage`."""


@dataclass(frozen=True, slots=True)
class TrafficCount:
    """Count, mean speed and mean headway for one direction and one class in an interval."""

    forward: bool
    """Whether the vehicles moved in the forward direction of the line."""
    vehicle_class: str
    """Class of the vehicles, or `unknown`."""
    count: int
    ambiguous: int
    """Number of these passages that are ambiguous."""
    mean_speed: float
    """Mean horizontal speed, m/s."""
    mean_headway: float
    """Mean headway, s. NaN if no headway is known."""


@dataclass(frozen=True, slots=True)
class TrafficSummary:
    """Traffic across one line in one interval."""

    begin_ns: int
    end_ns: int
    line: str
    observed_s: float
    """Duration within the interval that is covered by frames, s."""
    counts: tuple[TrafficCount, ...]
    """Count for each observed direction and class."""
