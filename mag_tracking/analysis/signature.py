"""Signatures of passes at one sensor, and their features for classification."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

N_SAMPLES, MIN_SAMPLES = 64, 8
"""Number of samples of a resampled signature, and minimum number of a recorded one."""
BASELINE_FRACTION, TAIL_FRACTION = 0.1, 0.005
"""Fraction of a signature, at each end, for the baseline, and of its energy that is cut off."""
MIN_PROMINENCE = 0.1
"""Minimum prominence of an extremum relative to the range of its axis."""
AUTOCORRELATION_LAGS = (2, 4, 8, 16)
"""Lags of the autocorrelation of the field magnitude, in samples."""
N_DCT_COEFFICIENTS = 8
"""Number of coefficients of the discrete cosine transform of the field magnitude."""


@dataclass(frozen=True)
class Signature:
    """Field of one pass at one sensor."""

    t: FloatArray
    """(n,) [s], increasing."""
    field: FloatArray
    """(n, n_axes) field, in `unit`."""
    label: str
    """Class; empty if unknown."""
    source: str
    """Origin of the signature, used in messages."""
    axes: tuple[str, ...]
    """Names of the axes."""
    unit: str
    """Unit of `field`: T, or empty if unknown."""
    group: str
    """Name common to all signatures of one target. Training and test data share no group."""


def features(signature: Signature) -> FloatArray:
    """Compute features (n_features,) of the shape and magnitude of a signature, not of its
    duration.

    For each axis: logarithm of the range, fraction of the energy, numbers of maxima and minima,
    positions of the largest and the smallest value, fraction of the power in the upper third of the
    spectrum. For the field magnitude: logarithm of its maximum, number of maxima, autocorrelation,
    DCT coefficients. Raises ValueError if there are too few samples, a value is not finite, times
    do not increase, or the field is constant.
    """
    t, field = (np.asarray(a, dtype=float) for a in (signature.t, signature.field))
    if len(t) < MIN_SAMPLES:
        raise ValueError(f'too few samples for a signature: {len(t)}; at least {MIN_SAMPLES} are '
                         'required')
    if not (np.isfinite(t).all() and np.isfinite(field).all()):
        raise ValueError('a time or a field value is not finite')
    if not (np.diff(t) > 0.0).all():
        raise ValueError('the times do not increase')
    largest = np.abs(field).max()
    if not largest > 0.0 or not np.ptp(field / largest, axis=0).max() > 1e-12:
        raise ValueError('the field is constant')
    shape = _resample(t, field / largest)
    magnitude = np.linalg.norm(shape, axis=1)
    energy = np.square(shape).sum(axis=0)
    axis_features = [v for axis, fraction in zip(shape.T, energy / energy.sum(), strict=True)
                     for v in _axis_features(axis, float(fraction), float(magnitude.max()))]
    return np.array([np.log(magnitude.max()) + np.log(largest), *axis_features,
                     *_magnitude_features(magnitude / magnitude.max())])


def _resample(t: FloatArray, field: FloatArray) -> FloatArray:
    """Subtract the line through both ends, cut off the tails, resample to (N_SAMPLES, n_axes)."""
    n = max(2, round(BASELINE_FRACTION * len(t)))
    ends = np.r_[:n, len(t) - n:len(t)]
    A = np.stack([np.ones_like(t), (t - t[0]) / (t[-1] - t[0])], axis=1)
    field = field - A @ np.linalg.lstsq(A[ends], field[ends], rcond=None)[0]
    even_times = np.linspace(t[0], t[-1], max(4 * N_SAMPLES, len(t)))
    fine_field = np.stack([np.interp(even_times, t, axis) for axis in field.T], axis=1)
    energy = np.square(fine_field).sum(axis=1)
    fraction = np.cumsum(energy) / energy.sum()
    begin = int(np.searchsorted(fraction, TAIL_FRACTION))
    end = int(np.searchsorted(fraction, 1.0 - TAIL_FRACTION)) + 1
    sample_indices = np.linspace(begin, min(end, len(even_times) - 1), N_SAMPLES)
    # Average over the new sampling interval to prevent aliasing.
    width = max(1, round((sample_indices[-1] - sample_indices[0]) / N_SAMPLES))
    smooth = np.stack([np.convolve(axis, np.ones(width) / width, 'same') for axis in fine_field.T],
                      axis=1)
    return np.stack([np.interp(sample_indices, np.arange(len(even_times)), axis)
                     for axis in smooth.T], axis=1)


def _axis_features(axis: FloatArray, energy_fraction: float, max_magnitude: float) -> list[float]:
    """Features of one axis, given its fraction of the energy and the maximum field magnitude."""
    value_range = float(np.ptp(axis))
    spectrum = np.square(np.abs(np.fft.rfft(axis)))[1:]
    high_fraction = spectrum[2 * len(spectrum) // 3:].sum() / spectrum.sum() \
        if value_range > 0.0 else 0.0
    n_high, n_low = (_n_maxima(v) for v in (axis, -axis))
    return [float(np.log(max(value_range / max_magnitude, 1e-3))), energy_fraction, n_high, n_low,
            int(np.argmax(axis)) / N_SAMPLES, int(np.argmin(axis)) / N_SAMPLES,
            float(np.log10(high_fraction + 1e-8))]


def _n_maxima(values: FloatArray) -> int:
    """Number of maxima whose prominence is at least `MIN_PROMINENCE` of the value range."""
    # Deferred: the import takes 0.25 s.
    from scipy.signal import find_peaks

    return len(find_peaks(
        values, prominence=MIN_PROMINENCE * max(float(np.ptp(values)), 1e-300))[0])


def _magnitude_features(magnitude: FloatArray) -> list[float]:
    """Features of a field magnitude that is normalised to a maximum of one."""
    from scipy.fft import dct

    centred = magnitude - magnitude.mean()
    variance = float(centred @ centred)
    correlations = [float(centred[:-lag] @ centred[lag:]) / max(variance, 1e-300)
                    for lag in AUTOCORRELATION_LAGS]
    dct_coefficients = dct(magnitude, norm='ortho')[:N_DCT_COEFFICIENTS]
    return [_n_maxima(magnitude), *correlations, *(float(c) for c in dct_coefficients)]
