"""What the calibration knows of a network, to and from its message."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes
from mag_tracking.errors import RecordingError
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.messages.schema import stamp_dict, stamp_ns, xyz
from mag_tracking.messages.shapes import CalibrationState, MessageDict
from mag_tracking.network import SensorNetwork


class _Background(Protocol):
    """A `RunningBackground`."""

    @property
    def ready(self) -> bool: ...
    @property
    def frozen(self) -> bool: ...
    @property
    def doubtful(self) -> bool: ...
    @property
    def doubtful_times(self) -> DoubtfulTimes: ...
    @property
    def n_relearnt(self) -> int: ...
    @property
    def covariance(self) -> FloatArray | None: ...


class _Calibration(Protocol):
    """The stage that calibrates; see `Calibrate`."""

    def background(self, sensor: str) -> FloatArray: ...
    def backgrounds(self) -> Mapping[str, _Background]: ...
    def counts_of(self, sensor: str) -> Mapping[str, int]: ...
    def last_stamp_ns(self, sensor: str) -> int | None: ...

def sensor_dict(calibrate: _Calibration, network: SensorNetwork, j: int) -> MessageDict:
    """mag_tracking_msgs/SensorCalibration of sensor `j`."""
    name = network.names[j]
    background, counts = calibrate.backgrounds()[name], calibrate.counts_of(name)
    ready = background.ready and calibrate.last_stamp_ns(name) is not None
    C = background.covariance if ready else None
    q, std = quaternion_from_rotation(network.R_ws[j]), network.orientation_std[j]
    done = network.calibrated[j]
    since, until = background.doubtful_times[-1] if background.doubtful_times else (None, None)
    return {'sensor': name, 'ready': ready, 'frozen': background.frozen,
            'doubtful': background.doubtful,
            'doubtful_since': stamp_dict(since or 0), 'doubtful_until': stamp_dict(until or 0),
            'background': xyz(calibrate.background(name) if ready else np.full(3, np.nan)),
            'covariance': (np.full((3, 3), np.nan) if C is None else C).ravel().tolist(),
            'n_samples': counts['accepted'], 'n_rejected': counts['rejected'],
            'n_relearnt': background.n_relearnt,
            'orientation': {**xyz(q), 'w': float(q[3])},
            'orientation_std': (np.full(3, np.nan) if std is None else std).tolist(),
            'clock_offset': float(network.clock_offset[j]),
            'clock_offset_std': float('nan') if done is None else done.clock_offset_std,
            'calibrated_at': '' if done is None else done.date,
            'calibrated_by': '' if done is None else done.by}


def doubtful_times(message: CalibrationState) -> dict[str, DoubtfulTimes]:
    """{sensor: latest doubtful stretch of its background} of a message-shaped CalibrationState.

    The tuple is empty if the background was never doubtful.
    """
    times: dict[str, DoubtfulTimes] = {}
    for s in message.sensors:
        since, until = stamp_ns(s.doubtful_since), stamp_ns(s.doubtful_until)
        times[s.sensor] = ((since, until or None),) if since else ()
    return times


def with_orientations(network: SensorNetwork, message: CalibrationState) -> SensorNetwork:
    """The `SensorNetwork` turned as a message-shaped CalibrationState says.

    Raises RecordingError where that is of other sensors, or turns one by no rotation.
    """
    names = tuple(s.sensor for s in message.sensors)
    if names != network.names:
        raise RecordingError(f'a calibration of {", ".join(names)} does not fit the network of '
                             f'{", ".join(network.names)}')
    if message.header.frame_id != network.frame:
        raise RecordingError(f'a calibration in the frame {message.header.frame_id!r}, not '
                             f'{network.frame!r}')
    q = np.array([[s.orientation.x, s.orientation.y, s.orientation.z, s.orientation.w]
                  for s in message.sensors])
    std = [np.array(s.orientation_std, dtype=float) for s in message.sensors]
    for name, v in zip(names, std, strict=True):
        if not (np.isnan(v).all() or (np.isfinite(v) & (v > 0.0)).all()):
            raise RecordingError(f'a calibration of {name} with deviations of {v.tolist()} rad')
    try:
        R_ws = rotation_from_quaternion(q)
    except ValueError as error:
        raise RecordingError(f'a calibration with an orientation that is none: {error}') from error
    return replace(network, R_ws=R_ws, orientation_std=tuple(
        None if np.isnan(v).all() else v for v in std))
