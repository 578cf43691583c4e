"""Predicted readings of fixed sensors for a magnet on a tracked tool, and their derivatives.

`TrackedMagnet.poses` and `predicted_readings` define the unknowns and their order.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import (
    cross_matrix,
    left_jacobian,
    quaternion_between,
    quaternion_from_rotation_vector,
    rotation_from_quaternion,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import dipole_field, dipole_jacobians

N_SENSOR, N_SHARED, N_POSE = 10, 12, 8
"""Numbers of unknowns: per sensor (bias, gain, rotation, position); shared (shift and rotation of
the board, offset and tilt of the magnet in the tool, log of the moment); per pose (position, tilt,
ambient field)."""

Prediction: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Predicted readings and their derivatives; see `predicted_readings`."""

UP = np.array([0.0, 0.0, 1.0])
"""Unit vector of the z axis."""


def tool_rotations(axes: FloatArray) -> FloatArray:
    """Minimal rotations (K, 3, 3) from the tool frame to the tracker frame, from the tool's z axes.

    The roll about a tracked axis is not measured. The minimal rotation is exact if the tool is
    tilted without roll; otherwise, a rotated vector has a wrong component perpendicular to the
    axis.
    """
    return rotation_from_quaternion(np.array([quaternion_between(UP, a) for a in axes]))


def rotation(v: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors [rad]."""
    return rotation_from_quaternion(quaternion_from_rotation_vector(v))


@dataclass(frozen=True)
class TrackedMagnet:
    """A magnet on a tracked tool, with uncertain alignment to the tool and to the board."""

    tool: FloatArray
    """(K, 3) [m] tracked points, tracker frame."""
    R_tool: FloatArray
    """(K, 3, 3) rotations from the tool frame to the tracker frame; z is the axis of the tool."""
    pivot: FloatArray
    """(3,) [m] centre of the rotation between board and tracker, tracker frame."""
    moment: float
    """[A m²] Nominal moment."""

    def poses(self, shared: FloatArray, pose: FloatArray) -> tuple[
            FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Positions [m] and moments [A m²] of the magnet, world frame, and their derivatives.

        Each is (K, 3), and is first differentiated by `shared`, (K, 3, 12), then by `pose`,
        (K, 3, 8).

        Parameters
        ----------
        shared : shift [m] and rotation vector [rad] from the tracker to the board (world) frame;
            offset [m] and tilt [slope] of the magnet in the tool frame; log of the moment over its
            nominal value
        pose : corrections of position [m, world frame] and tilt [slope, tool frame]; change of the
            ambient field [T, world frame], which does not affect the pose
        """
        K = len(self.tool)
        R_b, J_b = rotation(shared[3:6]), left_jacobian(shared[3:6])
        R = R_b @ self.R_tool
        arm = (self.tool - self.pivot) @ R_b.T + R @ shared[6:9]
        axis = np.hstack([shared[9:11] + pose[:, 3:5], np.ones((K, 1))])
        length = np.linalg.norm(axis, axis=1)[:, None]
        axis = axis / length
        m = self.moment * np.exp(shared[11]) * np.einsum('kij,kj->ki', R, axis)
        slope = (np.eye(3) - axis[:, :, None] * axis[:, None, :])[:, :, :2] / length[:, :, None]
        dm_dtilt = self.moment * np.exp(shared[11]) * R @ slope
        dr, dm = np.zeros((2, K, 3, N_SHARED))
        dr[:, :, :3] = np.eye(3)
        dr[:, :, 3:6] = -cross_matrix(arm) @ J_b
        dr[:, :, 6:9] = R
        dm[:, :, 3:6] = -cross_matrix(m) @ J_b
        dm[:, :, 9:11] = dm_dtilt
        dm[:, :, 11] = m
        dr_pose, dm_pose = np.zeros((2, K, 3, N_POSE))
        dr_pose[:, :, :3] = np.eye(3)
        dm_pose[:, :, 3:5] = dm_dtilt
        return self.pivot + shared[:3] + arm + pose[:, :3], m, dr, dm, dr_pose, dm_pose


def predicted_readings(network: SensorNetwork, magnet: TrackedMagnet, sensor: FloatArray,
                       shared: FloatArray, pose: FloatArray) -> Prediction:
    """Predict the reading of each sensor at each pose, and its derivatives.

    `sensor` (n, 10) is bias [T, sensor frame], gain minus one, rotation vector [rad, nominal sensor
    frame] and position minus the nominal position [m, world frame]; `shared` and `pose` are as for
    `TrackedMagnet.poses`. Returns readings and readings without the bias (n, K, 3) [T, sensor
    frame], then derivatives by `sensor`, `shared` and `pose`, NaN for a magnet at a sensor.
    TSP14 eq. (2), (30) for the dipole; T10 section 6.3 for the corrections, here with finite
    rotations.
    """
    r, m, *derivatives = magnet.poses(shared, pose)
    d = (network.positions + sensor[:, 7:])[:, None] - r
    R_correction = np.swapaxes(rotation(sensor[:, 4:7]), 1, 2)
    gain = (1.0 + sensor[:, 3])[:, None, None]
    M = gain * R_correction @ network.R_sw
    nominal = np.einsum('nij,nkj->nki', network.R_sw, dipole_field(d, m) + pose[:, 5:])
    dB_dr, dB_dm = dipole_jacobians(d, m)
    dB_dr, dB_dm = M[:, None] @ dB_dr, M[:, None] @ dB_dm
    by_sensor = np.zeros((*d.shape, N_SENSOR))
    by_sensor[..., :3] = np.eye(3)
    field = np.einsum('nij,nkj->nki', R_correction, nominal)
    by_sensor[..., 3] = field
    by_sensor[..., 4:7] = ((gain * R_correction)[:, None] @ cross_matrix(nominal)
                           @ left_jacobian(sensor[:, 4:7])[:, None])
    by_sensor[..., 7:] = dB_dr
    dr, dm, dr_pose, dm_pose = derivatives
    by_pose = dB_dm @ dm_pose - dB_dr @ dr_pose
    by_pose[..., 5:] = M[:, None]
    signal = gain * field
    return (signal + sensor[:, None, :3], signal, by_sensor, dB_dm @ dm - dB_dr @ dr, by_pose)
