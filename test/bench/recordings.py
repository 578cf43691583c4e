"""Number of unambiguous poses and pose errors, in bundled recordings and simulated passes.

All bundled recordings with one vehicle or magnet are replayed, and simulated passes are tracked
live. The figures are the number of unambiguous poses, how many of them are within 2 m of the
truth, and, for recordings, the errors of the first track. With `--against FOLDER`, the package of
another checkout is measured for comparison. At most 5 % of the correct poses may be lost, and
errors may grow by at most 3 %.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.analysis.track_errors import interpolate_truth
from mag_tracking.apps.replay import replay
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.pose_table import import_pose_table
from mag_tracking.recording.reader import Recording
from mag_tracking.records import Track
from support.bundled import DATA, NETWORK_FILE, ROOT, VEHICLES, vehicle_path
from support.random_passes import KINDS, SIMULATORS, WRONG_M, errors_of
from support.situation_worlds import FOUR, car, random_pass_world, straight

RUNS = 5
"""Number of simulated passes per control and simulator."""
MIN_UNFLAGGED_RATIO = 0.95
"""Minimum number of unflagged poses, relative to the other checkout. It applies to the correct
poses of each recording or control, and to all poses of the total."""
MAX_ERROR = 1.03
"""Maximum ratio of an error to the error with the other checkout."""
UNFLAGGED, CORRECT = 'unflagged', f'unflagged, within {WRONG_M:g} m'
ERRORS = {'rms': 'RMS [m]', 'closest': 'closest [m]', 'anees': 'ANEES', 'position_mean': 'mean [m]',
          'axis_median_deg': 'axis [deg]'}


def recordings(folder):
    """Return {name: (recording, network file, preset)}; import pose tables into `folder`."""
    found = {name: (vehicle_path(name), NETWORK_FILE, 'vehicle') for name in VEHICLES}
    corridor = DATA / 'corridor'
    found['corridor'] = (corridor / 'corridor_8_sensors.mcap', corridor / 'network.yaml', 'vehicle')
    for run in (1, 2):
        table = DATA / 'magnet_16_sensors' / f'lisa_data{run}'
        imported = import_pose_table(table.with_suffix('.csv'), f'{table}_background.csv',
                                     folder / f'magnet{run}', 1e-6)
        found[f'magnet {run}'] = (*imported[:2], 'magnet')
    return found


def counts_of_table(table, truth):
    """Numbers of unflagged poses and of correct unflagged poses in a table of results."""
    with open(table, newline='', encoding='utf-8') as stream:
        unflagged = [row for row in csv.DictReader(stream) if row['ambiguous'] == '0']
    found = np.array([[float(row['x']), float(row['y'])] for row in unflagged]).reshape(-1, 2)
    true = interpolate_truth(truth, [int(row['stamp_ns']) for row in unflagged])[:, :2]
    return len(unflagged), int((np.linalg.norm(found - true, axis=1) <= WRONG_M).sum())


def figures_of_recording(recording, network, preset, folder):
    """Replay a recording; return the numbers of poses and errors of the first track, by figure."""
    run = replay(Recording(recording), read_network(network), settings_for(preset), folder)
    truth = next(iter(run.truth.values()))
    found = {}
    for prefix, table in (('', 'poses.csv'), ('smoothed: ', 'poses_smoothed.csv')):
        found[prefix + UNFLAGGED], found[prefix + CORRECT] = counts_of_table(folder / table, truth)
    for track in run.summary['tracks'][:1]:
        for prefix, of in (('', track), ('smoothed: ', track.get('smoothed') or {})):
            found |= {prefix + text: of['truth'][error] for error, text in ERRORS.items()
                      if of.get('truth') and of['truth'].get(error) is not None}
    return found


def figures_of_control(name):
    """Simulate `RUNS` passes of a control by each simulator and track them live.

    Returns the numbers of poses, by figure.
    """
    total = {UNFLAGGED: 0, CORRECT: 0}
    for s, simulator in enumerate(SIMULATORS):
        for seed in range(RUNS):
            rng = np.random.default_rng([seed, s])
            a_world = (straight(rng, simulator, car(rng, simulator), rng.uniform(7.0, 20.0), FOUR)
                       if name == 'car, four sensors' else random_pass_world(rng, simulator, name))
            pipeline = Pipeline(a_world.network, settings_for('vehicle'))
            unflagged = [r for r in pipeline.feed(a_world.readings) + pipeline.flush()
                         if isinstance(r, Track) and not r.ended and not r.ambiguous]
            total[UNFLAGGED] += len(unflagged)
            error = errors_of(unflagged, a_world.t, a_world.positions[0])[0]
            total[CORRECT] += int((error <= WRONG_M).sum())
    return total


def with_progress_bar(items, label):
    """Iterate over the items, with a progress bar on a terminal."""
    return tqdm(items, desc=label, disable=None, leave=False)


def measure():
    """Measure all recordings and controls; return {name: {figure: value}}."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = {name: figures_of_recording(*source, folder / 'results' / name.replace(' ', '_'))
                 for name, source in with_progress_bar(recordings(folder).items(), 'recordings')}
    found |= {f'simulated {name}': figures_of_control(name)
              for name in with_progress_bar((*KINDS, 'car, four sensors'), 'controls')}
    return found | {'all': {f: sum(x.get(f, 0) for x in found.values())
                            for f in (UNFLAGGED, CORRECT)}}


def measure_checkout(checkout):
    """Measure all recordings and controls with the package of another checkout."""
    # With `-m`, Python searches for packages first in the working folder.
    done = subprocess.run([sys.executable, '-m', 'bench.recordings', '--json'], check=True,
                          cwd=checkout, env=os.environ | {'PYTHONPATH': str(ROOT / 'test')},
                          stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def is_worse(name, figure, now, before):
    """Whether a figure is worse `now` than `before` (the other checkout), beyond its tolerance."""
    if CORRECT in figure or (name, figure) == ('all', UNFLAGGED):
        return now < MIN_UNFLAGGED_RATIO * before
    if UNFLAGGED in figure:
        return False  # A decrease is an improvement if the poses were wrong.
    return now > max(MAX_ERROR * before, 1.0 if 'ANEES' in figure else 0.0)


def comparison(name, figure, now, before):
    """Return a line with two values of a figure, and whether `now` is worse than `before`.

    Missing values are None.
    """
    worse = before is not None and (now is None or is_worse(name, figure, now, before))
    values = [f'{"-" if now is None else f"{now:.4g}":>8s}']
    values += [] if before is None else [f'before {before:8.4g}']
    return f'  {figure:28s} {"  ".join(values)}{"  WORSE" if worse else ""}', worse


def main():
    """Print the figures; return 1 if a figure is worse than with the other checkout."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--against', type=Path, metavar='FOLDER', help='checkout to compare with')
    parser.add_argument('--json', action='store_true', help='print only the figures, as JSON')
    args = parser.parse_args()
    if args.against and not (args.against / 'mag_tracking' / '__init__.py').is_file():
        # The installed package would be measured instead.
        parser.error(f'{args.against} is not a checkout: it has no package mag_tracking')
    found = measure()
    if args.json:
        print(json.dumps(found))
        return 0
    results = Figures('recordings')
    for name, figures in found.items():
        for figure, value in figures.items():
            results.record(f'{name}: {figure}', value)
    results.save()
    before = measure_checkout(args.against) if args.against else {}
    n_worse = 0
    for name, figures in found.items():
        print(f'{name}:')
        old_figures = before.get(name, {})
        for figure in figures | old_figures:
            text, worse = comparison(name, figure, figures.get(figure), old_figures.get(figure))
            print(text)
            n_worse += worse
    return 1 if n_worse else 0


if __name__ == '__main__':
    sys.exit(main())
