"""Figures of fitted passes: one function a figure, each returns the figure."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.report.figures import SCALE_1D
from mag_tracking.report.literal_text import literal
from mag_tracking.report.palette import AXIS_COLOURS, SERIES
from mag_tracking.report.scales import field_unit
from mag_tracking.report.style import legend_beside, plain_log_ticks


class _Network(Protocol):
    """What the figures read of a `SensorNetwork`."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def index(self, name: str) -> int: ...


class _Data(Protocol):
    """What the figures read of a `PassData`."""

    @property
    def network(self) -> _Network: ...

    @property
    def t(self) -> FloatArray: ...

    @property
    def sensor(self) -> IntArray: ...

    @property
    def field(self) -> FloatArray: ...

    @property
    def covariance(self) -> FloatArray: ...

    @property
    def sensors(self) -> IntArray: ...


class _Fit(Protocol):
    """What the figures read of a `PassFit`."""

    @property
    def n_dipoles(self) -> int: ...

    @property
    def data(self) -> _Data: ...

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def x(self) -> FloatArray: ...

    @property
    def predicted(self) -> FloatArray: ...

    @property
    def predicted_std(self) -> FloatArray: ...

    @property
    def normalised_cost(self) -> float: ...


class _FittedPass(Protocol):
    """What the figures read of a `FittedPass`."""

    @property
    def recording(self) -> str: ...

    @property
    def label(self) -> str: ...

    @property
    def fits(self) -> Sequence[_Fit]: ...

    @property
    def chosen(self) -> _Fit | None: ...


def pass_figure(fit: _Fit, title: str, most: int = 6) -> Figure:
    """Measured and fitted field with the band that 90 % of the measurements should lie in.

    By noise and `PassFit.robust_covariance`; where the normalised cost is above one, what the model
    does not describe counts as more noise.

    Parameters
    ----------
    fit : PassFit
    title : str
    most : int
        Sensors drawn; with more, those with the strongest field.

    Source: TSP14 Fig. 6.
    """
    data = fit.data
    level = fit.predicted - target_alone(fit)
    strength = {j: np.nanmax(np.abs(data.field - level)[data.sensor == j]) for j in data.sensors}
    shown = sorted(sorted(strength, key=lambda j: -strength[j])[:most])
    f, unit = field_unit(max(strength.values()))
    more = max(1.0, fit.normalised_cost)
    figure = Figure(figsize=(10.0, 1.0 + 2.6 * len(shown)), layout='constrained')
    for axes, j in zip(figure.subplots(len(shown), 1, squeeze=False, sharex=True).flat, shown,
                       strict=True):
        mine = data.sensor == j
        t = data.t[mine]
        # A coarse sensor at rest has a larger one, so that all its readings count as one.
        noise = np.nanmin(np.einsum('nii->ni', data.covariance[mine]), axis=0, initial=np.inf)
        for a, colour in enumerate(AXIS_COLOURS):
            if np.isnan(data.field[mine, a]).all():
                continue
            middle = f * (fit.predicted - level)[mine, a]
            half = f * SCALE_1D * np.sqrt(fit.predicted_std[mine, a]**2 + more * noise[a])
            axes.fill_between(t, middle - half, middle + half, color=colour, alpha=0.25, lw=0)
            axes.plot(t, f * (data.field - level)[mine, a], '.', ms=2.5, color=colour,
                      label=f'{"xyz"[a]}')
            axes.plot(t, middle, '-', lw=0.9, color='k')
        axes.set_title(literal(data.network.names[j]), fontsize=9)
        axes.set_ylabel(f'field [{unit}]')
        axes.grid(alpha=0.3)
        legend_beside(axes)
    axes.set_xlabel('time from the strongest field [s]')
    figure.suptitle(f'{literal(title)}: measured (dots), fitted (lines), 90 % bands', fontsize=11)
    return figure


def target_alone(fit: _Fit) -> FloatArray:
    """(n, 3) [T] the fitted field without the backgrounds, which are the last unknowns."""
    out = fit.predicted.copy()
    for name, value in zip(fit.names, fit.x, strict=True):
        if name.startswith('B '):
            sensor, axis = name[2:].rsplit(' ', 1)
            out[fit.data.sensor == fit.data.network.index(sensor), 'xyz'.index(axis)] -= value
    return out


def order_figure(passes: Sequence[_FittedPass]) -> Figure:
    """Normalised cost over the number of dipoles, a line a pass; filled = the order chosen.

    Parameters
    ----------
    passes : sequence of FittedPass

    Source: TSP14 Fig. 7.
    """
    figure = Figure(figsize=(7.5, 5.0), layout='constrained')
    axes = figure.add_subplot()
    for k, one in enumerate(passes):
        fits = [f for f in one.fits if len(f.x)]
        if not fits:
            continue
        colour = SERIES[k % len(SERIES)]
        axes.semilogy([f.n_dipoles for f in fits], [f.normalised_cost for f in fits], 'o-',
                      mfc='w', color=colour, label=literal(f'{one.recording}, {one.label}'))
        if one.chosen is not None:
            axes.semilogy([one.chosen.n_dipoles], [one.chosen.normalised_cost], 'o', ms=8,
                          color=colour)
    axes.axhline(1.0, color='k', lw=0.8, ls='--')
    axes.set_xticks(sorted({f.n_dipoles for one in passes for f in one.fits}))
    axes.set_xlabel('number of dipoles')
    axes.set_ylabel('normalised cost (1 = the model is right)')
    axes.grid(alpha=0.3, which='both')
    legend_beside(axes)
    plain_log_ticks(axes)
    figure.suptitle('How well a row of dipoles describes each pass (filled: the order chosen)',
                    fontsize=11)
    return figure
