"""Figures of fitted passes; each function returns one figure."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.report.figures import SCALE_1D
from mag_tracking.report.literal_text import literal
from mag_tracking.report.palette import AXIS_COLOURS, SERIES_COLOURS
from mag_tracking.report.scales import field_unit
from mag_tracking.report.style import legend_beside, plain_log_ticks


class _Network(Protocol):
    """Attributes of a `SensorNetwork` that the figures use."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def index(self, name: str) -> int: ...


class _Data(Protocol):
    """Attributes of a `PassData` that the figures use."""

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
    """Attributes of a `PassFit` that the figures use."""

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
    """Attributes of a `FittedPass` that the figures use."""

    @property
    def recording(self) -> str: ...

    @property
    def label(self) -> str: ...

    @property
    def fits(self) -> Sequence[_Fit]: ...

    @property
    def chosen(self) -> _Fit | None: ...


def pass_figure(fit: _Fit, title: str, max_sensors: int = 6) -> Figure:
    """Plot the measured and the fitted field, with bands that should contain 90 % of the readings.

    The bands account for the noise and for the uncertainty of the fitted parameters
    (`PassFit.robust_covariance`). A normalised cost above 1 scales the noise variance, to account
    for model errors. Only the `max_sensors` sensors with the strongest fields are plotted. As
    [TSP14]_ Fig. 6.
    """
    data = fit.data
    background = fit.predicted - target_alone(fit)
    strength = {j: np.nanmax(np.abs(data.field - background)[data.sensor == j])
                for j in data.sensors}
    strongest = sorted(sorted(strength, key=lambda j: -strength[j])[:max_sensors])
    f, unit = field_unit(max(strength.values()))
    factor = max(1.0, fit.normalised_cost)
    figure = Figure(figsize=(10.0, 1.0 + 2.6 * len(strongest)), layout='constrained')
    for axes, j in zip(figure.subplots(len(strongest), 1, squeeze=False, sharex=True).flat,
                       strongest, strict=True):
        rows = data.sensor == j
        t = data.t[rows]
        # At rest, a coarse sensor has an enlarged covariance, so that all its readings count as one
        # reading. The minimum excludes these covariances.
        noise = np.nanmin(np.einsum('nii->ni', data.covariance[rows]), axis=0, initial=np.inf)
        for a, colour in enumerate(AXIS_COLOURS):
            if np.isnan(data.field[rows, a]).all():
                continue
            middle = f * (fit.predicted - background)[rows, a]
            half = f * SCALE_1D * np.sqrt(fit.predicted_std[rows, a]**2 + factor * noise[a])
            axes.fill_between(t, middle - half, middle + half, color=colour, alpha=0.25, lw=0)
            axes.plot(t, f * (data.field - background)[rows, a], '.', ms=2.5, color=colour,
                      label=f'{"xyz"[a]}')
            axes.plot(t, middle, '-', lw=0.9, color='k')
        axes.set_title(literal(data.network.names[j]), fontsize=9)
        axes.set_ylabel(f'field [{unit}]')
        axes.grid(alpha=0.3)
        legend_beside(axes)
    axes.set_xlabel('time relative to the strongest field [s]')
    figure.suptitle(f'{literal(title)}: measured (dots), fitted (lines), 90 % bands', fontsize=11)
    return figure


def target_alone(fit: _Fit) -> FloatArray:
    """Fitted field (n, 3) [T] of the target, without the fitted background of each sensor."""
    out = fit.predicted.copy()
    for name, value in zip(fit.names, fit.x, strict=True):
        if name.startswith('B '):
            sensor, axis = name[2:].rsplit(' ', 1)
            out[fit.data.sensor == fit.data.network.index(sensor), 'xyz'.index(axis)] -= value
    return out


def order_figure(passes: Sequence[_FittedPass]) -> Figure:
    """Plot the normalised cost against the number of dipoles, one line per pass, as [TSP14]_ Fig.
    7.

    A filled symbol marks the chosen number of dipoles.
    """
    figure = Figure(figsize=(7.5, 5.0), layout='constrained')
    axes = figure.add_subplot()
    for k, one in enumerate(passes):
        fits = [f for f in one.fits if len(f.x)]
        if not fits:
            continue
        colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
        axes.semilogy([f.n_dipoles for f in fits], [f.normalised_cost for f in fits], 'o-',
                      mfc='w', color=colour, label=literal(f'{one.recording}, {one.label}'))
        if one.chosen is not None:
            axes.semilogy([one.chosen.n_dipoles], [one.chosen.normalised_cost], 'o', ms=8,
                          color=colour)
    axes.axhline(1.0, color='k', lw=0.8, ls='--')
    axes.set_xticks(sorted({f.n_dipoles for one in passes for f in one.fits}))
    axes.set_xlabel('number of dipoles')
    axes.set_ylabel('normalised cost (1 if the residuals match the noise)')
    axes.grid(alpha=0.3, which='both')
    legend_beside(axes)
    plain_log_ticks(axes)
    figure.suptitle('Fit of a row of dipoles to each pass (filled: chosen order)',
                    fontsize=11)
    return figure
