"""Commands `mag-tracking calibrate network` and `calibrate tumble`."""

import argparse
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from tqdm import tqdm

from mag_tracking.cli import options
from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.records import Readings

if TYPE_CHECKING:
    from mag_tracking.apps.calibrate import Calibration
    from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit
    from mag_tracking.run import ArraySource, RecordingSource

_NETWORK_HELP = '''
Estimates the tilt (from the accelerometer), the heading (from the Earth's field), the clock offset
(from two or more knocks, at uneven intervals, that shake all sensors) and the noise of each sensor.
Keep targets away during the first seconds of the recording. Checks that all sensors measure the
same Earth field, and reports flipped or swapped axes and wrong units. Passing vehicles improve the
headings (disable with --no-passes). Headings remain uncertain (a bias of 0.6 uT rotates a compass
by two degrees); the tracker uses their standard deviations, which are written to the network file.
Nominal orientations are kept in the file, and the next calibration starts from them. The exit
status is 2 if the field of a sensor contradicts the Earth's field.

The network file must contain the Earth's field, as earth_field (tesla) or as site:
  site: {latitude: 58.4, longitude: 15.6, height: 60, date: 2026-05-01, x_azimuth_deg: 90}
x_azimuth_deg is the bearing of the x axis of the world frame, clockwise from true north.

example:
  mag-tracking calibrate network first_day.mcap --network site.yaml --out calibrated.yaml
'''

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


def add(commands: options.Commands) -> None:
    """Register the commands."""
    p = _add_command(commands, 'calibrate network', _network, _NETWORK_HELP, 'or rosbag2 folder')
    options.add_settings(p)
    p.add_argument('--no-passes', action='store_true',
                   help='do not estimate headings from passing targets')
    options.add_report(p)
    p = _add_command(commands, 'calibrate tumble', _tumble, _TUMBLE_HELP,
                     'rosbag2 folder, or table of readings')
    p.add_argument('--sensor', nargs='+', default=[], metavar='NAME',
                   help='sensors that were rotated (default: all)')
    p.add_argument('--field-magnitude', type=float, metavar='TESLA',
                   help='magnitude of the ambient field (if it is not given, the mean gain is not '
                   'calibrated)')
    options.add_table_options(p, sensor=False)


def _add_command(commands: options.Commands, name: str, run: Callable[[argparse.Namespace], int],
                 text: str, kinds: str) -> argparse.ArgumentParser:
    p = options.add_command(commands, name, run, text)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help=f'.mcap, .db3 or .bag file, {kinds}')
    options.add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='FILE', help='network file to write')
    p.add_argument('--figure', type=Path, metavar='FILE', help='draw the calibration (.png, .pdf)')
    return p


def _bar(args: argparse.Namespace, size: int | None) -> 'tqdm[NoReturn]':
    """Progress bar of the bytes of the recording, shown only in a terminal."""
    return tqdm(total=size, unit='B', unit_scale=True, desc=args.recording.name, disable=None)


def _network(args: argparse.Namespace) -> int:
    # Imported here, as in the other functions, because it loads scipy.
    from mag_tracking.apps.calibrate import calibrate

    network = options.recorded_network(args)
    settings = options.settings_of(args, network)
    recording = Recording(args.recording)
    options.check_outputs(args)
    options.check_report(args, args.recording, args.network, args.out, args.figure)
    n_reads = 1 if args.no_passes else 2
    with recorded_signals(signal.SIGINT) as signals, _bar(args, n_reads * recording.size) as bar:
        result = calibrate(recording, network, settings, options.utc_timestamp(),
                           not args.no_passes, bar.update, lambda: bool(signals))
    _print(result, recording)
    if signals:
        print('interrupted: nothing was written')
        return 130
    write_network(args.out, result.network,
                  f'Calibrated from {args.recording.name} and {args.network.name}.')
    if args.report is not None:
        # Imported here because it loads matplotlib.
        from mag_tracking.apps.calibrate_report import write_report

        write_report(result, network, args.recording.name, args.report)
    if args.figure is not None:
        # Imported here because it loads matplotlib.
        from mag_tracking.apps.calibrate_report import calibration_figure
        from mag_tracking.report.style import save_figure

        save_figure(calibration_figure(result, network), args.figure)
    print(f'network written to {args.out}')
    return 2 if result.survey.disagreements else 0


def _print(result: 'Calibration', recording: Recording) -> None:
    from mag_tracking.apps.calibrate import sensor_rows

    survey = result.survey
    print('sensor      tilt     heading [deg]    clock [ms]          noise [nT]           source')
    for name, tilt, heading, std, clock, clock_std, noise, source in sensor_rows(result.network):
        std_text = '  (?)' if np.isnan(std) else f'({std:.1f})'
        clock_text = '' if np.isnan(clock_std) else f'{1e3 * clock:+8.2f} ({1e3 * clock_std:.2f})'
        noise_text = '' if noise is None else ' '.join(f'{1e9 * v:5.1f}' for v in noise)
        print(f'{name:11s} {tilt:6.1f}  {heading:+8.1f} {std_text:>6s}  {clock_text:16s}  '
              f'{noise_text:17s}  {source}')
    if survey.reference:
        print(f'clock offsets relative to {survey.reference}')
    if result.evidence is not None:
        scatter = result.evidence.scatter[~np.isnan(result.evidence.scatter)]
        print(f'passes used: {result.evidence.n_tracks}'
              + (f'; largest scatter between passes: {np.sqrt(scatter.max()):.1f} standard '
                 'deviations' if len(scatter) else ''))
    for warning in survey.warnings():
        print(f'  warning: {warning}')
    for name in result.without_background:
        print(f'  warning: {name}: no background was learnt; keep targets away during the first '
              'seconds of the recording (run mag-tracking doctor for details)')
    if survey.disagreements and result.evidence is None:
        print('  note: passes were not used, because some sensors contradict the Earth\'s field')
    for cause, n in {**result.rejected, **recording.losses}.items():
        print(f'  warning: {cause}: {n}')


def _tumble(args: argparse.Namespace) -> int:
    from mag_tracking.apps.calibrate import tumble
    from mag_tracking.run import RecordingSource

    magnitude = args.field_magnitude
    if magnitude is not None and not 1e-6 <= magnitude <= 1e-3:
        raise SettingsError(f'--field-magnitude: expected 1e-6 to 1e-3 T, got {magnitude:g}')
    network = options.recorded_network(args)
    source = _source(args, network)
    options.check_outputs(args)
    size = source.recording.size if isinstance(source, RecordingSource) else None
    with recorded_signals(signal.SIGINT) as signals, _bar(args, size) as bar:
        calibrated, fits, readings = tumble(source, network, args.sensor, options.utc_timestamp(),
                                            magnitude, bar.update, lambda: bool(signals))
    for name, fit in fits.items():
        _print_fit(name, fit)
    for cause, n in source.lost.items():
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


def _source(args: argparse.Namespace, network: SensorNetwork) -> 'RecordingSource | ArraySource':
    from mag_tracking.recording.field_table import SUFFIXES, read_field_table
    from mag_tracking.run import ArraySource, RecordingSource

    if args.recording.suffix.lower() not in SUFFIXES:
        return RecordingSource(Recording(args.recording), network)
    # The name of the only sensor of a table that does not name it.
    candidates = args.sensor or network.names
    table = read_field_table(args.recording, options.table_options(
        args, candidates[0] if len(candidates) == 1 else ''), with_times=False)
    options.print_notes(args.recording, table.notes)
    readings = Readings.joined(table.sessions)
    if not set(readings.names) & set(network.names):
        raise RecordingError(f'the table has the sensors {", ".join(readings.names)}, and the '
                             f'network {", ".join(network.names)}')
    return ArraySource(readings)


def _print_fit(name: str, fit: 'EllipsoidFit') -> None:
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
