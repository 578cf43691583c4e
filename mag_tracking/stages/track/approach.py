"""Whether a target came from afar, by how its field grew."""

import numpy as np

from mag_tracking.calibration.growth import time_to_grow
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.records import FieldFrame

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


class Approach:
    """The first frames of a track, until its field is loud."""

    def __init__(self) -> None:
        self._sizes: list[float] = []
        self._is_open = True

    def add(self, frame: FieldFrame) -> bool:
        """Whether the field has grown, with this frame, as that of nothing that comes from afar."""
        if not self._is_open:
            return False
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        # A frame that is quieter than its noise is not quieter than that.
        self._sizes.append(float(np.sqrt(max(energy.sum() / max(n_axes.sum(), 1), 1.0))))
        if self._sizes[-1] <= LOUD * FELT:
            return False
        self._is_open = False
        sizes = np.array(self._sizes)
        times = time_to_grow(sizes, FELT, LOUD * FELT)
        # What falls meanwhile is of a target that has passed a first sensor.
        falls = sizes < STEADY * np.maximum.accumulate(sizes)
        if times is None or (falls & (sizes > FELT)).any():
            return False
        early, late = times
        return bool(np.log2((early + HALF_FRAME) / (late + HALF_FRAME)) < LEAST)
