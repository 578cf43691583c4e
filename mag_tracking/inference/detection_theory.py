"""Thresholds and probabilities of the chi-square energy test."""

from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, chndtr

from mag_tracking.arrays import FloatArray, IntArray


def energy_threshold(false_alarm_probability: float | FloatArray,
                     degrees_of_freedom: float | IntArray) -> FloatArray:
    """Threshold that chi-square noise exceeds with the false-alarm probability, T10 eq. (5.18)."""
    return cast(FloatArray, chdtri(degrees_of_freedom, false_alarm_probability))


def false_alarm_probability(threshold: float | FloatArray,
                            degrees_of_freedom: int | IntArray) -> FloatArray:
    """Probability P(chi2_n > threshold) without a target, the inverse of `energy_threshold`."""
    return cast(FloatArray, chdtrc(degrees_of_freedom, threshold))


def detection_probability(snr: float | FloatArray, threshold: float | FloatArray,
                          degrees_of_freedom: int | IntArray) -> FloatArray:
    """Probability P(chi2_n(snr) > threshold); `snr` is the non-centrality, T10 eq. (5.19)."""
    return cast(FloatArray, 1.0 - chndtr(threshold, degrees_of_freedom, snr))


def missed_detection_probability(probability: ArrayLike, run: int) -> FloatArray:
    """Exact probability that a pass contains no `run` consecutive detections, whose independent
    probabilities in each frame are `probability` (n, ...)."""
    p = np.asarray(probability, dtype=float)
    run_probability = np.zeros((run, *p.shape[1:]))
    run_probability[0] = 1.0
    for detected in p:
        # The count of consecutive detections grows by one or restarts at zero. The probability
        # that leaves the last entry is the probability of an onset.
        run_probability = np.concatenate([((1.0 - detected) * run_probability.sum(axis=0))[None],
                                          detected * run_probability[:-1]])
    missed: FloatArray = run_probability.sum(axis=0)
    return missed
