"""`make bench`: the batch fit of several vehicles at once, and what it takes.

On the recordings of several vehicles, on worlds of both simulators, and on single vehicles, which
are to stay one. `--data FOLDER` takes the recordings of another folder.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.network.file import read_network
from support.bundled import NETWORK_FILE
from support.busy_fits import fits_of_recording, fits_of_world, with_vehicles
from support.busy_recordings import BUSY
from support.busy_worlds import TRUCKS, busy
from support.random_passes import KINDS, SIMULATORS, random_pass
from support.samples import scenario
from support.worlds import World

OFF, SD = 0.1, 3.0
"""A speed that is off by more than both, this share and so many deviations, is sure and wrong."""
MIN_RIGHT, MAX_WRONG = 0.9, 0.01


class Tally:
    """Counts vehicles, and what was said of them."""

    def __init__(self):
        self.n_vehicles = self.n_passes = 0
        self.found, self.seconds = [], 0.0

    def add(self, passes, of_vehicles, n_vehicles, seconds):
        """Take the fits of a recording."""
        self.n_vehicles += n_vehicles
        self.n_passes += len({(one.recording, one.number) for one in passes})
        self.found += of_vehicles
        self.seconds += seconds

    def figures(self, figures, what, aim=None):
        """Print what came of it; returns (answers without a flag, of them wrong)."""
        off = np.array([of.one.chosen.speed[0] / of.speed - 1.0 for of in self.found])
        sd = np.array([of.one.chosen.speed[1] / of.speed for of in self.found])
        sure = np.array([not of.one.chosen.ambiguous for of in self.found], dtype=bool)
        wrong = sure & (np.abs(off) > OFF) & (np.abs(off) > SD * sd)
        n = max(self.n_vehicles, 1)
        figures.add(f'{what}: fitted in the right direction', len(off) / n, '', aim, True,
                    f' (of {self.n_vehicles})')
        figures.add(f'{what}: speed within 10 %', float((np.abs(off) < OFF).mean()), '',
                    MIN_RIGHT if aim else None, True)
        figures.add(f'{what}: median error of the position',
                    float(np.median([of.error for of in self.found])), 'm')
        figures.add(f'{what}: without a flag', float(sure.mean()), '',
                    note=f' (of them wrong: {wrong.sum()})')
        figures.add(f'{what}: a pass', self.seconds / max(self.n_passes, 1), 's')
        return int(sure.sum()), int(wrong.sum())


def recordings(folder):
    """`Tally` of the recordings of a folder whose vehicles are two at a time."""
    tally = Tally()
    for path in tqdm(sorted(folder.glob('[mf]*.truth.json')), disable=None, leave=False):
        name = path.name.removesuffix('.truth.json')
        begin = time.perf_counter()
        passes, found = fits_of_recording(name, folder)
        tally.add(passes, found, 16, time.perf_counter() - begin)
    return tally


def worlds(how, simulator, seeds, trucks=TRUCKS):
    """`Tally` of worlds of pairs, with a share of `trucks`."""
    tally = Tally()
    for n_sensors in (2, 4):
        for seed in tqdm(range(seeds), disable=None, leave=False):
            a_world = busy(how, n_sensors, simulator, seed, trucks=trucks)
            begin = time.perf_counter()
            passes = fits_of_world(a_world)
            took = time.perf_counter() - begin
            vehicles = [(a_world.t, position) for position in a_world.positions]
            tally.add(passes, with_vehicles(passes, vehicles), len(vehicles), took)
    return tally


def of_one(simulator, passes):
    """How many single vehicles were taken for several, and of how many."""
    network, split, n = read_network(NETWORK_FILE), 0, 0
    for kind in KINDS:
        for seed in tqdm(range(passes), disable=None, leave=False):
            body, course, duration, flaws = random_pass(simulator, kind, seed)
            readings, *_ = scenario.simulate(network, body, course, 100.0, duration,
                                             np.random.default_rng(seed), flaws)
            found = fits_of_world(World(network, readings, np.zeros(0), np.zeros((0, 0, 2))),
                                  (1, 2, 3))
            split += any(one.n_vehicles > 1 and one.chosen is not None for one in found)
            n += bool(found)
    return split, n


def main():
    """Print the figures; returns 1 where an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--data', type=Path, metavar='FOLDER', default=BUSY)
    parser.add_argument('--seeds', type=int, default=2, help='worlds of each kind')
    parser.add_argument('--passes', type=int, default=20, help='of each kind of single vehicle')
    given = parser.parse_args()
    figures = Figures('joint_fits')
    print('Fits of several vehicles at once')
    counted = [recordings(given.data).figures(figures, 'recordings', MIN_RIGHT)]
    for simulator in SIMULATORS:
        for how in ('meeting', 'following'):
            counted.append(worlds(how, simulator, given.seeds).figures(
                figures, f'{simulator}, {how}'))
        counted.append(worlds('meeting', simulator, given.seeds, 0.5).figures(
            figures, f'{simulator}, meeting, every other one a truck'))
        split, n = of_one(simulator, given.passes)
        figures.add(f'{simulator}: single vehicles taken for several', split / n, '', MAX_WRONG,
                    note=f' ({split} of {n})')
    sure, wrong = np.sum(counted, axis=0)
    figures.add('answers without a flag that are wrong', wrong / sure, '', MAX_WRONG,
                note=f' ({wrong} of {sure})')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
