"""Interfaces of the messages that are read, whether ROS objects or decoded messages."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

MessageDict: TypeAlias = dict[str, Any]
"""Message to be written, as nested dicts of its fields."""


class Time(Protocol):
    """Interface of builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """Interface of std_msgs/Header."""

    stamp: Time
    frame_id: str


class Vector3(Protocol):
    """Interface of geometry_msgs/Vector3 and Point."""

    x: float
    y: float
    z: float


class Quaternion(Vector3, Protocol):
    """Interface of geometry_msgs/Quaternion."""

    w: float


class MagneticField(Protocol):
    """Interface of sensor_msgs/MagneticField."""

    header: Header
    magnetic_field: Vector3
    magnetic_field_covariance: Sequence[float]


class Imu(Protocol):
    """Interface of sensor_msgs/Imu; only the acceleration is read."""

    header: Header
    linear_acceleration: Vector3
    linear_acceleration_covariance: Sequence[float]


class FieldReadings(Protocol):
    """Interface of mag_tracking_msgs/FieldReadings."""

    header: Header
    sensors: Sequence[str]
    sensor: Sequence[int]
    stamp: Sequence[int]
    field: Sequence[float]
    covariance: Sequence[float]


class NetworkFrame(Protocol):
    """Interface of mag_tracking_msgs/NetworkFrame."""

    header: Header
    sensors: Sequence[str]
    field: Sequence[float]
    covariance: Sequence[float]
    n_samples: Sequence[int]
    time_offset: Sequence[float]
    target_present: bool
    statistic: float
    degrees_of_freedom: int


class SensorCalibration(Protocol):
    """Interface of mag_tracking_msgs/SensorCalibration, limited to the fields that are read."""

    sensor: str
    doubtful: bool
    doubtful_since: Time
    doubtful_until: Time
    orientation: Quaternion
    orientation_std: Sequence[float]


class CalibrationState(Protocol):
    """Interface of mag_tracking_msgs/CalibrationState."""

    header: Header
    sensors: Sequence[SensorCalibration]


class Pose(Protocol):
    """Interface of geometry_msgs/Pose."""

    position: Vector3
    orientation: Quaternion


class PoseStamped(Protocol):
    """Interface of geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose
