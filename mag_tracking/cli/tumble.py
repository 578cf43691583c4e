"""mag-tracking tumble."""

import argparse
import signal
from pathlib import Path

from tqdm import tqdm

from mag_tracking.apps.tumble import tumble
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    check_outputs,
    now,
    recorded_network,
)
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import write_network
from mag_tracking.recording.reader import Recording

_TUMBLE = '''
For sensors that can be taken in the hand: turn each slowly through all directions, far
from iron, while `mag-tracking record` runs. Readings then lie on an ellipsoid; what takes
it to a sphere (hard iron, soft iron, scale, skewness) is written into the network file and
taken from every reading from then on. Do this first: background and noise in the file were
of other readings, and are taken out. A turning that leaves directions out is refused.

example:
  mag-tracking tumble hand.mcap --network site.yaml --sensor mag_3 --out site_tumbled.yaml
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'tumble', _tumble, _TUMBLE)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='an .mcap, .db3 or .bag file, or a rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--sensor', nargs='+', default=[], metavar='NAME',
                   help='which were turned (default: all)')
    p.add_argument('--field-size', type=float, metavar='TESLA',
                   help='size of the field there; without it gains are left as they are')
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='the network file to write')
    p.add_argument('--figure', type=Path, metavar='FILE', help='draw what was found (.png, .pdf)')


def _tumble(args: argparse.Namespace) -> int:
    """mag-tracking tumble."""
    if args.field_size is not None and not 1e-6 <= args.field_size <= 1e-3:
        raise SettingsError(f'--field-size: {args.field_size:g} is not between 1e-6 and 1e-3 tesla')
    network, recording = recorded_network(args), Recording(args.recording)
    check_outputs(args)
    with recorded_signals(signal.SIGINT) as seen:
        with tqdm(total=recording.size, unit='B', unit_scale=True, desc=args.recording.name,
                  disable=None) as bar:
            found, fits, readings, _ = tumble(recording, network, args.sensor, now(),
                                              args.field_size, bar.update, lambda: bool(seen))
    for name, fit in fits.items():
        _print_fit(name, fit)
    for what, n in recording.losses.items():
        print(f'  warning: {what}: {n}')
    good = [name for name, fit in fits.items() if fit.converged]
    if seen or not good:
        print('interrupted: nothing was written' if seen else 'nothing was written')
        return 130 if seen else 1
    write_network(args.out, found, f'{", ".join(good)} tumbled in {args.recording.name}; before '
                  f'that {args.network.name}.')
    if args.figure is not None:
        from mag_tracking.report.calibration_figures import tumble_figure
        from mag_tracking.report.figure_file import save_figure

        save_figure(tumble_figure({name: fits[name] for name in good}, readings), args.figure)
    print(f'the network is in {args.out}')
    return 0


def _print_fit(name: str, fit: EllipsoidFit) -> None:
    """One ellipsoid."""
    if not fit.converged:
        print(f'{name}: refused: {fit.reason}')
    else:
        offset = ' '.join(f'{1e6 * v:.3f} ({1e6 * s:.3f})' for v, s in
                          zip(fit.offset, fit.offset_std, strict=True))
        print(f'{name}: size of the field scatters by {100 * fit.residual:.2f} %, before '
              f'{100 * fit.residual_before:.1f} %; offset {offset} uT; coverage '
              f'{fit.coverage:.2f}; {fit.n_readings} readings, {fit.n_outliers} outliers')
    for text in fit.warnings:
        print(f'  warning: {name}: {text}')
