"""Thresholds and probabilities of the chi-square energy test.

Source: T10 section 5.4, eq. (5.14)-(5.19).
"""

import numpy as np
from scipy.special import chdtrc, chdtri, chndtr


def energy_threshold(false_alarm_probability, degrees_of_freedom):
    """Threshold h with P(chi2_n > h) = `false_alarm_probability`; T10 eq. (5.18)."""
    return chdtri(degrees_of_freedom, false_alarm_probability)


def false_alarm_probability(threshold, degrees_of_freedom):
    """P(chi2_n > threshold), the inverse of `energy_threshold`."""
    return chdtrc(degrees_of_freedom, threshold)


def detection_probability(snr, threshold, degrees_of_freedom):
    """P(chi2_n(snr) > threshold) with non-centrality `snr`; T10 eq. (5.19)."""
    return 1.0 - chndtr(threshold, degrees_of_freedom, snr)


def missed_probability(probability, run):
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
    return waiting.sum(axis=0)
