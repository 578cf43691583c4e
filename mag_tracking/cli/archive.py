"""mag-tracking archive."""

import argparse
import os
import signal
from pathlib import Path

from tqdm import tqdm

from mag_tracking.apps.archive import archive, recordings_of, size_of
from mag_tracking.cli.options import Commands, add_command, add_recorded_network, recorded_network
from mag_tracking.cli.tracking_options import add_settings, settings_of
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals

_ARCHIVE = '''
Tracks what is in many recordings, or in long ones, on several processors or machines. The
rows are those of `mag-tracking replay` of each recording by itself: a long one is cut where no
target is near. Run it again, and it goes on where it stopped; recordings that are done are left
alone. One that fails is listed with its reason, and the others go on.

Writes to DIR, as Parquet that pandas, DuckDB and polars read (docs/archive.md has the columns):
  tracks/      one row a track          passes/      one row a fitted pass
  poses/       one row a pose           smoothed/    the same, smoothed
  health/      each sensor every ten minutes
  recordings.parquet  one row a recording, also of those that failed

examples:
  mag-tracking archive recordings/ --network site.yaml --out archive
  mag-tracking archive 'station_1/2026-03-*.mcap' --network site.yaml --out archive --workers 8
  mag-tracking archive /share/month --network site.yaml --out /share/archive \\
      --scheduler tcp://10.0.0.5:8786

The workers of a scheduler need this package, and the same paths to recordings and DIR.
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'archive', _archive, _ARCHIVE)
    p.add_argument('recordings', nargs='+', metavar='FOLDER|GLOB|RECORDING',
                   help='folders are searched with all that is in them')
    add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder of the dataset')
    add_settings(p)
    where = p.add_mutually_exclusive_group()
    where.add_argument('--workers', type=int, metavar='N', default=os.cpu_count() or 1,
                       help='processes on this machine (default: as many as it has processors)')
    where.add_argument('--scheduler', metavar='ADDRESS',
                       help='of a Dask scheduler that runs somewhere, such as tcp://10.0.0.5:8786')


def _archive(args: argparse.Namespace) -> int:
    """mag-tracking archive."""
    if args.workers < 1:
        raise SettingsError(f'--workers: expected 1 or more, got {args.workers}')
    network, settings = recorded_network(args), settings_of(args)
    recordings = recordings_of(args.recordings)
    with recorded_signals(signal.SIGINT) as seen, \
            tqdm(total=sum(map(size_of, recordings)), unit='B', unit_scale=True, desc='archive',
                 disable=None) as bar:
        run = archive(recordings, network, settings, args.out, args.workers, args.scheduler,
                      bar.update, lambda: bool(seen), tqdm.write)
    print(f'{len(run.done)} recordings tracked: {run.tracks} tracks, {run.passes} passes'
          + (f'; {len(run.were_done)} were done before' if run.were_done else ''))
    if run.lost_workers:
        print(f'  a worker was lost {run.lost_workers} times; what it did was done again')
    if run.failed:
        print(f'  {len(run.failed)} failed; recordings.parquet has the reasons')
    if run.interrupted:
        print(f'interrupted; what was done is in {args.out}, and the same command goes on')
        return 130
    print(f'the dataset is in {args.out}')
    return 1 if run.failed else 0
