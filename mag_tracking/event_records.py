"""Event records: single-sensor passes, disturbances, vehicle passages and traffic summaries."""

from dataclasses import dataclass

from mag_tracking.arrays import FloatArray

SIGNATURE_SPAN = 4.0
"""Half the length of a signature, which is centred on the closest point of approach [time
scales]."""


@dataclass(frozen=True, slots=True)
class PassEvent:
    """A pass described by a single sensor, for which the spatial scale is unobservable."""

    sensor: str
    """Name of the sensor."""
    number: int
    """Number of the event of this sensor, from 1."""
    ended: bool
    """True if the target left. False if the readings ended first."""
    onset_ns: int
    """Time of the onset, ns since 1970."""
    release_ns: int
    """Last time at which the target was detected, without the hold time, ns since 1970."""
    peak_ns: int
    """Time of `peak`, ns since 1970."""
    peak: FloatArray
    """Largest field, (3,) T, sensor frame. NaN = missing axis."""
    energy: float
    """Energy of the field from onset to release, summed over all axes, T² s."""
    axes: str
    """Measured axes, such as 'xy'."""
    noise_std: FloatArray
    """Standard deviation of one reading, (3,) T, sensor frame."""
    closest_ns: int
    """Time of the closest point of approach, ns since 1970, for a dipole on a straight line."""
    closest_std: float
    """Standard deviation of `closest_ns`, s. inf if unobservable."""
    time_scale: float
    """Range at the closest point divided by the speed, s. NaN if unobservable."""
    left_to_right: float
    """Probability of motion from left to right, seen from the sensor towards the target. 0.5 if
    unknown, for example without two horizontal axes."""
    signature: FloatArray
    """Field at equal steps from -4 to 4 time scales about the closest point, (33, 3) T, sensor
    frame. NaN where there are no readings."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A change of the field that is better explained by something other than a target."""

    stamp_ns: int
    """Latest known time of the disturbance, ns since 1970."""
    id: int
    """Number of the disturbance, from 1."""
    ended: bool
    """True if the network is quiet again or the frames have ended. False while the disturbance
    continues."""
    begin_ns: int
    """Start time of the disturbance, ns since 1970."""
    largest: float
    """Magnitude of the largest field at any sensor, T."""
    sensors: tuple[str, ...]
    """Names of the affected sensors, the strongest first."""
    uniform: float
    """Probability of one common field across the network, as opposed to an independent field at
    each sensor."""
    track_id: int
    """Number of the latest track that is ambiguous because of the disturbance."""


@dataclass(frozen=True, slots=True)
class VehiclePassage:
    """Passage of a vehicle across a counting line, estimated from the whole track."""

    stamp_ns: int
    """Time at which the middle of the vehicle was on the line, ns since 1970."""
    number: int
    """Number of the passage, from 1, in chronological order over all lines."""
    line: str
    """Name of the counting line."""
    track_id: int
    """Number of the track."""
    forward: bool
    """Whether the vehicle moved in the forward direction of the line."""
    direction_error: float
    """Probability that the direction is wrong, from the rotation of the field at each sensor near
    the path, independently of the track. NaN if the rotation is inconclusive or another vehicle was
    nearby."""
    position: FloatArray
    """Position on the line, (3,) m, world frame."""
    lateral: float
    """Distance from the middle of the line, m. Positive to the left of the forward direction."""
    velocity: FloatArray
    """Velocity, (3,) m/s, world frame."""
    speed: float
    """Horizontal speed, m/s."""
    speed_std: float
    """Standard deviation of `speed`, m/s."""
    heading_std: float
    """Standard deviation of the direction of `velocity`, rad."""
    length: float
    """Length of the row of dipoles that models the vehicle, m. 0 for a point target."""
    length_std: float
    """Standard deviation of `length`, m. 0 for a point target."""
    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    moment_covariance: FloatArray
    """Covariance of `moment`, (3, 3) (A m²)², world frame."""
    vehicle_class: str
    """Most probable class, or `unknown`."""
    class_probabilities: FloatArray
    """Probability of each class, (n_classes,), in the order of `traffic.class_names`."""
    headway: float
    """Time since the previous passage in the same direction, s. NaN for the first passage."""
    ambiguous: bool
    """Whether the passage is ambiguous: `doubts` is not empty."""
    doubts: tuple[str, ...]
    """Reasons why the passage is ambiguous: names from `stages.traffic.stage`."""


@dataclass(frozen=True, slots=True)
class TrafficCount:
    """Number of vehicles of one direction and class in an interval, and their mean speed."""

    forward: bool
    """Whether the vehicles moved in the forward direction of the line."""
    vehicle_class: str
    """Class of the vehicles, or `unknown`."""
    count: int
    """Number of passages."""
    ambiguous: int
    """Number of these passages that are ambiguous."""
    mean_speed: float
    """Mean horizontal speed, m/s."""
    mean_headway: float
    """Mean headway, s. NaN if unknown."""


@dataclass(frozen=True, slots=True)
class TrafficSummary:
    """Traffic across one line in one interval."""

    begin_ns: int
    """Start of the interval, ns since 1970."""
    end_ns: int
    """End of the interval, ns since 1970."""
    line: str
    """Name of the counting line."""
    observed_s: float
    """Duration within the interval that is covered by frames, s."""
    counts: tuple[TrafficCount, ...]
    """Count for each observed direction and class."""
