"""Directions: how evenly a sensor was turned through them, and what each reading weighs then."""

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from mag_tracking.arrays import FloatArray, IntArray

EMPTY_OCTANT = 0.125
"""An octant with less weight than this share of the mean counts as empty."""

N_CELLS = 500
"""Directions are counted in so many equal cells, about 10 degrees across ..."""

CROWDED = 3.0
"""... and readings in a cell with so many times the median number share the weight of that many."""

_OCTANTS = np.array(list(product([1.0, -1.0], repeat=3)))


def _cells() -> cKDTree:
    """Tree of N_CELLS unit vectors, evenly spread: a Fibonacci spiral."""
    i = np.arange(N_CELLS) + 0.5
    z, angle = 1.0 - 2.0 * i / N_CELLS, np.pi * (1.0 + np.sqrt(5.0)) * i
    rho = np.sqrt(1.0 - z * z)
    return cKDTree(np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1))


_CELLS = _cells()


def _octant_name(signs: FloatArray) -> str:
    """Such as '+x-y+z'."""
    return ''.join(('-' if sign < 0.0 else '+') + axis
                   for sign, axis in zip(signs, 'xyz', strict=True))


def counted(q: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Unit vectors (n, 3) of `q`, their cells (n,), and how many there are in each cell."""
    u = q / np.maximum(np.linalg.norm(q, axis=1), 1e-12)[:, None]
    cell = np.asarray(_CELLS.query(u)[1], dtype=np.int64)
    return u, cell, np.asarray(np.bincount(cell, minlength=N_CELLS), dtype=np.int64)


def even_weights(q: FloatArray) -> FloatArray:
    """(n,) 0 to 1 of `q` (n, 3): a crowded cell weighs at most CROWDED times the median one."""
    _, cell, n = counted(q)
    return np.minimum(1.0, CROWDED * np.median(n[n > 0]) / n[cell])


def coverage(u: FloatArray, w: FloatArray) -> float:
    """Smallest eigenvalue of the weighted mean of f f^T, f the harmonics to degree two at `u`."""
    x, y, z = u.T
    s = np.sqrt(15.0)
    f = np.column_stack([np.ones(len(u)), np.sqrt(3.0) * u, s * x * y, s * y * z, s * x * z,
                         0.5 * s * (x * x - y * y), 0.5 * np.sqrt(5.0) * (3.0 * z * z - 1.0)])
    # Rounding can make a zero negative.
    return max(0.0, float(np.linalg.eigvalsh(f.T @ (w[:, None] * f) / w.sum())[0]))


def empty_octants(u: FloatArray, w: FloatArray) -> tuple[str, ...]:
    """Names of the octants with hardly a reading among directions `u` (n, 3) of weights `w`."""
    share = 8.0 * np.bincount(np.argmax(u @ _OCTANTS.T, axis=1), w, 8) / w.sum()
    return tuple(_octant_name(signs) for signs in _OCTANTS[share < EMPTY_OCTANT])
