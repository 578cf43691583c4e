"""Signatures of passes at one sensor, and features of their shape."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

N_SAMPLES = 64
"""Number of samples of a resampled signature, which makes it independent of its duration."""

BASELINE_SHARE = 0.1
"""Share of a signature at each end that defines the baseline."""

ENERGY_TAIL = 0.005
"""Share of the energy before the beginning, and after the end, of the evaluated part."""

MIN_PROMINENCE = 0.1
"""Minimum prominence of an extremum relative to the range of its axis."""

LAGS = (2, 4, 8, 16)
"""Lags of the autocorrelation of the field size, in samples."""

N_COSINES = 8
"""Number of coefficients of the discrete cosine transform of the field size."""

MIN_SAMPLES = 8
"""Minimum number of samples of a signature."""


@dataclass(frozen=True)
class Signature:
    """Field of one pass at one sensor."""

    t: FloatArray
    """(n,) [s], increasing."""
    field: FloatArray
    """(n, n_axes) [T], or in an unknown unit."""
    label: str
    """Class; empty if unknown."""
    source: str
    """Origin of the signature, for messages."""
    axes: tuple[str, ...]
    """Names of the axes."""
    unit: str
    """T, or empty if unknown."""
    group: str
    """Name shared by the signatures of one target, which are kept together in training or test."""


def features(signature: Signature) -> FloatArray:
    """Features of the shape and size of a signature.

    Parameters
    ----------
    signature : Signature

    Returns
    -------
    (n_features,) array
        For each axis: logarithm of the range, share of the energy, numbers of maxima and minima,
        positions of the largest and the smallest value, share of the upper third of the spectrum.
        For the size of the field: its logarithm, number of maxima, autocorrelation, cosine
        transform. The duration is not a feature, since the speed is unknown.

    Raises
    ------
    ValueError
        If the signature has too few samples, is not finite, its times do not increase, or its
        field is constant.
    """
    t, field = np.asarray(signature.t, dtype=float), np.asarray(signature.field, dtype=float)
    if len(t) < MIN_SAMPLES:
        raise ValueError(f'{len(t)} samples are too few for a signature; expected at least '
                         f'{MIN_SAMPLES}')
    if not (np.isfinite(t).all() and np.isfinite(field).all()):
        raise ValueError('a time or a field value is not finite')
    if not (np.diff(t) > 0.0).all():
        raise ValueError('the times do not increase')
    largest = np.abs(field).max()
    if not largest > 0.0 or not np.ptp(field / largest, axis=0).max() > 1e-12:
        raise ValueError('the field is constant')
    shape = _resampled(t, _without_baseline(t, field / largest))
    size = np.linalg.norm(shape, axis=1)
    energy = np.square(shape).sum(axis=0)
    of_axes = [v for axis, share in zip(shape.T, energy / energy.sum(), strict=True)
               for v in _axis_features(axis, float(share), float(size.max()))]
    return np.array([np.log(size.max()) + np.log(largest), *of_axes,
                     *_size_features(size / size.max())])


def _without_baseline(t: FloatArray, field: FloatArray) -> FloatArray:
    """Field minus the least-squares line through both ends of the signature."""
    n = max(2, round(BASELINE_SHARE * len(t)))
    ends = np.r_[:n, len(t) - n:len(t)]
    A = np.stack([np.ones_like(t), (t - t[0]) / (t[-1] - t[0])], axis=1)
    line = np.linalg.lstsq(A[ends], field[ends], rcond=None)[0]
    departure: FloatArray = field - A @ line
    return departure


def _resampled(t: FloatArray, field: FloatArray) -> FloatArray:
    """Part (N_SAMPLES, n_axes) that contains nearly all of the energy."""
    even = np.linspace(t[0], t[-1], max(4 * N_SAMPLES, len(t)))
    fine = np.stack([np.interp(even, t, axis) for axis in field.T], axis=1)
    energy = np.square(fine).sum(axis=1)
    part = np.cumsum(energy) / energy.sum()
    begin = int(np.searchsorted(part, ENERGY_TAIL))
    end = int(np.searchsorted(part, 1.0 - ENERGY_TAIL)) + 1
    at = np.linspace(begin, min(end, len(even) - 1), N_SAMPLES)
    # Averaging over the new interval removes changes that the new samples cannot represent.
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
    # The import takes 0.25 s.
    from scipy.signal import find_peaks

    return len(find_peaks(
        values, prominence=MIN_PROMINENCE * max(float(np.ptp(values)), 1e-300))[0])


def _size_features(size: FloatArray) -> list[float]:
    """Features of the field size, normalised to a maximum of one."""
    from scipy.fft import dct

    centred = size - size.mean()
    variance = float(centred @ centred)
    correlations = [float(centred[:-lag] @ centred[lag:]) / max(variance, 1e-300) for lag in LAGS]
    cosines = dct(size, norm='ortho')[:N_COSINES]
    return [_n_maxima(size), *correlations, *(float(c) for c in cosines)]
