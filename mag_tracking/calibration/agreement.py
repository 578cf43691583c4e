"""Comparison of measured fields with the Earth's field, and explanations of differences.

Without a target, all sensors measure the same field in different frames. Flipped axes, swapped
axes, a wrong unit or two exchanged sensors are therefore detected and named.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from scipy.stats import chi2

from mag_tracking.arrays import FloatArray

FALSE_ALARM_PROBABILITY = 1e-5
"""Probability that a correct sensor is reported."""

MAX_HEADING_STDS = 5.0
"""Maximum tested heading error, in standard deviations."""

YAW_STEP = np.deg2rad(0.25)
"""[rad] Step of the tested headings; one step rotates a horizontal field of 20 uT by 0.1 uT."""

MAX_REMAINING_FRACTION = 0.3
"""Maximum difference that remains after a partial explanation, as a fraction of the original
difference."""

MAX_RATIO_TO_NEXT = 0.5
"""Maximum difference that remains after a partial explanation, relative to the difference that
remains after the next best change of axes of the same complexity."""

UNITS = (('gauss', 1e4), ('millitesla', 1e3), ('microtesla', 1e6), ('nanotesla', 1e9))
_AXES = 'xyz'

_AxisChange: TypeAlias = tuple[str, tuple[int, ...], FloatArray]
"""Description, order and signs (3,) of a signed permutation of the axes."""


@dataclass(frozen=True)
class FieldInconsistency:
    """A sensor whose measured field is inconsistent with the Earth's field."""

    sensor: str
    magnitude: float
    """[T] Magnitude of the measured field minus the Earth's field, over the reported axes."""
    explanations: tuple[str, ...]
    """The simplest possible explanations; empty if no known fault explains the difference."""

    def __str__(self) -> str:
        cause = ' or '.join(self.explanations) or (
            'not explained by swapped or flipped axes, a wrong unit or exchanged sensors; check '
            'for iron or magnets nearby, and check the configured orientation')
        return (f'{self.sensor} differs from the Earth\'s field by {self.magnitude * 1e6:.3g} uT: '
                f'{cause}')


def consensus(fields: FloatArray, R_ws: FloatArray) -> FloatArray:
    """Median of the measured fields of a network, for each world axis.

    Parameters
    ----------
    fields : (n, 3) array, T, sensor frames
        Measured fields; NaN for an unreported axis.
    R_ws : (n, 3, 3) array
        Sensor to world.

    Returns
    -------
    (3,) array, T, world frame

    Raises
    ------
    ValueError
        If fewer than three sensors report all axes. With two sensors, the faulty sensor cannot
        be identified.
    """
    is_complete = ~np.isnan(fields).any(axis=1)
    if np.count_nonzero(is_complete) < 3:
        raise ValueError('if earth_field is unknown, at least three sensors must report all axes, '
                         f'but only {np.count_nonzero(is_complete)} do')
    field: FloatArray = np.median(
        np.einsum('jik,jk->ji', R_ws[is_complete], fields[is_complete]), axis=0)
    return field


def disagreements(names: Sequence[str], fields: FloatArray, R_ws: FloatArray,
                  orientation_std: FloatArray, earth_field: FloatArray,
                  bias_std: float) -> list[FieldInconsistency]:
    """Find the sensors that do not measure the Earth's field.

    Parameters
    ----------
    names : sequence of n str
    fields : (n, 3) array, T, sensor frames
        Fields measured without a target; NaN for an unreported axis.
    R_ws : (n, 3, 3) array
        Sensor to world.
    orientation_std : (n, 3) array, rad
        Standard deviations of the orientations, about the world axes.
    earth_field : (3,) array, T, world frame
    bias_std : float, T
        Standard deviation of the bias of a sensor, including nearby iron, per axis.

    Returns
    -------
    list of FieldInconsistency
        In the order of `names`.
    """
    B0 = np.asarray(earth_field, dtype=float)
    suspects = [j for j in range(len(names))
                if not _is_consistent(fields[j], R_ws[j], orientation_std[j], B0, bias_std)]
    inconsistencies = []
    for j in suspects:
        magnitude = np.sqrt(np.nansum((fields[j] - R_ws[j].T @ B0)**2))
        inconsistencies.append(FieldInconsistency(names[j], float(magnitude), _explanations(
            j, suspects, names, fields, R_ws, orientation_std, B0, bias_std)))
    return inconsistencies


def _is_consistent(y: FloatArray, R_ws: FloatArray, std: FloatArray, B0: FloatArray,
                   bias_std: float) -> bool:
    """Whether a measured field is consistent with the Earth's field at the best heading."""
    return _is_consistent_cached(
        _cache_key(y), _cache_key(R_ws), _cache_key(std), _cache_key(B0), bias_std)


def _cache_key(a: FloatArray) -> tuple[float, ...]:
    """Elements of an array as a hashable cache key."""
    return tuple(np.ravel(a).tolist())


@functools.lru_cache(maxsize=4096)
def _is_consistent_cached(field: tuple[float, ...], orientation: tuple[float, ...],
                          orientation_std: tuple[float, ...], B0: tuple[float, ...],
                          bias_std: float) -> bool:
    """Compute `_is_consistent` from tuples, which are hashable, and cache the result."""
    y, R_ws, std = (np.array(field), np.array(orientation).reshape(3, 3),
                    np.array(orientation_std))
    is_reported = ~np.isnan(y)
    if not is_reported.any():
        return True
    # Heading errors may be large, so a grid is tested; tilts are small and are linearised.
    yaw, B = _headings(std, np.array(B0))
    tilt_effect = (R_ws.T @ np.cross(np.eye(3), np.array(B0)).T * std)[:, :2]
    S = (bias_std**2 * np.eye(3) + tilt_effect @ tilt_effect.T)[np.ix_(is_reported, is_reported)]
    r = (y - B @ R_ws)[:, is_reported]
    energy = np.einsum('ni,ij,nj->n', r, np.linalg.inv(S), r) + (yaw / std[2])**2
    return bool(energy.min() <= chi2.isf(FALSE_ALARM_PROBABILITY, np.count_nonzero(is_reported)))


def _explanations(j: int, suspects: Sequence[int], names: Sequence[str], fields: FloatArray,
                  R_ws: FloatArray, orientation_std: FloatArray, B0: FloatArray,
                  bias_std: float) -> tuple[str, ...]:
    """Simplest faults that explain the field of sensor `j`; empty if no fault does."""
    def fits(y: FloatArray, R: FloatArray = R_ws[j],
             std: FloatArray = orientation_std[j]) -> bool:
        return _is_consistent(y, R, std, B0, bias_std)

    y = fields[j]
    # Exchanged sensors: both must be suspect, and both must fit after the exchange.
    explanations = [f'it is exchanged with {names[i]}' for i in suspects if i != j
                    and fits(y, R_ws[i], orientation_std[i])
                    and fits(fields[i], R_ws[j], orientation_std[j])]
    explanations += [f'its unit is {unit}' for unit, scale in UNITS if fits(y / scale)]
    if explanations:
        return tuple(explanations)
    for changes in _axis_changes():
        explanations = [description for description, order, signs in changes
                        if fits(signs * y[list(order)])]
        if explanations:
            return tuple(explanations)
    return _partial_explanation(y, R_ws[j], orientation_std[j], B0)


def _partial_explanation(y: FloatArray, R_ws: FloatArray, std: FloatArray,
                         B0: FloatArray) -> tuple[str, ...]:
    """Describe the simplest change of axes that explains most of the difference from `B0`.

    Empty if there is no such change, or if it is not unique.
    """
    original_difference = _remaining_difference(y, R_ws, std, B0)
    for changes in _axis_changes():
        remainders = sorted(
            (_remaining_difference(signs * y[list(order)], R_ws, std, B0), description)
            for description, order, signs in changes)
        # If two changes explain the difference equally well, neither is reported.
        if remainders[0][0] < MAX_REMAINING_FRACTION * original_difference and not (
                len(remainders) > 1 and remainders[1][0] < remainders[0][0] / MAX_RATIO_TO_NEXT):
            return (f'{remainders[0][1]}, and {remainders[0][0] * 1e6:.2g} uT remain (due to '
                    'nearby iron or the bias of the sensor)',)
    return ()


def _remaining_difference(y: FloatArray, R_ws: FloatArray, std: FloatArray,
                          B0: FloatArray) -> float:
    """Magnitude [T] of a measured field minus the Earth's field, at the best heading."""
    is_reported = ~np.isnan(y)
    _, B = _headings(std, B0)
    return float(np.linalg.norm((y - B @ R_ws)[:, is_reported], axis=1).min())


def _headings(std: FloatArray, B0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tested heading errors (n,) [rad] of a sensor, and the Earth's fields (n, 3) [T].

    Each field is rotated by the corresponding heading error.
    """
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
            if flipped_axes:
                parts.append(f'{" and ".join(flipped_axes)} '
                             f'{"is" if len(flipped_axes) == 1 else "are"} flipped')
            groups.setdefault((n_moved + len(flipped_axes) + (n_moved > 0), n_moved), []).append(
                (', '.join(parts), order, np.array(signs)))
    return [groups[key] for key in sorted(groups)]
