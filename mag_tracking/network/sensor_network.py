"""The sensor network: where each sensor is, how it is turned, what it was calibrated to."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import NetworkError
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.network.topics import absolute
from mag_tracking.units import NS

CLOSE = 2.0
"""[m] Half a car."""
ONE_PLACE = 0.1
"""[m] Sensors closer than this, seen from above, do not tell a delay."""


@dataclass(frozen=True)
class Calibrated:
    """When and how a sensor was calibrated."""

    date: str
    """As ISO 8601 has it."""
    by: str
    """What its orientation comes from, in words."""
    clock_offset_std: float
    """[s]; NaN where the offset was not measured."""
    stated: tuple[float, ...] | None = None
    """(4,) quaternion xyzw, sensor to world, as it was stated by hand; None = not kept. A later
    survey begins there: what an earlier one found is not another statement."""
    stated_std: tuple[float, ...] | None = None
    """(3,) [rad] of `stated`, about the world's axes; None = not known."""


@dataclass(frozen=True)
class SensorNetwork:
    """Stationary three-axis magnetometers; the order of `names` is that of every array."""

    names: tuple[str, ...]
    positions: FloatArray
    """(n, 3) [m], world."""
    R_ws: FloatArray
    """(n, 3, 3), sensor to world."""
    topics: tuple[str, ...]
    """Per sensor; those that do not begin with / are relative to a namespace."""
    frame: str = 'map'
    earth_field: FloatArray | None = None
    """(3,) [T], world; None = unknown."""
    noise_std: tuple[FloatArray | None, ...] = ()
    """Per sensor (3,) [T]; None = to be estimated."""
    background: tuple[FloatArray | None, ...] = ()
    """Per sensor (3,) [T], sensor frame; None = to be learnt."""
    orientation_std: tuple[FloatArray | None, ...] = ()
    """Per sensor (3,) [rad], how far it may be turned from `R_ws` about each of the world's
    axes; None = not known."""
    # None only until `__post_init__`.
    clock_offset: FloatArray = cast(FloatArray, None)
    """(n,) [s] How far each sensor's clock is ahead; taken from its stamps. None = zeros."""
    offset: tuple[FloatArray | None, ...] = ()
    """Per sensor (3,) [T], sensor frame: hard iron of the sensor itself, as a tumbling tells."""
    correction: tuple[FloatArray | None, ...] = ()
    """Per sensor (3, 3): B = correction @ (reading - offset)."""
    imu_topics: tuple[str | None, ...] = ()
    """Per sensor, of its accelerometer; None = it has none."""
    calibrated: tuple[Calibrated | None, ...] = ()
    """Per sensor; None = never."""
    namespace: str | None = None
    """Namespace of the relative topics in a recording; None = the one in which they are found."""

    def __post_init__(self) -> None:
        n = len(self.names)
        if n == 0:
            raise NetworkError('a network needs at least one sensor')
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise NetworkError(f'sensor {twice[0]} is there twice')
        names = [absolute(t) for t in self.topics]
        shared = sorted({t for t in names if names.count(t) > 1})
        if shared:
            raise NetworkError(f'topic {shared[0]} is that of two sensors')
        if self.positions.shape != (n, 3) or self.R_ws.shape != (n, 3, 3):
            raise NetworkError(f'{n} sensors need positions ({n}, 3) and orientations ({n}, 3, 3)')
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
        """(n,) `topics` as a recording without a known namespace has them at the root."""
        return tuple(absolute(topic, self.namespace or '/') for topic in self.topics)

    @property
    def R_sw(self) -> FloatArray:
        """(n, 3, 3), world to sensor."""
        return np.ascontiguousarray(np.swapaxes(self.R_ws, 1, 2))

    @property
    def clock_offset_ns(self) -> IntArray:
        """(n,) [ns] `clock_offset`, rounded."""
        offset: IntArray = np.rint(np.multiply(self.clock_offset, NS)).astype(np.int64)
        return offset

    @property
    def centre(self) -> FloatArray:
        """(3,) [m], mean of the sensor positions."""
        centre: FloatArray = self.positions.mean(axis=0)
        return centre

    @property
    def is_close(self) -> bool:
        """Whether all sensors are within `CLOSE` of each other; one alone is.

        What a model leaves out of a vehicle is then about the same at all of them, and together
        they tell hardly more of range and size than one sensor does.
        """
        return bool(np.hypot(*np.ptp(self.positions[:, :2], axis=0)) < CLOSE)

    def part(self, rows: IntArray) -> 'SensorNetwork':
        """The network of the sensors `rows` (n,) alone."""
        per_sensor: dict[str, Any] = {
            name: tuple(getattr(self, name)[j] for j in rows)
            for name in ('names', 'topics', 'noise_std', 'background', 'orientation_std', 'offset',
                         'correction', 'imu_topics', 'calibrated')}
        return replace(self, positions=self.positions[rows], R_ws=self.R_ws[rows],
                       clock_offset=self.clock_offset[rows], **per_sensor)

    def as_stated(self) -> 'SensorNetwork':
        """The network with the orientations that were stated before any calibration."""
        R_ws, std = self.R_ws.copy(), list(self.orientation_std)
        for j, done in enumerate(self.calibrated):
            if done is not None and done.stated is not None:
                R_ws[j] = rotation_from_quaternion(done.stated)
                std[j] = None if done.stated_std is None else np.array(done.stated_std)
        return replace(self, R_ws=R_ws, orientation_std=tuple(std))

    def marked(self, j: int, date: str, by: str,
               clock_offset_std: float = float('nan')) -> Calibrated:
        """The `Calibrated` of sensor `j` from now on; what was stated by hand is kept in it."""
        done, std = self.calibrated[j], self.orientation_std[j]
        if done is not None and done.stated is not None:
            return replace(done, date=date, by=by, clock_offset_std=clock_offset_std)
        return Calibrated(date, by, clock_offset_std,
                          tuple(quaternion_from_rotation(self.R_ws[j]).tolist()),
                          None if std is None else tuple(std.tolist()))

    def index(self, name: str) -> int:
        """Row of sensor `name`; raises NetworkError if there is none."""
        try:
            return self.names.index(name)
        except ValueError:
            raise NetworkError(f'unknown sensor {name}; the network has '
                               f'{", ".join(self.names)}') from None
