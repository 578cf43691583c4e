"""Coverage of the sphere by the readings of a tumbled sensor, and weights by direction."""

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from mag_tracking.arrays import FloatArray, IntArray

EMPTY_OCTANT = 0.125
"""Maximum weight of an empty octant relative to the mean weight of an octant."""

N_CELLS = 500
"""Number of equal cells on the sphere of directions, about 10 degrees wide."""

MAX_CELL_WEIGHT = 3.0
"""Maximum total weight of a cell, in multiples of the median number of readings per cell."""

_OCTANTS = np.array(list(product([1.0, -1.0], repeat=3)))


def _cells() -> cKDTree:
    """Build a k-d tree of N_CELLS evenly spread unit vectors (a Fibonacci spiral)."""
    i = np.arange(N_CELLS) + 0.5
    z, angle = 1.0 - 2.0 * i / N_CELLS, np.pi * (1.0 + np.sqrt(5.0)) * i
    rho = np.sqrt(1.0 - z * z)
    return cKDTree(np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1))


_CELLS = _cells()


def _octant_name(signs: FloatArray) -> str:
    """Name of an octant, e.g. '+x-y+z'."""
    return ''.join(('-' if sign < 0.0 else '+') + axis
                   for sign, axis in zip(signs, 'xyz', strict=True))


def binned(q: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Unit vectors of `q` (n, 3), the cell of each (n,), and the count of each cell (N_CELLS,)."""
    u = q / np.maximum(np.linalg.norm(q, axis=1), 1e-12)[:, None]
    cell = np.asarray(_CELLS.query(u)[1], dtype=np.int64)
    return u, cell, np.asarray(np.bincount(cell, minlength=N_CELLS), dtype=np.int64)


def even_weights(q: FloatArray) -> FloatArray:
    """Weights (n,), 0 to 1, that limit the influence of crowded directions of `q` (n, 3).

    The total weight of a cell is at most `MAX_CELL_WEIGHT` times the median number of directions in
    the cells that are not empty.
    """
    _, cell, n = binned(q)
    return np.minimum(1.0, MAX_CELL_WEIGHT * np.median(n[n > 0]) / n[cell])


def coverage(u: FloatArray, w: FloatArray) -> float:
    """Coverage of the sphere by unit vectors (n, 3) with weights (n,): 0 to 1, 1 if even.

    It is the smallest eigenvalue of the weighted mean of f fᵀ, with the spherical harmonics f to
    degree two.
    """
    x, y, z = u.T
    s = np.sqrt(15.0)
    f = np.column_stack([np.ones(len(u)), np.sqrt(3.0) * u, s * x * y, s * y * z, s * x * z,
                         0.5 * s * (x * x - y * y), 0.5 * np.sqrt(5.0) * (3.0 * z * z - 1.0)])
    # Rounding can make a zero negative.
    return max(0.0, float(np.linalg.eigvalsh(f.T @ (w[:, None] * f) / w.sum())[0]))


def empty_octants(u: FloatArray, w: FloatArray) -> tuple[str, ...]:
    """Octants, e.g. '+x-y+z', whose weight is below `EMPTY_OCTANT` of the mean weight."""
    weight = 8.0 * np.bincount(np.argmax(u @ _OCTANTS.T, axis=1), w, 8) / w.sum()
    return tuple(_octant_name(signs) for signs in _OCTANTS[weight < EMPTY_OCTANT])
