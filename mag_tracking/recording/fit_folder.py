"""The table of fitted passes: CSV as it goes, JSON at the end."""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mag_tracking.analysis.pass_result import Bearing, PassFit
from mag_tracking.errors import OutputError
from mag_tracking.recording.result_folder import without_nan

FIT_COLUMNS = (
    'recording', 'pass', 'n_dipoles', 'chosen', 'reason', 'stamp_ns', 'n_values', 'n_unknowns',
    'normalised_cost', 'explained', 'velocity_change', 'ambiguous', 'x', 'y', 'z', 'vx', 'vy',
    'vz', 'sd_x', 'sd_y', 'sd_z', 'sd_vx', 'sd_vy', 'sd_vz', 'speed', 'sd_speed', 'heading_deg',
    'sd_heading_deg', 'length', 'sd_length', 'mx', 'my', 'mz', 'sd_mx', 'sd_my', 'sd_mz',
    'cpa_time', 'sd_cpa_time', 'cpa_range', 'sd_cpa_range', 'rate', 'sd_rate')
"""Deviations are of `PassFit.honest_covariance`; the CPA is to the middle of the sensors, its time
in seconds after `stamp_ns`. The rate is speed over CPA range, which one sensor alone tells; its
directions are in `fits.json`."""


class _FittedPass(Protocol):
    """See `apps.fit.FittedPass`."""

    @property
    def recording(self) -> str: ...
    @property
    def number(self) -> int: ...
    @property
    def fits(self) -> Sequence[PassFit]: ...
    @property
    def notes(self) -> Sequence[str]: ...
    @property
    def chosen(self) -> PassFit | None: ...


def fit_row(fit: PassFit) -> dict[str, Any]:
    """{column: number} of one `PassFit`, without those that say which pass it is.

    Where the fit has a reason not to be believed all numbers of the target are NaN.
    """
    row: dict[str, Any] = dict.fromkeys(FIT_COLUMNS[6:], math.nan)
    row |= {'ambiguous': '', 'n_dipoles': fit.n_dipoles, 'reason': fit.reason,
            'stamp_ns': fit.data.stamp_ns, 'n_values': fit.data.n_values, 'n_unknowns': len(fit.x)}
    if len(fit.x):
        row |= {'normalised_cost': fit.normalised_cost, 'explained': fit.explained,
                'velocity_change': fit.velocity_change}
    if fit.bearing is not None:
        b = fit.bearing
        row |= {'cpa_time': b.cpa_time, 'sd_cpa_time': b.cpa_time_std, 'rate': b.rate,
                'sd_rate': b.rate_std}
    if fit.reason:
        return row
    row['ambiguous'] = int(fit.ambiguous)
    sd = np.sqrt(np.diagonal(fit.honest_covariance))
    moment, P = fit.moment
    heading = [math.degrees(v) for v in fit.heading]
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    groups: tuple[tuple[str, Iterable[float]], ...] = (
        ('x y z', fit.position), ('vx vy vz', fit.velocity),
        ('sd_x sd_y sd_z sd_vx sd_vy sd_vz', sd[:6]), ('speed sd_speed', fit.speed),
        ('heading_deg sd_heading_deg', heading), ('length sd_length', fit.length),
        ('mx my mz', moment), ('sd_mx sd_my sd_mz', np.sqrt(np.diagonal(P))),
        ('cpa_time sd_cpa_time cpa_range sd_cpa_range', fit.closest_approach(centre)))
    for names, values in groups:
        row |= dict(zip(names.split(), map(float, values), strict=True))
    return row


def pass_rows(one: _FittedPass) -> list[dict[str, Any]]:
    """[{column: value}] of a `FittedPass`, one for each of its fits: `FIT_COLUMNS`."""
    return [{'recording': one.recording, 'pass': one.number, **fit_row(fit),
             'chosen': int(fit is one.chosen)} for fit in one.fits]


class FitFolder:
    """`fits.csv` and `fits.json` in a folder; a context manager.

    Rows are written as they come, `fits.json` at the end, whatever ended it; what is put into
    `summary` is in it, too.
    """

    def __init__(self, folder: str | PathLike[str]) -> None:
        """Raises OutputError where the folder cannot be made or written."""
        self.folder = Path(folder)
        self.rows: list[dict[str, Any]] = []
        self.summary: dict[str, Any] = {}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._stream = open(self.folder / 'fits.csv', 'w', newline='', encoding='utf-8')
        except OSError as error:
            raise OutputError(f'cannot write to {self.folder}: {error.strerror}') from error
        self._writer = csv.writer(self._stream)
        self._writer.writerow(FIT_COLUMNS)

    def __enter__(self) -> 'FitFolder':
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        with open(self.folder / 'fits.json', 'w', encoding='utf-8') as stream:
            json.dump(without_nan({'fits': self.rows, **self.summary}), stream, indent=1,
                      allow_nan=False)
            stream.write('\n')

    def add(self, one: _FittedPass) -> None:
        """Write the rows of a `FittedPass`."""
        for fit, row in zip(one.fits, pass_rows(one), strict=True):
            self.rows.append(row | {'notes': list(one.notes), 'bearing': _bearing(fit.bearing)})
            self._writer.writerow([repr(v) if isinstance(v, float) else v
                                   for v in (row[c] for c in FIT_COLUMNS)])
        self._stream.flush()


def _bearing(bearing: Bearing | None) -> dict[str, Any] | None:
    """A `Bearing` for JSON, or None."""
    if bearing is None:
        return None
    return {'to_closest_point': bearing.cpa_direction.tolist(),
            'motion': bearing.motion_direction.tolist(),
            'moment': bearing.moment_direction.tolist(),
            'std_deg': np.degrees(bearing.direction_std).tolist(),
            'or_reversed': 'target and motion may both be reversed'}
