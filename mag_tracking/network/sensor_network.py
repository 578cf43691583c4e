"""The sensor network: position, orientation, calibration and topic of each sensor."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import NetworkError
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.units import NS

TOPIC_NAME_PATTERN = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
"""Pattern of a valid relative or absolute topic name."""
_NAMESPACE_PATTERN = re.compile(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+')
MAX_COMPACT_EXTENT = 2.0
"""Maximum horizontal extent of a compact network [m], half of the length of a car."""
MAX_SENSORS = 1000
"""Maximum number of sensors of a network."""
MAX_EXTENT = 1e5
"""Maximum distance between two sensors of a network [m]. Over larger distances, the surface of the
Earth is no plane; positions that are farther apart have another unit than metres."""
MIN_BOARD_SENSORS, MAX_BOARD_EXTENT = 3, 1.0
"""Minimum number of sensors of a board, and its maximum extent [m]. A board tracks a magnet."""
MIN_DELAY_BASELINE = 0.1
"""Minimum horizontal distance between two sensors for the estimation of a delay [m]."""
_OPTIONAL = ('noise_std', 'background', 'orientation_std', 'offset', 'correction', 'imu_topics',
             'calibrated')
"""Attributes of a network that a sensor may lack."""


def absolute(topic: str, namespace: str = '/') -> str:
    """Resolve a topic name in a namespace; an absolute name is returned unchanged."""
    return topic if topic.startswith('/') else f'{namespace.rstrip("/")}/{topic}'


def namespaces_of(topics: Iterable[str], recorded: Collection[str]) -> list[str]:
    """Namespaces, in alphabetical order, in which at least one relative topic was recorded.

    Absolute `topics` are ignored. If the root namespace '/' is among them, it is the only one.
    """
    namespaces = {name.removesuffix(f'/{topic}') or '/'
                  for topic in topics if not topic.startswith('/')
                  for name in recorded if name.endswith(f'/{topic}')}
    return ['/'] if '/' in namespaces else sorted(namespaces)


def checked_namespace(namespace: str) -> str:
    """Return a valid absolute namespace unchanged; raises NetworkError for any other."""
    if not _NAMESPACE_PATTERN.fullmatch(namespace):
        raise NetworkError(f'{namespace!r} is not a valid namespace: it must begin with / and '
                           'contain only letters, digits and _; no part may begin with a digit')
    return namespace


def _duplicates(values: Sequence[str]) -> list[str]:
    """Values that occur more than once, sorted."""
    return sorted(value for value, n in Counter(values).items() if n > 1)


@dataclass(frozen=True)
class CalibrationRecord:
    """Record of a sensor calibration: date (ISO 8601), method, and orientation entered by hand."""

    date: str
    by: str
    """Source of the orientation, such as the name of the method."""
    clock_offset_std: float
    """Standard deviation of the clock offset, s. NaN if the offset was not measured."""
    nominal: tuple[float, ...] | None = None
    """Orientation entered by hand, (4,) quaternion xyzw, sensor to world frame. None if unknown.
    Each survey uses it as its prior: the result of a previous survey is no independent evidence."""
    nominal_std: tuple[float, ...] | None = None
    """Standard deviation of `nominal` about the world axes, (3,) rad. None if unknown."""


@dataclass(frozen=True)
class SensorNetwork:
    """Network of stationary three-axis magnetometers. All arrays are in the order of `names`."""

    names: tuple[str, ...]
    """Name of each sensor."""
    positions: FloatArray
    """Position of each sensor, (n, 3) m, world frame."""
    R_ws: FloatArray
    """Rotation of each sensor, (n, 3, 3), sensor to world frame."""
    topics: tuple[str, ...]
    """Topic of each sensor. Names without a leading / are relative to a namespace."""
    frame: str = 'map'
    """Name of the world frame."""
    earth_field: FloatArray | None = None
    """Flux density of the Earth, (3,) T, world frame. None if unknown."""
    noise_std: tuple[FloatArray | None, ...] = ()
    """Noise standard deviation of the readings of each sensor, (3,) T, sensor frame. None if it
    must be estimated."""
    background: tuple[FloatArray | None, ...] = ()
    """Background of each sensor, (3,) T, sensor frame. None if it must be estimated."""
    orientation_std: tuple[FloatArray | None, ...] = ()
    """Standard deviation of the mounting error of each sensor about the world axes, (3,) rad. None
    if unknown."""
    # The value is None only until `__post_init__` has run.
    clock_offset: FloatArray = cast(FloatArray, None)
    """Offset of the clock of each sensor, (n,) s, positive if the clock is ahead. The offset is
    subtracted from the timestamps. None is replaced by zeros."""
    offset: tuple[FloatArray | None, ...] = ()
    """Hard iron offset of each sensor, (3,) T, sensor frame, from a tumbling calibration. None if
    the sensor has no such calibration."""
    correction: tuple[FloatArray | None, ...] = ()
    """Correction matrix of each sensor, (3, 3): B = correction @ (reading - offset). None if the
    sensor has no tumbling calibration."""
    imu_topics: tuple[str | None, ...] = ()
    """Topic of each sensor's accelerometer. None if the sensor has no accelerometer."""
    calibrated: tuple[CalibrationRecord | None, ...] = ()
    """Last calibration of each sensor. None if the sensor was never calibrated."""
    namespace: str | None = None
    """Namespace of the relative topics in a recording. If None, a reader uses the namespace that
    contains these topics."""

    def __post_init__(self) -> None:
        n = len(self.names)
        if n == 0:
            raise NetworkError('a network requires at least one sensor')
        if n > MAX_SENSORS:
            raise NetworkError(f'the network has {n} sensors; the maximum is {MAX_SENSORS}: divide '
                               'it into several networks')
        if duplicates := _duplicates(self.names):
            raise NetworkError(f'duplicate sensor name {duplicates[0]}; names must be unique')
        if duplicates := _duplicates([absolute(t) for t in self.topics]):
            raise NetworkError(f'topic {duplicates[0]} is assigned to more than one sensor')
        if self.positions.shape != (n, 3) or self.R_ws.shape != (n, 3, 3):
            raise NetworkError(f'{n} sensors require positions of shape ({n}, 3) and orientations '
                               f'of shape ({n}, 3, 3)')
        self._check_extent()
        names_by_position: dict[tuple[float, ...], str] = {}
        for name, position in zip(self.names, map(tuple, self.positions.tolist()), strict=True):
            other = names_by_position.setdefault(position, name)
            if other != name:
                raise NetworkError(f'sensors {other} and {name} are both at {list(position)} m')
        for name in _OPTIONAL:
            if not getattr(self, name):
                object.__setattr__(self, name, (None,) * n)
        if self.clock_offset is None:
            object.__setattr__(self, 'clock_offset', np.zeros(n))

    def _check_extent(self) -> None:
        """Raise NetworkError if two sensors are too far apart."""
        from_centre = np.linalg.norm(self.positions - np.median(self.positions, axis=0), axis=1)
        far = int(np.argmax(from_centre))
        distance = np.linalg.norm(self.positions - self.positions[far], axis=1)
        other = int(np.argmax(distance))
        if distance[other] > MAX_EXTENT:
            pair = ' and '.join(self.names[j] for j in sorted((far, other)))
            raise NetworkError(f'sensors {pair} are {distance[other] / 1e3:,.0f} km apart; the '
                               f'maximum is {MAX_EXTENT / 1e3:g} km: are the positions in metres?')

    def __len__(self) -> int:
        return len(self.names)

    @property
    def absolute_topics(self) -> tuple[str, ...]:
        """Absolute topic of each sensor, resolved in `namespace`, or in / if it is None."""
        return tuple(absolute(topic, self.namespace or '/') for topic in self.topics)

    @property
    def R_sw(self) -> FloatArray:
        """Rotation of each sensor, (n, 3, 3), world to sensor frame."""
        return np.ascontiguousarray(np.swapaxes(self.R_ws, 1, 2))

    @property
    def clock_offset_ns(self) -> IntArray:
        """`clock_offset` rounded to nanoseconds, (n,) ns."""
        return np.asarray(np.rint(np.multiply(self.clock_offset, NS)), dtype=np.int64)

    @property
    def centre(self) -> FloatArray:
        """Mean of the sensor positions, (3,) m, world frame."""
        return np.asarray(self.positions.mean(axis=0))

    @property
    def is_compact(self) -> bool:
        """Whether the horizontal extent of the network is less than `MAX_COMPACT_EXTENT`.

        In a compact network, the errors of a vehicle model are almost equal at all sensors. Such a
        network determines range and moment hardly better than a single sensor.
        """
        return bool(np.hypot(*np.ptp(self.positions[:, :2], axis=0)) < MAX_COMPACT_EXTENT)

    @property
    def is_board(self) -> bool:
        """Whether the sensors are so close together that they track a magnet, not a vehicle."""
        extent = np.linalg.norm(np.ptp(self.positions, axis=0))
        return len(self) >= MIN_BOARD_SENSORS and bool(extent < MAX_BOARD_EXTENT)

    def part(self, rows: IntArray) -> 'SensorNetwork':
        """Create a network of selected sensors.

        Parameters
        ----------
        rows : (k,) int array
            Indices of the selected sensors.

        Returns
        -------
        SensorNetwork
        """
        per_sensor: dict[str, Any] = {name: tuple(getattr(self, name)[j] for j in rows)
                                      for name in ('names', 'topics', *_OPTIONAL)}
        return replace(self, positions=self.positions[rows], R_ws=self.R_ws[rows],
                       clock_offset=self.clock_offset[rows], **per_sensor)

    def with_nominal_orientations(self) -> 'SensorNetwork':
        """Copy the network with the orientations and uncertainties that were entered by hand.

        Returns
        -------
        SensorNetwork
            Sensors without a record of such an orientation are unchanged.
        """
        R_ws, std = self.R_ws.copy(), list(self.orientation_std)
        for j, record in enumerate(self.calibrated):
            if record is not None and record.nominal is not None:
                R_ws[j] = rotation_from_quaternion(record.nominal)
                std[j] = None if record.nominal_std is None else np.array(record.nominal_std)
        return replace(self, R_ws=R_ws, orientation_std=tuple(std))

    def calibration_record(self, j: int, date: str, by: str,
                           clock_offset_std: float = float('nan')) -> CalibrationRecord:
        """Create the record of a new calibration of a sensor.

        Parameters
        ----------
        j : int
            Index of the sensor.
        date : str
            Date in ISO 8601 format.
        by : str
            Source of the orientation, such as the name of the method.
        clock_offset_std : float, s, optional
            NaN if the offset was not measured.

        Returns
        -------
        CalibrationRecord
            Record that includes the orientation that was entered by hand. If no previous record
            contains this orientation, the current orientation is recorded.
        """
        previous, std = self.calibrated[j], self.orientation_std[j]
        if previous is not None and previous.nominal is not None:
            return replace(previous, date=date, by=by, clock_offset_std=clock_offset_std)
        return CalibrationRecord(date, by, clock_offset_std,
                                 tuple(quaternion_from_rotation(self.R_ws[j]).tolist()),
                                 None if std is None else tuple(std.tolist()))

    def index(self, name: str) -> int:
        """Index of a sensor.

        Parameters
        ----------
        name : str

        Returns
        -------
        int

        Raises
        ------
        NetworkError
            If the network has no sensor of this name.
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise NetworkError(f'unknown sensor {name}; the network has '
                               f'{", ".join(self.names)}') from None
