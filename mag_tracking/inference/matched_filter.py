"""Matched filter: detection of a known signal in coloured noise, by one or several sensors.

It bounds the detectability of a pass whose signature is known; the energy test (`detection_theory`)
needs no signature and detects less. The equations are those of MITRE12 section 3 and appendix B.
Spectral densities are two-sided: the noise power is their integral over negative and positive
frequencies. NaN means not measured: an axis, or a detector without any axis. Invalid values raise
ValueError with the value.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from mag_tracking.arrays import BoolArray, FloatArray

_BAND_EDGE_TOLERANCE = 1e-9
"""Relative tolerance with which a frequency on the edge of a band belongs to it."""


def noise_spectrum(frequency: ArrayLike, background: float, resolution: float,
                   bandwidth: float) -> FloatArray:
    """Power spectral density of geomagnetic 1/f noise and sensor quantisation.

    Parameters
    ----------
    frequency : (...) array, Hz
        Of either sign.
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
    MITRE12 eq. (B.10) is two-sided; eq. (B.8), for which this is not stated, is treated as
    two-sided as well. Its denominator is the frequency in Hz, as a pure number.

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
    """Deflection of the matched filter: separation of its two means in standard deviations.

    Parameters
    ----------
    B : (..., n, n_axes) array, T
        Signal without noise, n samples in time. An axis that is NaN at all times is not measured.
    sampling_rate : float, Hz
    spectrum : callable, (n_f,) array, Hz -> (n_f,) array, T²/Hz
        Two-sided noise density, positive, equal and independent on all axes. It is called for the
        frequencies in the band only. Frequencies with an infinite density do not contribute.
    band : (2,) sequence, Hz
        Lowest and highest frequency kept, both included; infinity = no upper limit.

    Returns
    -------
    (...) array
        Root of the sum of the squared deflections of the axes; NaN if no axis is measured.

    Raises
    ------
    ValueError
        If a shape or value is invalid, or if n samples have no frequency in the band.

    Notes
    -----
    The transform is the continuous one, the DFT divided by the sampling rate. With the DFT itself,
    as printed, the deflection would depend on the sampling rate and be too large by this factor.
    The sum runs over both signs of the frequency, as the density is two-sided; the paper does not
    state this, and a one-sided sum would give a deflection smaller by sqrt(2). The figures of the
    paper are reproduced with the DFT divided by n instead, which gives a deflection larger by
    `sampling_rate` / n [1/s]: see examples/mitre12.py.

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
    kept = (f >= low * (1.0 - _BAND_EDGE_TOLERANCE)) & (f <= high * (1.0 + _BAND_EDGE_TOLERANCE))
    if not kept.any():
        raise ValueError(f'{n} samples at {sampling_rate} Hz have no frequency in the band '
                         f'{list(band)} Hz: the frequency spacing is {sampling_rate / n} Hz')
    S = np.broadcast_to(np.asarray(spectrum(f[kept]), dtype=float), f[kept].shape)
    _raise_for_invalid('spectrum', 'above 0', S, ~(S > 0.0))
    # Negative frequencies mirror the positive ones; zero and half the rate have no counterpart.
    signs = np.where((f == 0.0) | (2 * np.arange(len(f)) == n), 1.0, 2.0)[kept]
    F = np.fft.rfft(np.where(missing[..., None, :], 0.0, B), axis=-2)[..., kept, :]
    # Amplitudes are divided before they are squared: squares of picoteslas are tiny.
    weight = np.sqrt(signs / (sampling_rate * n * S))
    d = np.sqrt(np.sum(np.abs(F * weight[:, None]) ** 2, axis=(-2, -1)))
    return np.where(missing.all(axis=-1), np.nan, d)[()]


def detection_probability(deflection: ArrayLike, false_alarm_probability: ArrayLike
                          ) -> FloatArray:
    """Probability that the matched filter detects its signal.

    Parameters
    ----------
    deflection : (...) array
        Deflection; NaN = not measured.
    false_alarm_probability : (...) array
        Above 0 and below 1; broadcasts against `deflection`.

    Returns
    -------
    (...) array
        NaN where nothing is measured.

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
    """Probability that at least one of several independent detectors detects.

    Parameters
    ----------
    probability : (...) array
        Detection probability of each sensor and period; NaN = missing, never detects.
    axis : int or tuple of int, optional
        Axes to combine. Default: all axes.

    Returns
    -------
    (...) array
        Probability without the combined axes. Probabilities far below the rounding error of 1 are
        preserved: three times 1e-30 gives 3e-30.

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
        silent = np.sum(np.log1p(-np.where(np.isnan(p), 0.0, p)), axis=axis)
    any_of_them: FloatArray = -np.expm1(silent)
    return any_of_them


def _raise_for_invalid(name: str, needed: str, value: ArrayLike, bad: bool | BoolArray) -> None:
    """Raise ValueError for the first entry of `value` flagged in `bad`, one flag or of its shape.
    """
    if np.any(bad):
        at = np.argwhere(bad)[0].tolist() if np.ndim(bad) else []
        where = at if at else ''
        got = np.asarray(value)[tuple(at)].tolist()
        raise ValueError(f'{name}{where} must be {needed}, got {got}')
