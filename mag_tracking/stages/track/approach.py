"""Whether a target came from afar, by how its field grew."""

import numpy as np

from mag_tracking.calibration.growth import growth_of
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS

FELT = 2.5
"""Root mean square of the whitened field where it is first felt."""

LOUD = 10.0
"""The growth from there to so many times as much is looked at."""

LEAST = -0.25
"""Binary logarithm of the ratio of both halves of the growth. 0.55 by theory where the distance
falls evenly, -0.83 where a target starts from rest beside a sensor, less where the field jumps."""

STEADY = 0.85
"""It does not grow steadily where it falls to this share of what it was."""

HALF_FRAME = 0.5
"""It is not known when within a frame a size was reached."""

MAX_FRAMES = 1000
"""A target that is not loud by then is not judged."""


class Approach:
    """The first frames of a track, until its field is loud."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._sizes: list[float] = []
        self._is_open = True

    def add(self, frame: FieldFrame) -> bool:
        """Whether the field has grown, with this frame, unlike that of a target from afar."""
        if not self._is_open:
            return False
        self._times.append(frame.stamp_ns / NS)
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        # A frame that is quieter than its noise is not quieter than that.
        self._sizes.append(float(np.sqrt(max(energy.sum() / max(n_axes.sum(), 1), 1.0))))
        self._is_open = self._sizes[-1] <= LOUD * FELT and len(self._sizes) < MAX_FRAMES
        return not self._is_open and self._is_doubtful()

    def _is_doubtful(self) -> bool:
        """Whether the frames tell that the target did not come from afar."""
        time, sizes = np.array(self._times), np.array(self._sizes)
        growth = growth_of(time, sizes, FELT, LOUD * FELT)
        # What falls meanwhile is of a target that has passed a first sensor.
        falls = sizes < STEADY * np.maximum.accumulate(sizes)
        if growth is None or (falls & (sizes > FELT)).any():
            return False
        half = HALF_FRAME * float(np.median(np.diff(time)))
        return bool(np.log2((growth.early + half) / (growth.late + half)) < LEAST)
