"""Conversion of records to and from ROS messages.

The content of each message is defined once, in `messages.schema`, as nested dicts. ROS messages
have the same attributes as decoded messages of a recording, so its functions also read them.
"""

import functools
import importlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.publisher import Publisher

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.records import Hypothesis, Track

_TYPE_NAME = re.compile(r'[A-Za-z]\w*/msg/[A-Za-z]\w*')


def message_class(type_name: str) -> Any:
    """Python class of a type such as `std_msgs/msg/Header`; None if it is not an installed type."""
    if not _TYPE_NAME.fullmatch(type_name):
        return None
    package, _, name = type_name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name, None)
    except ModuleNotFoundError:
        return None


def to_message(cls: Any, content: Mapping[str, Any]) -> Any:
    """Convert nested dicts to a ROS message; an unknown field raises AttributeError."""
    message = cls()
    for name, value in content.items():
        if isinstance(value, dict):
            value = to_message(type(getattr(message, name)), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            element_class = _element_class(cls, name)
            value = [to_message(element_class, v) for v in value]
        setattr(message, name, value)
    return message


def has_subscribers(publisher: Publisher) -> bool:
    """Whether a publisher has subscribers."""
    return publisher.get_subscription_count() > 0


def send(publisher: Publisher, content: Mapping[str, Any] | None) -> None:
    """Publish a message with the given fields; None is not published."""
    if content is not None:
        publisher.publish(to_message(publisher.msg_type, content))


@functools.cache
def _element_class(cls: Any, name: str) -> Any:
    """Return the message class of the elements in the sequence field `name`."""
    element = cls.get_fields_and_field_types()[name].removeprefix('sequence<').removesuffix('>')
    package, leaf = element.split('/')
    return message_class(f'{package}/msg/{leaf}')


def _vector(v: Any) -> FloatArray:
    """Convert the fields x, y and z of a message to an array (3,)."""
    return np.array([v.x, v.y, v.z])


def track_of(message: Any, hypotheses: Any = None, n_sensors: int | None = None) -> Track:
    """Convert mag_tracking_msgs/Track to a `Track`.

    Without `hypotheses`, a HypothesisArray, it has the best one of each arrival direction.
    `n_sensors` is by default that of `innovation_by_sensor`. Raises RecordingError if array lengths
    do not match it, a number is not finite, or an active track has no hypothesis.
    """
    _check_lengths(message, len(message.innovation_by_sensor) if n_sensors is None else n_sensors)
    pose = np.array(message.pose.covariance).reshape(6, 6)
    q = message.pose.pose.orientation
    members = tuple(
        Hypothesis(h.arrival, h.weight, _vector(h.position), _vector(h.velocity),
                   np.array(h.covariance).reshape(6, 6), _vector(h.moment), h.kind)
        for h in (message.arrivals if hypotheses is None else hypotheses.hypotheses))
    if not members and message.status != message.ENDED:
        raise RecordingError(f'Track {message.id} has no arrivals; expected at least one')
    track = Track(
        stamp_ns(message.header.stamp), message.id,
        _vector(message.pose.pose.position), _vector(message.velocity),
        np.array(message.covariance).reshape(6, 6), np.array([q.x, q.y, q.z, q.w]),
        pose[3:, 3:], pose[:3, 3:], _vector(message.moment),
        np.array(message.moment_covariance).reshape(3, 3), message.kind, message.length,
        message.length_std, message.ambiguous, message.status == message.ENDED, message.existence,
        message.weight, message.normalised_innovation, np.array(message.innovation_by_sensor),
        message.degrees_of_freedom, message.arrival, message.kind_weight,
        tuple(message.unobservable),
        np.array(message.predicted_field).reshape(-1, 3), np.array(message.mounting).reshape(-1, 3),
        np.array(message.mounting_covariance).reshape(-1, 3, 3), members,
        tuple(message.doubts))
    _check_finite(f'Track {track.id}', position=track.position, velocity=track.velocity,
                  covariance=track.covariance)
    return track


def _check_lengths(message: Any, n: int) -> None:
    """Raise RecordingError if the array lengths of a Track do not match `n` sensors."""
    lengths = {name: len(getattr(message, name)) for name in (
        'innovation_by_sensor', 'predicted_field', 'mounting', 'mounting_covariance')}
    required = dict(zip(lengths, (n, 3 * n, 3 * n, 9 * n), strict=True))
    without_mounting = required | {'mounting': 0, 'mounting_covariance': 0}
    if lengths not in (required, without_mounting):
        raise RecordingError(f'Track {message.id} of {n} sensors: expected array lengths '
                             f'{required}, or no mounting; got {lengths}')


def _check_finite(subject: str, **arrays: FloatArray) -> None:
    """Raise RecordingError if an array has a NaN or infinite element."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise RecordingError(f'{subject}: {name} is {values.tolist()}; expected finite values')


def smoothed_path_of(message: Any) -> FloatArray:
    """Positions (n, 3) of a mag_tracking_msgs/SmoothedTrack, m, world frame; raises RecordingError
    if it has no position, array lengths differ, or a value is not finite."""
    lengths = {name: len(getattr(message, name)) for name in (
        'poses', 'velocities', 'pose_ambiguous')}
    n = lengths['poses']
    if not n or {*lengths.values()} != {n}:
        raise RecordingError(f'SmoothedTrack {message.track_id}: expected arrays of one length, '
                             f'at least 1; got {lengths}')
    path = np.array([_vector(p.pose.pose.position) for p in message.poses])
    _check_finite(f'SmoothedTrack {message.track_id}', position=path)
    return path
