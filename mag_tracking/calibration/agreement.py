"""Whether all sensors of a network measure the same Earth, and what is wrong where they do not.

Without a target every sensor has the same field in another frame. A flipped axis, a swapped
pair, another unit or two sensors in each other's place are seen at once, and told by name.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from scipy.stats import chi2

from mag_tracking.arrays import FloatArray

IMPROBABLE = 1e-5
"""A sensor that is right disagrees with this probability."""

FARTHEST = 5.0
"""A heading that is off by more deviations is not tried."""

YAW_STEP = np.deg2rad(0.25)
"""Headings are tried so far apart: of 20 uT across the vertical a tenth of a microtesla."""

MOST = 0.3
"""A change of axes explains most of a disagreement where it leaves less than this share ..."""

CLEARLY = 0.5
"""... and less than this share of what the next one as simple leaves."""

UNITS = (('gauss', 1e4), ('millitesla', 1e3), ('microtesla', 1e6), ('nanotesla', 1e9))
_AXES = 'xyz'

_Change: TypeAlias = tuple[str, tuple[int, ...], FloatArray]
"""Text, order and signs (3,) of a signed permutation."""


@dataclass(frozen=True)
class Disagreement:
    """A sensor whose field is not the Earth's."""

    sensor: str
    size: float
    """[T] Measured less expected."""
    explanations: tuple[str, ...]
    """What would explain it, the simplest only; empty where nothing that is known does."""

    def __str__(self) -> str:
        because = ' or '.join(self.explanations) or (
            'no axis, unit or exchange of sensors explains it: iron or a magnet beside it, or '
            'another orientation than stated')
        return f'{self.sensor} is {self.size * 1e6:.3g} uT from the field of the Earth: {because}'


def consensus(fields: FloatArray, R_ws: FloatArray) -> FloatArray:
    """(3,) [T] the field, in the world, that most sensors of a network agree on.

    `fields` (n, 3) [T], sensor frames, NaN = not reported; `R_ws` (n, 3, 3). Raises
    ValueError with fewer than three sensors with all axes: of two nobody knows which is right.
    """
    whole = ~np.isnan(fields).any(axis=1)
    if np.count_nonzero(whole) < 3:
        raise ValueError('without an earth_field three sensors with three axes are needed to '
                         f'compare, there are {np.count_nonzero(whole)}')
    field: FloatArray = np.median(np.einsum('jik,jk->ji', R_ws[whole], fields[whole]), axis=0)
    return field


def disagreements(names: Sequence[str], fields: FloatArray, R_ws: FloatArray,
                  orientation_std: FloatArray, earth_field: FloatArray,
                  bias_std: float) -> list[Disagreement]:
    """The sensors that do not measure the field of the Earth.

    Parameters
    ----------
    names : (n,) of str
    fields : (n, 3) [T], sensor frames
        Without a target; NaN = not reported.
    R_ws : (n, 3, 3)
    orientation_std : (n, 3) [rad]
        How far each may be turned, about the world's axes.
    earth_field : (3,) [T], world
    bias_std : float [T]
        What a sensor and the iron near it may add, on each axis.

    Returns
    -------
    list of Disagreement, in the order of `names`
    """
    B0 = np.asarray(earth_field, dtype=float)
    odd = [j for j in range(len(names))
           if not _fits(fields[j], R_ws[j], orientation_std[j], B0, bias_std)]
    out = []
    for j in odd:
        size = np.sqrt(np.nansum((fields[j] - R_ws[j].T @ B0)**2))
        out.append(Disagreement(names[j], float(size), _explanations(
            j, odd, names, fields, R_ws, orientation_std, B0, bias_std)))
    return out


def _fits(y: FloatArray, R_ws: FloatArray, std: FloatArray, B0: FloatArray,
          bias_std: float) -> bool:
    """Whether a field is no less likely than IMPROBABLE, at the heading that suits it best."""
    return _fits_numbers(_numbers(y), _numbers(R_ws), _numbers(std), _numbers(B0), bias_std)


def _numbers(a: FloatArray) -> tuple[float, ...]:
    """The elements, as a key of a cache."""
    return tuple(np.ravel(a).tolist())


@functools.lru_cache(maxsize=4096)
def _fits_numbers(field: tuple[float, ...], orientation: tuple[float, ...],
                  orientation_std: tuple[float, ...], B0: tuple[float, ...],
                  bias_std: float) -> bool:
    """`_fits` of tuples; a network that is watched is asked the same every second."""
    y, R_ws, std = (np.array(field), np.array(orientation).reshape(3, 3),
                    np.array(orientation_std))
    there = ~np.isnan(y)
    if not there.any():
        return True
    # A heading may be far off, and is tried; a tilt is small, and its effect is its slope.
    yaw, B = _headings(std, np.array(B0))
    turn = (R_ws.T @ np.cross(np.eye(3), np.array(B0)).T * std)[:, :2]
    S = (bias_std**2 * np.eye(3) + turn @ turn.T)[np.ix_(there, there)]
    r = (y - B @ R_ws)[:, there]
    energy = np.einsum('ni,ij,nj->n', r, np.linalg.inv(S), r) + (yaw / std[2])**2
    return bool(energy.min() <= chi2.isf(IMPROBABLE, np.count_nonzero(there)))


def _explanations(j: int, odd: Sequence[int], names: Sequence[str], fields: FloatArray,
                  R_ws: FloatArray, orientation_std: FloatArray, B0: FloatArray,
                  bias_std: float) -> tuple[str, ...]:
    """The simplest of what makes the field of sensor `j` fit."""
    def fits(y: FloatArray, R: FloatArray = R_ws[j],
             std: FloatArray = orientation_std[j]) -> bool:
        return _fits(y, R, std, B0, bias_std)

    y = fields[j]
    # Sensors in each other's place: both have to be odd, and both to fit then.
    found = [f'it and {names[i]} are exchanged' for i in odd if i != j
             and fits(y, R_ws[i], orientation_std[i])
             and fits(fields[i], R_ws[j], orientation_std[j])]
    found += [f'its unit is {unit}' for unit, scale in UNITS if fits(y / scale)]
    if found:
        return tuple(found)
    for others in _changes():
        found = [text for text, order, signs in others if fits(signs * y[list(order)])]
        if found:
            return tuple(found)
    return _most_likely(y, R_ws[j], orientation_std[j], B0)


def _most_likely(y: FloatArray, R_ws: FloatArray, std: FloatArray,
                 B0: FloatArray) -> tuple[str, ...]:
    """The simplest change of axes that explains most of the disagreement of a field, if any."""
    before = _remaining(y, R_ws, std, B0)
    for others in _changes():
        left = sorted((_remaining(signs * y[list(order)], R_ws, std, B0), text)
                      for text, order, signs in others)
        # Two that explain it as well are no explanation.
        if left[0][0] < MOST * before and not (
                len(left) > 1 and left[1][0] < left[0][0] / CLEARLY):
            return (f'{left[0][1]}, which leaves {left[0][0] * 1e6:.2g} uT (iron beside it, or its '
                    'own bias)',)
    return ()


def _remaining(y: FloatArray, R_ws: FloatArray, std: FloatArray, B0: FloatArray) -> float:
    """[T] What a field differs from the Earth's at the heading that suits it best."""
    there = ~np.isnan(y)
    _, B = _headings(std, B0)
    return float(np.linalg.norm((y - B @ R_ws)[:, there], axis=1).min())


def _headings(std: FloatArray, B0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Headings (n,) [rad] that a sensor may have, and the Earth's field (n, 3) for each."""
    most = min(np.pi, FARTHEST * std[2])
    yaw = np.linspace(-most, most, 1 + 2 * max(1, round(most / YAW_STEP)))
    return yaw, np.stack([B0[0] * np.cos(yaw) + B0[1] * np.sin(yaw),
                          B0[1] * np.cos(yaw) - B0[0] * np.sin(yaw), np.full(len(yaw), B0[2])],
                         axis=1)


def _changes() -> list[list[_Change]]:
    """Signed permutations in groups, the simplest first: lists of (text, order, signs)."""
    groups: dict[tuple[int, int], list[_Change]] = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            moved = sum(k != i for i, k in enumerate(order))
            flipped = [_AXES[i] for i, s in enumerate(signs) if s < 0.0]
            if not moved and not flipped:
                continue
            parts = []
            if moved == 2:
                parts.append(' and '.join(_AXES[i] for i in range(3) if order[i] != i)
                             + ' are swapped')
            elif moved:
                parts.append('its axes are in the order '
                             + ', '.join(_AXES[order.index(i)] for i in range(3)))
            if flipped:
                parts.append(f'{" and ".join(flipped)} {"is" if len(flipped) == 1 else "are"} '
                             'flipped')
            groups.setdefault((moved + len(flipped) + (moved > 0), moved), []).append(
                (', '.join(parts), order, np.array(signs)))
    return [groups[key] for key in sorted(groups)]
