"""Detect: chi-square energy test on the whitened frames of all sensors ([T10], section 5.4)."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Detection, FieldFrame, plain
from mag_tracking.stages.detect import core
from mag_tracking.stages.settings import DetectSettings
from mag_tracking.stages.stage import Stage
from mag_tracking.units import NS

MEMORY_FRAMES = 100
"""Approximate number of frames without a target over which the square of each axis is averaged."""
RESTING_RATIO = 25.0
"""Minimum ratio of the nominal to the measured variance of an axis at rest."""
VARIANCE_REDUCTION = 20.0
"""Factor by which the variance of an axis at rest is reduced: the quantisation error of one step is
no noise of an axis that does not change without a target. In a network of two sensors, a single
step of one axis, which background drift can cause, remains below the threshold."""
RELEASE_PROBABILITY = 1e-2
"""Minimum probability that noise exceeds the threshold below which a frame is quiet."""
RECOVERY_S = 5.0
"""[s] Approximate time in which the calibration learns the background again after a target."""


@cache
def threshold(probability: float, degrees_of_freedom: int) -> float:
    """Energy threshold of the measured axes that noise exceeds with `probability`."""
    return float(energy_threshold(probability, degrees_of_freedom))


class Detect(Stage[FieldFrame, FieldFrame | Detection]):
    """Decides for each frame whether a target is present, by T10 eq. (5.14)-(5.19)."""

    def __init__(self, network: SensorNetwork, settings: DetectSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._names, self.settings = network.names, settings
        self._next_id = 1
        self._max_ratio, self._max_ratios = 0.0, np.zeros(len(network))
        # Thresholds for a single sensor, by its number of axes.
        self._single_thresholds = np.array([np.inf, *(
            threshold(settings.false_alarm_probability, k) for k in (1, 2, 3))])
        self.max_consecutive_above = 0
        # Number of frames without a target, and mean square of the field in them, for each axis.
        self._n_quiet: FloatArray = np.zeros((len(network), 3))
        self._mean_square: FloatArray = np.zeros((len(network), 3))
        self._reset()

    def _reset(self) -> None:
        """Reset to the state without a detection."""
        self._present, self._n_above, self._frozen_s = False, 0, 0.0
        self._last_ns: int | None = None
        self._last_active_ns: int | None = None
        self._onset_ns: int | None = None

    def feed(self, frame: FieldFrame) -> list[FieldFrame | Detection]:
        """Test a frame: return an onset or release, if any, and the frame with its detection flag,
        unless its covariance is invalid."""
        out: list[FieldFrame | Detection] = []
        if self._last_ns is not None and frame.stamp_ns <= self._last_ns:
            self.counts['time jumped back'] += 1
            out += self._release(self._last_ns, float('nan'), 0, '')
            self._reset()
        self._last_ns = frame.stamp_ns
        try:
            energy, axes = whitened_energy(frame.field, core.scaled(
                plain(frame.covariance), self._n_quiet, self._mean_square, MEMORY_FRAMES / 4,
                RESTING_RATIO, VARIANCE_REDUCTION, self._background_variance(frame.stamp_ns)))
        except np.linalg.LinAlgError:
            self.counts['rejected: frame with a covariance that is not positive definite'] += 1
            return out
        statistic, n = float(energy.sum()), int(axes.sum())
        self.counts['frames'] += 1
        if n:
            if not self._present:
                self._max_ratio = max(self._max_ratio, statistic / threshold(
                    self.settings.false_alarm_probability, n))
                np.maximum(self._max_ratios, energy / self._single_thresholds[axes],
                           out=self._max_ratios)
            out += self._update_presence(frame.stamp_ns, statistic, n, energy / np.maximum(axes, 1))
        else:
            self.counts['frames without a measurement'] += 1
        if not self._present and not self._n_above:
            core.learn(plain(frame.field), MEMORY_FRAMES, self._n_quiet, self._mean_square)
        return [*out, replace(frame, target_present=self._present, statistic=statistic,
                              degrees_of_freedom=n)]

    @property
    def largest_excursion(self) -> float:
        """Square root of the largest ratio of energy to threshold in frames without a detection."""
        return float(np.sqrt(self._max_ratio))

    def largest_excursions(self) -> FloatArray:
        """As `largest_excursion`, with the energy and the threshold of each sensor alone."""
        return np.sqrt(self._max_ratios)

    def _background_variance(self, stamp_ns: int) -> float:
        """Update the time since the background was frozen; return the background variance [T²]."""
        if self._present and self._onset_ns is not None:
            self._frozen_s = (stamp_ns - self._onset_ns) / NS
        elif self._last_active_ns is not None and stamp_ns - self._last_active_ns > RECOVERY_S * NS:
            self._frozen_s = 0.0
        s = self.settings
        return (s.background_std + s.background_drift * self._frozen_s) ** 2

    def _update_presence(self, stamp_ns: int, statistic: float, n: int,
                         per_axis: FloatArray) -> list[Detection]:
        """Update the detection state, and return the onset or release, if there is one."""
        s = self.settings
        if statistic > threshold(s.false_alarm_probability, n):
            self.counts['frames above the threshold'] += 1
            self._n_above += 1
            self.max_consecutive_above = max(self.max_consecutive_above, self._n_above)
        else:
            self._n_above = 0
        if statistic > threshold(max(RELEASE_PROBABILITY, s.false_alarm_probability), n):
            self._last_active_ns = stamp_ns
        if not self._present and self._n_above >= s.onset_frames:
            self._present, self._last_active_ns = True, stamp_ns
            # If the background has not been learnt since the previous target, its uncertainty
            # continues to grow.
            self._onset_ns = stamp_ns - int(self._frozen_s * NS)
            self.counts['onsets'] += 1
            return [self._detection(stamp_ns, True, statistic, n, self._strongest(per_axis))]
        if self._present and self._last_active_ns is not None \
                and stamp_ns - self._last_active_ns > s.hold_s * NS:
            return self._release(stamp_ns, statistic, n, self._strongest(per_axis))
        return []

    def _strongest(self, per_axis: FloatArray) -> str:
        """Name of the sensor with the largest energy per axis, `per_axis` (n_sensors,)."""
        return self._names[int(per_axis.argmax())]

    def _release(self, stamp_ns: int, statistic: float, n: int, strongest: str) -> list[Detection]:
        """End the detection, if there is one, and return its release."""
        if not self._present:
            return []
        self._present = False
        detection = self._detection(stamp_ns, False, statistic, n, strongest)
        self._next_id += 1
        return [detection]

    def _detection(self, stamp_ns: int, onset: bool, statistic: float, n: int,
                   strongest: str) -> Detection:
        """Create the onset or release record of the current detection."""
        p = self.settings.false_alarm_probability
        return Detection(stamp_ns, self._next_id, onset, statistic, n,
                         threshold(p, n) if n else float('nan'), p, strongest)
