"""Throughput of the command `archive` with one and with two workers.

    PYTHONPATH=test python -m bench.archive [--passes 10000]

Each recording contains one pass, simulated by two simulators alternately. All recordings are
archived by one worker and by two workers, which must yield equal rows. The figures are the passes
per hour, the fraction of tracked passes and the error of the speed. The aim is that two workers are
at least 1.8 times as fast as one worker.
"""

import argparse
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.apps.archive import archive
from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.writer import RecordingWriter
from support import scenario
from support.bundled import NETWORK_FILE
from support.random_passes import KINDS, SIMULATORS, random_pass

N_STATIONS, VEHICLES_PER_DAY = 100, 5000
"""Number of stations, and number of vehicles per station and day, in the projection."""


def write_pass(path, seed):
    """Write a recording of a pass; return its path and the true speed [m/s] at the CPA."""
    network = read_network(NETWORK_FILE)
    simulator, kind = SIMULATORS[seed % 2], KINDS[seed // 2 % len(KINDS)]
    body, course, duration, flaws = random_pass(simulator, kind, seed)
    readings, t, position, _ = scenario.simulate(
        network, body, course, 100.0, duration, np.random.default_rng(seed), flaws)
    topic_of = dict(zip(network.names, network.topics, strict=True))
    path.mkdir()
    with RecordingWriter(path / f'{path.name}.mcap') as writer:
        for k, (name, content) in enumerate(magnetic_field_dicts(readings)):
            writer.write(f'/{topic_of[name]}', MAGNETIC_FIELD, content, int(readings.stamp_ns[k]))
    k = int(np.argmin(np.hypot(*position[:, :2].T)))
    return path, float(np.hypot(*np.gradient(position[:, :2], t, axis=0)[k]))


def hours_of(recordings, out, workers):
    """Archive the recordings; return (duration [h], result)."""
    with tqdm(total=len(recordings), desc=f'{workers} workers', disable=None) as bar:
        start = time.perf_counter()
        run = archive(recordings, NETWORK_FILE, settings_for('vehicle'), out, workers,
                      progress=lambda _: bar.update())
    assert len(run.done) == len(recordings) and not run.failed, run.failed
    return (time.perf_counter() - start) / 3600.0, run


def main():
    """Print the figures; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--passes', type=int, default=200)
    args = parser.parse_args()
    figures = Figures('archive')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'recordings').mkdir()
        paths = [folder / 'recordings' / f'pass_{k}' for k in range(args.passes)]
        with ProcessPoolExecutor(2) as pool:
            speeds = dict(tqdm(pool.map(write_pass, paths, range(args.passes), chunksize=8),
                               total=args.passes, desc='simulating', disable=None))
        hours, run = zip(*(hours_of(paths, folder / f'out_{n}', n) for n in (1, 2)), strict=True)
        tables = [[pq.read_table(folder / f'out_{n}' / table).sort_by(
            [('source', 'ascending'), ('stamp_ns', 'ascending')]) for n in (1, 2)]
            for table in ('tracks', 'poses', 'smoothed', 'passes', 'health')]
        assert all(a.equals(b) for a, b in tables), 'one and two workers yield different rows'
        tracks = tables[0][0].to_pandas()
    print(f'{args.passes} recordings of one pass each')
    for n, duration in zip((1, 2), hours, strict=True):
        figures.add(f'passes per hour, {n} workers', args.passes / duration, '',
                    more_is_better=True)
    figures.add('two workers over one', hours[0] / hours[1], '', 1.8, True)
    first = tracks.drop_duplicates('source')
    ratio = first['speed'] / [speeds[Path(source)] for source in first['source']]
    figures.add('passes tracked', len(first) / args.passes, '', more_is_better=True)
    figures.add('speed error, median', 100.0 * float((ratio - 1.0).abs().median()), '%')
    passes_per_year = N_STATIONS * VEHICLES_PER_DAY * 365.25
    cores = passes_per_year * hours[0] / args.passes / (24 * 365.25)
    print(f'  projection: {N_STATIONS} stations with {VEHICLES_PER_DAY} vehicles per day have '
          f'{passes_per_year:.3g} passes per year, which occupy {cores:.1f} such cores; one core '
          'processes a year of one station in '
          f'{passes_per_year / N_STATIONS * hours[0] / args.passes / 24:.0f} days')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
