"""Table of fitted passes, written as CSV during the run and as JSON at its end."""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Any, Protocol

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion
from mag_tracking.analysis.pass_result import Bearing, PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import OutputError
from mag_tracking.files import new_text_file, output_folder
from mag_tracking.report.json_text import without_nan
from mag_tracking.results.columns import FITS, names_of

_NAMES = names_of(FITS)


class _FittedPass(Protocol):
    """Interface of `apps.pass_fitter.FittedPass`."""

    @property
    def recording(self) -> str: ...
    @property
    def number(self) -> int: ...
    @property
    def vehicle(self) -> int: ...
    @property
    def n_vehicles(self) -> int: ...
    @property
    def fits(self) -> Sequence[PassFit]: ...
    @property
    def notes(self) -> Sequence[str]: ...
    @property
    def reported(self) -> PassFit | None: ...
    @property
    def correlated(self) -> CorrelatedMotion: ...
    @property
    def chosen(self) -> PassFit | None: ...


def fit_row(fit: PassFit, is_reported: bool = True) -> dict[str, Any]:
    """Values of a fit by column, without those that identify the pass; NaN if not trusted.

    A fit that is neither trusted nor reported for its pass lacks its trusted quantities too.
    """
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
    if fit.reason:
        return row | (_trusted_quantities(fit, centre) if is_reported else {})
    row['ambiguous'] = int(fit.ambiguous)
    sd = np.sqrt(np.concatenate([np.diagonal(fit.position_covariance),
                                 np.diagonal(fit.robust_covariance)[3:6]]))
    moment, P = fit.moment
    heading = [math.degrees(v) for v in fit.heading]
    groups: tuple[tuple[str, Iterable[float]], ...] = (
        ('x y z', fit.position), ('vx vy vz', fit.velocity),
        ('sd_x sd_y sd_z sd_vx sd_vy sd_vz', sd), ('speed sd_speed', fit.speed),
        ('heading_deg sd_heading_deg', heading), ('length sd_length', fit.length),
        ('mx my mz', moment), ('sd_mx sd_my sd_mz', np.sqrt(np.diagonal(P))),
        ('cpa_time sd_cpa_time cpa_range sd_cpa_range', fit.closest_approach(centre)))
    for names, values in groups:
        row |= dict(zip(names.split(), map(float, values), strict=True))
    return row


def _trusted_quantities(fit: PassFit, centre: FloatArray) -> dict[str, float]:
    """Trusted quantities of a fit, by column; the time of the CPA refers to `centre`, (3,) m."""
    quantities: dict[str, Iterable[float]] = {}
    if 'speed' in fit.trusted:
        quantities['speed sd_speed'] = fit.speed
    if 'direction' in fit.trusted:
        quantities['heading_deg sd_heading_deg'] = np.degrees(fit.heading)
    if 'time' in fit.trusted:
        quantities['cpa_time sd_cpa_time'] = fit.closest_approach(centre)[:2]
    return {name: float(value) for names, values in quantities.items()
            for name, value in zip(names.split(), values, strict=True)}


def pass_rows(fitted_pass: _FittedPass) -> list[dict[str, Any]]:
    """Rows of a fitted pass with the columns `FITS`, one per fit."""
    chosen, reported, c = fitted_pass.chosen, fitted_pass.reported, fitted_pass.correlated
    delay = {'delay_speed': c.speed, 'sd_delay_speed': c.speed_std,
             'delay_heading_deg': math.degrees(c.heading),
             'sd_delay_heading_deg': math.degrees(c.heading_std), 'no_delay': c.reason}
    return [{'recording': fitted_pass.recording, 'pass': fitted_pass.number,
             'vehicle': fitted_pass.vehicle, 'n_vehicles': fitted_pass.n_vehicles,
             **fit_row(fit, fit is reported),
             'chosen': int(fit is chosen), **delay} for fit in fitted_pass.fits]


class FitFolder:
    """Writes `fits.csv` and `fits.json` to a folder; a context manager.

    Rows are written immediately. `fits.json`, with the entries of `summary`, is written on exit,
    even after an error.
    """

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

    def __enter__(self) -> 'FitFolder':
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        with new_text_file(self.folder / 'fits.json') as stream:
            json.dump(without_nan({'fits': self.rows, **self.summary}), stream, indent=1,
                      allow_nan=False)
            stream.write('\n')

    def add(self, fitted_pass: _FittedPass) -> None:
        """Write the rows of a fitted pass."""
        for fit, row in zip(fitted_pass.fits, pass_rows(fitted_pass), strict=True):
            self.rows.append(row | {'notes': list(fitted_pass.notes),
                                    'bearing': _bearing(fit.bearing)})
            self._writer.writerow([row[name] for name in _NAMES])
        self._stream.flush()


def _bearing(bearing: Bearing | None) -> dict[str, Any] | None:
    """Convert a `Bearing` to a dict for JSON; return None if there is no bearing."""
    if bearing is None:
        return None
    return {'to_closest_point': bearing.cpa_direction.tolist(),
            'motion': bearing.motion_direction.tolist(),
            'moment': bearing.moment_direction.tolist(),
            'std_deg': np.degrees(bearing.direction_std).tolist(),
            'or_reversed': 'target and motion may both be reversed'}
