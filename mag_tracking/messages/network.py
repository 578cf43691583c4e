"""Frames and calibrations of a network as messages, and from messages."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.doubtful_times import DoubtfulTimes
from mag_tracking.errors import RecordingError
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.inference.covariances import MIN_PIVOT, smallest_pivots
from mag_tracking.messages import schema
from mag_tracking.messages.types import MessageDict
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame

MAX_OFFSET_S = 60.0
"""[s] Maximum time offset of a sensor within a frame; equals the maximum of `align.period_s`."""


class NamedSensors(Protocol):
    """Sensors with names, such as a `SensorNetwork`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Sensor names."""


def frame_dict(frame: FieldFrame, network: SensorNetwork) -> MessageDict:
    """Convert a `FieldFrame` to mag_tracking_msgs/NetworkFrame."""
    arrays = {name: schema.float64_array(getattr(frame, name))
              for name in ('field', 'covariance', 'time_offset')}
    return {**arrays, 'header': schema.header_dict(frame.stamp_ns, network.frame),
            'sensors': list(network.names), 'n_samples': frame.n_samples.tolist(),
            'target_present': frame.target_present,
            'statistic': frame.statistic, 'degrees_of_freedom': frame.degrees_of_freedom}


def frame_of(message: schema.NetworkFrame, network: NamedSensors) -> FieldFrame:
    """Convert a NetworkFrame, with the network's sensors in the same order, to a `FieldFrame`;
    raises RecordingError if it does not match the network or a value is invalid."""
    n = len(network.names)
    if tuple(message.sensors) != network.names:
        raise RecordingError(f'NetworkFrame has sensors {", ".join(message.sensors)}; the network '
                             f'has {", ".join(network.names)}')
    lengths = {name: len(getattr(message, name)) for name in (
        'field', 'covariance', 'n_samples', 'time_offset')}
    required = dict(zip(lengths, (3 * n, 9 * n, n, n), strict=True))
    if lengths != required:
        raise RecordingError(f'NetworkFrame of {n} sensors: expected array lengths {required}; '
                             f'got {lengths}')
    frame = FieldFrame(
        schema.stamp_ns(message.header.stamp), np.array(message.field).reshape(n, 3),
        np.array(message.covariance).reshape(n, 3, 3), np.array(message.n_samples, dtype=int),
        np.array(message.time_offset, dtype=float), bool(message.target_present),
        float(message.statistic), int(message.degrees_of_freedom))
    if np.isinf(frame.field).any():
        raise RecordingError('NetworkFrame: a field is infinite; expected finite values, or NaN '
                             'for a missing axis')
    if not (np.abs(frame.time_offset) <= MAX_OFFSET_S).all():
        raise RecordingError(f'NetworkFrame: time offsets are {frame.time_offset.tolist()} s; '
                             f'the maximum is {MAX_OFFSET_S:g} s')
    if not (smallest_pivots(frame.field, frame.covariance) > MIN_PIVOT).all():
        raise RecordingError('NetworkFrame: a covariance is not positive definite')
    return frame


class _Calibration(Protocol):
    def background(self, sensor: str) -> FloatArray: ...
    def latest_doubt(self, sensor: str) -> tuple[int, int | None] | None: ...
    def backgrounds(self) -> Mapping[str, RunningBackground]: ...
    def counts_of(self, sensor: str) -> Mapping[str, int]: ...
    def last_stamp_ns(self, sensor: str) -> int | None: ...


def sensor_dict(calibrate: _Calibration, network: SensorNetwork, j: int) -> MessageDict:
    """Calibration of sensor `j` as mag_tracking_msgs/SensorCalibration; NaN if unknown."""
    name = network.names[j]
    background, counts = calibrate.backgrounds()[name], calibrate.counts_of(name)
    ready = background.ready and calibrate.last_stamp_ns(name) is not None
    C = background.covariance if ready else None
    q, std = quaternion_from_rotation(network.R_ws[j]), network.orientation_std[j]
    record = network.calibrated[j]
    begin, end = calibrate.latest_doubt(name) or (0, 0)
    return {'sensor': name, 'ready': ready, 'frozen': background.frozen,
            'doubtful': end is None, 'doubtful_since': schema.stamp_dict(begin),
            'doubtful_until': schema.stamp_dict(end or 0),
            'background': schema.xyz(calibrate.background(name) if ready else np.full(3, np.nan)),
            'covariance': (np.full((3, 3), np.nan) if C is None else C).ravel().tolist(),
            'n_samples': counts['accepted'], 'n_rejected': counts['rejected'],
            'n_relearnt': background.n_relearnt,
            'orientation': schema.quaternion_dict(q),
            'orientation_std': (np.full(3, np.nan) if std is None else std).tolist(),
            'clock_offset': float(network.clock_offset[j]),
            'clock_offset_std': float('nan') if record is None else record.clock_offset_std,
            'calibrated_at': '' if record is None else record.date,
            'calibrated_by': '' if record is None else record.by}


def doubtful_times(message: schema.CalibrationState) -> dict[str, DoubtfulTimes]:
    """Latest doubtful interval of each sensor's background; empty if it was never doubtful."""
    times: dict[str, DoubtfulTimes] = {}
    for s in message.sensors:
        begin, end = schema.stamp_ns(s.doubtful_since), schema.stamp_ns(s.doubtful_until)
        times[s.sensor] = ((begin, end or None),) if begin else ()
    return times


def with_orientations(network: SensorNetwork, message: schema.CalibrationState) -> SensorNetwork:
    """Copy a network, with the sensor orientations of a CalibrationState; raises RecordingError if
    sensors or frame differ from the network's, or an orientation or its std is invalid."""
    names = tuple(s.sensor for s in message.sensors)
    if names != network.names:
        raise RecordingError(f'CalibrationState has sensors {", ".join(names)}; the network has '
                             f'{", ".join(network.names)}')
    if message.header.frame_id != network.frame:
        raise RecordingError(f'CalibrationState is in frame {message.header.frame_id!r}; the '
                             f'network is in {network.frame!r}')
    q = np.array([[s.orientation.x, s.orientation.y, s.orientation.z, s.orientation.w]
                  for s in message.sensors])
    std = [np.array(s.orientation_std, dtype=float) for s in message.sensors]
    for name, v in zip(names, std, strict=True):
        if not (np.isnan(v).all() or (np.isfinite(v) & (v > 0.0)).all()):
            raise RecordingError(f'CalibrationState of {name}: orientation_std is {v.tolist()} '
                                 'rad; expected positive values, or NaN if unknown')
    try:
        R_ws = rotation_from_quaternion(q)
    except ValueError as error:
        raise RecordingError(f'CalibrationState: invalid orientation: {error}') from error
    return replace(network, R_ws=R_ws, orientation_std=tuple(
        None if np.isnan(v).all() else v for v in std))
