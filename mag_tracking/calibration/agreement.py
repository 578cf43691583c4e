"""Comparison of measured fields with the Earth's field, and explanations of differences.

Without a target, all sensors measure the same field in different frames. Flipped or swapped axes, a
wrong unit, a wrong gain or exchanged sensors are therefore detected and named. Such a fault also
distorts the field of a target; a constant offset does not.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from scipy.special import chdtrc

from mag_tracking.arrays import FloatArray
from mag_tracking.settings import param

COMPASS_BIAS_STD = 6e-7
"""[T] Prior standard deviation, per axis, of the field of a sensor and of nearby iron."""

FALSE_ALARM_PROBABILITY = 1e-5
"""Probability that a correct sensor is reported."""

OFFSET_PROBABILITY = 1e-3
"""Probability that a sensor with a constant offset is regarded as misleading."""

EXPLAINED_PROBABILITY = 0.05
"""Probability of a larger remaining difference above which a fault is preferred to an offset."""

GAIN_STDS = 2.0
"""Half of the stated interval of a gain, in standard deviations."""

MIN_GAIN_ERROR, MAX_AXIS_GAIN, MAX_GAIN = 0.1, 10.0, 2e4
"""A gain is an explanation if it differs from 1 by more than the first value, and it or its inverse
is below the second value for one axis, and below the third for all axes."""

UNIT_TOLERANCE = 0.1
"""A gain that differs from a power of ten by less than this may be due to a wrong unit."""

MAX_HEADING_STDS, YAW_STEP = 5.0, np.deg2rad(0.25)
"""Maximum tested heading error in standard deviations, and step of the tested headings [rad]."""

MAX_REMAINING_FRACTION, MAX_RATIO_TO_NEXT = 0.3, 0.5
"""Maximum difference that remains after a partial explanation, relative to the original one, and to
that after the next best, equally complex change of axes."""

UNITS = (('gauss', 1e4), ('millitesla', 1e3), ('microtesla', 1e6), ('nanotesla', 1e9))
_AXES = 'xyz'

_AxisChange: TypeAlias = tuple[str, tuple[int, ...], FloatArray]
"""Description, order and signs (3,) of a signed permutation of the axes."""


@dataclass(frozen=True)
class SurveySettings:
    """Settings of the survey of orientations and clock offsets."""

    offset_std: float = param(
        5e-6, 'Standard deviation, per axis, of the constant offset of an uncalibrated sensor, '
        'including iron nearby. An offset does not affect tracks. If the background of a sensor '
        'contradicts the field of the Earth by more than this offset and the uncertainty of its '
        'orientation explain, its gain, its axes or its orientation are wrong, and its tracks are '
        'ambiguous. 0 disables this flag.', 'T', (0.0, 1e-3))
    nominal_std_deg: float = param(
        5.0, 'Standard deviation, about each axis, of the orientations in the network file, for '
        'sensors without orientation_std_deg.', 'deg', (0.06, 180.0))


@dataclass(frozen=True)
class FieldInconsistency:
    """A sensor whose measured field is inconsistent with the Earth's field."""

    sensor: str
    magnitude: float
    """[T] Magnitude of the measured field minus the Earth's field, over the reported axes."""
    explanations: tuple[str, ...]
    """The simplest possible explanations; empty if no known fault explains the difference."""
    misleads: bool
    """Whether the field of a target is probably distorted, too; not by a constant offset."""

    @property
    def advice(self) -> str:
        """Remedy."""
        return 'fix the sensor, its orientation in the network file, or earth_field' \
            if self.misleads else 'measure the offset with mag-tracking calibrate tumble if the ' \
            'orientations are calibrated'

    def __str__(self) -> str:
        cause = ' or '.join(self.explanations) or (
            'not explained by swapped or flipped axes, a wrong unit, a wrong gain or exchanged '
            'sensors; check for iron or magnets nearby, and check the configured orientation')
        return (f'{self.sensor} differs from the Earth\'s field by {self.magnitude * 1e6:.3g} uT: '
                f'{cause}')


def consensus(fields: FloatArray, R_ws: FloatArray) -> FloatArray:
    """Median per world axis, T, of the complete fields (n, 3) in the sensor frames; raises
    ValueError if these are fewer than three, because with two, the faulty sensor cannot be
    identified."""
    is_complete = ~np.isnan(fields).any(axis=1)
    if np.count_nonzero(is_complete) < 3:
        raise ValueError('if earth_field is unknown, at least three sensors must report all axes, '
                         f'but only {np.count_nonzero(is_complete)} do')
    field: FloatArray = np.median(
        np.einsum('jik,jk->ji', R_ws[is_complete], fields[is_complete]), axis=0)
    return field


def disagreements(names: Sequence[str], fields: FloatArray, R_ws: FloatArray,
                  orientation_std: FloatArray, earth_field: FloatArray,
                  bias_std: float, offset_std: float) -> list[FieldInconsistency]:
    """Find the sensors whose fields (n, 3) in T without a target differ from the Earth's field.

    `fields` is in the sensor frames, NaN for an unreported axis; `orientation_std` (n, 3) in rad is
    about the world axes. `bias_std`, which includes nearby iron, and `offset_std`, that of an
    uncalibrated sensor, are in T per axis. A difference within the offset is not misleading.
    """
    B0 = np.asarray(earth_field, dtype=float)
    sensors = [_Sensor(*sensor, B0, bias_std)
               for sensor in zip(names, fields, R_ws, orientation_std, strict=True)]
    suspects = [s for s in sensors if not s.fits(s.field)]
    inconsistencies = []
    for s in suspects:
        exact = _exact_explanations(s, suspects)
        is_offset = offset_std > 0.0 \
            and s.probability(s.field, offset_std) > OFFSET_PROBABILITY \
            and not any(p > EXPLAINED_PROBABILITY for _, p in exact)
        gains = _gain_explanations(s)
        explanations = tuple(text for text, _ in exact) or (
            ('a constant offset of the sensor or of iron nearby', *gains) if is_offset else
            gains or _partial_explanation(s))
        magnitude = float(np.sqrt(np.nansum((s.field - s.R_ws.T @ B0)**2)))
        inconsistencies.append(FieldInconsistency(
            s.name, magnitude, explanations, offset_std > 0.0 and not is_offset))
    return inconsistencies


@dataclass(frozen=True, eq=False)
class _Sensor:
    """Field and orientation of one sensor, compared with the Earth's field."""

    name: str
    field: FloatArray
    """(3,) [T] NaN for an unreported axis."""
    R_ws: FloatArray
    std: FloatArray
    """(3,) [rad] Standard deviation of the orientation about the world axes."""
    B0: FloatArray
    """(3,) [T] Earth's field in the world frame."""
    bias_std: float

    def probability(self, y: FloatArray, bias_std: float | None = None) -> float:
        """Probability that a field differs more from the Earth's field than `y` does."""
        key = (tuple(np.ravel(a).tolist()) for a in (y, self.R_ws, self.std, self.B0))
        return _probability(*key, self.bias_std if bias_std is None else bias_std)

    def fits(self, y: FloatArray) -> bool:
        """Whether a field is consistent with the Earth's field."""
        return self.probability(y) >= FALSE_ALARM_PROBABILITY

    def remaining_difference(self, y: FloatArray) -> float:
        """Magnitude [T] of a field minus the Earth's field, at the best heading."""
        _, B = _headings(self.std, self.B0)
        return float(np.linalg.norm((y - B @ self.R_ws)[:, ~np.isnan(y)], axis=1).min())


@functools.lru_cache(maxsize=4096)
def _probability(field: tuple[float, ...], orientation: tuple[float, ...],
                 orientation_std: tuple[float, ...], earth_field: tuple[float, ...],
                 bias_std: float) -> float:
    """Probability of a larger difference from the Earth's field, at the best heading (cached)."""
    y, R_ws, std, B0 = (np.array(field), np.array(orientation).reshape(3, 3),
                        np.array(orientation_std), np.array(earth_field))
    is_reported = ~np.isnan(y)
    if not is_reported.any():
        return 1.0
    # Heading errors may be large, so a grid is tested; tilts are small and are linearised.
    yaw, B = _headings(std, B0)
    tilt_effect = (R_ws.T @ np.cross(np.eye(3), B0).T * std)[:, :2]
    S = (bias_std**2 * np.eye(3) + tilt_effect @ tilt_effect.T)[np.ix_(is_reported, is_reported)]
    r = (y - B @ R_ws)[:, is_reported]
    energy = np.einsum('ni,ij,nj->n', r, np.linalg.inv(S), r) + (yaw / std[2])**2
    return float(chdtrc(np.count_nonzero(is_reported), energy.min()))


def _exact_explanations(s: _Sensor, suspects: Sequence[_Sensor]) -> list[tuple[str, float]]:
    """Simplest faults without a free parameter that explain the field, and their probabilities."""
    y = s.field
    # Exchanged sensors: both must be suspect, and both must fit after the exchange.
    candidates = [(f'it is exchanged with {other.name}',
                   min(other.probability(y), s.probability(other.field)))
                  for other in suspects if other is not s]
    candidates += [(f'its unit is {unit}', s.probability(y / scale)) for unit, scale in UNITS]
    for group in (candidates, *([(description, s.probability(signs * y[list(order)]))
                                 for description, order, signs in changes]
                                for changes in _axis_changes())):
        if explanations := [(text, p) for text, p in group if p >= FALSE_ALARM_PROBABILITY]:
            return explanations
    return []


def _gain_explanations(s: _Sensor) -> tuple[str, ...]:
    """Gains of all axes, or of one axis, that explain the field."""
    y, B = s.field, np.where(np.isnan(s.field), np.nan, s.R_ws.T @ s.B0)
    found = []
    gain = np.sqrt(np.nansum(y**2) / np.nansum(B**2))
    relative_std = s.bias_std / np.sqrt(np.nansum(B**2))
    for sign, text in ((1.0, ''), (-1.0, 'x, y and z are flipped, with ')):
        if _is_wrong_gain(gain) and s.fits(sign * y / gain):
            power = round(np.log10(gain))
            is_unit = power and abs(gain / 10.0**power - 1.0) < UNIT_TOLERANCE
            found.append(f'{text}{_gain_text(gain, relative_std)} (the direction agrees'
                         f'{"; a wrong unit?" if is_unit else ""})')
    for a, axis in enumerate(_AXES):
        # A field along the axis that is below the noise has no gain.
        if np.isnan(y[a]) or not abs(B[a]) > 2.0 * GAIN_STDS * s.bias_std:
            continue
        corrected = np.where(np.arange(3) == a, B, y)
        if _is_wrong_gain(y[a] / B[a], MAX_AXIS_GAIN) and s.fits(corrected):
            found.append(f'{_gain_text(y[a] / B[a], s.bias_std / abs(B[a]))} of {axis} alone')
    return tuple(found)


def _is_wrong_gain(gain: float, max_gain: float = MAX_GAIN) -> bool:
    """Whether a gain differs from 1, and is possible."""
    return abs(gain - 1.0) > MIN_GAIN_ERROR and 1.0 / max_gain < gain < max_gain


def _gain_text(gain: float, relative_std: float) -> str:
    """Interval of a gain with a relative standard deviation."""
    low, high = (f'{gain * (1.0 + sign * GAIN_STDS * relative_std):.2g}' for sign in (-1.0, 1.0))
    return f'gain {low}' if low == high else f'gain {low} to {high}'


def _partial_explanation(s: _Sensor) -> tuple[str, ...]:
    """Simplest change of axes that explains most of the difference, unless ambiguous, or a wrong
    orientation if the magnitude agrees."""
    original_difference = s.remaining_difference(s.field)
    for changes in _axis_changes():
        remainders = sorted((s.remaining_difference(signs * s.field[list(order)]), description)
                            for description, order, signs in changes)
        # If two changes explain the difference equally well, neither is reported.
        if remainders[0][0] < MAX_REMAINING_FRACTION * original_difference and not (
                len(remainders) > 1 and remainders[1][0] < remainders[0][0] / MAX_RATIO_TO_NEXT):
            return (f'{remainders[0][1]}, and {remainders[0][0] * 1e6:.2g} uT remain (due to '
                    'nearby iron or the bias of the sensor)',)
    difference = abs(np.linalg.norm(s.field) - np.linalg.norm(s.B0))
    return ('another orientation (the magnitude agrees)',) \
        if difference < MAX_HEADING_STDS * s.bias_std else ()


def _headings(std: FloatArray, B0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tested heading errors (n,) [rad], and the Earth's fields rotated by them (n, 3) [T]."""
    max_error = min(np.pi, MAX_HEADING_STDS * std[2])
    yaw = np.linspace(-max_error, max_error, 1 + 2 * max(1, round(max_error / YAW_STEP)))
    return yaw, np.stack([B0[0] * np.cos(yaw) + B0[1] * np.sin(yaw),
                          B0[1] * np.cos(yaw) - B0[0] * np.sin(yaw), np.full(len(yaw), B0[2])],
                         axis=1)


def _axis_changes() -> list[list[_AxisChange]]:
    """Groups of equally complex signed permutations of the axes, simplest group first."""
    groups: dict[tuple[int, int], list[_AxisChange]] = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            n_moved = sum(k != i for i, k in enumerate(order))
            flipped_axes = [_AXES[i] for i, s in enumerate(signs) if s < 0.0]
            if not n_moved and not flipped_axes:
                continue
            parts = []
            if n_moved == 2:
                parts.append(' and '.join(_AXES[i] for i in range(3) if order[i] != i)
                             + ' are swapped')
            elif n_moved:
                parts.append('its axes are in the order '
                             + ', '.join(_AXES[order.index(i)] for i in range(3)))
            if len(flipped_axes) == 3:
                parts.append('x, y and z are flipped')
            elif flipped_axes:
                parts.append(f'{" and ".join(flipped_axes)} '
                             f'{"is" if len(flipped_axes) == 1 else "are"} flipped')
            # An inverted sensor is as simple as one that is mounted upside down.
            n_changes = n_moved + min(len(flipped_axes), 2) + (n_moved > 0)
            groups.setdefault((n_changes, n_moved), []).append(
                (', '.join(parts), order, np.array(signs)))
    return [groups[key] for key in sorted(groups)]
