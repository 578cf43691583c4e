"""Conversion of network frames to messages as nested dicts, and from messages, without ROS."""

from typing import Protocol

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.inference.covariances import MIN_PIVOT, smallest_pivots
from mag_tracking.messages.schema import float64_array, header_dict, stamp_ns
from mag_tracking.messages.shapes import MessageDict, NetworkFrame
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame

MAX_OFFSET_S = 60.0
"""[s] Maximum time offset of a sensor within a frame; equals the maximum of `align.period_s`."""


class NamedSensors(Protocol):
    """Sensors with names, such as a `SensorNetwork`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Sensor names."""

    def __len__(self) -> int: ...


def frame_dict(frame: FieldFrame, network: SensorNetwork) -> MessageDict:
    """Convert a `FieldFrame` to mag_tracking_msgs/NetworkFrame."""
    return {'header': header_dict(frame.stamp_ns, network.frame), 'sensors': list(network.names),
            'field': float64_array(frame.field), 'covariance': float64_array(frame.covariance),
            'n_samples': frame.n_samples.tolist(), 'time_offset': float64_array(frame.time_offset),
            'target_present': frame.target_present,
            'statistic': frame.statistic, 'degrees_of_freedom': frame.degrees_of_freedom}


def frame_of(message: NetworkFrame, network: NamedSensors) -> FieldFrame:
    """Convert a NetworkFrame, with the network's sensors in the same order, to a `FieldFrame`.

    Raises RecordingError if sensors or array lengths do not match the network, a value is out of
    range, or a covariance is not positive definite.
    """
    n = len(network)
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
        stamp_ns(message.header.stamp), np.array(message.field).reshape(n, 3),
        np.array(message.covariance).reshape(n, 3, 3), np.array(message.n_samples, dtype=int),
        np.array(message.time_offset, dtype=float), bool(message.target_present),
        float(message.statistic), int(message.degrees_of_freedom))
    _check_numbers(frame)
    return frame


def _check_numbers(frame: FieldFrame) -> None:
    """Raise RecordingError for an infinite field, a large time offset or an invalid covariance."""
    if np.isinf(frame.field).any():
        raise RecordingError('NetworkFrame: a field is infinite; expected finite values, or NaN '
                             'for a missing axis')
    if not (np.abs(frame.time_offset) <= MAX_OFFSET_S).all():
        raise RecordingError(f'NetworkFrame: time offsets are {frame.time_offset.tolist()} s; '
                             f'the maximum is {MAX_OFFSET_S:g} s')
    if not (smallest_pivots(frame.field, frame.covariance) > MIN_PIVOT).all():
        raise RecordingError('NetworkFrame: a covariance is not positive definite')
