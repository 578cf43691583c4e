"""mag-tracking fit."""

import argparse
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.correlated_motion import contradicts_delays
from mag_tracking.analysis.pass_result import MAX_NORMALISED_COST, Bearing, PassFit
from mag_tracking.apps.fit import RecordingFit, check_cpa_range, check_orders
from mag_tracking.apps.pass_fitter import FittedPass
from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    distinct_names,
    recorded_network,
)
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.inference.iron import hard_and_soft_iron
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.fit_folder import FitFolder
from mag_tracking.recording.reader import Recording
from mag_tracking.settings import read_parameter_file

_FIT = '''
Cuts the passes out of a recording (from before a detection until its end) and fits
each as a whole: a row of 1, 2, 3, 4 dipoles at constant velocity (TSP14). For a
vehicle on a straight road this is the most accurate that there is, and the normalised
cost says whether to believe it: 1 = the model is right.

Two or three vehicles that are seen at once (the tracker, which runs along, says how many) are
fitted together, on a road at z = 0, and each gets a table of its own.

A pass that this cannot describe (a turn, more vehicles at once, nothing but noise, one
sensor alone, ...) gets a reason instead of numbers. Speed, direction and time of the closest
point are judged each for itself, and given where they are determined. Where one sensor is
behind another on the way, the delay between them gives speed and direction once more,
without any model.

Writes to DIR:
  fits.csv, fits.json   a row a pass, vehicle and order
  report.html           map, time slider and fields, to look at in a browser
  *_pass_N.png          measured against fitted field, with 90 % bands; of several
                        vehicles *_pass_N_vehicle_K.png, without the others' field
  orders.png            normalised cost over the order

examples:
  mag-tracking fit road.mcap --network network.yaml --out fits
  mag-tracking fit north.mcap south.mcap east.mcap --same-vehicle --network network.yaml --out fits
  mag-tracking fit alone.mcap --network one_sensor.yaml --cpa-range 4.5 0.3 --out fits
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'fit', _fit, _FIT)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='an .mcap, .db3 or .bag file, or a rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder for the results')
    p.add_argument('--orders', nargs='+', type=int, default=[1, 2, 3, 4], metavar='N',
                   help='numbers of dipoles to try (default: 1 2 3 4)')
    p.add_argument('--cpa-range', nargs=2, type=float, metavar=('RANGE', 'STD'),
                   help='for one sensor, which cannot tell the scale: the range of the closest '
                   'point and its deviation [m]')
    p.add_argument('--same-vehicle', action='store_true',
                   help='all passes are of one vehicle: tell its hard and soft iron')
    p.add_argument('--params', type=Path, metavar='FILE', help='settings that differ')
    p.add_argument('--no-figures', action='store_true', help='leave the pictures out')


def _fit(args: argparse.Namespace) -> int:
    """mag-tracking fit."""
    network = recorded_network(args)
    settings = settings_for('vehicle', read_parameter_file(args.params) if args.params else {})
    _check(args, network)
    # All is opened before anything is written.
    recordings = [Recording(path) for path in args.recordings]
    if any(recording.lies_in(args.out) for recording in recordings):
        raise OutputError(f'{args.out} is the folder of a recording; the results would be in it')
    jobs = [RecordingFit(r, network, settings, args.orders, args.cpa_range) for r in recordings]
    passes: list[FittedPass] = []
    warnings: list[str] = []
    with recorded_signals(signal.SIGINT) as seen, FitFolder(args.out) as folder:
        for path, recording, job in zip(args.recordings, recordings, jobs, strict=True):
            with tqdm(total=recording.size, unit='B', unit_scale=True, desc=path.name,
                      disable=None) as bar:
                for one in job.passes(bar.update, lambda: bool(seen)):
                    folder.add(one)
                    passes.append(one)
                    bar.clear()
                    _print_pass(one)
                    if not args.no_figures:
                        _draw(one, args.out)
            lines = [f'{path.name}: {line}' for line in job.warnings()]
            warnings += lines
            for line in lines:
                print(f'  warning: {line}')
            if seen:
                break
        iron = _iron(passes, network) if args.same_vehicle else None
        folder.summary = {'iron': iron, 'interrupted': bool(seen)}
    # It needs matplotlib, which the other commands should not load.
    from mag_tracking.apps.fit_report import write_report

    write_report(passes, network, warnings, args.out)
    if not passes:
        print('no pass: nothing was detected')
    elif not args.no_figures:
        _draw_orders(passes, args.out)
    print(f'{"interrupted; what was done is" if seen else "results"} in {args.out}')
    return 130 if seen else 0


def _check(args: argparse.Namespace, network: SensorNetwork) -> None:
    """Raise SettingsError or OutputError for options that make no sense."""
    distinct_names(args.recordings)
    check_orders('--orders', args.orders)
    check_cpa_range('--cpa-range', args.cpa_range, network)
    if args.same_vehicle and not (network.earth_field is not None and network.earth_field.any()):
        raise SettingsError('--same-vehicle: the network file has no earth_field, without which '
                            'hard and soft iron cannot be told apart')


def _print_pass(one: FittedPass) -> None:
    """A table of the orders of one pass."""
    data = one.fits[0].data
    print(f'{one.recording}, {one.label}: {data.n_values} measurements, '
          f'sensors: {", ".join(data.network.names[j] for j in data.sensors)}')
    for note in one.notes:
        print(f'  note: {note}')
    if any(not f.reason for f in one.fits):
        print('  dipoles  cost       x        y       z      speed        heading      length   '
              '   moment')
    for fit in one.fits:
        mark = '*' if fit is one.chosen else ' '
        cost = f'{fit.normalised_cost:8.2f}' if len(fit.x) else ' ' * 8
        print(f' {mark}   {fit.n_dipoles}  {cost}  {fit.reason or _numbers(fit)}')
        if fit.bearing is not None:
            _print_bearing(fit.bearing)
        if fit.reason and fit is one.known:
            print(f'        determined: {_known(fit)}')
        if not fit.reason and fit.is_poor_mixture:
            print('        ambiguous: the vehicles together are described poorly')
        elif not fit.reason and fit.ambiguous:
            behind, path = min(fit.rivals, key=lambda rival: rival[0])
            print(f'        ambiguous: {np.exp(-0.5 * behind):.2f} times as likely is '
                  f'({", ".join(f"{v:.2f}" for v in path[:3])}) m'
                  + (f' with a length of {abs(path[6]):.1f} m' if len(path) > 6 else ''))
    _print_delay(one)
    if one.chosen is not None:
        least = one.chosen.normalised_cost
        if least > MAX_NORMALISED_COST:
            print(f'  a row of dipoles describes it poorly (cost {least:.1f}): '
                  'speed and position may be off by several of the deviations')
        centre = one.chosen.data.network.positions[one.chosen.data.sensors].mean(axis=0)
        time, std, distance, distance_std = one.chosen.closest_approach(centre)
        print(f'  closest to the middle of the sensors {time:+.2f} ({std:.2f}) s after the '
              f'strongest field, {distance:.2f} ({distance_std:.2f}) m away')
        far, fast = one.disagreement
        if np.isfinite(far):
            print(f'  orders with nearly this cost differ by up to {far:.2f} m and {fast:.2f} m/s, '
                  'which the deviations (in brackets) do not know of')


def _known(fit: PassFit) -> str:
    """Speed, direction and time, as far as they are trusted, of a fit that is no answer as a
    whole."""
    speed, speed_std = fit.speed
    heading, heading_std = np.degrees(fit.heading)
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    time, time_std, _, _ = fit.closest_approach(centre)
    texts = {'speed': f'{speed:.2f}({speed_std:.2f}) m/s',
             'direction': f'{heading:.1f}({heading_std:.1f}) deg',
             'time': f'closest to the middle of the sensors {time:+.2f}({time_std:.2f}) s after '
                     'the strongest field'}
    return ', '.join(texts[name] for name in fit.trusted)


def _print_delay(one: FittedPass) -> None:
    """The velocity by the delays between sensors, and whether the fit agrees."""
    c = one.correlated
    if c.reason:
        print(f'  no speed by the delay between sensors: {c.reason}')
        return
    line = ', along the line of the sensors' if np.isnan(c.heading_std) else ''
    print(f'  by the delay between sensors: {c.speed:.2f}({c.speed_std:.2f}) m/s, '
          f'{np.degrees(c.heading):.0f} deg{line}')
    best = one.chosen
    if best is not None and contradicts_delays(best.speed, best.heading, c):
        print('  warning: fit and delay contradict each other; believe neither (a clock, a '
              'position in the network file, a turn)')


def _numbers(fit: PassFit) -> str:
    """Position, speed, heading, length and moment, with deviations in brackets."""
    sd = np.sqrt(np.diagonal(fit.robust_covariance))[:3]
    place = ' '.join(f'{v:6.2f}({s:.2f})' for v, s in zip(fit.position, sd, strict=True))
    moment, P = fit.moment
    size = np.linalg.norm(moment)
    size_std = np.sqrt(moment @ P @ moment) / size
    heading, heading_std = np.degrees(fit.heading)
    return (f'{place} m  {fit.speed[0]:.2f}({fit.speed[1]:.2f}) m/s  {heading:.1f}'
            f'({heading_std:.1f}) deg  {fit.length[0]:.1f}({fit.length[1]:.1f}) m  '
            f'{size:.0f}({size_std:.0f}) A m^2')


def _print_bearing(b: Bearing) -> None:
    """What one sensor tells."""
    def text(k: int, direction: FloatArray) -> str:
        if not np.isfinite(direction).all():
            return 'unknown'
        return (f'({" ".join(f"{v:.2f}" for v in direction)}) to '
                f'{np.degrees(b.direction_std[k]):.1f} deg')

    print(f'        direction to the closest point {text(0, b.cpa_direction)}, of motion '
          f'{text(1, b.motion_direction)}, or both reversed; of the moment '
          f'{text(2, b.moment_direction)}')
    print(f'        closest {b.cpa_time:+.3f} ({b.cpa_time_std:.3f}) s after the strongest field; '
          f'speed over range {b.rate:.3f} ({b.rate_std:.3f}) 1/s')


def _iron(passes: Sequence[FittedPass], network: SensorNetwork) -> dict[str, Any] | None:
    """Hard and soft iron from the chosen fits, JSON-ready, or None with a line that says why."""
    together = [one for one in passes if one.n_vehicles > 1]
    if together:
        print(f'--same-vehicle: {len(together)} vehicles that were seen with others are left out')
    fits = [one.chosen for one in passes if one.chosen is not None and one.n_vehicles == 1]
    try:
        if not fits:
            raise ValueError('no pass has an answer')
        if network.earth_field is None:
            raise ValueError('the network file has no earth_field')
        moments, covariances = zip(*(f.moment for f in fits), strict=True)
        iron = hard_and_soft_iron(moments, [f.heading[0] for f in fits],
                                  network.earth_field / MU0, covariances)
    except ValueError as error:
        print(f'hard and soft iron: {error}')
        return None
    std = np.sqrt(np.diagonal(iron.covariance)) * np.sqrt(max(1.0, iron.normalised_cost))
    hard = ', '.join(f'{v:.1f} ({s:.1f})' for v, s in zip(iron.hard, std[:3], strict=True))
    print(f'hard iron m0 = {hard} A m^2 (forward, left, up); soft iron D = {iron.soft:.3f} '
          f'({std[3]:.3f}) m^3; {len(fits)} passes, normalised cost {iron.normalised_cost:.1f}')
    return {'hard': iron.hard.tolist(), 'soft': iron.soft, 'std': std.tolist(),
            'normalised_cost': iron.normalised_cost, 'passes': len(fits)}


def _draw(one: FittedPass, out: Path) -> None:
    """Draw the order chosen, or the richest that there is."""
    fit = one.chosen or next((f for f in reversed(one.fits) if len(f.x)), None)
    if fit is None:
        return
    # Drawing needs matplotlib, which a run without figures should not wait for.
    from mag_tracking.report.figure_file import save_figure
    from mag_tracking.report.fit_figures import pass_figure

    title = f'{one.recording}, {one.label}, {fit.n_dipoles} dipole{"s" * (fit.n_dipoles > 1)}'
    title += ' (field of the others removed)' if one.n_vehicles > 1 else ''
    save_figure(pass_figure(fit, title + (' (no answer)' if fit.reason else '')),
                out / f'{one.recording}_{one.label.replace(", ", "_").replace(" ", "_")}.png')


def _draw_orders(passes: Sequence[FittedPass], out: Path) -> None:
    """The figure of all orders."""
    from mag_tracking.report.figure_file import save_figure
    from mag_tracking.report.fit_figures import order_figure

    save_figure(order_figure(passes), out / 'orders.png')
