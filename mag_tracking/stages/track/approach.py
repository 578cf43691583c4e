"""Approach test: whether a field grows like the field of a target that approaches from afar."""

import numpy as np

from mag_tracking.calibration.level_change import growth_of
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS

SENSED_LEVEL = 2.5
"""RMS of the whitened field above which the target counts as sensed."""

GROWTH_RATIO = 10.0
"""Ratio of the highest to the lowest field level in the test; the lowest level is
`SENSED_LEVEL`."""

MIN_LOG2_RATIO = -0.25
"""Minimum log2 ratio of the durations of the first and the second half of the growth. The
theoretical value is 0.55 for a target that approaches at constant speed, and -0.83 for a target
that starts from rest next to a sensor. The value of a sudden jump of the field is near 0."""

FALL_FRACTION = 0.85
"""If the field falls below this fraction of its previous maximum while the target is sensed, the
target has passed its first sensor, and the test passes."""

LEVEL_TIME_STD = 0.5
"""Uncertainty of the time at which the field reached a level, in frame periods."""

MAX_FRAMES = 1000
"""The test is skipped if the field has not grown by `GROWTH_RATIO` within this number of frames."""


class Approach:
    """Approach test on the first frames of a track, until the field has grown by `GROWTH_RATIO`."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._levels: list[float] = []
        self._is_open = True

    def add(self, frame: FieldFrame) -> bool:
        """Add a frame, and return whether it completes the test and the test fails."""
        if not self._is_open:
            return False
        self._times.append(frame.stamp_ns / NS)
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        # The RMS of pure noise is 1; smaller values carry no information.
        self._levels.append(float(np.sqrt(max(energy.sum() / max(n_axes.sum(), 1), 1.0))))
        self._is_open = self._levels[-1] <= GROWTH_RATIO * SENSED_LEVEL \
            and len(self._levels) < MAX_FRAMES
        return not self._is_open and self._is_doubtful()

    def _is_doubtful(self) -> bool:
        """Whether the field grows unlike the field of a target that approaches from afar."""
        time, levels = np.array(self._times), np.array(self._levels)
        growth = growth_of(time, levels, SENSED_LEVEL, GROWTH_RATIO * SENSED_LEVEL)
        # If the field falls before it reaches the highest level, the target has passed its first
        # sensor.
        is_falling = levels < FALL_FRACTION * np.maximum.accumulate(levels)
        if growth is None or (is_falling & (levels > SENSED_LEVEL)).any():
            return False
        std = LEVEL_TIME_STD * float(np.median(np.diff(time)))
        return bool(np.log2((growth.early + std) / (growth.late + std)) < MIN_LOG2_RATIO)
