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

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.matrices import raise_for_invalid

_BAND_EDGE_TOLERANCE = 1e-9
"""Relative tolerance by which a band is extended, so that the band includes its edges."""


def noise_spectrum(frequency: ArrayLike, background: float, resolution: float,
                   bandwidth: float) -> FloatArray:
    """Two-sided spectral density [T²/Hz] of geomagnetic 1/f noise and sensor quantisation.

    `background` [T/sqrt(Hz)] is the geomagnetic noise at 1 Hz: 1e-12 in rural areas, 1e-10 in
    towns; unless it is zero, the density is infinite at zero frequency. The quantisation noise of
    steps `resolution` [T] is spread over `bandwidth` [Hz], half the sampling rate.
    MITRE12 eq. (B.8)-(B.10): (B.10) is two-sided, (B.8) is assumed to be; the denominator of (B.8)
    is the frequency in Hz as a pure number.
    """
    f = np.abs(np.asarray(frequency, dtype=float))
    raise_for_invalid('frequency', 'a number', f, np.isnan(f))
    for name, value in (('background', background), ('resolution', resolution)):
        raise_for_invalid(name, 'at least 0 and finite', value, not 0.0 <= value < np.inf)
    raise_for_invalid('bandwidth', 'above 0 and finite', bandwidth, not 0.0 < bandwidth < np.inf)
    steps = resolution**2 / (24.0 * bandwidth)
    if background == 0.0:
        return np.full(f.shape, steps)
    with np.errstate(divide='ignore'):
        density: FloatArray = background**2 / f + steps
    return density


def deflection(B: ArrayLike, sampling_rate: float, spectrum: Callable[[FloatArray], ArrayLike],
               band: Sequence[float]) -> FloatArray:
    """Deflection: difference of the filter's means with and without the signal over its std.

    `B` (..., n, n_axes) [T] is the noise-free signal; an axis that is all NaN is not measured. The
    result combines the axes; NaN if none is measured. `spectrum` maps frequencies [Hz] in the
    `band` (both edges included, inf allowed) to the two-sided noise density [T²/Hz], equal and
    independent on all axes; an infinite density does not contribute.

    MITRE12 eq. (B.11)-(B.13). The DFT is divided by the sampling rate to approximate the continuous
    transform; the plain DFT, as printed, is too large by that factor. The sum includes both signs
    of the frequency, which the paper does not mention; one sign gives 1/sqrt(2) of the deflection.
    The figures of the paper result from a DFT divided by n, which makes the deflection larger by
    `sampling_rate` / n [1/s]: see examples/mitre12.py.
    """
    B = np.asarray(B, dtype=float)
    if B.ndim < 2 or 0 in B.shape[-2:]:
        raise ValueError(f'B must have shape (..., n, n_axes), got {B.shape}')
    missing = np.isnan(B).all(axis=-2)
    raise_for_invalid('B', 'finite, or NaN on a whole axis', B,
                       ~np.isfinite(B) & ~missing[..., None, :])
    raise_for_invalid('sampling_rate', 'above 0 and finite', sampling_rate,
                       not 0.0 < sampling_rate < np.inf)
    low, high = band
    raise_for_invalid('band', 'two ascending frequencies, the first at least 0', list(band),
                       not 0.0 <= low < high)
    n = B.shape[-2]
    f = np.arange(n // 2 + 1) * sampling_rate / n
    in_band = (f >= low * (1.0 - _BAND_EDGE_TOLERANCE)) & (f <= high * (1.0 + _BAND_EDGE_TOLERANCE))
    if not in_band.any():
        raise ValueError(f'{n} samples at {sampling_rate} Hz have no frequency in the band '
                         f'{list(band)} Hz: the frequency spacing is {sampling_rate / n} Hz')
    S = np.broadcast_to(np.asarray(spectrum(f[in_band]), dtype=float), f[in_band].shape)
    raise_for_invalid('spectrum', 'above 0', S, ~(S > 0.0))
    # Negative frequencies mirror the positive ones; zero and half the rate have no counterpart.
    signs = np.where((f == 0.0) | (2 * np.arange(len(f)) == n), 1.0, 2.0)[in_band]
    F = np.fft.rfft(np.where(missing[..., None, :], 0.0, B), axis=-2)[..., in_band, :]
    # Amplitudes are divided before they are squared: squares of picoteslas are tiny.
    weight = np.sqrt(signs / (sampling_rate * n * S))
    d = np.sqrt(np.sum(np.abs(F * weight[:, None]) ** 2, axis=(-2, -1)))
    return np.where(missing.all(axis=-1), np.nan, d)[()]


def detection_probability(deflection: ArrayLike, false_alarm_probability: ArrayLike
                          ) -> FloatArray:
    """Detection probability of the matched filter, NaN where the deflection is NaN.

    MITRE12 eq. (3), (4), where Phi is the complementary normal distribution.
    """
    deflection = np.asarray(deflection, dtype=float)
    p_fa = np.asarray(false_alarm_probability, dtype=float)
    raise_for_invalid('deflection', 'at least 0', deflection, deflection < 0.0)
    raise_for_invalid('false_alarm_probability', 'above 0 and below 1', p_fa,
                       ~((p_fa > 0.0) & (p_fa < 1.0)))
    return ndtr(deflection + ndtri(p_fa))


def any_detection_probability(probability: ArrayLike,
                              axis: int | tuple[int, ...] | None = None) -> FloatArray:
    """Probability that at least one of several independent detectors detects the signal.

    NaN counts as 0; the default `axis` combines all axes. Probabilities far below the rounding
    error of 1 are preserved: three of 1e-30 give 3e-30. MITRE12 eq. (5) over sensors, eq. (6) over
    sensors and periods. Noise that persists over periods or affects several sensors is not
    independent.
    """
    p = np.asarray(probability, dtype=float)
    raise_for_invalid('probability', 'from 0 to 1', p, (p < 0.0) | (p > 1.0))
    with np.errstate(divide='ignore'):
        log_missed = np.sum(np.log1p(-np.where(np.isnan(p), 0.0, p)), axis=axis)
    detected: FloatArray = -np.expm1(log_missed)
    return detected
