"""Matched filter: detection of a known signal in coloured noise, by one or several sensors.

It bounds the detectability of a pass with a known signature; the energy test (`detection_theory`)
requires no signature and detects less. The equations are from MITRE12 section 3 and appendix B.
Spectral densities are two-sided: the noise power is their integral over negative and positive
frequencies. NaN marks an axis that was not measured, or a detector without axes. Invalid values
raise ValueError.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from mag_tracking.arrays import BoolArray, FloatArray

_BAND_EDGE_TOLERANCE = 1e-9
"""Relative tolerance by which a band is extended, so that the band includes its edges."""


def noise_spectrum(frequency: ArrayLike, background: float, resolution: float,
                   bandwidth: float) -> FloatArray:
    """Power spectral density of geomagnetic 1/f noise and sensor quantisation.

    Parameters
    ----------
    frequency : (...) array, Hz
        Positive or negative.
    background : float, T/sqrt(Hz)
        Level of the geomagnetic noise at 1 Hz; 1e-12 in rural areas, 1e-10 in towns.
    resolution : float, T
        Quantisation step of the sensor.
    bandwidth : float, Hz
        Half the sampling rate, over which the quantisation noise is spread.

    Returns
    -------
    (...) array, T²/Hz
        Two-sided density. Infinite at zero frequency, unless `background` is zero.

    Notes
    -----
    MITRE12 eq. (B.10) is two-sided; eq. (B.8) is assumed to be two-sided, too. The denominator of
    eq. (B.8) is the frequency in Hz, as a pure number.

    References
    ----------
    [MITRE12]_ eq. (B.8)-(B.10).
    """
    f = np.abs(np.asarray(frequency, dtype=float))
    _raise_for_invalid('frequency', 'a number', f, np.isnan(f))
    for name, value in (('background', background), ('resolution', resolution)):
        _raise_for_invalid(name, 'at least 0 and finite', value, not 0.0 <= value < np.inf)
    _raise_for_invalid('bandwidth', 'above 0 and finite', bandwidth, not 0.0 < bandwidth < np.inf)
    steps = resolution**2 / (24.0 * bandwidth)
    if background == 0.0:
        return np.full(f.shape, steps)
    with np.errstate(divide='ignore'):
        density: FloatArray = background**2 / f + steps
    return density


def deflection(B: ArrayLike, sampling_rate: float, spectrum: Callable[[FloatArray], ArrayLike],
               band: Sequence[float]) -> FloatArray:
    """Deflection of the matched filter.

    This is the difference of its mean outputs with and without the signal, divided by the standard
    deviation of the output.

    Parameters
    ----------
    B : (..., n, n_axes) array, T
        Signal without noise, n samples in time. An axis that is NaN at all times is not measured.
    sampling_rate : float, Hz
    spectrum : callable, (n_f,) array, Hz -> (n_f,) array, T²/Hz
        Two-sided noise density, positive, equal and independent on all axes. The function is called
        for frequencies in the band only. Frequencies with an infinite density do not contribute.
    band : (2,) sequence, Hz
        Lowest and highest frequency, both included; the highest may be infinite.

    Returns
    -------
    (...) array
        Root of the sum of the squared deflections of the axes. NaN if no axis is measured.

    Raises
    ------
    ValueError
        If a shape or value is invalid, or if n samples have no frequency in the band.

    Notes
    -----
    The transform approximates the continuous transform: the DFT is divided by the sampling rate.
    With the plain DFT, as printed, the deflection would be too large by a factor of the sampling
    rate. The sum includes both signs of the frequency, as the density is two-sided. The paper does
    not mention this; a one-sided sum would make the deflection smaller by a factor of sqrt(2). The
    figures of the paper are reproduced if the DFT is divided by n instead, which makes the
    deflection larger by a factor of `sampling_rate` / n [1/s]: see examples/mitre12.py.

    References
    ----------
    [MITRE12]_ eq. (B.11)-(B.13).
    """
    B = np.asarray(B, dtype=float)
    if B.ndim < 2 or 0 in B.shape[-2:]:
        raise ValueError(f'B must have shape (..., n, n_axes), got {B.shape}')
    missing = np.isnan(B).all(axis=-2)
    _raise_for_invalid('B', 'finite, or NaN on a whole axis', B,
                       ~np.isfinite(B) & ~missing[..., None, :])
    _raise_for_invalid('sampling_rate', 'above 0 and finite', sampling_rate,
                       not 0.0 < sampling_rate < np.inf)
    low, high = band
    _raise_for_invalid('band', 'two ascending frequencies, the first at least 0', list(band),
                       not 0.0 <= low < high)
    n = B.shape[-2]
    f = np.arange(n // 2 + 1) * sampling_rate / n
    in_band = (f >= low * (1.0 - _BAND_EDGE_TOLERANCE)) & (f <= high * (1.0 + _BAND_EDGE_TOLERANCE))
    if not in_band.any():
        raise ValueError(f'{n} samples at {sampling_rate} Hz have no frequency in the band '
                         f'{list(band)} Hz: the frequency spacing is {sampling_rate / n} Hz')
    S = np.broadcast_to(np.asarray(spectrum(f[in_band]), dtype=float), f[in_band].shape)
    _raise_for_invalid('spectrum', 'above 0', S, ~(S > 0.0))
    # Negative frequencies mirror the positive ones; zero and half the rate have no counterpart.
    signs = np.where((f == 0.0) | (2 * np.arange(len(f)) == n), 1.0, 2.0)[in_band]
    F = np.fft.rfft(np.where(missing[..., None, :], 0.0, B), axis=-2)[..., in_band, :]
    # Amplitudes are divided before they are squared: squares of picoteslas are tiny.
    weight = np.sqrt(signs / (sampling_rate * n * S))
    d = np.sqrt(np.sum(np.abs(F * weight[:, None]) ** 2, axis=(-2, -1)))
    return np.where(missing.all(axis=-1), np.nan, d)[()]


def detection_probability(deflection: ArrayLike, false_alarm_probability: ArrayLike
                          ) -> FloatArray:
    """Detection probability of the matched filter.

    Parameters
    ----------
    deflection : (...) array
        Deflection; NaN where nothing is measured.
    false_alarm_probability : (...) array
        Above 0 and below 1; broadcasts against `deflection`.

    Returns
    -------
    (...) array
        NaN where the deflection is NaN.

    Raises
    ------
    ValueError
        If a deflection is negative or a probability is out of range.

    Notes
    -----
    Phi in the paper is the complementary normal distribution.

    References
    ----------
    [MITRE12]_ eq. (3), (4).
    """
    deflection = np.asarray(deflection, dtype=float)
    p_fa = np.asarray(false_alarm_probability, dtype=float)
    _raise_for_invalid('deflection', 'at least 0', deflection, deflection < 0.0)
    _raise_for_invalid('false_alarm_probability', 'above 0 and below 1', p_fa,
                       ~((p_fa > 0.0) & (p_fa < 1.0)))
    return ndtr(deflection + ndtri(p_fa))


def any_detection_probability(probability: ArrayLike,
                              axis: int | tuple[int, ...] | None = None) -> FloatArray:
    """Probability that at least one of several independent detectors detects the signal.

    Parameters
    ----------
    probability : (...) array
        Detection probability of each sensor and period; NaN is treated as 0.
    axis : int or tuple of int, optional
        Axes to combine. Default: all axes.

    Returns
    -------
    (...) array
        Array without the combined axes. Probabilities far below the rounding error of 1 are
        preserved: three detectors with 1e-30 give 3e-30.

    Raises
    ------
    ValueError
        If a probability is out of range.

    Notes
    -----
    Noise that persists for more than one period, or affects several sensors, is not independent.

    References
    ----------
    [MITRE12]_ eq. (5) over sensors, eq. (6) over sensors and periods.
    """
    p = np.asarray(probability, dtype=float)
    _raise_for_invalid('probability', 'from 0 to 1', p, (p < 0.0) | (p > 1.0))
    with np.errstate(divide='ignore'):
        log_missed = np.sum(np.log1p(-np.where(np.isnan(p), 0.0, p)), axis=axis)
    detected: FloatArray = -np.expm1(log_missed)
    return detected


def _raise_for_invalid(name: str, requirement: str, value: ArrayLike,
                       is_invalid: bool | BoolArray) -> None:
    """Raise ValueError for the first entry of `value` that is flagged in `is_invalid`, if any."""
    if np.any(is_invalid):
        index = np.argwhere(is_invalid)[0].tolist() if np.ndim(is_invalid) else []
        position = index if index else ''
        actual = np.asarray(value)[tuple(index)].tolist()
        raise ValueError(f'{name}{position} must be {requirement}, got {actual}')
