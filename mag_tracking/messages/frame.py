"""Frames of a network to and from messages, as nested dicts, without ROS."""

from typing import Protocol

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.inference.axes import MIN_PIVOT, smallest_pivots
from mag_tracking.messages.schema import doubles, header_dict, stamp_ns
from mag_tracking.messages.shapes import MessageDict, NetworkFrame
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame

MAX_OFFSET_S = 60.0
"""[s] The longest frame there can be (`align.period_s`)."""


class NamedSensors(Protocol):
    """Sensors with names, such as a `SensorNetwork`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Sensor names."""

    def __len__(self) -> int: ...


def frame_dict(frame: FieldFrame, network: SensorNetwork) -> MessageDict:
    """mag_tracking_msgs/NetworkFrame of a `FieldFrame`."""
    return {'header': header_dict(frame.stamp_ns, network.frame), 'sensors': list(network.names),
            'field': doubles(frame.field), 'covariance': doubles(frame.covariance),
            'n_samples': frame.n_samples.tolist(), 'time_offset': doubles(frame.time_offset),
            'target_present': frame.target_present,
            'statistic': frame.statistic, 'degrees_of_freedom': frame.degrees_of_freedom}


def frame_of(message: NetworkFrame, network: NamedSensors) -> FieldFrame:
    """`FieldFrame` of a message-shaped NetworkFrame.

    Raises RecordingError where sensors or lengths are not those of the network.
    """
    n = len(network)
    if tuple(message.sensors) != network.names:
        raise RecordingError(f'a frame of {", ".join(message.sensors)} does not fit the network '
                             f'of {", ".join(network.names)}')
    lengths = {name: len(getattr(message, name)) for name in (
        'field', 'covariance', 'n_samples', 'time_offset')}
    expected = dict(zip(lengths, (3 * n, 9 * n, n, n), strict=True))
    if lengths != expected:
        raise RecordingError(f'a frame of {n} sensors needs arrays of lengths {expected}, '
                             f'got {lengths}')
    frame = FieldFrame(
        stamp_ns(message.header.stamp), np.array(message.field).reshape(n, 3),
        np.array(message.covariance).reshape(n, 3, 3), np.array(message.n_samples, dtype=int),
        np.array(message.time_offset, dtype=float), bool(message.target_present),
        float(message.statistic), int(message.degrees_of_freedom))
    _check_numbers(frame)
    return frame


def _check_numbers(frame: FieldFrame) -> None:
    """Raise RecordingError where a frame holds what no alignment gives."""
    if np.isinf(frame.field).any():
        raise RecordingError('a frame with an infinite field')
    if not (np.abs(frame.time_offset) <= MAX_OFFSET_S).all():
        raise RecordingError(f'a frame with time offsets of {frame.time_offset.tolist()} s')
    if not (smallest_pivots(frame.field, frame.covariance) > MIN_PIVOT).all():
        raise RecordingError('a frame with a covariance that is not positive definite')
