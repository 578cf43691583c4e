"""T10, Figures 5.2 to 5.4: what one and two magnetometers tell, and how far they reach.

T10 is Wahlström, Target Tracking using Maxwell's Equations, 2010, chapter 5. The target of
its Table 5.1 drives past a sensor at the origin; the noise is the identity and the field is
without mu0/4 pi, as its numbers are relative. Ranges are in TSP14's scale (Wahlström &
Gustafsson, Magnetometer Modeling and Validation, 2014), as T10's tesla are too small by
about 450.

The samples are k = 0 .. 59, from [-3, 1, 0] on. T10's sum (5.2) has k = 1 .. 60.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from mag_tracking.inference.crlb import information, observability, snr_range
from mag_tracking.inference.detection_theory import (
    detection_probability,
    energy_threshold,
    false_alarm_probability,
)
from mag_tracking.physics.dipole import K_DIPOLE, dipole_field, dipole_jacobians

R0, V0, M = np.array([-3.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.ones(3)
"""Table 5.1: [m], [m/s], relative."""
N_SAMPLES, SAMPLE_TIME = 60, 0.1
NAMES = [f'{state}_{axis}' for state in ('r0', 'v0', 'm') for axis in 'xyz']
ONE, TWO = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
SCALE = np.repeat([1.0, 1.0 / (N_SAMPLES * SAMPLE_TIME), 1.0], 3)
"""Sizes of r0, v0 and m by (5.11), for r = 1 m and T = 6 s."""
P_FA, P_D, SNR = 0.01, 0.5, 9.2
NOISE_STD = np.sqrt(1.3e-16)
"""[T] of an axis, TSP14 section VI.B."""
MOMENTS = {'small car': 300.0, 'large car': 600.0, 'truck': 1800.0}
"""[A m^2], TSP14."""
GRID = np.arange(-30, 31) / 5.0
"""[m] places of the second sensor."""


def sensor_information(sensor, m=M):
    """Information of one sensor at (3,) [m] about [r0, v0, m], (9, 9); (5.2)."""
    t = SAMPLE_TIME * np.arange(N_SAMPLES)[:, None]
    dB_dd, dB_dm = dipole_jacobians(sensor - (R0 + t * V0), m)
    return information(np.concatenate([-dB_dd, -t[:, :, None] * dB_dd, dB_dm], axis=-1) / K_DIPOLE)


def seen_by(sensors, m=M):
    """Observability of the nine states with several sensors (n, 3); (5.7)."""
    return observability(sum(sensor_information(s, m) for s in sensors), NAMES)


def information_map():
    """Information of the first sensor and a second one at each place, (n_y, n_x, 9, 9)."""
    places = np.stack(np.broadcast_arrays(GRID, GRID[:, None], 0.0), axis=-1)
    return sensor_information(ONE[0]) + np.apply_along_axis(sensor_information, -1, places)


def condition_map(J, scale=None):
    """Condition number (n_y, n_x) of matrices (n_y, n_x, 9, 9); infinite where singular."""
    numbers = np.full(J.shape[:2], np.inf)
    for at in np.argwhere(np.isfinite(J).all(axis=(-2, -1))):  # the path may meet the sensor
        numbers[tuple(at)] = observability(J[tuple(at)], NAMES, scale).condition_number
    return numbers


def about_cpa(J):
    """Information about [r at the closest point, v0, m] instead of [r0, v0, m]."""
    t_cpa = -(R0 @ V0) / (V0 @ V0)
    T = np.eye(9) - t_cpa * np.eye(9, k=3) * (np.arange(9) < 3)[:, None]
    return T.T @ J @ T


def condition_maps():
    """Condition numbers by the states they are of: (5.1)'s, about the closest point, (5.11)'s."""
    J = information_map()
    return {'plain': condition_map(J), 'cpa': condition_map(about_cpa(J)),
            'scaled': condition_map(J, SCALE)}


def best_place(numbers, same_side=False):
    """Place (x, y) of the smallest number, and it; 1 m or more from the line of the path."""
    y = GRID[:, None]
    masked = np.where((np.abs(y - 1.0) > 0.999) & ((y < 1.0) | (not same_side)), numbers, np.inf)
    i, j = np.unravel_index(masked.argmin(), masked.shape)
    return (float(GRID[j]), float(GRID[i])), float(masked[i, j])


def figure_5_2():
    """Eigenvalues of the information matrix for one and two sensors."""
    figure = Figure(figsize=(7.5, 4.6), layout='constrained')
    axes, number = figure.add_subplot(), np.arange(1, 10)
    for sensors, style, label in ((ONE, 'o', 'one sensor, at [0, 0, 0]'),
                                  (TWO, 's', 'two sensors, at [0, 0, 0] and [0, 2, 0]')):
        seen = seen_by(sensors)
        zero = seen.kernel_dimension
        points, = axes.semilogy(number[zero:], seen.eigenvalues[zero:], style, label=label)
        axes.plot(number[:zero], np.full(zero, 2e-2), 'v', mfc='w', ms=9,
                  mec=points.get_color())
        for k in range(zero):
            axes.annotate('zero', (number[k], 2e-2), xytext=(14, -4), textcoords='offset points')
    axes.set(ylim=(1e-2, 3e4), xlabel='number of the eigenvalue, ascending',
             ylabel='eigenvalue (relative units)', xticks=number,
             title='T10 Figure 5.2: eigenvalues of the information matrix')
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left')
    return figure


def figure_5_3(numbers):
    """Condition number (n_y, n_x) by the second sensor's place, log colours."""
    figure = Figure(figsize=(7.5, 6.0), layout='constrained')
    axes = figure.add_subplot()
    shown = np.clip(numbers, None, 1e300)  # infinite: as bad as can be shown
    image = axes.pcolormesh(GRID, GRID, shown, cmap='viridis_r', norm=LogNorm(1e3, 1e6),
                            shading='nearest', rasterized=True)
    path = R0 + SAMPLE_TIME * np.arange(N_SAMPLES)[:, None] * V0
    axes.plot(path[:, 0], path[:, 1], 'r-', lw=2.0, label='path')
    axes.annotate('', path[-1, :2] + [0.6, 0.0], path[-1, :2],
                  arrowprops={'arrowstyle': '->', 'color': 'r', 'lw': 2.0})
    axes.plot(0.0, 0.0, 'r^', ms=9, mec='w', label='first sensor')
    axes.plot(0.0, 2.0, 'wD', ms=7, mec='k', label='opposite the first, [0, 2]')
    axes.plot(*best_place(numbers)[0], 'w*', ms=13, mec='k',
              label='best at 1 m or more from the line')
    figure.colorbar(image, extend='both', label='condition number')
    axes.set(aspect='equal', xlabel='x of the second sensor [m]',
             ylabel='y of the second sensor [m]',
             title='T10 Figure 5.3: condition number of the information matrix')
    figure.legend(loc='outside lower center', ncols=4, fontsize=8)
    return figure


def figure_5_4():
    """Distribution of the test statistic without and with a target."""
    figure = Figure(figsize=(7.5, 4.6), layout='constrained')
    axes, x, h = figure.add_subplot(), np.linspace(0.0, 35.0, 701), energy_threshold(P_FA, 3)
    for density, colour, name, tail in (
            (chi2.pdf(x, 3), 'tab:blue', 'H0: noise alone', P_FA),
            (ncx2.pdf(x, 3, SNR), 'tab:orange', f'H1: target, SNR {SNR}',
             detection_probability(SNR, h, 3))):
        axes.plot(x, density, color=colour, label=f'{name}; {tail:.3f} beyond the threshold')
        axes.fill_between(x, density, where=x >= h, color=colour, alpha=0.3, lw=0)
    axes.axvline(h, color='k', ls='--', lw=1.2, label=f'threshold {h:.2f} for P_FA {P_FA}')
    axes.set(xlabel='test statistic y\' R⁻¹ y', ylabel='probability density', xlim=(0.0, 35.0),
             ylim=(0.0, None), title='T10 Figure 5.4: energy of one measurement, three axes')
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def comparison(maps):
    """The numbers by name; `maps` are those of `condition_maps`."""
    up, h = np.array([0.0, 0.0, 1.0]), energy_threshold(P_FA, 3)
    one, two = seen_by(ONE), seen_by(TWO)
    d = -(R0 + SAMPLE_TIME * np.arange(N_SAMPLES)[:, None] * V0)
    B, thrice = dipole_field(d, M), dipole_field(3.0 * d, 27.0 * M)
    at = np.argmin(np.abs(GRID)), np.argmin(np.abs(GRID - 2.0))
    n = {'one': one.eigenvalues, 'up': seen_by(ONE, up).eigenvalues, 'two': two.eigenvalues,
         'condition': two.condition_number, 'kernel': one.kernel[:, 0] / one.kernel[1, 0],
         'thrice': np.abs(thrice - B).max() / np.abs(B).max(), 'threshold': h,
         'snr': brentq(lambda s: detection_probability(s, h, 3) - P_D, 1.0, 30.0),
         'p_fa at 11.2': false_alarm_probability(11.2, 3),
         'snr at 11.2': brentq(lambda s: detection_probability(s, 11.2, 3) - P_D, 1.0, 30.0),
         't10 range': snr_range(1.0, np.sqrt(1e-21), SNR),
         'ranges': {name: snr_range(m, NOISE_STD, SNR) for name, m in MOMENTS.items()}}
    for name, numbers in maps.items():
        n[f'{name} opposite'] = numbers[at[1], at[0]]
        n[f'{name} best'] = best_place(numbers)
        n[f'{name} best same side'] = best_place(numbers, same_side=True)
    return n


def report(n):
    """What agrees with T10 and what does not, as text."""
    def place(name):
        (x, y), number = n[name]
        return f'{number:.0f} at [{x:.1f}, {y:.1f}]'

    def list_of(values):
        return ', '.join(f'{np.where(abs(v) < 1e-9, 0.0, v):.4g}' for v in values)

    ranges = ', '.join(f'{name} {r:.1f} m' for name, r in n['ranges'].items())
    return f"""\
Figure 5.2, eigenvalues
  agrees   One sensor: {list_of(n['one'][:2])} are the smallest, so that one direction is lost:
           ({list_of(n['kernel'])}) = [r0, v0, 3 m].
           Three times the distance and speed, 27 times the moment: the field differs by
           {n['thrice']:.0e} of itself (5.5). Two sensors: {list_of(n['two'][:1])} is the smallest.
  differs  (5.3) gives one direction for all states. For m = [0, 0, 1], across the plane
           of path and sensor, two are lost: {list_of(n['up'][:3])}.
Figure 5.3, second sensor
  agrees   The condition number at [0, 2] is {n['plain opposite']:.0f}. On the first sensor's side
           the second should be well apart: the best is {place('plain best same side')}
           (all bests 1 m or more from the line of the path).
  differs  Opposite the first is not the best: that is {place('plain best')}, as the states
           are those at the start, left of both. For the position at the closest point instead
           T10 is nearly right: [0, 2] has {n['cpa opposite']:.0f}, the best is {place('cpa best')},
           on the first sensor's side {place('cpa best same side')}.
           With the scale of (5.11), which makes v0 count in r/T, [0, 2] has
           {n['scaled opposite']:.0f}, and the best is on the same side: {place('scaled best')}.
Figure 5.4, test statistic
  differs  The threshold for P_FA 0.01 is {n['threshold']:.3f}, not 11.2 (which has P_FA \
{n['p_fa at 11.2']:.4f}).
           P_D 0.5 then needs an SNR of {n['snr']:.2f}; with 11.2 it is \
{n['snr at 11.2']:.2f}, T10's 9.2.
Range (5.20)-(5.24), at SNR {SNR}
  agrees   T10's own numbers give {n['t10 range']:.1f} m, its 10 m.
  agrees   In TSP14's scale: {ranges}.
           The least over all directions; along the dipole's axis 1.26 times as far."""


def main(argv=None):
    """Write the figures, print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('out/t10_observability'))
    out = parser.parse_args(argv).out
    out.mkdir(parents=True, exist_ok=True)
    maps = condition_maps()
    for name, figure in (('figure_5_2', figure_5_2()), ('figure_5_3', figure_5_3(maps['plain'])),
                         ('figure_5_4', figure_5_4())):
        figure.savefig(out / f'{name}.png', dpi=110)
    print(report(comparison(maps)))
    print(f'figures: {out}')


if __name__ == '__main__':
    main()
