"""Table of fitted passes, written as CSV during the run and as JSON at its end."""

import csv
import math
from collections.abc import Iterable
from contextlib import AbstractContextManager
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.analysis.pass_result import Bearing, PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import OutputError
from mag_tracking.files import new_text_file, output_folder, write_json
from mag_tracking.results.columns import FITS, names_of

_NAMES = names_of(FITS)


def fit_row(fit: PassFit, is_reported: bool = True) -> dict[str, Any]:
    """Values of a fit by column, without those that identify the pass; NaN if not trusted, also for
    the trusted quantities of a fit that is neither trusted nor reported."""
    row: dict[str, Any] = dict.fromkeys(_NAMES[_NAMES.index('stamp_ns'):], math.nan)
    row |= {'ambiguous': '', 'trusted': '', 'n_dipoles': fit.n_dipoles, 'reason': fit.reason,
            'stamp_ns': fit.data.stamp_ns, 'n_values': fit.data.n_values,
            'n_unknowns': fit.n_unknowns}
    if len(fit.x):
        row |= {'normalised_cost': fit.normalised_cost, 'explained': fit.explained,
                'residual_elsewhere': fit.residual_elsewhere,
                'velocity_change': fit.velocity_change,
                'trusted': ' '.join(fit.trusted) if is_reported else ''}
    if fit.bearing is not None:
        b = fit.bearing
        row |= {'cpa_time': b.cpa_time, 'sd_cpa_time': b.cpa_time_std, 'rate': b.rate,
                'sd_rate': b.rate_std}
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    trusted = fit.trusted if fit.reason and is_reported else ()
    groups: list[tuple[str, Iterable[float]]] = []
    if not fit.reason or 'speed' in trusted:
        groups.append(('speed sd_speed', fit.speed))
    if not fit.reason or 'direction' in trusted:
        groups.append(('heading_deg sd_heading_deg', np.degrees(fit.heading)))
    if not fit.reason or 'time' in trusted:
        groups.append(('cpa_time sd_cpa_time', fit.closest_approach(centre)[:2]))
    if not fit.reason:
        row['ambiguous'] = int(fit.ambiguous)
        moment, P = fit.moment
        groups += [
            ('x y z', fit.position), ('sd_x sd_y sd_z', _std(fit.position_covariance)),
            ('vx vy vz', fit.velocity),
            ('sd_vx sd_vy sd_vz', _std(fit.robust_covariance[3:6, 3:6])),
            ('length sd_length', fit.length), ('mx my mz', moment), ('sd_mx sd_my sd_mz', _std(P)),
            ('cpa_range sd_cpa_range', fit.closest_approach(centre)[2:])]
    for names, values in groups:
        row |= dict(zip(names.split(), map(float, values), strict=True))
    return row


def _std(P: FloatArray) -> FloatArray:
    std: FloatArray = np.sqrt(np.diagonal(P))
    return std


def pass_rows(fitted_pass: FittedPass) -> list[dict[str, Any]]:
    """Rows of a fitted pass with the columns `FITS`, one per fit."""
    chosen, reported, c = fitted_pass.chosen, fitted_pass.reported, fitted_pass.correlated
    delay = {'delay_speed': c.speed, 'sd_delay_speed': c.speed_std,
             'delay_heading_deg': math.degrees(c.heading),
             'sd_delay_heading_deg': math.degrees(c.heading_std), 'no_delay': c.reason}
    return [{'recording': fitted_pass.recording, 'pass': fitted_pass.number,
             'vehicle': fitted_pass.vehicle, 'n_vehicles': fitted_pass.n_vehicles,
             **fit_row(fit, fit is reported),
             'chosen': int(fit is chosen), **delay} for fit in fitted_pass.fits]


class FitFolder(AbstractContextManager['FitFolder']):
    """Writes `fits.csv` continuously, and on exit, even after an error, `fits.json` with the
    entries of `summary`; a context manager."""

    def __init__(self, folder: str | PathLike[str]) -> None:
        self.folder = output_folder(folder)
        self.rows: list[dict[str, Any]] = []
        self.summary: dict[str, Any] = {}
        try:
            self._stream = new_text_file(self.folder / 'fits.csv', newline='')
        except OSError as error:
            raise OutputError(f'cannot write to {self.folder}: {error.strerror}') from error
        self._writer = csv.writer(self._stream)
        self._writer.writerow(_NAMES)

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        write_json(self.folder / 'fits.json', {'fits': self.rows, **self.summary})

    def add(self, fitted_pass: FittedPass) -> None:
        """Write the rows of a fitted pass."""
        for fit, row in zip(fitted_pass.fits, pass_rows(fitted_pass), strict=True):
            self.rows.append(row | {'notes': list(fitted_pass.notes),
                                    'bearing': _bearing(fit.bearing)})
            self._writer.writerow([row[name] for name in _NAMES])
        self._stream.flush()


def _bearing(bearing: Bearing | None) -> dict[str, Any] | None:
    if bearing is None:
        return None
    return {'to_closest_point': bearing.cpa_direction.tolist(),
            'motion': bearing.motion_direction.tolist(),
            'moment': bearing.moment_direction.tolist(),
            'std_deg': np.degrees(bearing.direction_std).tolist(),
            'or_reversed': 'target and motion may both be reversed'}
