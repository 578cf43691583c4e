"""Compiled functions for axes with coarse resolution."""

from mag_tracking.arrays import FloatArray

def learn(field: FloatArray, memory: float, n: FloatArray, square: FloatArray) -> None:
    """Update the mean squares `square` [T²] of at most `memory` values, and their numbers `n`, all
    (n_sensors, 3), with the field of a frame [T]; missing axes (NaN) are skipped."""

def scaled(covariance: FloatArray, n: FloatArray, square: FloatArray, least: float, factor: float,
           most: float, allowance: float) -> FloatArray:
    """Covariances (n_sensors, 3, 3) [T²] with the variances of axes at rest reduced by the factor
    `most`, and with `allowance` [T²] added to the variance of every axis.

    An axis is at rest if it has at least `least` values and its mean square times `factor` is
    smaller than its variance.
    """
