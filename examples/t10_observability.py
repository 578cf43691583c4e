"""T10 Figures 5.2 to 5.4: observability with one and two magnetometers, and detection range.

T10 is Wahlström, Target Tracking using Maxwell's Equations, 2010, chapter 5. The target of its
Table 5.1 drives past a sensor at the origin. The noise covariance is the identity and the field
omits mu0/(4 pi), because the numbers of T10 are relative. Ranges are in the scale of TSP14
(Wahlström & Gustafsson, Magnetometer Modeling and Validation, 2014), because the fields in T10 are
too small by a factor of about 450.

The samples are k = 0 .. 59, starting at [-3, 1, 0]. The sum in T10 eq. (5.2) has k = 1 .. 60.
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
"""Table 5.1: position [m], velocity [m/s], moment (relative)."""
N_SAMPLES, SAMPLE_TIME = 60, 0.1
NAMES = [f'{state}_{axis}' for state in ('r0', 'v0', 'm') for axis in 'xyz']
ONE_SENSOR, TWO_SENSORS = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
SCALE = np.repeat([1.0, 1.0 / (N_SAMPLES * SAMPLE_TIME), 1.0], 3)
"""Typical magnitudes of r0, v0 and m by eq. (5.11), for r = 1 m and T = 6 s."""
P_FA, P_D, SNR = 0.01, 0.5, 9.2
NOISE_STD = np.sqrt(1.3e-16)
"""Noise standard deviation of one axis [T], TSP14 section VI.B."""
MOMENTS = {'small car': 300.0, 'large car': 600.0, 'truck': 1800.0}
"""Magnitudes of the moments [A m²], TSP14."""
GRID = np.arange(-30, 31) / 5.0
"""Coordinates of the second sensor [m]."""


def sensor_information(sensor, m=M):
    """Information matrix (9, 9) of [r0, v0, m] from one sensor at `sensor` (3,) [m], eq. (5.2)."""
    t = SAMPLE_TIME * np.arange(N_SAMPLES)[:, None]
    dB_dd, dB_dm = dipole_jacobians(sensor - (R0 + t * V0), m)
    return information(np.concatenate([-dB_dd, -t[:, :, None] * dB_dd, dB_dm], axis=-1) / K_DIPOLE)


def observability_of(sensors, m=M):
    """Observability of the nine states with sensors at (n, 3) [m]; eq. (5.7)."""
    return observability(sum(sensor_information(s, m) for s in sensors), NAMES)


def information_map():
    """Information matrices (n_y, n_x, 9, 9) with a second sensor at each point of the grid."""
    grid_points = np.stack(np.broadcast_arrays(GRID, GRID[:, None], 0.0), axis=-1)
    return sensor_information(ONE_SENSOR[0]) \
        + np.apply_along_axis(sensor_information, -1, grid_points)


def condition_map(J, scale=None):
    """Condition numbers (n_y, n_x) of matrices (n_y, n_x, 9, 9); infinite where singular."""
    numbers = np.full(J.shape[:2], np.inf)
    for at in np.argwhere(np.isfinite(J).all(axis=(-2, -1))):  # NaN if the sensor is on the path
        numbers[tuple(at)] = observability(J[tuple(at)], NAMES, scale).condition_number
    return numbers


def information_at_cpa(J):
    """Transform an information matrix of [r0, v0, m] to [r at the CPA, v0, m]."""
    t_cpa = -(R0 @ V0) / (V0 @ V0)
    T = np.eye(9) - t_cpa * np.eye(9, k=3) * (np.arange(9) < 3)[:, None]
    return T.T @ J @ T


def condition_maps():
    """Maps of the condition number for three state vectors.

    The state vectors are that of eq. (5.1), the same with the position at the CPA, and that of
    eq. (5.1) scaled by eq. (5.11).
    """
    J = information_map()
    return {'plain': condition_map(J), 'cpa': condition_map(information_at_cpa(J)),
            'scaled': condition_map(J, SCALE)}


def best_sensor_position(numbers, same_side=False):
    """Position (x, y) [m] of the second sensor with the smallest condition number, and this number.

    Only positions at least 1 m from the line of the path are considered. `same_side` excludes
    positions across the path from the first sensor.
    """
    y = GRID[:, None]
    masked = np.where((np.abs(y - 1.0) > 0.999) & ((y < 1.0) | (not same_side)), numbers, np.inf)
    i, j = np.unravel_index(masked.argmin(), masked.shape)
    return (float(GRID[j]), float(GRID[i])), float(masked[i, j])


def figure_5_2():
    """Plot the eigenvalues of the information matrix for one and two sensors."""
    figure = Figure(figsize=(7.5, 4.6), layout='constrained')
    axes, number = figure.add_subplot(), np.arange(1, 10)
    for sensors, style, label in ((ONE_SENSOR, 'o', 'one sensor, at [0, 0, 0]'),
                                  (TWO_SENSORS, 's', 'two sensors, at [0, 0, 0] and [0, 2, 0]')):
        observed = observability_of(sensors)
        zero = observed.kernel_dimension
        points, = axes.semilogy(number[zero:], observed.eigenvalues[zero:], style, label=label)
        axes.plot(number[:zero], np.full(zero, 2e-2), 'v', mfc='w', ms=9,
                  mec=points.get_color())
        for k in range(zero):
            axes.annotate('zero', (number[k], 2e-2), xytext=(14, -4), textcoords='offset points')
    axes.set(ylim=(1e-2, 3e4), xlabel='index of the eigenvalue, ascending',
             ylabel='eigenvalue (relative units)', xticks=number,
             title='T10 Figure 5.2: eigenvalues of the information matrix')
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left')
    return figure


def figure_5_3(numbers):
    """Plot a map of the condition numbers (n_y, n_x) by position of the second sensor."""
    figure = Figure(figsize=(7.5, 6.0), layout='constrained')
    axes = figure.add_subplot()
    clipped = np.clip(numbers, None, 1e300)  # LogNorm does not draw infinite values.
    image = axes.pcolormesh(GRID, GRID, clipped, cmap='viridis_r', norm=LogNorm(1e3, 1e6),
                            shading='nearest', rasterized=True)
    path = R0 + SAMPLE_TIME * np.arange(N_SAMPLES)[:, None] * V0
    axes.plot(path[:, 0], path[:, 1], 'r-', lw=2.0, label='path')
    axes.annotate('', path[-1, :2] + [0.6, 0.0], path[-1, :2],
                  arrowprops={'arrowstyle': '->', 'color': 'r', 'lw': 2.0})
    axes.plot(0.0, 0.0, 'r^', ms=9, mec='w', label='first sensor')
    axes.plot(0.0, 2.0, 'wD', ms=7, mec='k', label='opposite the first, [0, 2]')
    axes.plot(*best_sensor_position(numbers)[0], 'w*', ms=13, mec='k',
              label='best, at least 1 m from the line')
    figure.colorbar(image, extend='both', label='condition number')
    axes.set(aspect='equal', xlabel='x of the second sensor [m]',
             ylabel='y of the second sensor [m]',
             title='T10 Figure 5.3: condition number of the information matrix')
    figure.legend(loc='outside lower center', ncols=4, fontsize=8)
    return figure


def figure_5_4():
    """Plot the distributions of the test statistic without and with a target."""
    figure = Figure(figsize=(7.5, 4.6), layout='constrained')
    axes, x, h = figure.add_subplot(), np.linspace(0.0, 35.0, 701), energy_threshold(P_FA, 3)
    for density, colour, name, tail in (
            (chi2.pdf(x, 3), 'tab:blue', 'H0: noise only', P_FA),
            (ncx2.pdf(x, 3, SNR), 'tab:orange', f'H1: target, SNR {SNR}',
             detection_probability(SNR, h, 3))):
        axes.plot(x, density, color=colour, label=f'{name}; {tail:.3f} above the threshold')
        axes.fill_between(x, density, where=x >= h, color=colour, alpha=0.3, lw=0)
    axes.axvline(h, color='k', ls='--', lw=1.2, label=f'threshold {h:.2f} for P_FA {P_FA}')
    axes.set(xlabel='test statistic y\' R⁻¹ y', ylabel='probability density', xlim=(0.0, 35.0),
             ylim=(0.0, None), title='T10 Figure 5.4: energy of one measurement, three axes')
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def comparison(maps):
    """Compute the values that are compared with T10, by name.

    `maps` is the result of `condition_maps`.
    """
    vertical_moment, h = np.array([0.0, 0.0, 1.0]), energy_threshold(P_FA, 3)
    one, two = observability_of(ONE_SENSOR), observability_of(TWO_SENSORS)
    d = -(R0 + SAMPLE_TIME * np.arange(N_SAMPLES)[:, None] * V0)
    B, scaled_field = dipole_field(d, M), dipole_field(3.0 * d, 27.0 * M)
    at = np.argmin(np.abs(GRID)), np.argmin(np.abs(GRID - 2.0))
    n = {'one': one.eigenvalues, 'up': observability_of(ONE_SENSOR, vertical_moment).eigenvalues,
         'two': two.eigenvalues,
         'condition': two.condition_number, 'kernel': one.kernel[:, 0] / one.kernel[1, 0],
         'thrice': np.abs(scaled_field - B).max() / np.abs(B).max(), 'threshold': h,
         'snr': brentq(lambda s: detection_probability(s, h, 3) - P_D, 1.0, 30.0),
         'p_fa at 11.2': false_alarm_probability(11.2, 3),
         'snr at 11.2': brentq(lambda s: detection_probability(s, 11.2, 3) - P_D, 1.0, 30.0),
         't10 range': snr_range(1.0, np.sqrt(1e-21), SNR),
         'ranges': {name: snr_range(m, NOISE_STD, SNR) for name, m in MOMENTS.items()}}
    for name, numbers in maps.items():
        n[f'{name} opposite'] = numbers[at[1], at[0]]
        n[f'{name} best'] = best_sensor_position(numbers)
        n[f'{name} best same side'] = best_sensor_position(numbers, same_side=True)
    return n


def report(n):
    """Report that compares the values of `comparison` with T10."""
    def optimum_of(name):
        (x, y), number = n[name]
        return f'{number:.0f} at [{x:.1f}, {y:.1f}]'

    def list_of(values):
        return ', '.join(f'{np.where(abs(v) < 1e-9, 0.0, v):.4g}' for v in values)

    ranges = ', '.join(f'{name} {r:.1f} m' for name, r in n['ranges'].items())
    return f"""\
Figure 5.2, eigenvalues
  agrees   One sensor: {list_of(n['one'][:2])} are the smallest, so one direction is unobservable:
           ({list_of(n['kernel'])}) = [r0, v0, 3 m].
           At three times the distance and speed and 27 times the moment, the relative difference
           of the field is {n['thrice']:.0e} (5.5). Two sensors: the smallest is \
{list_of(n['two'][:1])}.
  differs  (5.3) gives one direction for all states. For m = [0, 0, 1], normal to the plane of
           path and sensor, two are unobservable: {list_of(n['up'][:3])}.
Figure 5.3, second sensor
  agrees   The condition number at [0, 2] is {n['plain opposite']:.0f}. On the side of the first
           sensor, the second should be far from the first: the best is
           {optimum_of('plain best same side')} (all optima are at least 1 m from the line of the \
path).
  differs  The position opposite the first sensor is not optimal: the best is
           {optimum_of('plain best')}, because the states refer to the start, left of both.
           For the position at the closest point of approach, T10 is nearly right: [0, 2] has
           {n['cpa opposite']:.0f}, the best is {optimum_of('cpa best')}, on the side of the first
           sensor {optimum_of('cpa best same side')}. With the scale of (5.11), which measures v0 in
           r/T, [0, 2] has {n['scaled opposite']:.0f}, and the best is on the same side:
           {optimum_of('scaled best')}.
Figure 5.4, test statistic
  differs  The threshold for P_FA 0.01 is {n['threshold']:.3f}, not 11.2 (which has P_FA \
{n['p_fa at 11.2']:.4f}).
           P_D 0.5 then requires an SNR of {n['snr']:.2f}; with threshold 11.2 it is \
{n['snr at 11.2']:.2f}, the 9.2 of T10.
Range (5.20)-(5.24), at SNR {SNR}
  agrees   The numbers of T10 give {n['t10 range']:.1f} m, as published (10 m).
  agrees   In the scale of TSP14: {ranges}.
           Minimum over all directions; the range along the axis of the dipole is 1.26 times \
larger."""


def main(argv=None):
    """Write the figures and print the comparison."""
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
