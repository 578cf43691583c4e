"""Batch fit of several simultaneous vehicles: accuracy, wrong fits and duration.

Recordings and simulated worlds with two simultaneous vehicles, and passes of single vehicles, are
fitted. The figures are the fraction of vehicles fitted in the correct direction, the fraction of
speeds within 10 %, the position error and the time per pass. The aims for the recordings are 90 %
correct directions and 90 % of the speeds within 10 %. At most 1 % of single vehicles may be fitted
as several vehicles, and at most 1 % of the fits that are not flagged as ambiguous may be wrong.
With `--data FOLDER`, the recordings of another folder are used.
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
from support.busy_fits import assigned_fits, fits_of_recording, fits_of_world
from support.busy_recordings import BUSY
from support.busy_worlds import TRUCKS, busy
from support.random_passes import KINDS, SIMULATORS, random_pass
from support.samples import scenario
from support.worlds import World

MAX_ERROR, MAX_ERROR_STD = 0.1, 3.0
"""A speed is wrong if its relative error exceeds both `MAX_ERROR` and this number of standard
deviations."""
MIN_CORRECT, MAX_WRONG = 0.9, 0.01


class Tally:
    """Fits of vehicles, their duration, and the numbers of vehicles and passes."""

    def __init__(self):
        self.n_vehicles = self.n_passes = 0
        self.found, self.seconds = [], 0.0

    def add(self, passes, of_vehicles, n_vehicles, seconds):
        """Add the fits of a recording or world.

        `passes` are all fitted passes; `of_vehicles` are the fits assigned to true vehicles.
        """
        self.n_vehicles += n_vehicles
        self.n_passes += len({(one.recording, one.number) for one in passes})
        self.found += of_vehicles
        self.seconds += seconds

    def figures(self, figures, label, aim=None):
        """Print the figures; return (number of unflagged fits, number of wrong unflagged fits)."""
        error = np.array([of.fitted_pass.chosen.speed[0] / of.speed - 1.0 for of in self.found])
        sd = np.array([of.fitted_pass.chosen.speed[1] / of.speed for of in self.found])
        unflagged = np.array([not of.fitted_pass.chosen.ambiguous for of in self.found], dtype=bool)
        wrong = unflagged & (np.abs(error) > MAX_ERROR) & (np.abs(error) > MAX_ERROR_STD * sd)
        n = max(self.n_vehicles, 1)
        figures.add(f'{label}: fitted in the right direction', len(error) / n, '', aim, True,
                    f' (of {self.n_vehicles})')
        figures.add(f'{label}: speed within 10 %', float((np.abs(error) < MAX_ERROR).mean()), '',
                    MIN_CORRECT if aim else None, True)
        figures.add(f'{label}: median error of the position',
                    float(np.median([of.error for of in self.found])), 'm')
        figures.add(f'{label}: without a flag', float(unflagged.mean()), '',
                    note=f' ({wrong.sum()} of them wrong)')
        figures.add(f'{label}: time of a fit', self.seconds / max(self.n_passes, 1), 's')
        return int(unflagged.sum()), int(wrong.sum())


def recordings(folder):
    """Fit the recordings of a folder with two simultaneous vehicles; return their `Tally`."""
    tally = Tally()
    for path in tqdm(sorted(folder.glob('[mf]*.truth.json')), disable=None, leave=False):
        name = path.name.removesuffix('.truth.json')
        begin = time.perf_counter()
        passes, found = fits_of_recording(name, folder)
        tally.add(passes, found, 16, time.perf_counter() - begin)
    return tally


def worlds(pattern, simulator, seeds, trucks=TRUCKS):
    """Fit worlds with pairs of vehicles and a fraction `trucks` of trucks; return their `Tally`."""
    tally = Tally()
    for n_sensors in (2, 4):
        for seed in tqdm(range(seeds), disable=None, leave=False):
            a_world = busy(pattern, n_sensors, simulator, seed, trucks=trucks)
            begin = time.perf_counter()
            passes = fits_of_world(a_world)
            duration_s = time.perf_counter() - begin
            vehicles = [(a_world.t, position) for position in a_world.positions]
            tally.add(passes, assigned_fits(passes, vehicles), len(vehicles), duration_s)
    return tally


def single_vehicles(simulator, passes):
    """Fit single vehicles; return the number fitted as several vehicles, and the total number."""
    network, n_split, n = read_network(NETWORK_FILE), 0, 0
    for kind in KINDS:
        for seed in tqdm(range(passes), disable=None, leave=False):
            body, course, duration, flaws = random_pass(simulator, kind, seed)
            readings, *_ = scenario.simulate(network, body, course, 100.0, duration,
                                             np.random.default_rng(seed), flaws)
            found = fits_of_world(World(network, readings, np.zeros(0), np.zeros((0, 0, 2))),
                                  (1, 2, 3))
            n_split += any(one.n_vehicles > 1 and one.chosen is not None for one in found)
            n += bool(found)
    return n_split, n


def main():
    """Print the figures; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--data', type=Path, metavar='FOLDER', default=BUSY)
    parser.add_argument('--seeds', type=int, default=2, help='number of worlds of each kind')
    parser.add_argument('--passes', type=int, default=20,
                        help='number of single vehicles of each kind')
    args = parser.parse_args()
    figures = Figures('joint_fits')
    print('Fits of several vehicles at once')
    counted = [recordings(args.data).figures(figures, 'recordings', MIN_CORRECT)]
    for simulator in SIMULATORS:
        for pattern in ('meeting', 'following'):
            counted.append(worlds(pattern, simulator, args.seeds).figures(
                figures, f'{simulator}, {pattern}'))
        counted.append(worlds('meeting', simulator, args.seeds, 0.5).figures(
            figures, f'{simulator}, meeting, every other one a truck'))
        n_split, n = single_vehicles(simulator, args.passes)
        figures.add(f'{simulator}: single vehicles taken for several', n_split / n, '', MAX_WRONG,
                    note=f' ({n_split} of {n})')
    unflagged, wrong = np.sum(counted, axis=0)
    figures.add('answers without a flag that are wrong', wrong / unflagged, '', MAX_WRONG,
                note=f' ({wrong} of {unflagged})')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
