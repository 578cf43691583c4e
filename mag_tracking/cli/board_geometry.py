"""mag-tracking board-geometry."""

import argparse
import datetime
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.network_geometry import GeometrySettings, NetworkGeometry
from mag_tracking.apps.board_geometry import (
    ASSUMED_NOISE,
    GeometrySurvey,
    board_of,
    survey_geometry,
)
from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import read_network, write_network
from mag_tracking.settings import flatten, read_parameter_file, replace

_GEOMETRY = '''
A board of fixed sensors calibrates itself: a magnet of known moment is moved about over
it, and what all sensors read of every pose tells where each sensor really is, how it is
turned, its gain and its bias. A tracker gives the poses (the board may be shifted and
turned against it, the magnet within its tool); without one, --unknown-poses finds them
too, in the box from --low to --high. Poses should fill the space that will be used, with
the magnet tilted this way and that: 162 of them were enough for 41 sensors.

The TABLE is a CSV, a row a pose: x0,y0,z0,x1,... [T, each sensor's own frame; empty =
not measured], mag_x0,mag_y0,mag_z0 [m], mag_mx0,mag_my0,mag_mz0 (unit vector).

--params takes what is known beforehand, as standard deviations (0 = exactly):
{settings}

examples:
  mag-tracking board-geometry poses.csv --sensors positions.csv --moment 0.264 --out board.yaml
  mag-tracking board-geometry poses.csv --network board.yaml --moment 0.264 --unknown-poses \\
      --low -0.05 -0.05 0.03 --high 0.2 0.22 0.3 --out calibrated.yaml --figure board.png
'''


def add(commands: Commands) -> None:
    """Register the command."""
    settings = '\n'.join(f'  {p.name}: {p.value}  # {p.doc}{f" [{p.unit}]" if p.unit else ""}'
                         for p in flatten(GeometrySettings()))
    p = add_command(commands, 'board-geometry', _geometry,
                    _GEOMETRY.replace('{settings}', settings))
    p.add_argument('table', type=Path, metavar='TABLE', help='readings and poses (.csv)')
    stated = p.add_mutually_exclusive_group(required=True)
    stated.add_argument('--sensors', type=Path, metavar='FILE',
                        help='x,y,z [m] of every sensor (.csv), turned along the axes')
    add_network(stated, required=False, text='or the board as stated (network.yaml), its sensors '
                'in the order of the table')
    p.add_argument('--moment', required=True, type=float, metavar='A_M2',
                   help='size of the magnet\'s moment')
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='the network file to write')
    p.add_argument('--noise-std', type=float, metavar='TESLA', help='noise of one reading, where '
                   f'the network file has none (default: {ASSUMED_NOISE:g}, and not written)')
    p.add_argument('--unknown-poses', action='store_true', help='nothing tracked the magnet')
    for name, what in (('--low', 'lowest'), ('--high', 'highest')):
        p.add_argument(name, nargs=3, type=float, metavar=('X', 'Y', 'Z'),
                       help=f'{what} corner of the box where it was [m]')
    p.add_argument('--params', type=Path, metavar='FILE', help='settings that differ')
    p.add_argument('--figure', type=Path, metavar='FILE', help='draw what was found (.png, .pdf)')


def _geometry(args: argparse.Namespace) -> int:
    """mag-tracking board-geometry."""
    box = _checked(args)
    network = read_network(args.network) if args.sensors is None else board_of(args.sensors)
    settings = replace(GeometrySettings(), read_parameter_file(args.params) if args.params else {})
    date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds')
    what = 'poses and geometry' if box else 'geometry'
    # Ctrl-C ends it at once: nothing has been written yet.
    with _time_passing(f'finding the {what} of {len(network)} sensors'):
        found = survey_geometry(args.table, network, args.moment, settings, date, box,
                                args.noise_std)
    _print(found, box is not None)
    if not found.geometry.converged:
        print(f'mag-tracking: refused: {found.geometry.reason}; nothing was written',
              file=sys.stderr)
        return 1
    # From here on, what is begun is ended.
    with recorded_signals(signal.SIGINT):
        write_network(args.out, found.network, 'Geometry from a magnet\'s poses in '
                      f'{args.table.name}; before that {(args.sensors or args.network).name}.')
        if args.figure is not None:
            # Drawing needs matplotlib, which a run without a figure should not wait for.
            from mag_tracking.report.figure_file import save_figure
            from mag_tracking.report.geometry_figures import geometry_figure

            save_figure(geometry_figure(found), args.figure)
    print(f'the network is in {args.out}')
    return 0


def _checked(args: argparse.Namespace) -> tuple[Sequence[float], Sequence[float]] | None:
    """The box, or None; raises SettingsError or OutputError for options that make no sense."""
    corners = args.low, args.high
    if args.unknown_poses and None in corners:
        raise SettingsError('--unknown-poses: --low and --high are needed, the box to look in')
    if not args.unknown_poses and corners != (None, None):
        raise SettingsError('--low and --high are for --unknown-poses')
    if not (np.isfinite(args.moment) and args.moment > 0.0):
        raise SettingsError(f'--moment: expected it above 0 A m^2, got {args.moment:g}')
    if args.noise_std is not None and not 1e-15 <= args.noise_std < 1e-3:
        raise SettingsError('--noise-std: expected it above a femtotesla and below a millitesla, '
                            f'got {args.noise_std:g}')
    if args.unknown_poses and not (np.isfinite(np.subtract(*corners)).all()
                                   and np.less(*corners).all()):
        raise SettingsError(f'--high: expected it above {args.low} in x, y and z, got {args.high}')
    for path in (args.out, args.figure):
        if path is not None and not path.absolute().parent.is_dir():
            raise OutputError(f'cannot write {path}: there is no folder {path.parent}')
    return corners if args.unknown_poses else None


@contextmanager
def _time_passing(text: str) -> Iterator[None]:
    """Says what is done, and on a terminal for how long; nobody knows how long it will take."""
    done = threading.Event()
    bar = tqdm(desc=text, bar_format='{desc}: {elapsed}', disable=None)
    if bar.disable:
        print(text, flush=True)

    def tick() -> None:
        while not done.wait(0.5):
            bar.refresh()

    ticker = threading.Thread(target=tick, daemon=True)
    ticker.start()
    try:
        yield
    finally:
        done.set()
        ticker.join()
        bar.close()


def _print(found: GeometrySurvey, blind: bool) -> None:
    """What was found as a table, and what is wrong."""
    g = found.geometry
    if g.converged:
        print('sensor      moved [mm]    turned [deg]   gain            '
              'bias [uT]                    residual')
        for j, name in enumerate(found.network.names):
            print(f'{name:11s} {_row(found, j)}')
        _print_magnet(g, blind)
    left_out = found.n_poses - len(found.rows)
    print(f'{len(found.rows)} of {found.n_poses} poses, normalised cost {g.normalised_cost:.2f} '
          '(1 = as noise and field error say)')
    if left_out:
        print(f'  warning: poses without readings{" or outside the box" * blind}, left out: '
              f'{left_out}')
    if g.suspect_sensors:
        print('  warning: sensors that do not fit with the others, or only far from what was '
              f'stated (mounting, axes, unit, noise?): {", ".join(g.suspect_sensors)}')
    guessed = sum(std is None for std in found.network.noise_std)
    if guessed:
        print(f'  note: nobody says the noise of {guessed} sensors: counted with '
              f'{ASSUMED_NOISE:g} T (--noise-std, or noise_std in a network file)')
    for j, name in enumerate(found.network.names):
        if np.isnan(g.bias[j]).all():
            print(f'  warning: {name} has no reading: it stays as stated')
    for name, axes in found.silent_axes:
        print(f'  warning: {name} never reported {axes}: its background will have to be learnt')
    if found.suspect_rows:
        print('  warning: rows of poses that do not fit (the header is row 1): '
              f'{", ".join(map(str, found.suspect_rows))}')


def _print_magnet(g: NetworkGeometry, blind: bool) -> None:
    """Moment, and how the magnet sits in its tool."""
    def listed(values: FloatArray, std: FloatArray, scale: float, digits: int) -> str:
        return ' '.join(f'{scale * v:.{digits}f} ({scale * s:.{digits}f})'
                        for v, s in zip(values, std, strict=True))

    moment, std = g.moment
    print(f'moment {moment:.4f} ({std:.4f}) A m^2' if std else f'moment {moment:g} A m^2, as given')
    if not blind:
        offset, offset_std = g.tool_offset
        tilt, tilt_std = g.tool_tilt
        print(f'magnet from the tracked point, along the tool\'s x y z: '
              f'{listed(offset, offset_std, 1e3, 2)} mm; tilted by '
              f'{listed(tilt, tilt_std, 180.0 / np.pi, 2)} deg')


def _row(found: GeometrySurvey, j: int) -> str:
    """One sensor of the table."""
    g = found.geometry
    moved = 1e3 * np.linalg.norm(found.network.positions[j] - found.stated.positions[j])
    moved_std, rotated_std = (np.sqrt(np.square(v[j]).mean())
                             for v in (1e3 * g.position_std, np.rad2deg(g.rotation_std)))
    bias = ' '.join(f'{1e6 * b:+8.2f}' for b in g.bias[j])
    return (f'{moved:5.2f} ({moved_std:.2f})  {np.rad2deg(found.turned[j]):6.2f} '
            f'({rotated_std:.2f})  {g.gain[j]:.4f} ({g.gain_std[j]:.4f}) {bias}  '
            f'{g.sensor_residual[j]:8.2f}')
