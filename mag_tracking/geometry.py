"""Rotations, unit quaternions in the order (x, y, z, w), speed, heading and overlap of bodies."""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray


def rotation_from_quaternion(q: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4); raises ValueError if a norm
    differs from one by more than 1e-3."""
    q = np.asarray(q, dtype=float)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(norm - 1.0) <= 1e-3):
        raise ValueError(f'quaternions must have norm 1, got norms {np.ravel(norm).tolist()}')
    x, y, z, w = np.moveaxis(q / norm, -1, 0)
    return np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ], -2)


def quaternion_from_rotation_vector(v: ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) [rad]; the identity at v = 0."""
    v = np.asarray(v, dtype=float)
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # np.sinc is sin(a)/a with a in units of pi, and has the right limit at zero.
    return np.concatenate([0.5 * v * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def rotation_vectors_between(q: ArrayLike, other: ArrayLike) -> FloatArray:
    """Shortest rotation vectors (..., 3) [rad], world axes, from `q` (4,) to others (..., 4)."""
    q, other = np.asarray(q, dtype=float), np.asarray(other, dtype=float)
    v, w = -q[:3], q[3]
    along = other[..., 3:] * v + w * other[..., :3] + np.cross(other[..., :3], v)
    cosine = other[..., 3] * w - other[..., :3] @ v
    sine = np.linalg.norm(along, axis=-1)
    angle = 2.0 * np.arctan2(sine, np.abs(cosine))
    scale = np.where(cosine < 0.0, -1.0, 1.0) * np.divide(
        angle, sine, out=np.full(sine.shape, 2.0), where=sine > 1e-12)
    vectors: FloatArray = scale[..., None] * along
    return vectors


def cross_matrix(a: ArrayLike) -> FloatArray:
    """Cross-product matrices [a]x (..., 3, 3) of vectors (..., 3), with [a]x b = a x b."""
    a = np.asarray(a, dtype=float)
    out = np.zeros(a.shape + (3,))
    out[..., 0, 1], out[..., 0, 2] = -a[..., 2], a[..., 1]
    out[..., 1, 0], out[..., 1, 2] = a[..., 2], -a[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -a[..., 1], a[..., 0]
    return out


def left_jacobian(v: ArrayLike) -> FloatArray:
    """Left Jacobian J (..., 3, 3) of SO(3) at rotation vectors `v` (..., 3) [rad].

    To first order R(v + d) = R(J d) R(v); J is the identity at v = 0. See [Sola18]_, SO(3).
    """
    v = np.asarray(v, dtype=float)
    square = np.einsum('...i,...i->...', v, v)[..., None, None]
    angle = np.sqrt(square)
    K = cross_matrix(v)
    half = np.sinc(0.5 * angle / np.pi)
    # (angle - sin(angle)) / angle^3, by its Taylor series where the subtraction would cancel.
    small = angle < 1e-2
    coefficient = np.where(small, (1.0 - square / 20.0) / 6.0,
                           (1.0 - np.sinc(angle / np.pi)) / np.where(small, 1.0, square))
    J: FloatArray = np.eye(3) + 0.5 * half**2 * K + coefficient * K @ K
    return J


def quaternions_from_yaw(yaw: FloatArray) -> FloatArray:
    """Unit quaternions (n, 4) of rotations about z by `yaw` (n,) [rad]."""
    zero = np.zeros(len(yaw))
    return np.stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=1)


def rotation_about_z(angle: float) -> FloatArray:
    """Matrix (3, 3) of a rotation about z by `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_between(R: FloatArray, other: FloatArray) -> float:
    """Rotation about the world z axis, in [-pi, pi] rad, that brings `R` closest to `other`."""
    M = other @ R.T
    return float(np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Unit quaternion (4,) of a rotation matrix, whose largest component is positive."""
    w2 = np.array([1 + R[0, 0] - R[1, 1] - R[2, 2], 1 - R[0, 0] + R[1, 1] - R[2, 2],
                   1 - R[0, 0] - R[1, 1] + R[2, 2], 1 + R[0, 0] + R[1, 1] + R[2, 2]])
    k = int(np.argmax(w2))
    symmetric = np.array([
        [w2[0], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
        [R[0, 1] + R[1, 0], w2[1], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
        [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], w2[2], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], w2[3]]])
    q: FloatArray = symmetric[k] / np.linalg.norm(symmetric[k])
    return q


def quaternion_between(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Shortest rotation from direction `a` (3,) to direction `b` (3,), as a unit quaternion (4,).

    For opposite directions, the rotation axis is an arbitrary vector perpendicular to `a`.
    """
    u: FloatArray = np.asarray(a, dtype=float) / np.linalg.norm(a)
    v: FloatArray = np.asarray(b, dtype=float) / np.linalg.norm(b)
    w = 1.0 + u @ v
    if w < 1e-12:
        across = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        return np.append(across / np.linalg.norm(across), 0.0)
    q: FloatArray = np.append(np.cross(u, v), w)
    q /= np.linalg.norm(q)
    return q


def speed_of(velocity: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Speed and std (at 0 the largest in any direction) of a velocity (d,), covariance (d, d)."""
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    u = velocity / speed
    return speed, float(np.sqrt(u @ covariance @ u))


def heading_of(velocity: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Heading anticlockwise from x and std [rad], 0 and inf at rest, of a velocity (2,) or (3,)."""
    vx, vy = velocity[:2]
    if vx == vy == 0.0:
        return 0.0, float('inf')
    g = np.array([-vy, vx]) / (vx * vx + vy * vy)
    return float(np.arctan2(vy, vx)), float(np.sqrt(g @ covariance[:2, :2] @ g))


def propagated_path(path: FloatArray, seconds: float) -> FloatArray:
    """Shift the time origin of straight paths (..., n) by `seconds`: position [m] and velocity
    [m/s] at the origin, and n - 6 constant states."""
    propagated: FloatArray = path.copy()
    propagated[..., :3] += seconds * path[..., 3:6]
    return propagated


def overlap(position: FloatArray, velocity: FloatArray, clearance: ArrayLike,
            width: float) -> FloatArray:
    """Length (n,) [m] by which two bodies overlap along the heading of the second, or zero.

    `position` and `velocity` (2, n, 2 or 3) are those of both bodies. From the distance `clearance`
    [m] along the heading, or `width` [m] across it, they do not overlap.
    """
    offset = position[0, :, :2] - position[1, :, :2]
    speed = np.maximum(np.linalg.norm(velocity[1, :, :2], axis=1), 1e-6)
    forward = velocity[1, :, :2] / speed[:, None]
    along = np.abs(np.einsum('ni,ni->n', offset, forward))
    across = np.abs(offset[:, 0] * forward[:, 1] - offset[:, 1] * forward[:, 0])
    return np.where(across < width, np.maximum(clearance - along, 0.0), 0.0)
