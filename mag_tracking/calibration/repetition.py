"""Repetition: detect a driver that publishes readings faster than its sensor measures.

Each reading is then repeated a regular number of times. A sensor with coarse steps also repeats
readings at rest, but at random: the number of repetitions has a geometric distribution.
"""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray

MIN_REPETITION = 1.2
"""Minimum number of readings per measurement; timing jitter causes fewer repetitions."""
MAX_REPETITION = 40.0
"""Maximum number of readings per measurement."""
MIN_LOG_ODDS = 24.0
"""Minimum significance of the regularity: random repetitions reach the power of a frequency with a
probability of exp(-24), at each of some thousand frequencies."""
MIN_RESULTANT = 0.85
"""Minimum regularity of the changes, relative to a perfectly regular source."""
MAX_JITTER = 0.2
"""Maximum deviation of an interval from a multiple of the median interval, relative to it."""
MIN_REGULAR = 0.9
"""Minimum fraction of the intervals with less jitter, to know where readings were lost."""
MAX_LOST = 2.0
"""Maximum ratio of all readings, including lost ones, to the received readings."""
OVERSAMPLING = 4
"""Oversampling of the frequencies at which the regularity is evaluated."""


def changes_of(fields: FloatArray) -> BoolArray:
    """Whether each reading (n, 3) differs from the previous one; True for the first."""
    before, after = fields[:-1], fields[1:]
    equal = (after == before) | np.isnan(after) & np.isnan(before)
    return np.append(np.ones(min(1, len(fields)), dtype=bool), ~equal.all(axis=1))


def with_lost_readings(fields: FloatArray, stamps: IntArray) -> FloatArray:
    """Insert a NaN row wherever a reading was lost, by the timestamps (n,) in ns.

    Unchanged if the timestamps are irregular, or most readings are lost.
    """
    intervals = np.diff(stamps) / max(1.0, float(np.median(np.diff(stamps)))) if len(stamps) > 1 \
        else np.zeros(0)
    steps = np.round(intervals)
    if np.mean(np.abs(intervals - steps) > MAX_JITTER) > 1.0 - MIN_REGULAR or not len(steps) \
            or steps.min() < 1.0 or steps.sum() > MAX_LOST * len(stamps):
        return fields
    index = np.append(0, np.cumsum(steps.astype(np.int64)))
    out: FloatArray = np.full((int(index[-1]) + 1, 3), np.nan)
    out[index] = fields
    return out


def repetition_of(fields: FloatArray) -> float:
    """Number of chronological readings (n, 3) per measurement, from the regularity of the changes.

    A source that is read every r readings changes at the readings ceil(k r). The phases of the
    changes modulo r then cover 1/r of the circle, so their resultant is sin(π/r) / (π/r). Changes
    missing because two measurements are equal do not matter. 1 if readings are not repeated
    regularly; an integer unless the rates are incommensurate.
    """
    n, present = len(fields), np.flatnonzero(~np.isnan(fields).all(axis=1))
    is_change = np.zeros(n, dtype=bool)
    is_change[present] = changes_of(fields[present])
    changes = np.flatnonzero(is_change[1:])
    n_changes = len(changes)
    if n_changes < MIN_LOG_ODDS or n_changes > len(present) / MIN_REPETITION:
        return 1.0
    size = OVERSAMPLING * 2 ** int(np.ceil(np.log2(n)))
    resultant = np.abs(np.fft.rfft(is_change[1:].astype(float), size)) / n_changes
    frequency = np.arange(len(resultant)) / size
    # A rate above half the rate of publishing is aliased. Equal measurements only lower the number
    # of changes, so a source is at least as fast as the changes.
    frequency = np.where(frequency < 0.95 * n_changes / n, 1.0 - frequency, frequency)
    period = 1.0 / np.maximum(frequency, 1e-9)
    expected = np.sinc(1.0 / period)
    is_regular = (period >= MIN_REPETITION) & (period <= MAX_REPETITION) \
        & (resultant > MIN_RESULTANT * expected) & (n_changes * resultant**2 > MIN_LOG_ODDS)
    if not is_regular.any():
        return 1.0
    # Multiples of the rate are regular as well: the slowest source decides.
    slowest = np.flatnonzero(is_regular & (period > 0.9 * period[is_regular].max()))
    bin_of_best = slowest[np.argmax(resultant[slowest])]
    best = _refined(changes, float(frequency[bin_of_best]), 1.0 / size)
    nearest = round(best)
    return float(nearest) if abs(best - nearest) * n < 2.0 * best**2 / OVERSAMPLING else best


def _refined(changes: IntArray, frequency: float, width: float) -> float:
    """Period of the most regular `frequency` [1/reading] within `width`, at the changed indices."""
    frequencies = frequency + width * np.linspace(-1.0, 1.0, 65)
    resultant = np.abs(np.exp(2j * np.pi * np.outer(frequencies, changes)).sum(axis=1))
    return float(1.0 / frequencies[np.argmax(resultant)])
