"""mag-tracking calibrate and tumble."""

import datetime
import signal
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.calibrating import calibrate, tumble
from mag_tracking.cli.options import add_command, add_network, add_settings, settings_of
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.interrupts import noted_signals
from mag_tracking.io.bag import Recording
from mag_tracking.io.network_file import read_network, write_network

_CALIBRATE = '''
From a recording that begins without a target: how each sensor is turned (accelerometer
and compass), how far its clock is off (knock twice, unevenly, so that all sensors feel
it), its noise, and whether all sensors measure the same Earth: a flipped axis, a swapped
pair or another unit is named. What passes tells more of the headings (--no-passes to
leave that out). An unknown bias of 0.6 uT turns a compass by two degrees: the deviations
that are written into the network file say what is known, and the tracker counts with them.
What was stated by hand is kept there, too: calibrating again begins from that. The exit
status is 2 where a sensor cannot be right.

The network file needs the Earth's field, as earth_field (tesla) or as the site:
  site: {latitude: 58.4, longitude: 15.6, height: 60, date: 2026-05-01, x_azimuth_deg: 90}
x_azimuth_deg is the bearing of the frame's x axis (of the road) from true north.

example:
  mag-tracking calibrate first_day.mcap --network site.yaml --out calibrated.yaml
'''

_TUMBLE = '''
For sensors that can be taken in the hand: turn each slowly through all directions, far
from iron, while `mag-tracking record` runs. Readings then lie on an ellipsoid; what takes
it to a sphere (hard iron, soft iron, scale, skewness) is written into the network file and
taken from every reading from then on. Do this first: background and noise in the file were
of other readings, and are taken out. A turning that leaves directions out is refused.

example:
  mag-tracking tumble hand.mcap --network site.yaml --sensor mag_3 --out site_tumbled.yaml
'''


FIGURES = ('.png', '.pdf', '.svg')


def add(commands):
    """Register the commands."""
    p = add_command(commands, 'calibrate', _calibrate,
                    'Find how sensors are turned and their clocks are off.', _CALIBRATE)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='an .mcap file or a rosbag2 folder')
    add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='the network file to write')
    add_settings(p)
    p.add_argument('--no-passes', action='store_true', help='do not track what passes')
    p.add_argument('--figure', type=Path, metavar='FILE', help='draw what was found (.png, .pdf)')

    p = add_command(commands, 'tumble', _tumble,
                    'Find the hard and soft iron of sensors that were turned about.', _TUMBLE)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='an .mcap file or a rosbag2 folder')
    add_network(p)
    p.add_argument('--sensor', nargs='+', default=[], metavar='NAME',
                   help='which were turned (default: all)')
    p.add_argument('--field-size', type=float, metavar='TESLA',
                   help='size of the field there; without it gains are left as they are')
    p.add_argument('--out', required=True, type=Path, metavar='FILE',
                   help='the network file to write')
    p.add_argument('--figure', type=Path, metavar='FILE', help='draw what was found (.png, .pdf)')


def _tumble(args):
    """mag-tracking tumble."""
    if args.field_size is not None and not 1e-6 <= args.field_size <= 1e-3:
        raise SettingsError(f'--field-size: {args.field_size:g} is not between 1e-6 and 1e-3 tesla')
    network, recording = read_network(args.network), Recording(args.recording)
    _check_folders(args)
    with noted_signals(signal.SIGINT) as seen:
        with tqdm(total=recording.size, unit='B', unit_scale=True, desc=args.recording.name,
                  disable=None) as bar:
            found, fits, readings, _ = tumble(recording, network, args.sensor, _now(),
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

        tumble_figure({name: fits[name] for name in good}, readings).savefig(args.figure, dpi=110)
    print(f'the network is in {args.out}')
    return 0


def _print_fit(name, fit):
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


def _now():
    """The time, as a calibration is marked with it."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds')


def _check_folders(args):
    """Raise OutputError where what is to be written has no folder to be in."""
    for path in (args.out, args.figure):
        if path is not None and not path.absolute().parent.is_dir():
            raise OutputError(f'cannot write {path}: there is no folder {path.parent}')
        if path is not None and path.is_dir():
            raise OutputError(f'cannot write {path}: it is a folder')
    if args.figure is not None and args.figure.suffix.lower() not in FIGURES:
        raise SettingsError(f'--figure: {args.figure.name} ends in none of {", ".join(FIGURES)}')


def _calibrate(args):
    """mag-tracking calibrate."""
    network, settings = read_network(args.network), settings_of(args)
    recording = Recording(args.recording)
    _check_folders(args)
    times = 1 if args.no_passes else 2
    with noted_signals(signal.SIGINT) as seen:
        with tqdm(total=times * recording.size, unit='B', unit_scale=True,
                  desc=args.recording.name, disable=None) as bar:
            found = calibrate(recording, network, settings, _now(), not args.no_passes, bar.update,
                              lambda: bool(seen))
    _print(found, recording)
    if seen:
        print('interrupted: nothing was written')
        return 130
    write_network(args.out, found.network,
                  f'Calibrated from {args.recording.name} and {args.network.name}.')
    if args.figure is not None:
        # Drawing needs matplotlib, which a run without a figure should not wait for.
        from mag_tracking.report.calibration_figures import calibration_figure

        calibration_figure(found, network).savefig(args.figure, dpi=110)
    print(f'the network is in {args.out}')
    return 2 if found.survey.disagreements else 0


def _print(found, recording):
    """The calibration as a table, and what is wrong."""
    survey = found.survey
    print('sensor      tilted   heads [deg]      clock [ms]          noise [nT]           by')
    for j, sensor in enumerate(survey.sensors):
        print(f'{sensor.sensor:11s} {_row(found, j)}')
    if survey.reference:
        print(f'clocks against that of {survey.reference}')
    if found.evidence is not None:
        scatter = found.evidence.scatter[~np.isnan(found.evidence.scatter)]
        print(f'{found.evidence.n_tracks} passes counted in'
              + (f'; they differ by {np.sqrt(scatter.max()):.1f} of what they claim at most'
                 if len(scatter) else ''))
    for text in survey.warnings():
        print(f'  warning: {text}')
    for name in found.without_background:
        print(f'  warning: {name}: no background was learnt: the recording needs a target-free '
              'beginning (mag-tracking doctor may say more)')
    if survey.disagreements and found.evidence is None:
        print('  note: passes were left out, because of sensors that cannot be right')
    for what, n in {**found.rejected, **recording.losses}.items():
        print(f'  warning: {what}: {n}')


def _row(found, j):
    """One sensor of the table."""
    network = found.network
    R, std = network.R_ws[j], network.orientation_std[j]
    tilt = np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0)))
    # Where the sensor's x axis points, seen from above.
    heading = np.degrees(np.arctan2(R[1, 0], R[0, 0]))
    sd = '  (?)' if std is None else f'({np.degrees(std[2]):.1f})'
    done, noise = network.calibrated[j], network.noise_std[j]
    clock = ' ' * 16
    if done is not None and not np.isnan(done.clock_offset_std):
        clock = f'{1e3 * network.clock_offset[j]:+8.2f} ({1e3 * done.clock_offset_std:.2f})'
    quiet = ' '.join(f'{1e9 * v:5.1f}' for v in noise) if noise is not None else ' ' * 17
    return (f'{tilt:6.1f}  {heading:+8.1f} {sd:>6s}  {clock:16s}  {quiet}  '
            f'{"as stated" if done is None else done.by}')
