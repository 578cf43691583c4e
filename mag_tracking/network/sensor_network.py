"""The sensor network: position, orientation and calibration of each sensor."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import NetworkError
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.network.topics import absolute
from mag_tracking.units import NS

MAX_COMPACT_EXTENT = 2.0
"""Maximum horizontal extent of a compact network [m]: half of the length of a car."""
MIN_DELAY_BASELINE = 0.1
"""Minimum horizontal distance of two sensors for an observable delay between them [m]."""


@dataclass(frozen=True)
class CalibrationRecord:
    """When and how a sensor was calibrated."""

    date: str
    """Date in ISO 8601 format."""
    by: str
    """Source of the orientation, in words."""
    clock_offset_std: float
    """Standard deviation of the clock offset, s. NaN if the offset was not measured."""
    stated: tuple[float, ...] | None = None
    """Orientation as stated by hand, (4,) quaternion xyzw, sensor to world frame. None if not
    recorded. A later survey starts from it, because the result of an earlier survey is not
    independent evidence."""
    stated_std: tuple[float, ...] | None = None
    """Standard deviation of `stated` about the world axes, (3,) rad. None if unknown."""


@dataclass(frozen=True)
class SensorNetwork:
    """Stationary three-axis magnetometers. All arrays are in the order of `names`."""

    names: tuple[str, ...]
    """Name of each sensor."""
    positions: FloatArray
    """Position of each sensor, (n, 3) m, world frame."""
    R_ws: FloatArray
    """Rotation of each sensor, (n, 3, 3), sensor to world frame."""
    topics: tuple[str, ...]
    """Topic of each sensor. Names that do not begin with / are relative to a namespace."""
    frame: str = 'map'
    """Name of the world frame."""
    earth_field: FloatArray | None = None
    """Flux density of the Earth, (3,) T, world frame. None = unknown."""
    noise_std: tuple[FloatArray | None, ...] = ()
    """Standard deviation of one reading per sensor, (3,) T, sensor frame. None = to be
    estimated."""
    background: tuple[FloatArray | None, ...] = ()
    """Background per sensor, (3,) T, sensor frame. None = to be learnt."""
    orientation_std: tuple[FloatArray | None, ...] = ()
    """Standard deviation of the mounting error about the world axes per sensor, (3,) rad. None =
    unknown."""
    # None only until `__post_init__`.
    clock_offset: FloatArray = cast(FloatArray, None)
    """Offset of each sensor's clock, (n,) s, positive if it is ahead. It is subtracted from the
    timestamps. None = zeros."""
    offset: tuple[FloatArray | None, ...] = ()
    """Hard iron of each sensor itself, (3,) T, sensor frame, from a tumbling calibration."""
    correction: tuple[FloatArray | None, ...] = ()
    """Correction matrix per sensor, (3, 3): B = correction @ (reading - offset)."""
    imu_topics: tuple[str | None, ...] = ()
    """Topic of each sensor's accelerometer. None = no accelerometer."""
    calibrated: tuple[CalibrationRecord | None, ...] = ()
    """Calibration record per sensor. None = never calibrated."""
    namespace: str | None = None
    """Namespace of the relative topics in a recording. None = the namespace in which they are
    found."""

    def __post_init__(self) -> None:
        n = len(self.names)
        if n == 0:
            raise NetworkError('a network needs at least one sensor')
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise NetworkError(f'duplicate sensor name {twice[0]}')
        names = [absolute(t) for t in self.topics]
        shared = sorted({t for t in names if names.count(t) > 1})
        if shared:
            raise NetworkError(f'topic {shared[0]} is assigned to two sensors')
        if self.positions.shape != (n, 3) or self.R_ws.shape != (n, 3, 3):
            raise NetworkError(f'{n} sensors require positions of shape ({n}, 3) and orientations '
                               f'of shape ({n}, 3, 3)')
        places: dict[tuple[float, ...], str] = {}
        for name, place in zip(self.names, map(tuple, self.positions.tolist()), strict=True):
            other = places.setdefault(place, name)
            if other != name:
                raise NetworkError(f'sensors {other} and {name} are both at {list(place)}')
        for name in ('noise_std', 'background', 'orientation_std', 'offset', 'correction',
                     'imu_topics', 'calibrated'):
            if not getattr(self, name):
                object.__setattr__(self, name, (None,) * n)
        if self.clock_offset is None:
            object.__setattr__(self, 'clock_offset', np.zeros(n))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def absolute_topics(self) -> tuple[str, ...]:
        """Absolute topic of each sensor, relative names resolved in `namespace` or the root."""
        return tuple(absolute(topic, self.namespace or '/') for topic in self.topics)

    @property
    def R_sw(self) -> FloatArray:
        """Rotation of each sensor, (n, 3, 3), world to sensor frame."""
        return np.ascontiguousarray(np.swapaxes(self.R_ws, 1, 2))

    @property
    def clock_offset_ns(self) -> IntArray:
        """`clock_offset` rounded to nanoseconds, (n,) ns."""
        offset: IntArray = np.rint(np.multiply(self.clock_offset, NS)).astype(np.int64)
        return offset

    @property
    def centre(self) -> FloatArray:
        """Mean of the sensor positions, (3,) m, world frame."""
        centre: FloatArray = self.positions.mean(axis=0)
        return centre

    @property
    def is_compact(self) -> bool:
        """Whether all sensors are within `MAX_COMPACT_EXTENT` of each other, or there is only one.

        The model errors of a vehicle are then about the same at all sensors, and together they
        observe range and size hardly better than a single sensor.
        """
        return bool(np.hypot(*np.ptp(self.positions[:, :2], axis=0)) < MAX_COMPACT_EXTENT)

    def part(self, rows: IntArray) -> 'SensorNetwork':
        """Select sensors.

        Parameters
        ----------
        rows : (k,) int array
            Rows of the sensors.

        Returns
        -------
        SensorNetwork
        """
        per_sensor: dict[str, Any] = {
            name: tuple(getattr(self, name)[j] for j in rows)
            for name in ('names', 'topics', 'noise_std', 'background', 'orientation_std', 'offset',
                         'correction', 'imu_topics', 'calibrated')}
        return replace(self, positions=self.positions[rows], R_ws=self.R_ws[rows],
                       clock_offset=self.clock_offset[rows], **per_sensor)

    def with_stated_orientations(self) -> 'SensorNetwork':
        """Copy the network with the orientations that were stated before any calibration.

        Returns
        -------
        SensorNetwork
        """
        R_ws, std = self.R_ws.copy(), list(self.orientation_std)
        for j, done in enumerate(self.calibrated):
            if done is not None and done.stated is not None:
                R_ws[j] = rotation_from_quaternion(done.stated)
                std[j] = None if done.stated_std is None else np.array(done.stated_std)
        return replace(self, R_ws=R_ws, orientation_std=tuple(std))

    def calibration_record(self, j: int, date: str, by: str,
               clock_offset_std: float = float('nan')) -> CalibrationRecord:
        """Create the record of a new calibration of a sensor.

        Parameters
        ----------
        j : int
            Row of the sensor.
        date : str
            Date in ISO 8601 format.
        by : str
            Source of the orientation, in words.
        clock_offset_std : float, s, optional
            NaN if the offset was not measured.

        Returns
        -------
        CalibrationRecord
            Keeps the orientation that was stated by hand.
        """
        done, std = self.calibrated[j], self.orientation_std[j]
        if done is not None and done.stated is not None:
            return replace(done, date=date, by=by, clock_offset_std=clock_offset_std)
        return CalibrationRecord(date, by, clock_offset_std,
                          tuple(quaternion_from_rotation(self.R_ws[j]).tolist()),
                          None if std is None else tuple(std.tolist()))

    def index(self, name: str) -> int:
        """Row of a sensor.

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
