"""Immutable records passed between stages: SI units, time as integer nanoseconds since 1970.

The values of a missing axis or sensor are NaN. The arrays of a record must not be modified.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.errors import ReadingsError

_Number = TypeVar('_Number', bound=np.generic)


@overload
def plain(values: ArrayLike) -> FloatArray:
    """Return `values` as a float64 array."""


@overload
def plain(values: ArrayLike, dtype: type[_Number]) -> NDArray[_Number]:
    """Return `values` as an array of type `dtype`."""


def plain(values: ArrayLike, dtype: type[Any] = float) -> NDArray[Any]:
    """C-contiguous, writable array that compiled code accepts: `values` itself or a copy."""
    # Most arrays meet the requirements, and this check takes a fifth of the time of `np.require`.
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.flags.carray:
        return values
    return np.require(values, dtype, ['C', 'W'])


@dataclass(frozen=True, slots=True)
class Readings:
    """A batch of magnetometer readings from any sensors, in order of arrival.

    A single reading is a batch of one. Raises ReadingsError if the shapes do not match.
    """

    names: tuple[str, ...]
    """Names of the sensors."""
    sensor: IntArray
    """Index of the sensor of each reading in `names`, (n,)."""
    stamp_ns: IntArray
    """Time of each measurement, (n,) int64 ns since 1970."""
    field: FloatArray
    """Flux density, (n, 3) T, sensor frame. NaN where an axis is missing. Calibrated readings
    exclude the background."""
    covariance: FloatArray | None = None
    """Noise covariance, (n, 3, 3) T², sensor frame. An unknown covariance is a matrix of NaN. None
    means that all covariances are unknown."""

    def __post_init__(self) -> None:
        """Check the shapes of the arrays, because compiled code does not check them."""
        n = len(self.sensor)
        for name, values, shape in (
                ('sensor', self.sensor, (n,)), ('stamp_ns', self.stamp_ns, (n,)),
                ('field', self.field, (n, 3)), ('covariance', self.covariance, (n, 3, 3))):
            if values is not None and np.shape(values) != shape:
                raise ReadingsError(f'{name}: expected shape {shape} for {n} readings; '
                                    f'got {np.shape(values)}')

    def __len__(self) -> int:
        return len(self.sensor)

    def has_unknown_covariance(self) -> BoolArray:
        """Whether the covariance of each reading is unknown.

        Returns
        -------
        (n,) bool array
        """
        if self.covariance is None:
            return np.ones(len(self), dtype=bool)
        missing: BoolArray = np.isnan(self.covariance).reshape(-1, 9)
        unknown: BoolArray = missing[:, 0] if not missing[:, 0].any() else np.all(missing, axis=1)
        return unknown

    def rows(self, index: Mapping[str, int]) -> IntArray:
        """Look up the sensor index of each reading.

        Parameters
        ----------
        index : mapping of str to int
            Index of each sensor, by name.

        Returns
        -------
        (n,) int array
            -1 for a sensor that is not in `index`.
        """
        return np.array([index.get(name, -1) for name in self.names], dtype=np.int64)[self.sensor]

    def sensor_names(self) -> list[str]:
        """Name of the sensor of each reading.

        Returns
        -------
        list of str, length n
        """
        return [self.names[j] for j in self.sensor.tolist()]

    def part(self, which: BoolArray | IntArray | slice) -> 'Readings':
        """Select readings.

        Parameters
        ----------
        which : (n,) bool array, (k,) int array, or slice
            Selected readings: a mask, indices in any order, or a range.

        Returns
        -------
        Readings
        """
        C = self.covariance
        return Readings(self.names, self.sensor[which], self.stamp_ns[which], self.field[which],
                        None if C is None else C[which])

    @classmethod
    def joined(cls, parts: Iterable['Readings']) -> 'Readings':
        """Concatenate batches.

        Parameters
        ----------
        parts : iterable of Readings

        Returns
        -------
        Readings
            All readings, in the order of `parts`.
        """
        parts = [p for p in parts if len(p)]
        if len(parts) <= 1:
            return parts[0] if parts else cls.by_name([], [], np.empty((0, 3)))
        names = tuple(dict.fromkeys(name for p in parts for name in p.names))
        rows = {name: j for j, name in enumerate(names)}
        covariance = None
        if any(p.covariance is not None for p in parts):
            covariance = np.concatenate([np.full((len(p), 3, 3), np.nan) if p.covariance is None
                                         else p.covariance for p in parts])
        return cls(names, np.concatenate([p.rows(rows) for p in parts]),
                   np.concatenate([p.stamp_ns for p in parts]),
                   np.concatenate([p.field for p in parts]), covariance)

    @classmethod
    def single(cls, sensor: str, stamp_ns: int, field: FloatArray,
               covariance: FloatArray | None = None) -> 'Readings':
        """Create a batch of one reading.

        Parameters
        ----------
        sensor : str
            Name of the sensor.
        stamp_ns : int, ns
        field : (3,) array, T, sensor frame
        covariance : (3, 3) array, T², sensor frame, optional

        Returns
        -------
        Readings
        """
        return cls((sensor,), np.zeros(1, dtype=np.int64), np.array([stamp_ns], dtype=np.int64),
                   field[None], None if covariance is None else covariance[None])

    @classmethod
    def by_name(cls, sensors: Sequence[str], stamps: Sequence[int] | IntArray, field: FloatArray,
                covariance: FloatArray | None = None) -> 'Readings':
        """Create a batch from one sensor name per reading.

        Parameters
        ----------
        sensors : sequence of str, length n
            Name of the sensor of each reading.
        stamps : (n,) sequence of int, ns
        field : (n, 3) array, T, sensor frame
        covariance : (n, 3, 3) array, T², sensor frame, optional

        Returns
        -------
        Readings
        """
        names = tuple(dict.fromkeys(sensors))
        rows = {name: j for j, name in enumerate(names)}
        return cls(names, np.array([rows[s] for s in sensors], dtype=np.int64),
                   np.array(stamps, dtype=np.int64), field, covariance)


@dataclass(frozen=True, slots=True)
class AccelerationSample:
    """One reading of a sensor's accelerometer."""

    stamp_ns: int
    sensor: str
    acceleration: FloatArray
    """Specific force, (3,) m/s², sensor frame. Points up at rest."""


@dataclass(frozen=True, slots=True)
class FieldFrame:
    """The samples of all sensors within one period, averaged per sensor."""

    stamp_ns: int
    """Mean time of the samples, ns since 1970."""
    field: FloatArray
    """Mean flux density without background, (n_sensors, 3) T, sensor frames. NaN if missing."""
    covariance: FloatArray
    """Covariance of `field`, (n_sensors, 3, 3) T², sensor frames. NaN for a missing sensor."""
    n_samples: IntArray
    """Number of averaged samples per sensor, (n_sensors,). 0 for a missing sensor."""
    time_offset: FloatArray
    """Mean time of each sensor's samples relative to `stamp_ns`, (n_sensors,) s. 0 if missing."""
    target_present: bool = False
    """Whether a target is detected, including the hold time. False before the detection stage."""
    statistic: float = float('nan')
    """Whitened energy of the frame, chi-square distributed under noise. NaN before detection."""
    degrees_of_freedom: int = 0
    """Degrees of freedom of `statistic`, the number of measured axes. 0 before detection."""


@dataclass(frozen=True, slots=True)
class Detection:
    """Onset or release of a detection by the network."""

    stamp_ns: int
    id: int
    """Number of the detection. Onset and release have the same number."""
    onset: bool
    """True for an onset, false for a release."""
    statistic: float
    """Whitened energy of the frame, chi-square distributed under noise."""
    degrees_of_freedom: int
    threshold: float
    """Threshold of `statistic` for an onset. NaN if no axis was measured."""
    false_alarm_probability: float
    """Probability that noise alone exceeds `threshold` in a single frame."""
    strongest_sensor: str
    """Sensor with the largest whitened energy per axis. Empty if no axis was measured."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One hypothesis of the filter bank of a track, as published."""

    arrival: str
    """Name of the assumed arrival direction. Empty for a magnet."""
    weight: float
    """Probability within the bank, 0 to 1."""
    position: FloatArray
    """Position, (3,) m, world frame."""
    velocity: FloatArray
    """Velocity, (3,) m/s, world frame."""
    covariance: FloatArray
    """Covariance of [position, velocity], (6, 6) m and m/s, world frame."""
    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    kind: str
    """Assumed kind of vehicle. Empty for a magnet."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses(Sequence[Hypothesis]):
    """Sequence of the hypotheses of a bank, stored as arrays.

    A track may have hundreds of hypotheses in each frame, so a `Hypothesis` is created only on
    access. The elements of the arrays are its attributes.
    """

    arrivals: tuple[str, ...]
    weights: FloatArray
    """(n,)."""
    states: FloatArray
    """[Position, velocity], (n, 6) m and m/s, world frame."""
    covariances: FloatArray
    """(n, 6, 6) m and m/s, world frame."""
    moments: FloatArray
    """(n, 3) A m², world frame."""
    kinds: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.weights)

    @overload
    def __getitem__(self, i: int) -> Hypothesis: ...

    @overload
    def __getitem__(self, i: slice) -> tuple[Hypothesis, ...]: ...

    def __getitem__(self, i: int | slice) -> Hypothesis | tuple[Hypothesis, ...]:
        if isinstance(i, slice):
            return tuple(self[k] for k in range(*i.indices(len(self))))
        return Hypothesis(self.arrivals[i], float(self.weights[i]), self.states[i, :3],
                          self.states[i, 3:], self.covariances[i], self.moments[i], self.kinds[i])


def best_of_arrivals(members: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Copies of the most probable hypothesis of each arrival direction, with the total weight of
    the direction, in descending order."""
    if isinstance(members, Hypotheses):
        arrivals, weights = members.arrivals, members.weights.tolist()
    else:
        arrivals, weights = tuple(h.arrival for h in members), [h.weight for h in members]
    best, total = dict[str, int](), dict[str, float]()
    for k, (name, weight) in enumerate(zip(arrivals, weights, strict=True)):
        total[name] = total.get(name, 0.0) + weight
        if name not in best or weight > weights[best[name]]:
            best[name] = k
    return sorted((replace(members[k], weight=total[name]) for name, k in best.items()),
                  key=lambda h: -h.weight)


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    """Covariances of position, velocity and orientation about a pose, as in `Pose`."""

    covariance: FloatArray
    orientation_covariance: FloatArray
    position_orientation_covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a target at one time."""

    stamp_ns: int
    id: int
    """Number of the track."""
    position: FloatArray
    """(3,) m, world frame."""
    velocity: FloatArray
    """(3,) m/s, world frame."""
    covariance: FloatArray
    """Covariance of [position, velocity] about this pose, (6, 6) m and m/s, world frame."""
    orientation: FloatArray
    """(4,) quaternion xyzw, body to world frame."""
    orientation_covariance: FloatArray
    """Covariance of small rotations about the fixed world axes, (3, 3) rad²."""
    position_orientation_covariance: FloatArray
    """Cross-covariance of position and orientation, (3, 3) m rad, world frame."""
    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    moment_covariance: FloatArray
    """(3, 3) (A m²)², world frame."""
    kind: str
    """Kind of vehicle. Empty for a magnet."""
    length: float
    """Length of the row of dipoles that models the target, m. 0 for a point target."""
    length_std: float
    ambiguous: bool
    """Whether other hypotheses were still possible, or the pose is doubtful."""


@dataclass(frozen=True, slots=True)
class SmoothedPose(Pose):
    """Pose of a target, smoothed with the measurements before and after it."""

    complete: bool
    """True if the whole track was used, false for fixed-lag smoothing."""


@dataclass(frozen=True, slots=True)
class Track(Pose):
    """State of a track in one frame: the published hypothesis, and a summary of all hypotheses.

    The covariances cover all hypotheses near the position. For a vehicle, `covariance` also covers
    the error of the middle due to the part of the vehicle that no sensor has observed yet, and an
    alternative straight path that explains the whole pass. The covariances in `hypotheses` do not
    include these two contributions.
    """

    ended: bool
    existence: float
    """Probability of a target, as opposed to noise alone."""
    weight: float
    """Probability of the published hypothesis within the bank, 0 to 1."""
    nis: float
    """Normalised innovation squared of the published hypothesis. NaN without a measurement."""
    nis_by_sensor: FloatArray
    """Contribution of each sensor to `nis`, conditional on the preceding sensors, (n_sensors,). NaN
    for a missing sensor."""
    degrees_of_freedom: int
    """Degrees of freedom of `nis`: the number of measured axes."""
    arrival: str
    """Arrival direction of the published hypothesis. Empty for a magnet."""
    kind_weight: float
    """Total weight of all hypotheses of the same kind, 0 to 1."""
    unobservable: tuple[bool, ...]
    """Whether x, y, z, and the rotations about the body's x, y and z axes are unobservable, (6,).
    An unobservable rotation has variance π² and is not an estimate."""
    predicted: FloatArray
    """Field that the published hypothesis predicts, without the estimated model errors,
    (n_sensors, 3) T, sensor frames."""
    mounting: FloatArray
    """Estimated mounting error of each sensor, (n_sensors, 3) rad: small angles as in
    `physics.dipole.rotated_fields`. (0, 3) if not estimated."""
    mounting_covariance: FloatArray
    """Covariance of `mounting`, (n_sensors, 3, 3) rad². (0, 3, 3) if not estimated."""
    hypotheses: Sequence[Hypothesis] = field(default=())
    """All hypotheses, including the published one, in descending order of weight."""
    doubts: tuple[str, ...] = ()
    """Reasons why the pose is ambiguous: names from `stages.track.doubts`."""
    topic_uncertainty: PoseUncertainty | None = None
    """Uncertainty for messages without an ambiguity flag. For an ambiguous track, it covers all
    hypotheses, including distant ones. None if such messages are withheld (see
    `track.ambiguous_poses`)."""

    @property
    def mounting_std(self) -> FloatArray:
        """Standard deviation of `mounting`, (n_sensors, 3) or (0, 3) rad."""
        std: FloatArray = np.sqrt(np.einsum('jii->ji', self.mounting_covariance))
        return std
