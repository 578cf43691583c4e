"""Thresholds and probabilities of the chi-square energy test.

Source: T10 section 5.4, eq. (5.14)-(5.19).
"""

from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, chndtr

from mag_tracking.arrays import FloatArray, IntArray


def energy_threshold(false_alarm_probability: float | FloatArray,
                     degrees_of_freedom: float | IntArray) -> FloatArray:
    """Threshold h with P(chi2_n > h) = `false_alarm_probability`; T10 eq. (5.18)."""
    return cast(FloatArray, chdtri(degrees_of_freedom, false_alarm_probability))


def false_alarm_probability(threshold: float | FloatArray,
                            degrees_of_freedom: int | IntArray) -> FloatArray:
    """P(chi2_n > threshold), the inverse of `energy_threshold`."""
    return cast(FloatArray, chdtrc(degrees_of_freedom, threshold))


def detection_probability(snr: float | FloatArray, threshold: float | FloatArray,
                          degrees_of_freedom: int | IntArray) -> FloatArray:
    """P(chi2_n(snr) > threshold) with non-centrality `snr`; T10 eq. (5.19)."""
    return cast(FloatArray, 1.0 - chndtr(threshold, degrees_of_freedom, snr))


def missed_detection_probability(probability: ArrayLike, run: int) -> FloatArray:
    """Probability that no `run` frames in a row detect.

    Parameters
    ----------
    probability : (n, ...)
        Of each frame's detection, in order of time; the frames are independent.
    run : int

    Returns (...): exact, by the distribution of how many frames in a row have detected so far.
    """
    p = np.asarray(probability, dtype=float)
    waiting = np.zeros((run, *p.shape[1:]))
    waiting[0] = 1.0
    for detected in p:
        # One more in a row, or none; the last one leaves: the target has been detected.
        waiting = np.concatenate([((1.0 - detected) * waiting.sum(axis=0))[None],
                                  detected * waiting[:-1]])
    missed: FloatArray = waiting.sum(axis=0)
    return missed
