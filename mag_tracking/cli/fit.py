"""Command `mag-tracking fit`, and the table `fits` of `mag-tracking replay`."""

import argparse
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.correlated_motion import contradicts_delays
from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.analysis.pass_result import MAX_NORMALISED_COST, Bearing, PassFit
from mag_tracking.apps.fit import PassFitter, check_cpa_range, check_orders
from mag_tracking.arrays import FloatArray
from mag_tracking.cli import options
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.inference.identification import Iron, hard_and_soft_iron
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.results.fit_folder import FitFolder
from mag_tracking.results.result_folder import REPORT
from mag_tracking.run import RecordingSource, RunReport, progress_bar, run
from mag_tracking.settings import read_parameter_file
from mag_tracking.units import NS

ORDERS = (1, 2, 3, 4)
"""Numbers of dipoles that are tried by default."""
P_WARNING = 1e-3
"""False-alarm probability of the chi-square test for contradictory moments of one vehicle."""
Estimate = tuple[float, float]
"""Value and standard deviation; NaN if unknown."""

_FIT_HELP = '''
Extracts each pass from a recording (from shortly before a detection until the end of the
detection) and fits the whole pass with a row of 1, 2, 3 or 4 dipoles at constant velocity (TSP14).
For a vehicle on a straight road this is the most accurate estimate. The normalised cost is about 1
if the model is right and larger otherwise.

The tracker runs in parallel and determines the number of vehicles in a pass. Two or three
simultaneous vehicles are fitted together, on a road at z = 0, and listed separately.

If the model does not describe a pass (a turn, too many vehicles, noise, a single sensor, ...),
a reason is reported instead of an estimate. Speed, direction and time of the closest point of
approach are assessed separately and reported if the data determine them. If the target passes one
sensor after another, the delay between the sensors yields a second, independent estimate of speed
and direction.

files written to DIR:
  fits.csv, fits.json   one row per pass, vehicle and number of dipoles
  report.html           interactive report: map, time slider, fields
  *_pass_N.png          measured and fitted field with 90% bands; for several vehicles
                        *_pass_N_vehicle_K.png, without the field of other vehicles
  orders.png            normalised cost over the number of dipoles

examples:
  mag-tracking fit road.mcap --network network.yaml --out fits
  mag-tracking fit north.mcap south.mcap east.mcap --same-vehicle --network network.yaml --out fits
  mag-tracking fit alone.mcap --network one_sensor.yaml --cpa-range 4.5 0.3 --out fits
'''


def add(commands: options.Commands) -> None:
    """Register the command."""
    p = options.add_command(commands, 'fit', _fit, _FIT_HELP)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    options.add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    p.add_argument('--orders', nargs='+', type=int, default=ORDERS, metavar='N',
                   help='numbers of dipoles to try (default: 1 2 3 4)')
    p.add_argument('--cpa-range', nargs=2, type=float, metavar=('RANGE', 'STD'),
                   help='range at the closest point of approach and its standard deviation [m], '
                   'for a single sensor, which does not determine the scale')
    p.add_argument('--same-vehicle', action='store_true',
                   help='assume that all passes are of the same vehicle, and estimate its hard and '
                   'soft iron')
    p.add_argument('--params', type=Path, metavar='FILE',
                   help='YAML file with the settings to override')
    p.add_argument('--no-figures', action='store_true', help='do not draw figures')
    options.add_verbose(p)


def time_of(stamp_ns: float) -> str:
    """Format the time of day of a timestamp (UTC)."""
    time = datetime.fromtimestamp(stamp_ns / NS, tz=UTC)
    return f'{time:%H:%M:%S}.{time.microsecond // 10000:02d}'


def vehicle_row(label: str, time: str, kind: str, direction: str, speed: str | Estimate,
                closest: str | Estimate, verdict: str) -> str:
    """Format a row; `closest` is the distance from the centre of the sensors [m]."""
    return (f'  {label:<9}  {time:<11}  {kind or "-":<9}  {direction or "-":<10}  '
            f'{_text(speed):>14}  {_text(closest):>14}  {verdict or "-"}')


def _text(estimate: str | Estimate) -> str:
    """Format a value and its standard deviation, as far as they are known."""
    if isinstance(estimate, str):
        return estimate
    value, std = estimate
    return '-' if np.isnan(value) else f'{value:.2f}' if np.isnan(std) else \
        f'{value:.2f} ± {std:.2f}'


HEADER = vehicle_row('vehicle', 'time', 'kind', 'direction', 'speed [m/s]', 'closest [m]',
                     'verdict')


class Fits:
    """Fits of the passes of all recordings, written and printed during the run."""

    upto = 'track'

    def __init__(self, args: argparse.Namespace, network: SensorNetwork,
                 stopped: Callable[[], bool], stack: ExitStack) -> None:
        self._args, self._stopped = args, stopped
        self.folder = stack.enter_context(FitFolder(args.out))
        self.passes: list[FittedPass] = []

    def sink(self, name: str, pipeline: Pipeline) -> PassFitter:
        """Print the header of a recording and return its sink."""
        print(f'{name}:\n{HEADER}')
        return PassFitter(name, pipeline, self._args.orders, self._args.cpa_range, self._add,
                          self._stopped)

    def _add(self, fitted_pass: FittedPass) -> None:
        """Write and print a fitted pass; draw it for the command `fit`."""
        self.folder.add(fitted_pass)
        self.passes.append(fitted_pass)
        fit, drawn = fitted_pass.chosen, fitted_pass.drawn
        # The progress bar is moved down.
        with tqdm.external_write_mode():
            print(_row(fitted_pass))
            if self._args.verbose:
                _print_details(fitted_pass)
            if fit is not None and contradicts_delays(fit.speed, fit.heading,
                                                      fitted_pass.correlated):
                print('    warning: the velocities of the fit and from the delay contradict each '
                      'other; rely on neither. Check clock offsets, positions in the network '
                      'file, and whether the target turned')
        if self._args.command == 'fit' and not self._args.no_figures and drawn is not None:
            _draw(fitted_pass, drawn, self._args.out)

    def finish(self, name: str, report: RunReport, out: Path | None) -> None:
        """Complete the content of `fits.json`, which is written at the end of all recordings."""
        self.folder.summary = {'iron': None, 'interrupted': report.interrupted}


def _fit(args: argparse.Namespace) -> int:
    network = options.recorded_network(args)
    settings = settings_for('vehicle', read_parameter_file(args.params) if args.params else {})
    options.distinct_names(args.recordings)
    check_orders('--orders', args.orders)
    check_cpa_range('--cpa-range', args.cpa_range, network)
    earth = network.earth_field
    if args.same_vehicle and (earth is None or not earth.any()):
        raise SettingsError('--same-vehicle: add earth_field to the network file; hard and soft '
                            'iron cannot be separated without it')
    # All recordings are opened before a file is written.
    sources = [RecordingSource(Recording(path), network) for path in args.recordings]
    if any(source.recording.lies_in(args.out) for source in sources):
        raise OutputError(f'--out: {args.out} is the folder of a recording; choose another one')
    warnings: list[str] = []
    with recorded_signals(signal.SIGINT) as signals, ExitStack() as stack:
        def stopped() -> bool:
            return bool(signals)

        fits = Fits(args, network, stopped, stack)
        for source in sources:
            pipeline = Pipeline(network, settings, Fits.upto)
            with progress_bar(source) as bar:
                report = run(source, pipeline, [fits.sink(source.stem, pipeline)], bar.update,
                             stopped)
            options.print_diagnoses(report.diagnoses)
            warnings += [f'{source.name}: {line}' for line in report.warnings()]
            if signals:
                break
        passes = fits.passes
        iron = _iron(passes, earth) if args.same_vehicle and earth is not None else None
        fits.folder.summary = {'iron': iron, 'interrupted': bool(signals)}
    _write_report(passes, network, warnings, args)
    print(f'{"interrupted; partial results" if signals else "results"} in {args.out}')
    return 130 if signals else 0


def _write_report(passes: Sequence[FittedPass], network: SensorNetwork, warnings: Sequence[str],
                  args: argparse.Namespace) -> None:
    # Imported here, as in `_draw`, because it loads matplotlib.
    from mag_tracking.apps.fit_report import fit_page, order_figure
    from mag_tracking.report.style import save_figure

    fit_page(passes, network, warnings).write(args.out / REPORT)
    if not passes:
        print('no passes: nothing was detected')
    elif not args.no_figures:
        save_figure(order_figure(passes), args.out / 'orders.png')


def _row(fitted_pass: FittedPass) -> str:
    label = f'pass {fitted_pass.number}' + f'.{fitted_pass.vehicle}' * (fitted_pass.n_vehicles > 1)
    fit = fitted_pass.reported
    if fit is None:
        return vehicle_row(label, time_of(fitted_pass.fits[0].data.stamp_ns), '', '', '-', '-',
                           fitted_pass.fits[-1].reason)
    time, _, *closest = _closest_approach(fit)
    known = {*fit.trusted} if fit.reason else {'speed', 'direction', 'time', 'position'}
    return vehicle_row(
        label, time_of(fit.data.stamp_ns + (NS * time if 'time' in known else 0)),
        quantity(fit.n_dipoles, 'dipole'),
        f'{np.degrees(fit.heading[0]):.0f} deg' if 'direction' in known else '',
        fit.speed if 'speed' in known else '-',
        (closest[0], closest[1]) if 'position' in known else '-',
        fit.reason or ('ambiguous' if fit.ambiguous else 'unique')
        + (', poor fit' if fit.normalised_cost > MAX_NORMALISED_COST else ''))


def _closest_approach(fit: PassFit) -> tuple[float, float, float, float]:
    """Time [s] and distance [m] of the closest approach to the sensors, each with its std."""
    return fit.closest_approach(fit.data.network.positions[fit.data.sensors].mean(axis=0))


def _print_details(fitted_pass: FittedPass) -> None:
    data = fitted_pass.fits[0].data
    print(f'{fitted_pass.recording}, {fitted_pass.label}: '
          f'{quantity(data.n_values, "measurement")}, '
          f'sensors: {", ".join(data.network.names[j] for j in data.sensors)}')
    for note in fitted_pass.notes:
        print(f'  note: {note}')
    if any(not f.reason for f in fitted_pass.fits):
        print('  dipoles  cost       x        y       z      speed        heading      length   '
              '   moment   (standard deviation)')
    for fit in fitted_pass.fits:
        mark = '*' if fit is fitted_pass.chosen else ' '
        cost = f'{fit.normalised_cost:8.2f}' if len(fit.x) else ' ' * 8
        print(f' {mark}   {fit.n_dipoles}  {cost}  {fit.reason or _formatted_estimates(fit)}')
        if fit.bearing is not None:
            _print_bearing(fit.bearing)
        if fit.reason and fit is fitted_pass.reported:
            print(f'        still reliable: {_trusted_values(fit)}')
        if not fit.reason and fit.is_poor_joint_fit:
            print('        ambiguous: the joint fit of the vehicles is poor')
        elif not fit.reason and fit.ambiguous:
            chi_square, path = min(fit.rivals, key=lambda rival: rival[0])
            print(f'        ambiguous: {np.exp(-0.5 * chi_square):.2f} times as likely at position '
                  f'({", ".join(f"{v:.2f}" for v in path[:3])}) m'
                  + (f' and length {abs(path[6]):.1f} m' if len(path) > 6 else ''))
    c = fitted_pass.correlated
    line = ' (assumed along the line of the sensors)' if np.isnan(c.heading_std) else ''
    print(f'  no velocity from the delay between sensors: {c.reason}' if c.reason else
          f'  velocity from the delay between sensors: {_with_std((c.speed, c.speed_std), 2)} m/s, '
          f'heading {np.degrees(c.heading):.0f} deg{line}')
    if fitted_pass.chosen is not None:
        _print_chosen(fitted_pass, fitted_pass.chosen)


def _print_chosen(fitted_pass: FittedPass, chosen: PassFit) -> None:
    if chosen.normalised_cost > MAX_NORMALISED_COST:
        print(f'  poor fit (cost {chosen.normalised_cost:.1f}): errors of speed and position may '
              'be several standard deviations')
    time, std, distance, distance_std = _closest_approach(chosen)
    print(f'  closest to the centre of the sensors {time:+.2f} ({std:.2f}) s after the '
          f'strongest field, at {distance:.2f} ({distance_std:.2f}) m')
    dr, dv = fitted_pass.disagreement
    if np.isfinite(dr):
        print(f'  fits with a similar cost differ by up to {dr:.2f} m and {dv:.2f} m/s, '
              'which the standard deviations do not include')


def _trusted_values(fit: PassFit) -> str:
    time, time_std, _, _ = _closest_approach(fit)
    values = {'speed': f'{_with_std(fit.speed, 2)} m/s',
              'direction': f'{_with_std(np.degrees(fit.heading), 1)} deg',
              'time': f'closest to the centre of the sensors {time:+.2f}({time_std:.2f}) s after '
              'the strongest field'}
    return ', '.join(values[name] for name in fit.trusted)


def _formatted_estimates(fit: PassFit) -> str:
    sd = np.sqrt(np.diagonal(fit.position_covariance))
    position = ' '.join(f'{v:6.2f}({s:.2f})' for v, s in zip(fit.position, sd, strict=True))
    moment, P = fit.moment
    magnitude = float(np.linalg.norm(moment))
    return (f'{position} m  {_with_std(fit.speed, 2)} m/s  '
            f'{_with_std(np.degrees(fit.heading), 1)} deg  {_with_std(fit.length, 1)} m  '
            f'{_with_std((magnitude, float(np.sqrt(moment @ P @ moment)) / magnitude), 0)} A m^2')


def _with_std(estimate: Iterable[float], digits: int) -> str:
    value, std = estimate
    return f'{value:.{digits}f}({std:.{digits}f})'


def _print_bearing(b: Bearing) -> None:
    """Print what a single sensor observes: directions, time, and speed relative to range."""
    def direction_text(k: int, direction: FloatArray) -> str:
        if not np.isfinite(direction).all():
            return 'unknown'
        return (f'({" ".join(f"{v:.2f}" for v in direction)}) ± '
                f'{np.degrees(b.direction_std[k]):.1f} deg')

    print(f'        directions: closest point {direction_text(0, b.cpa_direction)}, motion '
          f'{direction_text(1, b.motion_direction)} (or both reversed), moment '
          f'{direction_text(2, b.moment_direction)}')
    print(f'        closest {b.cpa_time:+.3f} ({b.cpa_time_std:.3f}) s after the strongest field; '
          f'speed/range {b.rate:.3f} ({b.rate_std:.3f}) 1/s')


def _iron(passes: Sequence[FittedPass], earth_field: FloatArray) -> dict[str, Any] | None:
    """Estimate and print hard and soft iron; return them as a dict for JSON, or None on failure."""
    if n_together := sum(p.n_vehicles > 1 for p in passes):
        print('--same-vehicle: vehicles not used because they passed simultaneously with others: '
              f'{n_together}')
    fits = [p.chosen for p in passes if p.chosen is not None and p.n_vehicles == 1]
    try:
        if not fits:
            raise ValueError('no vehicle that passed alone has an estimate')
        moments, covariances = zip(*(f.moment for f in fits), strict=True)
        iron = hard_and_soft_iron(moments, [f.heading[0] for f in fits], earth_field / MU0,
                                  covariances)
    except ValueError as error:
        print(f'hard and soft iron were not estimated: {error}')
        return None
    std = np.sqrt(np.diagonal(iron.covariance)) * np.sqrt(max(1.0, iron.normalised_cost))
    hard = ', '.join(f'{v:.1f} ({s:.1f})' for v, s in zip(iron.hard, std[:3], strict=True))
    print(f'hard iron m0 = {hard} A m^2 (forward, left, up); soft iron D = {iron.soft:.3f} '
          f'({std[3]:.3f}) m^3; {quantity(len(fits), "pass", "passes")}, '
          f'normalised cost {iron.normalised_cost:.1f}')
    warnings = list(iron_warnings(iron, len(fits), std[3]))
    for warning in warnings:
        print(f'  warning: {warning}')
    return {'hard': iron.hard.tolist(), 'soft': iron.soft, 'std': std.tolist(),
            'normalised_cost': iron.normalised_cost, 'passes': len(fits), 'warnings': warnings}


def iron_warnings(iron: Iron, n_passes: int, soft_std: float) -> Iterator[str]:
    """Find reasons not to use an estimate of hard and soft iron, with its inflated std [m³]."""
    degrees_of_freedom = 3 * n_passes - 4
    if iron.normalised_cost * degrees_of_freedom > energy_threshold(P_WARNING, degrees_of_freedom):
        yield ('the moments contradict each other; the passes may be of different vehicles, or one '
               'of the fits is wrong')
    if iron.soft < -3.0 * soft_std:
        yield 'soft iron is negative, which is impossible; check the headings of the fits'


def _draw(fitted_pass: FittedPass, fit: PassFit, out: Path) -> None:
    # Imported here because it loads matplotlib.
    from mag_tracking.apps.fit_report import pass_figure
    from mag_tracking.report.style import save_figure

    title = f'{fitted_pass.recording}, {fitted_pass.label}, {quantity(fit.n_dipoles, "dipole")}'
    title += ' (without the field of other vehicles)' if fitted_pass.n_vehicles > 1 else ''
    save_figure(pass_figure(fit, title + (' (no estimate)' if fit.reason else '')),
                out / f'{fitted_pass.recording}_'
                f'{fitted_pass.label.replace(", ", "_").replace(" ", "_")}.png')
