"""SQL queries on an archive: traffic volume, speeds, repeated vehicles, drifting sensors.

    mag-tracking archive recordings/ --network site.yaml --out archive
    python examples/archive_questions.py archive

If no folder is given, the bundled recordings are archived first. The queries use DuckDB; pandas and
polars read the same files.
"""

import argparse
from pathlib import Path

import duckdb

import mag_tracking as mt
from mag_tracking.apps.archive import archive
from mag_tracking.pipeline import settings_for
from mag_tracking.results.archive_folder import TABLES
from mag_tracking.results.parquet_table import schema_of

ROOT = Path(__file__).resolve().parents[1]

QUESTIONS = {
    'vehicles per hour': '''
        SELECT date_trunc('hour', time) AS hour, kind, count(*) AS vehicles
        FROM tracks GROUP BY ALL ORDER BY ALL''',
    'speeds by kind [m/s], of unambiguous tracks': '''
        SELECT kind, count(*) AS vehicles, round(quantile_cont(speed, 0.15), 1) AS slow,
               round(median(speed), 1) AS median, round(quantile_cont(speed, 0.85), 1) AS fast
        FROM tracks WHERE verdict = 'unique' GROUP BY kind ORDER BY kind''',
    'pairs of passes with the most similar length and moment': '''
        WITH one AS (
            SELECT recording, number, length, sqrt(mx * mx + my * my + mz * mz) AS moment
            FROM passes WHERE reason = '')
        SELECT a.recording AS recording, a.number AS number, b.recording AS again,
               b.number AS again_number, round(a.moment) AS moment, round(b.moment) AS moment_again,
               round(a.length, 1) AS length, round(b.length, 1) AS length_again
        FROM one a JOIN one b ON (a.recording, a.number) < (b.recording, b.number)
        ORDER BY abs(ln(a.moment / b.moment)) + abs(ln(abs(a.length) / abs(b.length)))
        LIMIT 3''',
    'sensors with the largest drift [nT/min], and their noise [nT]': '''
        SELECT sensor, round(60e9 * max(greatest(abs(coalesce(drift_x, 0)),
               abs(coalesce(drift_y, 0)), abs(coalesce(drift_z, 0)))), 2) AS drift,
               round(1e9 * median(noise_x), 1) AS noise, sum(rejected) AS rejected
        FROM health GROUP BY sensor ORDER BY drift DESC''',
}
"""{title: SQL query over the tables of an archive}."""


def open_archive(folder):
    """Open a DuckDB connection with the tables of an archive as views."""
    connection = duckdb.connect()
    for table in ('tracks', 'poses', 'smoothed', 'passes', 'health'):
        if not any((folder / table).glob('**/*.parquet')):
            # No recording has rows for this table.
            connection.register(table, schema_of(TABLES[table]).empty_table())
            continue
        connection.sql(f"CREATE VIEW {table} AS SELECT * FROM read_parquet("
                       f"'{folder}/{table}/**/*.parquet')")
    return connection


def main():
    """Run the queries and print their results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', nargs='?', type=Path,
                        help='folder of an archive (default: archive the bundled recordings)')
    parser.add_argument('--out', type=Path, default=Path('out/archive'),
                        help='output folder for the archive of the bundled recordings')
    args = parser.parse_args()
    folder = args.folder
    if folder is None:
        folder = args.out
        run = archive([ROOT / 'test' / 'data' / 'vehicles'],
                      mt.read_network(ROOT / 'config' / 'network.yaml'), settings_for('vehicle'),
                      folder, workers=2, report=print)
        print(f'{len(run.done)} recordings archived in {folder}, {len(run.tracked_earlier)} '
              'were archived earlier')
    connection = open_archive(folder)
    for question, sql in QUESTIONS.items():
        print(f'\n{question}\n{connection.sql(sql)}')


if __name__ == '__main__':
    main()
