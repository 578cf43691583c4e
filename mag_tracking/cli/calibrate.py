"""Command `mag-tracking calibrate network`."""

import argparse
import signal
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.apps.calibrate import Calibration, calibrate
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    add_report,
    add_settings,
    check_outputs,
    check_report,
    recorded_network,
    settings_of,
    utc_timestamp,
)
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import write_network
from mag_tracking.recording.reader import Recording

_CALIBRATE_HELP = '''
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


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'calibrate network', _calibrate, _CALIBRATE_HELP)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='network file to write')
    add_settings(p)
    p.add_argument('--no-passes', action='store_true',
                   help='do not estimate headings from passing targets')
    p.add_argument('--figure', type=Path, metavar='FILE',
                   help='draw the calibration (.png, .pdf)')
    add_report(p)


def _calibrate(args: argparse.Namespace) -> int:
    """Run `mag-tracking calibrate network`."""
    network = recorded_network(args)
    settings = settings_of(args, network)
    recording = Recording(args.recording)
    check_outputs(args)
    check_report(args, args.recording, args.network, args.out, args.figure)
    n_reads = 1 if args.no_passes else 2
    with recorded_signals(signal.SIGINT) as signals:
        with tqdm(total=n_reads * recording.size, unit='B', unit_scale=True,
                  desc=args.recording.name, disable=None) as bar:
            result = calibrate(recording, network, settings, utc_timestamp(), not args.no_passes,
                               bar.update, lambda: bool(signals))
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


def _print(result: Calibration, recording: Recording) -> None:
    """Print the calibration as a table, followed by notes and warnings."""
    survey = result.survey
    print('sensor      tilt     heading [deg]    clock [ms]          noise [nT]           source')
    for j, sensor in enumerate(survey.sensors):
        print(f'{sensor.sensor:11s} {_row(result, j)}')
    if survey.reference:
        print(f'clock offsets relative to {survey.reference}')
    if result.evidence is not None:
        scatter = result.evidence.scatter[~np.isnan(result.evidence.scatter)]
        print(f'passes used: {result.evidence.n_tracks}'
              + (f'; largest scatter between passes: {np.sqrt(scatter.max()):.1f} standard '
                 'deviations'
                 if len(scatter) else ''))
    for warning in survey.warnings():
        print(f'  warning: {warning}')
    for name in result.without_background:
        print(f'  warning: {name}: no background was learnt; keep targets away during the first '
              'seconds of the recording (run mag-tracking doctor for details)')
    if survey.disagreements and result.evidence is None:
        print('  note: passes were not used, because some sensors contradict the Earth\'s field')
    for cause, n in {**result.rejected, **recording.losses}.items():
        print(f'  warning: {cause}: {n}')


def _row(result: Calibration, j: int) -> str:
    """Format the row of sensor `j` in the table."""
    network = result.network
    R, std = network.R_ws[j], network.orientation_std[j]
    tilt = np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0)))
    # Direction of the sensor's x axis in the horizontal plane.
    heading = np.degrees(np.arctan2(R[1, 0], R[0, 0]))
    sd = '  (?)' if std is None else f'({np.degrees(std[2]):.1f})'
    calibrated, noise = network.calibrated[j], network.noise_std[j]
    clock = ' ' * 16
    if calibrated is not None and not np.isnan(calibrated.clock_offset_std):
        clock = f'{1e3 * network.clock_offset[j]:+8.2f} ({1e3 * calibrated.clock_offset_std:.2f})'
    noise_column = ' '.join(f'{1e9 * v:5.1f}' for v in noise) if noise is not None else ' ' * 17
    return (f'{tilt:6.1f}  {heading:+8.1f} {sd:>6s}  {clock:16s}  {noise_column}  '
            f'{"nominal orientation" if calibrated is None else calibrated.by}')
