"""Axes whose steps are larger than their noise, compiled."""

from mag_tracking.arrays import FloatArray

def learn(field: FloatArray, memory: float, n: FloatArray, square: FloatArray) -> None:
    """Update the mean squares (n_sensors, 3), each of n values, by `field` (n_sensors, 3).

    More than `memory` values are not counted; a missing axis (NaN) changes nothing.
    """

def scaled(covariance: FloatArray, n: FloatArray, square: FloatArray, least: float, factor: float,
           most: float, allowance: float) -> FloatArray:
    """`covariance` (n_sensors, 3, 3) with smaller variances where an axis rests.

    It does where `square`, of at least `least` values, is smaller than its variance by `factor`:
    that is `most` times smaller then. To all variances `allowance` is added.
    """
