"""Trajectories in the format of the TUM RGB-D benchmark, which evo and others read."""

from collections.abc import Sequence
from os import PathLike

from mag_tracking.arrays import FloatArray
from mag_tracking.files import replace_text


def write_tum(path: str | PathLike[str], stamp_ns: Sequence[int], position: Sequence[FloatArray],
              orientation: Sequence[FloatArray]) -> None:
    """Write poses as lines of `time x y z qx qy qz qw`, in seconds and metres.

    Parameters
    ----------
    path : path
    stamp_ns : (n,) sequence of int
    position : (n,) sequence of (3,) arrays, m
    orientation : (n,) sequence of (4,) arrays
        Quaternions xyzw.

    Raises OutputError.
    """
    lines = []
    for stamp, p, q in zip(stamp_ns, position, orientation, strict=True):
        # In full: as a float a time of today has a resolution of 0.2 us only.
        seconds = f'{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}'
        lines.append(' '.join([seconds, *(f'{float(v):.9g}' for v in (*p, *q))]))
    replace_text(path, '\n'.join(lines) + '\n')
