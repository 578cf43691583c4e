"""Command `mag-tracking doctor`."""

import argparse
import signal
from pathlib import Path

import numpy as np

from mag_tracking.apps.doctor import Doctor, examine, write_report
from mag_tracking.cli import options
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.recording.reader import Recording
from mag_tracking.run import RecordingSource, progress_bar
from mag_tracking.stages.health.diagnosis import Finding, ranked
from mag_tracking.stages.health.sensor_health import SensorHealth

_DOCTOR_HELP = '''
Examines a recording or live topics, and reports the faults of each sensor with a remedy: missing,
lost or duplicate readings, clock steps, delays, noise above the calibration, stuck or saturated
sensors, spikes, flipped or swapped axes, wrong units (gauss or microtesla published as tesla),
backgrounds that are not learnt. The exit status is 0 if no serious fault was found, otherwise 2.

examples:
  mag-tracking doctor night.mcap --network site.yaml
  mag-tracking doctor --live 10 --network site.yaml
'''


def add(commands: options.Commands) -> None:
    """Register the command."""
    p = options.add_command(commands, 'doctor', _doctor, _DOCTOR_HELP)
    p.add_argument('recording', nargs='?', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    p.add_argument('--live', type=float, metavar='SECONDS',
                   help='examine live topics for SECONDS instead of a recording (needs ROS 2)')
    options.add_recorded_network(p)
    options.add_settings(p)
    options.add_report(p)


def _doctor(args: argparse.Namespace) -> int:
    if (args.recording is None) == (args.live is None):
        raise SettingsError('doctor: give either RECORDING or --live SECONDS')
    network = options.recorded_network(args)
    settings = options.settings_of(args, network)
    options.check_report(args, args.recording, args.network)
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        if args.live is not None:
            if not 1.0 <= args.live <= 86400.0:
                raise SettingsError(f'--live: expected 1 to 86400 s, got {args.live:g}')
            # Imported here because it needs ROS.
            from mag_tracking.nodes.doctor_node import listening

            with listening(network, settings, args.live, lambda: bool(signals),
                           args.ros_arguments) as live:
                live.status = _report(args, live.doctor, live.findings(), bool(signals))
            return live.status
        source = RecordingSource(Recording(args.recording), network, by_message=True)
        with progress_bar(source) as bar:
            doctor, further_findings = examine(source, network, settings, bar.update,
                                               lambda: bool(signals))
    return _report(args, doctor, further_findings, bool(signals))


def _report(args: argparse.Namespace, doctor: Doctor, further_findings: list[Finding],
            is_interrupted: bool) -> int:
    """Print all sensors and findings, write the report, and return the exit status."""
    for name, health in doctor.sensors.items():
        print(f'{name:11s} {_row(health)}')
    diagnoses = ranked(further_findings + doctor.findings())
    for d in diagnoses:
        print(f'{"ERROR" if d.serious else "note "} {d.finding.subject}: {d.finding.fault}\n'
              f'      {d.finding.advice}')
        for consequence in d.consequences:
            subject = '' if consequence.subject == d.finding.subject else f'{consequence.subject}: '
            print(f'      therefore {subject}{consequence.fault}')
    if not diagnoses:
        print('no faults found')
    if args.report is not None:
        write_report(doctor, diagnoses, 'the running sensors' if args.recording is None
                     else args.recording.name, args.report)
    if is_interrupted:
        print('interrupted: the results cover only the part read so far')
        return 130
    return 2 if any(d.serious for d in diagnoses) else 0


def _row(health: SensorHealth) -> str:
    c = health.counts
    if not c['readings']:
        return 'no readings'
    delay = health.delay_s[0]
    noise = ' '.join('  -  ' if np.isnan(v) else f'{1e9 * v:5.1f}' for v in health.noise_std)
    return (f'{c["readings"]:8d} readings  {health.rate:7.1f} Hz  {c["lost"]:5d} lost  '
            f'field {1e6 * np.sqrt(np.nansum(health.field**2)):7.2f} uT  noise {noise} nT'
            + ('' if np.isnan(delay) else f'  delay {1e3 * delay:.1f} ms'))
