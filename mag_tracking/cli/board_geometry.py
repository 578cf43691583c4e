"""Command `mag-tracking calibrate board`."""

import argparse
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from mag_tracking.calibration.network_fit import ASSUMED_NOISE, GeometrySettings
from mag_tracking.cli import options
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import read_network, write_network
from mag_tracking.quantities import quantity
from mag_tracking.settings import flatten, read_parameter_file, replace

if TYPE_CHECKING:
    from mag_tracking.apps.calibrate import GeometrySurvey

_GEOMETRY_HELP = '''
Estimates the position, orientation, gain and bias of each sensor of a board from the readings
of all sensors while a magnet of known moment is moved over the board. The poses of the magnet
are measured by a tracker; the offsets between tracker and board, and between tool and magnet,
are estimated. Without a tracker, --unknown-poses also estimates the poses, within the box
from --low to --high. The poses should fill the working volume, with the magnet tilted in
various directions: 162 poses were sufficient for 41 sensors.

TABLE is a CSV file with one row per pose: the readings x0,y0,z0,x1,... [T, sensor frame; empty
if not measured], the position mag_x0,mag_y0,mag_z0 of the magnet [m] and the direction of its
moment mag_mx0,mag_my0,mag_mz0 (unit vector).

--params overrides these settings, most of which are prior standard deviations (0 fixes the
quantity):
{settings}

examples:
  mag-tracking calibrate board poses.csv --sensors positions.csv --moment 0.264 --out board.yaml
  mag-tracking calibrate board poses.csv --network board.yaml --moment 0.264 --unknown-poses \\
      --low -0.05 -0.05 0.03 --high 0.2 0.22 0.3 --out calibrated.yaml --figure board.png
'''


def add(commands: options.Commands) -> None:
    """Register the command."""
    settings = '\n'.join(f'  {p.name}: {p.value}  # {p.doc}{f" [{p.unit}]" if p.unit else ""}'
                         for p in flatten(GeometrySettings()))
    p = options.add_command(commands, 'calibrate board', _geometry,
                            _GEOMETRY_HELP.replace('{settings}', settings))
    p.add_argument('table', type=Path, metavar='TABLE', help='readings and poses (.csv)')
    geometry = p.add_mutually_exclusive_group(required=True)
    geometry.add_argument('--sensors', type=Path, metavar='FILE',
                          help='nominal positions x,y,z [m] of all sensors (.csv); the axes of '
                          'each sensor are nominally parallel to x, y and z')
    options.add_network(geometry, required=False, text='network file with the nominal geometry, '
                        'sensors in the order of the table')
    p.add_argument('--moment', required=True, type=float, metavar='A_M2',
                   help='magnitude of the magnet\'s moment [A m^2]')
    p.add_argument('--out', required=True, type=Path, metavar='FILE', help='network file to write')
    p.add_argument('--noise-std', type=float, metavar='TESLA', help='noise standard deviation '
                   'of one reading, for sensors without noise_std in the network file '
                   f'(default: {ASSUMED_NOISE:g}, not written to the output)')
    p.add_argument('--unknown-poses', action='store_true',
                   help='estimate the poses of the magnet, if there is no tracker')
    for name, corner in (('--low', 'lower'), ('--high', 'upper')):
        p.add_argument(name, nargs=3, type=float, metavar=('X', 'Y', 'Z'),
                       help=f'{corner} corner of the box that contains the magnet [m]')
    p.add_argument('--params', type=Path, metavar='FILE',
                   help='YAML file with the settings to override')
    p.add_argument('--figure', type=Path, metavar='FILE',
                   help='draw the estimated geometry (.png, .pdf)')


def _geometry(args: argparse.Namespace) -> int:
    # Imported here because it loads the tracker.
    from mag_tracking.apps import calibrate

    box = _checked_box(args)
    network = calibrate.board_of(args.sensors) if args.sensors else read_network(args.network)
    settings = replace(GeometrySettings(), read_parameter_file(args.params) if args.params else {})
    unknowns = "magnet's poses and the geometry" if box else 'geometry'
    # Ctrl-C ends the estimation immediately: nothing has been written yet.
    with _elapsed_time(f'estimating the {unknowns} of {quantity(len(network), "sensor")}'):
        survey = calibrate.survey_geometry(args.table, network, args.moment, settings,
                                           options.utc_timestamp(), box, args.noise_std)
    _print(survey, box is not None)
    if not survey.geometry.converged:
        print(f'mag-tracking: calibration rejected: {survey.geometry.reason}; nothing was written',
              file=sys.stderr)
        return 1
    # Ctrl-C does not interrupt the writing.
    with recorded_signals(signal.SIGINT):
        write_network(args.out, survey.network, 'Geometry from a magnet\'s poses in '
                      f'{args.table.name}; nominal geometry: '
                      f'{(args.sensors or args.network).name}.')
        if args.figure is not None:
            # Imported here because it loads matplotlib.
            from mag_tracking.apps.calibrate_report import geometry_figure
            from mag_tracking.report.style import save_figure

            save_figure(geometry_figure(survey), args.figure)
    print(f'network written to {args.out}')
    return 0


def _checked_box(args: argparse.Namespace) -> tuple[Sequence[float], Sequence[float]] | None:
    """Return the corners of the box, None without --unknown-poses; check all options."""
    corners = args.low, args.high
    if args.unknown_poses and None in corners:
        raise SettingsError('--unknown-poses: give the box that contains the magnet with --low and '
                            '--high')
    if not args.unknown_poses and corners != (None, None):
        raise SettingsError('--low and --high require --unknown-poses')
    if not (np.isfinite(args.moment) and args.moment > 0.0):
        raise SettingsError(f'--moment: expected a value above 0 A m^2, got {args.moment:g}')
    if args.noise_std is not None and not 1e-15 <= args.noise_std < 1e-3:
        raise SettingsError('--noise-std: expected 1e-15 T or more and less than 1e-3 T, '
                            f'got {args.noise_std:g}')
    if args.unknown_poses and not (np.isfinite(np.subtract(*corners)).all()
                                   and np.less(*corners).all()):
        raise SettingsError(f'--high: expected values above {args.low} in x, y and z, got '
                            f'{args.high}')
    options.check_outputs(args)
    return corners if args.unknown_poses else None


@contextmanager
def _elapsed_time(task: str) -> Iterator[None]:
    """Print the task and, on a terminal, the elapsed time while the context is open."""
    stop = threading.Event()
    with tqdm(desc=task, bar_format='{desc}: {elapsed}', disable=None) as bar:
        if bar.disable:
            print(task, flush=True)

        def tick() -> None:
            while not stop.wait(0.5):
                bar.refresh()

        ticker = threading.Thread(target=tick, daemon=True)
        ticker.start()
        try:
            yield
        finally:
            stop.set()
            ticker.join()


def _print(survey: 'GeometrySurvey', has_unknown_poses: bool) -> None:
    g = survey.geometry
    if g.converged:
        print('sensor      shift [mm]    rotation [deg] gain            '
              'bias [uT]                    residual')
        for j, name in enumerate(survey.network.names):
            print(f'{name:11s} {_row(survey, j)}')
        moment, std = g.moment
        print(f'moment {moment:.4f} ({std:.4f}) A m^2' if std
              else f'moment {moment:g} A m^2 (given)')
        if not has_unknown_poses:
            offset, tilt = (
                ' '.join(f'{scale * v:.2f} ({scale * s:.2f})' for v, s in zip(*values, strict=True))
                for scale, values in ((1e3, g.tool_offset), (180.0 / np.pi, g.tool_tilt)))
            print(f'magnet relative to the tracked point, tool frame: {offset} mm; tilt {tilt} deg')
    print(f'{len(survey.rows)} of {survey.n_poses} poses used, normalised cost '
          f'{g.normalised_cost:.2f} (1 if consistent with noise and field error)')
    if n_unused := survey.n_poses - len(survey.rows):
        print('  warning: poses not used (no readings'
              f'{" or outside the box" * has_unknown_poses}): {n_unused}')
    if g.suspect_sensors:
        print('  warning: sensors inconsistent with other sensors or their nominal geometry '
              f'(check mounting, axes, unit, noise): {", ".join(g.suspect_sensors)}')
    if n_assumed := sum(std is None for std in survey.network.noise_std):
        print(f'  note: noise of {quantity(n_assumed, "sensor")} assumed to be '
              f'{ASSUMED_NOISE:g} T (set --noise-std, or noise_std in a network file)')
    for j, name in enumerate(survey.network.names):
        if np.isnan(g.bias[j]).all():
            print(f'  warning: {name} has no readings; its nominal geometry is kept')
    for name, axes in survey.silent_axes:
        print(f'  warning: {name} never reported {axes}: the background of these axes is unknown')
    if survey.suspect_rows:
        print('  warning: rows with inconsistent poses (the header is row 1): '
              f'{", ".join(map(str, survey.suspect_rows))}')


def _row(survey: 'GeometrySurvey', j: int) -> str:
    g = survey.geometry
    shift = 1e3 * np.linalg.norm(survey.network.positions[j] - survey.nominal.positions[j])
    shift_std, rotation_std = (np.sqrt(np.square(v[j]).mean())
                               for v in (1e3 * g.position_std, np.rad2deg(g.rotation_std)))
    bias = ' '.join(f'{1e6 * b:+8.2f}' for b in g.bias[j])
    return (f'{shift:5.2f} ({shift_std:.2f})  {np.rad2deg(survey.rotation_angle[j]):6.2f} '
            f'({rotation_std:.2f})  {g.gain[j]:.4f} ({g.gain_std[j]:.4f}) {bias}  '
            f'{g.sensor_residual[j]:8.2f}')
