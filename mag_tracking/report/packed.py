"""Encoding of arrays as base64 in JSON, in a third of the space of decimal numbers."""

import base64

import numpy as np
from numpy.typing import ArrayLike

Packed = dict[str, str]
"""Maps the type of the numbers to little-endian base64, which `scene.js` decodes."""


def packed(values: ArrayLike, kind: str = 'f8') -> Packed:
    """Encode an array (n,) as JSON object; `kind` is 'f8', 'f4' or 'u1'.

    'f4' is sufficient for values that are only plotted.
    """
    raw = np.ascontiguousarray(values, dtype=f'<{kind}').tobytes()
    return {kind: base64.b64encode(raw).decode('ascii')}
