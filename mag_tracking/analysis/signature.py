"""Signatures of passes at one sensor, and features of their shape."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

N_SAMPLES = 64
"""A signature is resampled to this number of samples, so that its duration does not matter."""

QUIET = 0.1
"""Share of a signature at each end that gives the baseline."""

ENERGY_TAIL = 0.005
"""Share of the energy before the begin, and after the end, of what is felt of a target."""

PROMINENT = 0.1
"""An extremum counts that stands out by this share of the range of its axis."""

LAGS = (2, 4, 8, 16)
"""Lags of the autocorrelation of the size, in samples."""

N_COSINES = 8
"""Coefficients of the discrete cosine transform of the size."""

MIN_SAMPLES = 8
"""A shorter signature has no shape."""


@dataclass(frozen=True)
class Signature:
    """The field of one pass at one sensor."""

    t: FloatArray
    """(n,) [s], in order."""
    field: FloatArray
    """(n, n_axes) [T], or in an unknown unit."""
    label: str
    """Class; empty if it is unknown."""
    source: str
    """Where it came from, for messages."""
    axes: tuple[str, ...]
    """Names of the axes."""
    unit: str
    """T, or empty if it is unknown."""
    group: str
    """Name shared by the signatures of one target, which are trained on or tested on together."""


def features(signature: Signature) -> FloatArray:
    """Features of the shape and the size of a signature.

    Parameters
    ----------
    signature : Signature

    Returns
    -------
    (n_features,) array
        For each axis the logarithm of the range, the share of the energy, the number of extrema,
        the places of the largest and the smallest value and the share of the upper third of the
        spectrum; for the size of the field its logarithm, the number of maxima, autocorrelation
        and cosine transform. The duration is left out, as the speed is not known.

    Raises
    ------
    ValueError
        If it has too few samples, is not finite, or nowhere differs from its baseline.
    """
    t, field = np.asarray(signature.t, dtype=float), np.asarray(signature.field, dtype=float)
    if len(t) < MIN_SAMPLES:
        raise ValueError(f'{len(t)} samples are too few for a signature; expected at least '
                         f'{MIN_SAMPLES}')
    if not (np.isfinite(t).all() and np.isfinite(field).all()):
        raise ValueError('a time or a field is not finite')
    if not (np.diff(t) > 0.0).all():
        raise ValueError('its times do not increase')
    largest = np.abs(field).max()
    if not largest > 0.0 or not np.ptp(field / largest, axis=0).max() > 1e-12:
        raise ValueError('the field does not vary')
    shape = _resampled(t, _without_baseline(t, field / largest))
    size = np.linalg.norm(shape, axis=1)
    energy = np.square(shape).sum(axis=0)
    of_axes = [v for axis, share in zip(shape.T, energy / energy.sum(), strict=True)
               for v in _axis_features(axis, float(share), float(size.max()))]
    return np.array([np.log(size.max()) + np.log(largest), *of_axes,
                     *_size_features(size / size.max())])


def _without_baseline(t: FloatArray, field: FloatArray) -> FloatArray:
    """The field less the line through its ends, by least squares."""
    n = max(2, round(QUIET * len(t)))
    ends = np.r_[:n, len(t) - n:len(t)]
    A = np.stack([np.ones_like(t), (t - t[0]) / (t[-1] - t[0])], axis=1)
    line = np.linalg.lstsq(A[ends], field[ends], rcond=None)[0]
    departure: FloatArray = field - A @ line
    return departure


def _resampled(t: FloatArray, field: FloatArray) -> FloatArray:
    """(N_SAMPLES, n_axes) of the part in which nearly all of the energy comes."""
    even = np.linspace(t[0], t[-1], max(4 * N_SAMPLES, len(t)))
    fine = np.stack([np.interp(even, t, axis) for axis in field.T], axis=1)
    energy = np.square(fine).sum(axis=1)
    part = np.cumsum(energy) / energy.sum()
    begin = int(np.searchsorted(part, ENERGY_TAIL))
    end = int(np.searchsorted(part, 1.0 - ENERGY_TAIL)) + 1
    at = np.linspace(begin, min(end, len(even) - 1), N_SAMPLES)
    # Means around the new samples: what changes faster than they do would be chance.
    width = max(1, round((at[-1] - at[0]) / N_SAMPLES))
    smooth = np.stack([np.convolve(axis, np.ones(width) / width, 'same') for axis in fine.T],
                      axis=1)
    out: FloatArray = np.stack([np.interp(at, np.arange(len(even)), axis) for axis in smooth.T],
                               axis=1)
    return out


def _axis_features(axis: FloatArray, share: float, size: float) -> list[float]:
    """Features of one axis; `share` of the energy, `size` of the largest field."""
    spread = float(np.ptp(axis))
    spectrum = np.square(np.abs(np.fft.rfft(axis)))[1:]
    high = spectrum[2 * len(spectrum) // 3:].sum() / spectrum.sum() if spread > 0.0 else 0.0
    n_high, n_low = (_n_maxima(v) for v in (axis, -axis))
    return [float(np.log(max(spread / size, 1e-3))), share, n_high, n_low,
            int(np.argmax(axis)) / N_SAMPLES, int(np.argmin(axis)) / N_SAMPLES,
            float(np.log10(high + 1e-8))]


def _n_maxima(values: FloatArray) -> int:
    """Number of prominent maxima."""
    # It takes a quarter of a second to import.
    from scipy.signal import find_peaks

    return len(find_peaks(values, prominence=PROMINENT * max(float(np.ptp(values)), 1e-300))[0])


def _size_features(size: FloatArray) -> list[float]:
    """Features of the size of the field, whose largest value is one."""
    from scipy.fft import dct

    centred = size - size.mean()
    variance = float(centred @ centred)
    correlations = [float(centred[:-lag] @ centred[lag:]) / max(variance, 1e-300) for lag in LAGS]
    cosines = dct(size, norm='ortho')[:N_COSINES]
    return [_n_maxima(size), *correlations, *(float(c) for c in cosines)]
