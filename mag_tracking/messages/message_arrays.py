"""Many messages of one type at once, from their CDR bytes.

A message of a header and numbers has a fixed size but for the name of its frame, so that many can
be read as arrays, twenty times faster than one by one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.messages.schema import known_covariances

_HEAD = np.dtype([('encapsulation', 'u1', 4), ('sec', '<i4'), ('nanosec', '<u4'),
                  ('length', '<u4')])
"""Before the name of the frame, whose `length` counts the zero at its end."""
_FIELD_DOUBLES = 12
"""x, y, z and the covariance."""
_POSE_DOUBLES = 7
"""x, y, z and the quaternion."""


class FieldArrays(NamedTuple):
    """The contents of magnetic fields as arrays."""

    is_read: BoolArray
    """(n,) False: the message is unusual or damaged, and left to a decoder. Its elements of the
    other arrays are meaningless."""
    stamp_ns: IntArray
    """(n,)"""
    field: FloatArray
    """(n, 3) [T]"""
    covariance: FloatArray | None
    """(n, 3, 3) [T^2] as in `Readings`."""


class PoseArrays(NamedTuple):
    """The contents of poses as arrays."""

    is_read: BoolArray
    """(n,) False: the message is of another frame, unusual or damaged, and left to a decoder. Its
    elements of the other arrays are meaningless."""
    stamp_ns: IntArray
    """(n,)"""
    pose: FloatArray
    """(n, 7) position [m] and quaternion xyzw."""


def magnetic_fields(content: bytes, begins: IntArray, ends: IntArray) -> FieldArrays:
    """Read the CDR bytes of sensor_msgs/MagneticField, which begin and end there in `content`."""
    stamped = _Stamped(content, begins, ends, _FIELD_DOUBLES)
    rows = np.flatnonzero(stamped.is_read)
    stamped.is_read[rows] = stamped.have_plain_frames(rows)
    numbers = stamped.numbers()
    return FieldArrays(stamped.is_read, stamped.stamp_ns, numbers[:, :3].copy(),
                       known_covariances(numbers[:, 3:].reshape(-1, 3, 3)))


def poses(content: bytes, begins: IntArray, ends: IntArray, frame: str) -> PoseArrays:
    """Read the CDR bytes of geometry_msgs/PoseStamped in a `frame`, which begin and end there in
    `content`."""
    stamped = _Stamped(content, begins, ends, _POSE_DOUBLES)
    rows = np.flatnonzero(stamped.is_read)
    stamped.is_read[rows] = stamped.have_frame(rows, frame)
    return PoseArrays(stamped.is_read, stamped.stamp_ns, stamped.numbers())


class _Stamped:
    """Messages of a header and numbers of eight bytes.

    Attributes
    ----------
    is_read : (n,) bool
        Neither cut off nor of another encapsulation than little-endian CDR.
    stamp_ns : (n,)
    """

    def __init__(self, content: bytes, begins: IntArray, ends: IntArray, n_doubles: int) -> None:
        self._data: NDArray[np.uint8] = np.frombuffer(content, np.uint8)
        self._begins, self._n_doubles = begins, n_doubles
        # Of a message that is cut off the head may lie beyond the end.
        head = self._data.take(begins[:, None] + np.arange(_HEAD.itemsize), mode='clip'
                               ).view(_HEAD)[:, 0] \
            if len(self._data) else np.zeros(len(begins), dtype=_HEAD)
        self._length = head['length'].astype(np.int64)
        # Numbers of eight bytes are aligned from behind the encapsulation on.
        self._first = (_HEAD.itemsize - 4 + self._length + 7) // 8 * 8 + 4
        self.is_read: BoolArray = (ends - begins >= self._first + 8 * n_doubles) \
            & (self._length > 0) \
            & (head['encapsulation'][:, 0] == 0) & (head['encapsulation'][:, 1] == 1)
        self.stamp_ns: IntArray = head['sec'].astype(np.int64) * 1_000_000_000 + head['nanosec']

    def _frames(self, rows: IntArray, length: int) -> NDArray[np.uint8]:
        """(k, length) the names of the frames of `rows` (k,), which have that length."""
        return self._data[(self._begins[rows] + _HEAD.itemsize)[:, None] + np.arange(length)]

    def have_plain_frames(self, rows: IntArray) -> BoolArray:
        """(k,) whether the names of the frames of `rows` (k,) are ASCII that ends with a zero."""
        out = np.zeros(len(rows), dtype=bool)
        for length in np.unique(self._length[rows]):
            same = np.flatnonzero(self._length[rows] == length)
            text = self._frames(rows[same], length)
            out[same] = (text[:, -1] == 0) & (text < 128).all(axis=1)
        return out

    def have_frame(self, rows: IntArray, frame: str) -> BoolArray:
        """(k,) whether the messages of `rows` (k,) name this frame."""
        name = np.frombuffer(frame.encode() + b'\0', np.uint8)
        out: BoolArray = self._length[rows] == len(name)
        out[out] = (self._frames(rows[out], len(name)) == name).all(axis=1)
        return out

    def numbers(self) -> FloatArray:
        """(n, n_doubles) those of the messages that are read; 0 of the others."""
        out = np.zeros((len(self._begins), self._n_doubles))
        rows = np.flatnonzero(self.is_read)
        if len(rows):
            at = (self._begins + self._first)[rows, None] + np.arange(8 * self._n_doubles)
            out[rows] = self._data[at].view('<f8')
        return out
