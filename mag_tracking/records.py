"""The records that flow: frozen, SI units, time as integer nanoseconds.

A missing axis or sensor is NaN. Arrays in a record are not to be changed.
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
    """Of float64."""


@overload
def plain(values: ArrayLike, dtype: type[_Number]) -> NDArray[_Number]:
    """Of the type `dtype`."""


def plain(values: ArrayLike, dtype: type[Any] = float) -> NDArray[Any]:
    """The array itself, or a copy where it is none that compiled code takes."""
    # Nearly always it is one, and asking is a fifth of the cost of `np.require`.
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.flags.carray:
        return values
    return np.require(values, dtype, ['C', 'W'])


@dataclass(frozen=True, slots=True)
class Readings:
    """A batch of magnetometer readings of any sensors, in the order in which they came.

    A single reading is a batch of one.
    """

    names: tuple[str, ...]
    """Names of sensors."""
    sensor: IntArray
    """(n,) which of `names`."""
    stamp_ns: IntArray
    """(n,) int64."""
    field: FloatArray
    """(n, 3) [T], sensor frame; after calibration without the background."""
    covariance: FloatArray | None = None
    """(n, 3, 3) [T^2], sensor frame; a row of NaN, or None for all: unknown."""

    def __post_init__(self) -> None:
        """Compiled code does not look at shapes. Raises ReadingsError."""
        n = len(self.sensor)
        for name, values, shape in (
                ('sensor', self.sensor, (n,)), ('stamp_ns', self.stamp_ns, (n,)),
                ('field', self.field, (n, 3)), ('covariance', self.covariance, (n, 3, 3))):
            if values is not None and np.shape(values) != shape:
                raise ReadingsError(f'{name}: expected shape {shape} for {n} readings; '
                                    f'got {np.shape(values)}')

    def __len__(self) -> int:
        return len(self.sensor)

    def without_covariance(self) -> BoolArray:
        """(n,) whether the covariance of a reading is unknown."""
        if self.covariance is None:
            return np.ones(len(self), dtype=bool)
        missing: BoolArray = np.isnan(self.covariance).reshape(-1, 9)
        unknown: BoolArray = missing[:, 0] if not missing[:, 0].any() else np.all(missing, axis=1)
        return unknown

    def rows(self, index: Mapping[str, int]) -> IntArray:
        """(n,) row of each reading's sensor in `index`, {name: row}; -1: not in it."""
        return np.array([index.get(name, -1) for name in self.names], dtype=np.int64)[self.sensor]

    def sensor_names(self) -> list[str]:
        """The name of each reading's sensor."""
        return [self.names[j] for j in self.sensor.tolist()]

    def part(self, which: BoolArray | IntArray | slice) -> 'Readings':
        """The readings of `which`: (n,) bool, rows in any order, or a slice."""
        C = self.covariance
        return Readings(self.names, self.sensor[which], self.stamp_ns[which], self.field[which],
                        None if C is None else C[which])

    @classmethod
    def joined(cls, parts: Iterable['Readings']) -> 'Readings':
        """One after the other, those of `parts`, [`Readings`]."""
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
        """One reading: (3,) [T], and (3, 3) [T^2] or None."""
        return cls((sensor,), np.zeros(1, dtype=np.int64), np.array([stamp_ns], dtype=np.int64),
                   field[None], None if covariance is None else covariance[None])

    @classmethod
    def by_name(cls, sensors: Sequence[str], stamps: Sequence[int] | IntArray, field: FloatArray,
                covariance: FloatArray | None = None) -> 'Readings':
        """Readings from lists of sensor names and timestamps [ns], and fields (n, 3) [T]."""
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
    """(3,) [m/s^2], sensor frame; at rest it points up."""


@dataclass(frozen=True, slots=True)
class FieldFrame:
    """One look of the whole network."""

    stamp_ns: int
    field: FloatArray
    """(n_sensors, 3) [T], sensor frames, background removed."""
    covariance: FloatArray
    """(n_sensors, 3, 3) [T^2] of `field`; rows of a missing sensor are NaN."""
    n_samples: IntArray
    """(n_sensors,) samples averaged; 0 = missing."""
    time_offset: FloatArray
    """(n_sensors,) [s] mean time of a sensor's samples, from `stamp_ns`; 0 where it is missing."""
    target_present: bool = False
    """The detector's verdict; false before detection."""
    statistic: float = float('nan')
    """Whitened energy, chi-square under noise; NaN before detection."""
    degrees_of_freedom: int = 0


@dataclass(frozen=True, slots=True)
class Detection:
    """The network began (onset) or ceased to see a target."""

    stamp_ns: int
    id: int
    onset: bool
    statistic: float
    degrees_of_freedom: int
    threshold: float
    false_alarm_probability: float
    strongest_sensor: str


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One member of the bank, as published."""

    arrival: str
    weight: float
    position: FloatArray
    """(3,) [m], world."""
    velocity: FloatArray
    """(3,) [m/s], world."""
    covariance: FloatArray
    """(6, 6) of position and velocity."""
    moment: FloatArray
    """(3,) [A m^2], world."""
    kind: str
    """The kind of target that it assumed; empty for a magnet."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses(Sequence[Hypothesis]):
    """Members of a bank as arrays; each is a `Hypothesis`, made when it is asked for.

    There may be hundreds in every frame, and hardly anybody looks at them.
    """

    arrivals: tuple[str, ...]
    weights: FloatArray
    """(n,)"""
    states: FloatArray
    """(n, 6) position and velocity, world."""
    covariances: FloatArray
    """(n, 6, 6)"""
    moments: FloatArray
    """(n, 3)"""
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
    """Best hypothesis of each arrival with the arrival's total weight, heaviest first."""
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
    """Covariances about a pose."""

    covariance: FloatArray
    """(6, 6) of position and velocity, world."""
    orientation_covariance: FloatArray
    """(3, 3) [rad^2], small rotations about the fixed world axes."""
    position_orientation_covariance: FloatArray
    """(3, 3) [m rad]."""


@dataclass(frozen=True, slots=True)
class SmoothedPose:
    """A target at one time, by what came before it and after."""

    stamp_ns: int
    id: int
    """Of the track."""
    position: FloatArray
    """(3,) [m], world."""
    velocity: FloatArray
    """(3,) [m/s], world."""
    covariance: FloatArray
    """(6, 6) of position and velocity, world."""
    orientation: FloatArray
    """(4,) quaternion xyzw, body to world."""
    orientation_covariance: FloatArray
    """(3, 3) [rad^2], small rotations about the fixed world axes."""
    position_orientation_covariance: FloatArray
    """(3, 3) [m rad]."""
    moment: FloatArray
    """(3,) [A m^2], world."""
    moment_covariance: FloatArray
    """(3, 3)."""
    kind: str
    length: float
    """[m] of the row of dipoles that the target is taken for; 0 for a point."""
    length_std: float
    """[m]; 0 for a point."""
    ambiguous: bool
    """Something else was still possible when it was smoothed."""
    complete: bool
    """All of the track was used; else what came within a fixed lag."""


@dataclass(frozen=True, slots=True)
class Track:
    """A target at one time: the best hypothesis and what is known of the others."""

    stamp_ns: int
    id: int
    ended: bool
    position: FloatArray
    """(3,) [m], world."""
    velocity: FloatArray
    """(3,) [m/s], world."""
    covariance: FloatArray
    """(6, 6) of position and velocity, world: about this pose, of all hypotheses at this place.
    That of a vehicle also covers what of its length is not yet seen, and a straight path that
    explains its whole pass and leads elsewhere; those of its `hypotheses` do not."""
    orientation: FloatArray
    """(4,) quaternion xyzw, body to world."""
    orientation_covariance: FloatArray
    """(3, 3) [rad^2], small rotations about the fixed world axes; it and those below are also of
    all hypotheses at this place."""
    position_orientation_covariance: FloatArray
    """(3, 3) [m rad]."""
    moment: FloatArray
    """(3,) [A m^2], world."""
    moment_covariance: FloatArray
    """(3, 3)."""
    existence: float
    weight: float
    """Of the published hypothesis, 0..1."""
    nis: float
    """Normalised innovation squared of the published hypothesis; NaN without a measurement."""
    nis_by_sensor: FloatArray
    """(n_sensors,) its parts, each given the sensors before it; NaN of a missing sensor."""
    degrees_of_freedom: int
    arrival: str
    kind: str
    """Of target, that of the published hypothesis; empty for a magnet."""
    kind_weight: float
    """Of all hypotheses of that kind, 0..1."""
    length: float
    """[m] of the row of dipoles that the target is taken for; 0 for a point."""
    length_std: float
    """[m]; 0 for a point."""
    ambiguous: bool
    unobservable: tuple[bool, ...]
    """(6): x, y, z, and rotation about the body's x, y, z."""
    predicted: FloatArray
    """(n_sensors, 3) [T], sensor frames: the frame's field as the published hypothesis has it,
    without what it takes for errors of its model."""
    mounting: FloatArray
    """(n_sensors, 3) [rad] angles as in `physics.mounting`; (0, 3) where they are not estimated."""
    mounting_covariance: FloatArray
    """(n_sensors, 3, 3) [rad^2], or (0, 3, 3)."""
    hypotheses: Sequence[Hypothesis] = field(default=())
    """Heaviest first; the published one is among them."""
    doubts: tuple[str, ...] = ()
    """Why it is ambiguous: names of `stages.track.doubts`."""
    topic_uncertainty: PoseUncertainty | None = None
    """For messages without a flag. About the pose of an ambiguous track, that of all hypotheses at
    any place; None: no such message is sent (`track.ambiguous_poses`)."""

    @property
    def mounting_std(self) -> FloatArray:
        """(n_sensors, 3) [rad], or (0, 3)."""
        std: FloatArray = np.sqrt(np.einsum('jii->ji', self.mounting_covariance))
        return std
