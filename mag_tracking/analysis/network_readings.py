"""What fixed sensors read of a magnet on a tracked tool, with derivatives by all that is unknown.

All unknowns are in units of their own prior deviation (`PoseUnknowns` says which), so that a prior
is the identity and a deviation of zero means fixed.
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

SENSOR, SHARED, POSE = 10, 12, 8
"""Numbers per sensor (bias, gain, rotation, position), of all (board's shift and rotation, the
magnet's offset and tilt in the tool, log of the moment), and per pose (place, tilt, ambient
field)."""

Prediction: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""As `predicted_readings` returns it."""

UP = np.array([0.0, 0.0, 1.0])


def tool_rotations(axes: FloatArray) -> FloatArray:
    """Rotations tool to tracker (K, 3, 3) that take z to the unit vectors `axes` (K, 3).

    The shortest ones: a tracked axis has no roll, and a tool that is tilted by an arm keeps its
    own. What is across the axis in the tool is meaningful as far as that holds.
    """
    return rotation_from_quaternion(np.array([quaternion_between(UP, a) for a in axes]))


def rotation(v: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return rotation_from_quaternion(quaternion_from_rotation_vector(v))


@dataclass(frozen=True)
class TrackedMagnet:
    """Where the magnet is, by a tracked tool and what is unknown between tool and board."""

    tool: FloatArray
    """(K, 3) [m], tracker: the tracked points."""
    R_tool: FloatArray
    """(K, 3, 3), tool to tracker; its z is the tool's axis."""
    pivot: FloatArray
    """(3,) [m]: the board turns about it, against the tracker."""
    moment: float
    """[A m^2] as stated."""

    def poses(self, shared: FloatArray, pose: FloatArray) -> tuple[
            FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Magnet centres and moments.

        Parameters
        ----------
        shared : (12,)
            Shift [m], rotation vector [rad], offset [m, tool], tilt [slope, tool], log of the
            moment over the stated one. Frames: tracker to board (world).
        pose : (K, 8)
            Deviation of the place [m, world] and of the tilt [slope, tool]; change of the ambient
            field [T, world], which is the same at all sensors and not read here.

        Returns
        -------
        r, m : (K, 3) [m], [A m^2], world
        dr_dshared, dm_dshared : (K, 3, 12)
        dr_dpose, dm_dpose : (K, 3, 8)
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
        dr, dm = np.zeros((2, K, 3, SHARED))
        dr[:, :, :3] = np.eye(3)
        dr[:, :, 3:6] = -cross_matrix(arm) @ J_b
        dr[:, :, 6:9] = R
        dm[:, :, 3:6] = -cross_matrix(m) @ J_b
        dm[:, :, 9:11] = dm_dtilt
        dm[:, :, 11] = m
        dr_pose, dm_pose = np.zeros((2, K, 3, POSE))
        dr_pose[:, :, :3] = np.eye(3)
        dm_pose[:, :, 3:5] = dm_dtilt
        return self.pivot + shared[:3] + arm + pose[:, :3], m, dr, dm, dr_pose, dm_pose


def predicted_readings(network: SensorNetwork, magnet: TrackedMagnet, sensor: FloatArray,
                       shared: FloatArray, pose: FloatArray) -> Prediction:
    """What every sensor reads of every pose.

    Parameters
    ----------
    network : SensorNetwork
        Positions and orientations as stated.
    magnet : TrackedMagnet
    sensor : (n, 10)
        Bias [T, sensor frame], gain less one, rotation vector [rad, stated sensor frame],
        position less the stated one [m, world].
    shared, pose : as for `TrackedMagnet.poses`

    Returns
    -------
    f : (n, K, 3) [T], sensor frame
    signal : (n, K, 3) [T], sensor frame
        The same without the bias.
    by_sensor, by_shared, by_pose : (n, K, 3, 10 or 12 or 8)
        NaN where the magnet is on a sensor.

    Source: TSP14 eq. (2), (30) for the dipole; the small unknowns as in T10 section 6.3, but with
    whole rotations.
    """
    r, m, *by = magnet.poses(shared, pose)
    d = (network.positions + sensor[:, 7:])[:, None] - r
    turn = np.swapaxes(rotation(sensor[:, 4:7]), 1, 2)
    gain = (1.0 + sensor[:, 3])[:, None, None]
    M = gain * turn @ network.R_sw
    stated = np.einsum('nij,nkj->nki', network.R_sw, dipole_field(d, m) + pose[:, 5:])
    dB_dr, dB_dm = dipole_jacobians(d, m)
    dB_dr, dB_dm = M[:, None] @ dB_dr, M[:, None] @ dB_dm
    by_sensor = np.zeros((*d.shape, SENSOR))
    by_sensor[..., :3] = np.eye(3)
    field = np.einsum('nij,nkj->nki', turn, stated)
    by_sensor[..., 3] = field
    by_sensor[..., 4:7] = ((gain * turn)[:, None] @ cross_matrix(stated)
                           @ left_jacobian(sensor[:, 4:7])[:, None])
    by_sensor[..., 7:] = dB_dr
    dr, dm, dr_pose, dm_pose = by
    by_pose = dB_dm @ dm_pose - dB_dr @ dr_pose
    by_pose[..., 5:] = M[:, None]
    signal = gain * field
    return (signal + sensor[:, None, :3], signal, by_sensor, dB_dm @ dm - dB_dr @ dr, by_pose)
