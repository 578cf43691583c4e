"""Compiled functions for axes with coarse resolution."""

from mag_tracking.arrays import FloatArray

def learn(field: FloatArray, memory: float, n: FloatArray, square: FloatArray) -> None:
    """Update the mean squares of the axes with a frame; missing axes (NaN) are skipped.

    Parameters
    ----------
    field : (n_sensors, 3) array, T
    memory : float
        Maximum number of values in the average.
    n : (n_sensors, 3) array
        Number of values of each axis; updated in place.
    square : (n_sensors, 3) array, T^2
        Mean squares; updated in place.
    """

def scaled(covariance: FloatArray, n: FloatArray, square: FloatArray, least: float, factor: float,
           most: float, allowance: float) -> FloatArray:
    """Reduce the variances of axes at rest, and add `allowance` to the variance of every axis.

    An axis is at rest if it has at least `least` values and its mean square times `factor` is
    smaller than its variance.

    Parameters
    ----------
    covariance : (n_sensors, 3, 3) array, T^2
    n, square : (n_sensors, 3) array
        As for `learn`.
    least : float
        Minimum number of values.
    factor : float
        Minimum ratio of the variance to the mean square of an axis at rest.
    most : float
        Factor by which the variance of an axis at rest is reduced.
    allowance : float, T^2
        Variance that is added to each axis.

    Returns
    -------
    (n_sensors, 3, 3) array, T^2
    """
