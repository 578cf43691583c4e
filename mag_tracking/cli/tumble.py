"""Command `mag-tracking calibrate tumble`."""

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
    add_table_options,
    check_outputs,
    print_notes,
    recorded_network,
    table_options,
    utc_timestamp,
)
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.records import Readings

_TUMBLE_HELP = '''
Calibrates sensors that can be held in the hand. Rotate each sensor slowly through all orientations,
far from iron, while `mag-tracking record` runs, or write the readings to a table, with or without
times. The readings lie on an ellipsoid; the correction to
a sphere (hard iron, soft iron, scale factors, skewness) is written to the network file and applied
to all later readings. Run this calibration before others, because background and noise in the
network file refer to uncorrected readings and are removed. The calibration of a sensor is rejected
if its rotation did not cover enough directions.

examples:
  mag-tracking calibrate tumble hand.mcap --network site.yaml --sensor mag_3 --out tumbled.yaml
  mag-tracking calibrate tumble hand.csv --unit uT --network site.yaml \\
      --sensor mag_3 --out tumbled.yaml
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'calibrate tumble', _tumble, _TUMBLE_HELP)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, rosbag2 folder, or table of readings')
    add_recorded_network(p)
    p.add_argument('--sensor', nargs='+', default=[], metavar='NAME',
                   help='sensors that were rotated (default: all)')
    p.add_argument('--field-magnitude', type=float, metavar='TESLA',
                   help='magnitude of the ambient field (if it is not given, the mean gain is not '
                   'calibrated)')
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='network file to write')
    p.add_argument('--figure', type=Path, metavar='FILE',
                   help='draw the calibration (.png, .pdf)')
    add_table_options(p, sensor=False)


def _tumble(args: argparse.Namespace) -> int:
    """Run `mag-tracking calibrate tumble`."""
    magnitude = args.field_magnitude
    if magnitude is not None and not 1e-6 <= magnitude <= 1e-3:
        raise SettingsError(f'--field-magnitude: expected 1e-6 to 1e-3 T, got {magnitude:g}')
    network = recorded_network(args)
    source = _source(args, network)
    check_outputs(args)
    with recorded_signals(signal.SIGINT) as signals:
        with tqdm(total=getattr(source, 'size', None), unit='B', unit_scale=True,
                  desc=args.recording.name, disable=None) as bar:
            calibrated, fits, readings, _ = tumble(
                source, network, args.sensor, utc_timestamp(), args.field_magnitude,
                bar.update, lambda: bool(signals))
    for name, fit in fits.items():
        _print_fit(name, fit)
    if isinstance(source, Recording):
        for cause, n in source.losses.items():
            print(f'  warning: {cause}: {n}')
    converged_names = [name for name, fit in fits.items() if fit.converged]
    if signals or not converged_names:
        print('interrupted: nothing was written' if signals else 'nothing was written')
        return 130 if signals else 1
    write_network(args.out, calibrated, f'{", ".join(converged_names)} tumbled in '
                  f'{args.recording.name}; based on {args.network.name}.')
    if args.figure is not None:
        from mag_tracking.apps.calibrate_report import tumble_figure
        from mag_tracking.report.style import save_figure

        save_figure(tumble_figure({name: fits[name] for name in converged_names}, readings),
                    args.figure)
    print(f'network written to {args.out}')
    return 0


def _source(args: argparse.Namespace, network: SensorNetwork) -> Recording | list[Readings]:
    """Open the recording, or read the table of readings."""
    from mag_tracking.recording.field_table import SUFFIXES, read_field_table

    if args.recording.suffix.lower() not in SUFFIXES:
        return Recording(args.recording)
    # The name of the only sensor of a table that does not name it.
    candidates = args.sensor or network.names
    table = read_field_table(args.recording, table_options(
        args, candidates[0] if len(candidates) == 1 else ''), with_times=False)
    print_notes(args.recording, table.notes)
    return table.sessions


def _print_fit(name: str, fit: EllipsoidFit) -> None:
    """Print the ellipsoid fit of one sensor, or the reason for its rejection."""
    if not fit.converged:
        print(f'{name}: calibration rejected: {fit.reason}')
    else:
        offset = ' '.join(f'{1e6 * v:.3f} ({1e6 * s:.3f})' for v, s in
                          zip(fit.offset, fit.offset_std, strict=True))
        print(f'{name}: scatter of the field magnitude {100 * fit.residual:.2f}% (uncorrected '
              f'{100 * fit.residual_before:.1f}%); offset {offset} uT; coverage '
              f'{fit.coverage:.2f}; {quantity(fit.n_readings, "reading")}, '
              f'{quantity(fit.n_outliers, "outlier")}')
    for warning in fit.warnings:
        print(f'  warning: {name}: {warning}')
