"""Compare the working tree with a commit: results for the bundled recordings, value by value.

    .venv/bin/python tools/compare_results.py BASE          # working tree against commit BASE

Every bundled recording is replayed with both versions from the command line, with all tables.
Every number in every CSV file must agree within the tolerance; every string and the number of rows
must be identical. The exit status is 1 if any value differs or a file is missing.
"""

import argparse
import csv
import math
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / 'test' / 'data'
TABLES = {'vehicle': 'poses,passages,events,fits', 'magnet': 'poses,events'}


def mag_tracking(tree, *arguments):
    """Run the command `mag-tracking` of the source tree `tree`."""
    environment = {k: v for k, v in os.environ.items() if k != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
    environment['PYTHONPATH'] = str(tree)
    environment.setdefault('OPENBLAS_NUM_THREADS', '1')
    done = subprocess.run([sys.executable, '-m', 'mag_tracking.cli', *map(str, arguments)],
                          cwd=tree, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f'{tree}: mag-tracking {" ".join(map(str, arguments))}\n{done.stderr}')


def recordings(tree, out):
    """Import the magnet tables; return all recordings as [(name, recording, network, target)]."""
    road = ROOT / 'config' / 'network.yaml'
    found = [(p.stem, p, road, 'vehicle') for p in sorted((DATA / 'vehicles').glob('*.mcap'))]
    for folder in ('two_way_road', 'corridor'):
        found += [(p.stem, p, DATA / folder / 'network.yaml', 'vehicle')
                  for p in sorted((DATA / folder).glob('*.mcap'))]
    found += [(p.stem, p, DATA / 'busy' / f'network_{p.stem.split("_", 1)[1]}.yaml', 'vehicle')
              for p in sorted((DATA / 'busy').glob('*.mcap'))]
    for n in (1, 2):
        source, folder = DATA / 'magnet_16_sensors', out / f'lisa{n}'
        mag_tracking(tree, 'import', source / f'lisa_data{n}.csv', '--background',
                     source / f'lisa_data{n}_background.csv', '--out', folder)
        recording = next(p for p in folder.rglob('*.mcap'))
        network = next(p for p in folder.rglob('*.yaml') if p.name != 'metadata.yaml')
        found.append((f'lisa_data{n}', recording, network, 'magnet'))
    return found


def replay_all(tree, out, workers):
    """Replay every bundled recording with the source tree `tree` into `out`; return the names."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    jobs = recordings(tree, out / 'imported')
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda r: mag_tracking(
            tree, 'replay', r[1], '--network', r[2], '--target', r[3], '--out', out / r[0],
            '--tables', TABLES[r[3]], '--no-figures'), jobs))
    return [name for name, *_ in jobs]


def difference(one, other):
    """Relative difference of two numbers; infinite for different strings."""
    if one == other:
        return 0.0
    try:
        a, b = float(one), float(other)
    except ValueError:
        return math.inf
    if math.isnan(a) and math.isnan(b):
        return 0.0
    return abs(a - b) / max(abs(a), abs(b)) if math.isfinite(a) and math.isfinite(b) else math.inf


def compare(one, other, renamed):
    """Compare two CSV files; return (n_rows, n_values, largest difference, its location)."""
    if not other.exists():
        return 0, 0, math.inf, f'{other} is missing'
    with open(one, newline='') as a, open(other, newline='') as b:
        rows, other_rows = list(csv.reader(a)), list(csv.reader(b))
    if len(rows) != len(other_rows) or rows[0] != other_rows[0]:
        return len(rows), 0, math.inf, f'{len(rows)} against {len(other_rows)} rows'
    worst, where, n = 0.0, '', 0
    for i, (row, other_row) in enumerate(zip(rows, other_rows, strict=True)):
        for column, x, y in zip(rows[0], row, other_row, strict=True):
            n += 1
            for old, new in renamed:
                x = x.replace(old, new)
            d = difference(x, y)
            if d > worst:
                worst, where = d, f'row {i}, {column}: {x} against {y}'
    return len(rows), n, worst, where


def main():
    """Replay with both versions, compare, and print one line per table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('base', help='commit to compare with')
    parser.add_argument('--tolerance', type=float, default=1e-12,
                        help='relative tolerance (default: 1e-12)')
    parser.add_argument('--workers', type=int, default=2,
                        help='number of concurrent replays (default: 2)')
    parser.add_argument('--renamed', nargs=2, action='append', default=[], metavar=('OLD', 'NEW'),
                        help='string in the results of the base, and the string that replaces it')
    args = parser.parse_args()
    build = ROOT / 'build' / 'compare'
    commit = subprocess.run(['git', 'rev-parse', '--short', args.base], cwd=ROOT, check=True,
                            capture_output=True, text=True).stdout.strip()
    tree, base_results = build / f'tree_{commit}', build / f'results_{commit}'
    if not tree.exists():
        subprocess.run(['git', 'worktree', 'add', '--detach', tree, commit], cwd=ROOT, check=True,
                       capture_output=True)
        subprocess.run([sys.executable, 'setup.py', '-q', 'build_ext', '--inplace'], cwd=tree,
                       check=True, capture_output=True)
    if not (base_results / 'complete').exists():
        replay_all(tree, base_results, args.workers)
        (base_results / 'complete').touch()
    names = replay_all(ROOT, build / 'results', args.workers)
    failed = False
    for name in names:
        for table in sorted(p.name for p in (base_results / name).glob('*.csv')):
            n_rows, n, worst, where = compare(
                base_results / name / table, build / 'results' / name / table, args.renamed)
            is_different = worst > args.tolerance
            failed |= is_different
            print(f'{name} {table}: {n_rows} rows, {n} values, largest difference {worst:.2g}'
                  + (f'  DIFFERS: {where}' if is_different else ''))
    print('different' if failed else f'all values agree within {args.tolerance:g} (relative)')
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
