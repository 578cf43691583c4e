"""Command `mag-tracking archive`."""

import argparse
import os
import signal
from pathlib import Path

from tqdm import tqdm

from mag_tracking.apps.archive import archive, recordings_of, size_of
from mag_tracking.cli import options
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.quantities import quantity

_ARCHIVE_HELP = '''
Tracks many or long recordings on several processors or machines. Each recording has the same
results as with `mag-tracking replay`; long recordings are divided while no target is present. An
interrupted run continues when the same command is run again; completed recordings are skipped. A
recording that fails is listed with the reason and does not stop the run.

Parquet files written to DIR:
  tracks/             one row per track
  poses/              one row per pose
  smoothed/           one row per smoothed pose
  passes/             one row per fitted pass
  health/             one row per sensor every ten minutes
  recordings.parquet  one row per recording, including failed recordings

examples:
  mag-tracking archive recordings/ --network site.yaml --out archive
  mag-tracking archive 'station_1/2026-03-*.mcap' --network site.yaml --out archive --workers 8
  mag-tracking archive /share/month --network site.yaml --out /share/archive \\
      --scheduler tcp://10.0.0.5:8786

The workers of a Dask scheduler need this package, and access to the recordings and DIR under the
same paths. A scheduler executes the code of whoever reaches it; the guide "Track an archive" shows
how to use one with certificates (tls://...).
'''


def add(commands: options.Commands) -> None:
    """Register the command."""
    p = options.add_command(commands, 'archive', _archive, _ARCHIVE_HELP)
    p.add_argument('recordings', nargs='+', metavar='FOLDER|GLOB|RECORDING',
                   help='recordings; folders are searched recursively')
    options.add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder of the dataset')
    options.add_settings(p)
    executor = p.add_mutually_exclusive_group()
    executor.add_argument('--workers', type=int, metavar='N', default=os.cpu_count() or 1,
                          help='number of processes on this machine (default: one per processor)')
    executor.add_argument('--scheduler', metavar='ADDRESS',
                          help='address of a running Dask scheduler (e.g. tcp://10.0.0.5:8786)')


def _archive(args: argparse.Namespace) -> int:
    if args.workers < 1:
        raise SettingsError(f'--workers: expected 1 or more, got {args.workers}')
    network = options.recorded_network(args)
    settings = options.settings_of(args, network)
    recordings = recordings_of(args.recordings)
    with recorded_signals(signal.SIGINT) as signals, \
            tqdm(total=sum(map(size_of, recordings)), unit='B', unit_scale=True, desc='archive',
                 disable=None) as bar:
        result = archive(recordings, network, settings, args.out, args.workers, args.scheduler,
                         bar.update, lambda: bool(signals), tqdm.write)
    print(f'{quantity(len(result.done), "recording")} tracked: {quantity(result.tracks, "track")}, '
          f'{quantity(result.passes, "pass", "passes")}'
          + (f'; {len(result.tracked_earlier)} skipped (already tracked)'
             if result.tracked_earlier else ''))
    if result.lost_workers:
        print(f'  workers lost: {result.lost_workers}; their tasks were repeated')
    if result.failed:
        print(f'  recordings failed: {len(result.failed)}; the reasons are in recordings.parquet')
    if result.interrupted:
        print(f'interrupted; partial results in {args.out}; run the same command to continue')
        return 130
    print(f'dataset in {args.out}')
    return 1 if result.failed else 0
