"""Rotations and quaternions; quaternions are (x, y, z, w) and unit."""

import numpy as np


def rotation_from_quaternion(q):
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


def quaternion_from_rotation_vector(v):
    """Unit quaternions xyzw (..., 4) of rotation vectors (..., 3) [rad]."""
    v = np.asarray(v, dtype=float)
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # sinc keeps the limit at zero: sin(a)/a with a in units of pi.
    return np.concatenate([0.5 * v * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def quaternion_from_yaw(yaw):
    """Quaternion xyzw (4,) of a rotation about z by `yaw` [rad]."""
    return np.array([0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])


def quaternion_between(a, b):
    """The shortest rotation, as quaternion xyzw (4,), that takes direction `a` to `b`.

    `a`, `b` : (3,), any length but zero. Where they are opposite, the turn is
    about any axis across them.
    """
    a = np.asarray(a, dtype=float) / np.linalg.norm(a)
    b = np.asarray(b, dtype=float) / np.linalg.norm(b)
    w = 1.0 + a @ b
    if w < 1e-12:
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return np.append(across / np.linalg.norm(across), 0.0)
    q = np.append(np.cross(a, b), w)
    return q / np.linalg.norm(q)
