"""Shapes of the messages that are read: ROS's own objects have them, and decoded ones."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

MessageDict: TypeAlias = dict[str, Any]
"""A message to be written: its fields by name, nested."""


class Time(Protocol):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


class Vector3(Protocol):
    """geometry_msgs/Vector3, or a Point."""

    x: float
    y: float
    z: float


class Quaternion(Vector3, Protocol):
    """geometry_msgs/Quaternion."""

    w: float


class MagneticField(Protocol):
    """sensor_msgs/MagneticField."""

    header: Header
    magnetic_field: Vector3
    magnetic_field_covariance: Sequence[float]


class Imu(Protocol):
    """sensor_msgs/Imu, of which only the acceleration is read."""

    header: Header
    linear_acceleration: Vector3
    linear_acceleration_covariance: Sequence[float]


class FieldReadings(Protocol):
    """mag_tracking_msgs/FieldReadings."""

    header: Header
    sensors: Sequence[str]
    sensor: Sequence[int]
    stamp: Sequence[int]
    field: Sequence[float]
    covariance: Sequence[float]


class NetworkFrame(Protocol):
    """mag_tracking_msgs/NetworkFrame."""

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
    """mag_tracking_msgs/SensorCalibration, of which only this is read."""

    sensor: str
    doubtful: bool
    doubtful_since: Time
    doubtful_until: Time
    orientation: Quaternion
    orientation_std: Sequence[float]


class CalibrationState(Protocol):
    """mag_tracking_msgs/CalibrationState."""

    header: Header
    sensors: Sequence[SensorCalibration]


class Pose(Protocol):
    """geometry_msgs/Pose."""

    position: Vector3
    orientation: Quaternion


class PoseStamped(Protocol):
    """geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose
