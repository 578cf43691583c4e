"""Types of arrays; shapes and units stand in docstrings."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StructArray: TypeAlias = NDArray[np.void]
"""A structured array: one record an element."""
Record: TypeAlias = Any
"""One element of a structured array."""
