"""Figures of a calibration; each function returns one figure."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import yaw_between
from mag_tracking.report.figures import SCALE_1D
from mag_tracking.report.literal_text import literal


class _Network(Protocol):
    """Attributes of a `SensorNetwork` that the figures use."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def R_ws(self) -> FloatArray: ...

    @property
    def orientation_std(self) -> tuple[FloatArray | None, ...]: ...

    @property
    def clock_offset(self) -> FloatArray: ...

    def __len__(self) -> int: ...

    def index(self, name: str) -> int: ...


class _Survey(Protocol):
    """Attributes of a `NetworkSurvey` that the figures use."""

    @property
    def network(self) -> _Network: ...

    @property
    def shocks(self) -> Mapping[str, tuple[FloatArray, FloatArray]]: ...


class _Calibration(Protocol):
    """Attributes of a `Calibration` that the figures use."""

    @property
    def network(self) -> _Network: ...

    @property
    def survey(self) -> _Survey: ...

    @property
    def evidence(self) -> object | None: ...


class _EllipsoidFit(Protocol):
    """Attributes of an `EllipsoidFit` that the figures use."""

    @property
    def coverage(self) -> float: ...

    def correct(self, readings: FloatArray) -> FloatArray: ...


def calibration_figure(calibration: _Calibration, nominal: _Network,
                       max_sensors: int = 8) -> Figure:
    """Plot the knocks before and after the clock correction, and the yaw of the sensors.

    `nominal` is the network with the orientations of the network file. The knocks of at most
    `max_sensors` sensors are plotted.
    """
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    _plot_knocks(left, middle, calibration, max_sensors)
    _plot_headings(right, calibration, nominal)
    return figure


def first_knock(shocks: Mapping[str, tuple[FloatArray, FloatArray]]) -> float:
    """Time [s] of the first acceleration above 30 % of the maximum of its sensor; 0 if none."""
    return min((float(t[s > 0.3 * s.max()][0]) for t, s in shocks.values()
                if len(s) and s.max() > 0.0), default=0.0)


def _plot_knocks(before: Axes, after: Axes, calibration: _Calibration, max_sensors: int) -> None:
    """Plot the acceleration around the first knock, before and after the clock correction."""
    shocks = {name: calibration.survey.shocks[name]
              for name in list(calibration.survey.shocks)[:max_sensors]}
    first = first_knock(shocks)
    for k, (name, (t, s)) in enumerate(shocks.items()):
        offset = calibration.network.clock_offset[calibration.network.index(name)]
        for axes, shift in ((before, 0.0), (after, offset)):
            near = np.abs(t - shift - first) < 0.25
            axes.plot(t[near] - shift - first, s[near], '.-', ms=4, lw=0.8, color=f'C{k}',
                      label=literal(name))
    for axes, title in ((before, 'knock, uncorrected clocks'), (after, 'knock, corrected clocks')):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel('time [s]')
        axes.grid(alpha=0.3)
    before.set_ylabel('acceleration relative to rest [m/s²]')
    if shocks:
        after.legend(fontsize=8)


def _plot_headings(axes: Axes, calibration: _Calibration, nominal: _Network) -> None:
    """Plot the yaw of each sensor relative to its nominal orientation, by calibration step."""
    n = len(nominal)
    steps = [('compass', calibration.survey.network, 'tab:orange', 0.12)]
    if calibration.evidence is not None:
        steps.append(('compass and passes', calibration.network, 'tab:blue', -0.12))
    for label, network, colour, shift in steps:
        yaw = [np.degrees(yaw_between(nominal.R_ws[j], network.R_ws[j])) for j in range(n)]
        std = [0.0 if s is None else SCALE_1D * np.degrees(s[2]) for s in network.orientation_std]
        axes.errorbar(yaw, np.arange(n) + shift, xerr=std, fmt='o', ms=4, capsize=3, color=colour,
                      label=label)
    axes.axvline(0.0, color='k', lw=0.8, ls=':', label='network file')
    axes.set_yticks(range(n), [literal(name) for name in nominal.names])
    axes.invert_yaxis()
    axes.set_title('rotation about the vertical (90 %)', fontsize=10)
    axes.set_xlabel('rotation [degrees]')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def tumble_figure(fits: Mapping[str, _EllipsoidFit], readings: Mapping[str, FloatArray]) -> Figure:
    """Plot a tumble calibration: magnitudes before and after correction, and field directions.

    `readings` (n, 3) are chronological.
    """
    figure = Figure(figsize=(10.0, 0.6 + 2.7 * len(fits)), layout='constrained')
    rows = figure.subplots(len(fits), 2, squeeze=False, width_ratios=(1.5, 1.0))
    for (left, right), (name, fit) in zip(rows, fits.items(), strict=True):
        y = readings[name][~np.isnan(readings[name]).any(axis=1)]
        B = fit.correct(y)
        for values, colour, label in ((y, 'tab:orange', 'raw data'), (B, 'tab:blue', 'corrected')):
            magnitude = np.linalg.norm(values, axis=1)
            left.plot(magnitude / magnitude.mean(), '.', ms=2, color=colour, rasterized=True,
                      label=f'{label}: std {100 * magnitude.std() / magnitude.mean():.2f} %')
        left.set_title(literal(name), fontsize=9)
        left.set_xlabel('reading')
        left.set_ylabel('field magnitude\nrelative to its mean')
        left.legend(fontsize=8, loc='upper right')
        u = B / np.linalg.norm(B, axis=1, keepdims=True)
        right.plot(np.degrees(np.arctan2(u[:, 1], u[:, 0])), u[:, 2], '.', ms=2,
                   color='tab:blue', rasterized=True)
        right.set_xlim(-180.0, 180.0)
        right.set_ylim(-1.0, 1.0)
        right.set_xlabel('azimuth of the field [degrees]')
        right.set_ylabel('z component')
        right.set_title(f'directions (equal-area), coverage {fit.coverage:.2f}', fontsize=9)
        for axes in (left, right):
            axes.grid(alpha=0.3)
    return figure
