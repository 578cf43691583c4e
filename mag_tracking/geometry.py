"""Rotations, quaternions (x, y, z, w; unit), speed and heading."""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray


def rotation_from_quaternion(q: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions xyzw (..., 4).

    Raises ValueError where a norm is further than 1e-3 from one.
    """
    q = np.asarray(q, dtype=float)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(norm - 1.0) <= 1e-3):
        raise ValueError(f'a quaternion needs norm 1, got {np.ravel(norm).tolist()}')
    x, y, z, w = np.moveaxis(q / norm, -1, 0)
    return np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ], -2)


def quaternion_from_rotation_vector(v: ArrayLike) -> FloatArray:
    """Unit quaternions xyzw (..., 4) of rotation vectors (..., 3) [rad]."""
    v = np.asarray(v, dtype=float)
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # sinc keeps the limit at zero: sin(a)/a with a in units of pi.
    return np.concatenate([0.5 * v * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def rotation_vectors_between(q: ArrayLike, other: ArrayLike) -> FloatArray:
    """The shortest rotations about world axes from orientation `q` to others.

    Parameters
    ----------
    q : (4,) unit quaternion xyzw
    other : (..., 4) unit quaternions xyzw

    Returns
    -------
    (..., 3) array, rad
        Of length pi at most.
    """
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
    """Matrices [a]x with [a]x b = a x b; `a` (..., 3) gives (..., 3, 3)."""
    a = np.asarray(a, dtype=float)
    out = np.zeros(a.shape + (3,))
    out[..., 0, 1], out[..., 0, 2] = -a[..., 2], a[..., 1]
    out[..., 1, 0], out[..., 1, 2] = a[..., 2], -a[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -a[..., 1], a[..., 0]
    return out


def left_jacobian(v: ArrayLike) -> FloatArray:
    """How a rotation changes with its rotation vector; `v` (..., 3) [rad] gives (..., 3, 3).

    To first order R(v + d) = R(J d) R(v): a change d of the vector turns what is
    turned already by J d more. Source: Solà, Deray and Atchuthan, A micro Lie
    theory for state estimation in robotics (2018), appendix on SO(3).
    """
    v = np.asarray(v, dtype=float)
    square = np.einsum('...i,...i->...', v, v)[..., None, None]
    angle = np.sqrt(square)
    K = cross_matrix(v)
    half = np.sinc(0.5 * angle / np.pi)
    # (angle - sin(angle)) / angle^3, by its series where the difference would be lost.
    small = angle < 1e-2
    third = np.where(small, (1.0 - square / 20.0) / 6.0,
                     (1.0 - np.sinc(angle / np.pi)) / np.where(small, 1.0, square))
    J: FloatArray = np.eye(3) + 0.5 * half**2 * K + third * K @ K
    return J


def quaternions_from_yaw(yaw: FloatArray) -> FloatArray:
    """Quaternions xyzw (n, 4) of rotations about z by `yaw` (n,) [rad]."""
    zero = np.zeros(len(yaw))
    return np.stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=1)


def rotation_about_z(angle: float) -> FloatArray:
    """Matrix (3, 3) of a rotation about z by `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_between(R: FloatArray, other: FloatArray) -> float:
    """[rad] Rotation about the world's z that takes orientation `R` (3, 3) nearest to `other`."""
    M = other @ R.T
    return float(np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Unit quaternion xyzw (4,) of a rotation matrix (3, 3), by its largest component."""
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
    """The shortest rotation, as quaternion xyzw (4,), that takes direction `a` to `b`.

    `a`, `b` : (3,), any length but zero. Where they are opposite, the turn is
    about any axis across them.
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
    """[m/s] The speed and its deviation, from a velocity (d,) and its covariance (d, d).

    At rest the deviation is the largest of any direction.
    """
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    u = velocity / speed
    return speed, float(np.sqrt(u @ covariance @ u))


def heading_of(velocity: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """[rad] The heading, anticlockwise from x, and its deviation.

    From a velocity (2 or 3,) and its covariance, seen from above. At rest the deviation is
    infinite.
    """
    vx, vy = velocity[:2]
    if vx == vy == 0.0:
        return 0.0, float('inf')
    g = np.array([-vy, vx]) / (vx * vx + vy * vy)
    return float(np.arctan2(vy, vx)), float(np.sqrt(g @ covariance[:2, :2] @ g))


def propagated_path(path: FloatArray, seconds: float) -> FloatArray:
    """Paths (..., 6 or more) of position, velocity and constants, starting `seconds` later."""
    moved: FloatArray = path.copy()
    moved[..., :3] += seconds * path[..., 3:6]
    return moved


def overlap(position: FloatArray, velocity: FloatArray, need: ArrayLike,
            width: float) -> FloatArray:
    """[m] By how much two bodies overlap along the heading of the second; 0 = not at all.

    Parameters
    ----------
    position, velocity : (2, n, 2 or 3) [m], [m/s]
        Of the middles of both.
    need : float or (n,) [m]
        Distance along that heading at which they do not overlap.
    width : float [m]
        Distance across it at which they do not overlap.

    Returns
    -------
    (n,)
    """
    away = position[0, :, :2] - position[1, :, :2]
    size = np.maximum(np.linalg.norm(velocity[1, :, :2], axis=1), 1e-6)
    forward = velocity[1, :, :2] / size[:, None]
    along = np.abs(np.einsum('ni,ni->n', away, forward))
    across = np.abs(away[:, 0] * forward[:, 1] - away[:, 1] * forward[:, 0])
    return np.where(across < width, np.maximum(need - along, 0.0), 0.0)
