"""Trajectories in the format of the TUM RGB-D benchmark, which evo and other tools read."""

from collections.abc import Sequence
from os import PathLike

from mag_tracking.arrays import FloatArray
from mag_tracking.files import replace_text


def write_tum(path: str | PathLike[str], stamp_ns: Sequence[int], position: Sequence[FloatArray],
              orientation: Sequence[FloatArray]) -> None:
    """Write poses as lines of `time x y z qx qy qz qw`, in s and m; orientations are xyzw."""
    lines = []
    for stamp, p, q in zip(stamp_ns, position, orientation, strict=True):
        # Formatted from integers: a float has a resolution of only 0.2 us for times since 1970.
        seconds = f'{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}'
        lines.append(' '.join([seconds, *(f'{float(v):.9g}' for v in (*p, *q))]))
    replace_text(path, '\n'.join(lines) + '\n')
