"""Archive command and archive tables for a few bundled recordings."""

import shutil
import sys
import time

import duckdb

from mag_tracking.results.archive_folder import TABLES
from support.bundled import NETWORK_FILE, QUICK, parameter_file, vehicle_path

NAMES = ('straight_car_right', 'straight_small_left', 'junction_left_to_right')


def archive_recordings(folder):
    """Fill a folder with three recordings, one in a subfolder, and two other files.

    Returns the folder.
    """
    (folder / 'below').mkdir()
    for name in NAMES:
        shutil.copy(vehicle_path(name), folder / ('below' if 'junction' in name else '.'))
    (folder / 'damaged.mcap').write_text('this is no recording')
    (folder / 'notes.txt').write_text('of the installer')
    return folder


def rows(folder, table):
    """Read all rows of an archive table, sorted."""
    columns = [c.name for c in TABLES[table]]
    files = folder / ('recordings.parquet' if table == 'recordings' else f'{table}/**/*.parquet')
    # The number makes the order unique for rows with the same source and timestamp.
    order = [n for n in ('source', 'track_id', 'number', 'stamp_ns', 'sensor') if n in columns]
    return duckdb.sql(f"SELECT {', '.join(columns)} FROM read_parquet('{files}') "
                      f"ORDER BY {', '.join(order)}").fetchall()


def same_tables(a, b):
    """Whether two archives have the same rows; NULL differs from NaN."""
    return all(rows(a, table) == rows(b, table) for table in TABLES)


def command(recordings, out, folder, *options):
    """Command line of the archive command with fast settings."""
    return [sys.executable, '-m', 'mag_tracking.cli', 'archive', str(recordings), '--network',
            str(NETWORK_FILE), '--params', str(parameter_file(folder / 'quick.yaml', QUICK)),
            '--out', str(out), *options]


def wait_for(condition):
    """Wait until `condition()` is true."""
    while not condition():
        time.sleep(0.02)
