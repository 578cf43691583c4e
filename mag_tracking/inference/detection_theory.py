"""Thresholds and probabilities of the chi-square energy test."""

from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, chndtr

from mag_tracking.arrays import FloatArray, IntArray


def energy_threshold(false_alarm_probability: float | FloatArray,
                     degrees_of_freedom: float | IntArray) -> FloatArray:
    """Threshold of the energy test for a given false-alarm probability.

    Parameters
    ----------
    false_alarm_probability : float or array
        P(chi2_n > threshold) without a target.
    degrees_of_freedom : float or array
        Number n of measured axes.

    Returns
    -------
    float or (...) array

    References
    ----------
    [T10]_ eq. (5.18).
    """
    return cast(FloatArray, chdtri(degrees_of_freedom, false_alarm_probability))


def false_alarm_probability(threshold: float | FloatArray,
                            degrees_of_freedom: int | IntArray) -> FloatArray:
    """False-alarm probability of the energy test, P(chi2_n > threshold).

    Parameters
    ----------
    threshold : float or array
    degrees_of_freedom : int or array
        Number n of measured axes.

    Returns
    -------
    float or (...) array
        Inverse of `energy_threshold`.
    """
    return cast(FloatArray, chdtrc(degrees_of_freedom, threshold))


def detection_probability(snr: float | FloatArray, threshold: float | FloatArray,
                          degrees_of_freedom: int | IntArray) -> FloatArray:
    """Detection probability of the energy test, P(chi2_n(snr) > threshold).

    Parameters
    ----------
    snr : float or array
        Signal-to-noise ratio, the non-centrality parameter.
    threshold : float or array
    degrees_of_freedom : int or array
        Number n of measured axes.

    Returns
    -------
    float or (...) array

    References
    ----------
    [T10]_ eq. (5.19).
    """
    return cast(FloatArray, 1.0 - chndtr(threshold, degrees_of_freedom, snr))


def missed_detection_probability(probability: ArrayLike, run: int) -> FloatArray:
    """Probability that a pass contains no `run` consecutive detections.

    Parameters
    ----------
    probability : (n, ...) array
        Detection probability of each frame, chronological; frames are assumed independent.
    run : int
        Number of consecutive frames required for an onset.

    Returns
    -------
    (...) array
        Exact: computed from the distribution of the current number of consecutive detections.
    """
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
