"""Type aliases for arrays. Shapes and units are given where the aliases are used."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StructArray: TypeAlias = NDArray[np.void]
"""Structured array: one record per element."""
Record: TypeAlias = Any
"""One element of a structured array."""


def are_equal(a: FloatArray | None, b: FloatArray | None) -> bool:
    """Whether two optional arrays are equal; None equals only None."""
    return a is b if a is None or b is None else np.array_equal(a, b)
