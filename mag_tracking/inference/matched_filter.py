"""The matched filter: detection of a known signal in coloured noise, by one sensor or several.

It says how well a pass could be detected if its shape were known; the energy test
(`detection_theory`) needs no shape and detects less. Densities are two-sided: the
noise power is their integral over negative and positive frequencies. NaN = not
measured: an axis, or a detector without any axis. Values that cannot be meant raise
ValueError with the value.

Source: MITRE12 section 3 and appendix B.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from mag_tracking.arrays import BoolArray, FloatArray

_BAND_EDGE_TOLERANCE = 1e-9
"""A frequency on the edge of a band belongs to it; it may be off by this share."""


def noise_spectrum(frequency: ArrayLike, background: float, resolution: float,
                   bandwidth: float) -> FloatArray:
    """Density of geomagnetic 1/f noise and of a sensor's quantisation.

    Parameters
    ----------
    frequency : (...) [Hz]
        Of either sign.
    background : float [T/sqrt(Hz)]
        Level of the geomagnetic noise at 1 Hz; 1e-12 in the country, 1e-10 in a town.
    resolution : float [T]
        Step of the sensor's output.
    bandwidth : float [Hz]
        Half of its sampling rate, over which the noise of the steps is spread.

    Returns
    -------
    (...) [T^2/Hz], two-sided
        Infinite at zero frequency, unless there is no background.

    Source: MITRE12 eq. (B.8)-(B.10). (B.10) is two-sided; (B.8), of which this is not
    said, is taken so, too. The frequency stands there in the denominator as a pure
    number, in Hz.
    """
    f = np.abs(np.asarray(frequency, dtype=float))
    _raise_for_invalid('frequency', 'numbers', f, np.isnan(f))
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
    """Deflection d of the matched filter: distance of its two means in standard deviations.

    Parameters
    ----------
    B : (..., n, n_axes) [T]
        Signal without noise, n samples in time; an axis that is NaN all the time is
        not measured.
    sampling_rate : float [Hz]
    spectrum : function (n_f,) [Hz] -> (n_f,) [T^2/Hz]
        Two-sided density of the noise, alike and independent on all axes; above 0.
        It is asked for the frequencies in the band only; where it is infinite,
        nothing is learnt.
    band : (2,) [Hz]
        Lowest and highest frequency kept, both included; infinity for no upper end.

    Returns
    -------
    (...)
        Root of the sum of the axes' d^2; NaN where no axis is measured.

    Raises ValueError also where n samples have no frequency in the band.

    Source: MITRE12 eq. (B.11)-(B.13), corrected: the transform is the continuous
    one, which is the DFT divided by the sampling rate; with the DFT itself, d would
    depend on the rate and be that many times too large. The sum is over both signs
    of the frequency, as the density is two-sided; the source, which does not say,
    leaves the choice of a half, and with it d smaller by sqrt(2). The source's figures
    come out with the DFT divided by n instead, so with a d that is larger by
    `sampling_rate` / n [1/s]: see examples/mitre12.py.
    """
    B = np.asarray(B, dtype=float)
    if B.ndim < 2 or 0 in B.shape[-2:]:
        raise ValueError(f'B needs shape (..., n, n_axes), got {B.shape}')
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
                         f'{list(band)} Hz: they are {sampling_rate / n} Hz apart')
    S = np.broadcast_to(np.asarray(spectrum(f[kept]), dtype=float), f[kept].shape)
    _raise_for_invalid('spectrum', 'above 0', S, ~(S > 0.0))
    # Negative frequencies are the mirror image; zero and half the rate have none.
    signs = np.where((f == 0.0) | (2 * np.arange(len(f)) == n), 1.0, 2.0)[kept]
    F = np.fft.rfft(np.where(missing[..., None, :], 0.0, B), axis=-2)[..., kept, :]
    # Each amplitude is divided before it is squared: squares of picoteslas get tiny.
    weight = np.sqrt(signs / (sampling_rate * n * S))
    d = np.sqrt(np.sum(np.abs(F * weight[:, None]) ** 2, axis=(-2, -1)))
    return np.where(missing.all(axis=-1), np.nan, d)[()]


def detection_probability(deflection: ArrayLike, false_alarm_probability: ArrayLike
                          ) -> FloatArray:
    """Probability that the matched filter detects the signal it is made for.

    Parameters
    ----------
    deflection : (...)
        NaN where nothing is measured; stays NaN.
    false_alarm_probability : (...)
        Above 0 and below 1; broadcasts against `deflection`.

    Source: MITRE12 eq. (3), (4), where Phi is the complementary normal distribution.
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
    probability : (...)
        Of each sensor and period; NaN = not there, which never detects.
    axis : int or tuple of int, optional
        Over which axes; all of them by default.

    Returns the shape without these axes. Probabilities far below the rounding of 1
    are kept: three times 1e-30 gives 3e-30.

    Source: MITRE12 eq. (5) over sensors, (6) over sensors and periods. Noise that
    lasts longer than a period, or reaches several sensors, is not independent.
    """
    p = np.asarray(probability, dtype=float)
    _raise_for_invalid('probability', 'from 0 to 1', p, (p < 0.0) | (p > 1.0))
    with np.errstate(divide='ignore'):
        silent = np.sum(np.log1p(-np.where(np.isnan(p), 0.0, p)), axis=axis)
    any_of_them: FloatArray = -np.expm1(silent)
    return any_of_them


def _raise_for_invalid(name: str, needed: str, value: ArrayLike, bad: bool | BoolArray) -> None:
    """Raise ValueError for the first entry of `value` that is `bad`, one flag or its shape."""
    if np.any(bad):
        at = np.argwhere(bad)[0].tolist() if np.ndim(bad) else []
        where = at if at else ''
        got = np.asarray(value)[tuple(at)].tolist()
        raise ValueError(f'{name}{where} has to be {needed}, got {got}')
