"""Types of arrays, and of compiled functions on them; shapes and units stand in docstrings."""

from typing import Any, Literal, TypeAlias, TypedDict

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StructArray: TypeAlias = NDArray[np.void]
"""A structured array: one record an element."""
Record: TypeAlias = Any
"""One element of a structured array. In compiled code its fields are attributes; NumPy's types know
of no such."""


class CompileOptions(TypedDict, total=False):
    """Options of `numba.njit` that a module's kernels share."""

    cache: bool
    error_model: Literal['numpy']
    fastmath: set[str]
    forceinline: bool
