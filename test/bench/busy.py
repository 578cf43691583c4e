"""Tracking of several vehicles at once: detection, accuracy and cost.

Recordings and simulated worlds with meeting and following vehicles and dense traffic are tracked.
The figures are the fraction of detected vehicles, the RMS error, the NEES, the number of false
tracks and the time of a search for another vehicle. At most 1 % of the poses that are not flagged
as ambiguous may be wrong, including poses of single vehicles. A frame of two vehicles may take
four times as long as a frame of one vehicle. With `--data FOLDER`, the recordings of another folder
are used (`*.mcap` with `*.truth.json`).
"""

import argparse
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.apps.track import track
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.initiation_vehicle import start_vehicle, vehicle_model
from mag_tracking.stages.track.new_target_search import NewTargetSearch
from support.bundled import NETWORK_FILE, VEHICLES, vehicle_path
from support.busy_recordings import BUSY, correctly_counted, tracked_recording
from support.busy_worlds import NETWORKS, busy, tracked
from support.random_passes import KINDS, are_wrong, one_random_pass

AIMS = {'meeting': (1.0, 4.0, 1.0), 'meeting more': (0.7, 3.0, 1.0),
        'following': (0.9, None, 1.0), 'traffic': (None, None, 11 / 12)}
"""{kind of recording: (median RMS [m], median NEES of two axes, fraction of vehicles found)}, or
None for a figure without an aim."""
MIN_MEETING = 15 / 16
"""Minimum fraction of meeting vehicles that two sensors must find: one of sixteen may be missed."""
MAX_WRONG, MAX_COST = 0.01, 4.0
N_HYP, RUNS = 20, 25


def aims_of(name):
    """Aims (RMS [m], NEES, fraction of vehicles found) of a recording with a given name."""
    kind = next((k for k in ('meeting', 'following', 'traffic') if name.startswith(k)), 'traffic')
    rms, nees, found = AIMS['meeting more' if kind == 'meeting' and '2_sensors' not in name
                            else kind]
    return rms, nees, MIN_MEETING if name.startswith('meeting_2') else found


def with_progress_bar(items, label):
    """Iterate over the items, with a progress bar on a terminal."""
    return tqdm(items, desc=label, disable=None, leave=False)


@contextmanager
def timed_searches():
    """Context manager that records the duration [s] of each search for another vehicle."""
    seconds, find = [], NewTargetSearch.find

    def timed(search):
        begin = time.perf_counter()
        try:
            return find(search)
        finally:
            seconds.append(time.perf_counter() - begin)

    NewTargetSearch.find = timed
    try:
        yield seconds
    finally:
        NewTargetSearch.find = find


def recordings(figures, folder):
    """Track the recordings; return the numbers [(unflagged poses, wrong unflagged poses)]."""
    counted = []
    for path in with_progress_bar(sorted(folder.glob('*.truth.json')), 'recordings'):
        name = path.name.removesuffix('.truth.json')
        with timed_searches() as seconds:
            tracked = tracked_recording(name, folder)
            result = tracked.score
        rms, nees, found = aims_of(name)
        n = len(result.rms)
        figures.add(f'{name}: found', float(result.is_found.mean()), '', found, True,
                    f' ({result.is_found.sum()} of {n})')
        figures.add(f'{name}: counted in the right direction', float(len(
            correctly_counted(name, tracked.passages, folder))), '', None, True,
            f' (of {len(tracked.passages)} counted)')
        figures.add(f'{name}: RMS', float(np.nanmedian(result.rms)), 'm', rms)
        figures.add(f'{name}: NEES', float(np.nanmedian(result.nees)), '', nees)
        figures.add(f'{name}: false tracks', result.n_extra, '', 0)
        figures.add(f'{name}: time of a search', float(np.median(seconds)), 's',
                    note=f' (longest {max(seconds):.2g} s, {len(seconds)} searches)')
        counted.append((result.n_unflagged, result.n_wrong))
    return counted


def simulated(figures, seeds):
    """Track worlds of the second simulator; return the same numbers as `recordings`."""
    counted = []
    for pattern in ('meeting', 'following', 'traffic'):
        scores = [tracked(busy(pattern, n, 'boxes', seed))[0]
                  for n in (2, 4) for seed in with_progress_bar(range(seeds), pattern)]
        found = np.concatenate([s.is_found for s in scores])
        figures.add(f'boxes, {pattern}: found', float(found.mean()), '', note=f' (of {len(found)})')
        figures.add(f'boxes, {pattern}: RMS',
                    float(np.nanmedian(np.concatenate([s.rms for s in scores]))), 'm')
        figures.add(f'boxes, {pattern}: false tracks', sum(s.n_extra for s in scores), '')
        counted += [(s.n_unflagged, s.n_wrong) for s in scores]
    return counted


def single_vehicles(passes):
    """Track single vehicles; return the same numbers as `recordings`.

    The vehicles are in the bundled recordings, and in passes of each kind of the second simulator.
    """
    counted = []
    for name in with_progress_bar(VEHICLES, 'vehicles'):
        result = track(vehicle_path(name), NETWORK_FILE)
        poses = result.poses[~result.poses['ambiguous']]
        t, true, _ = next(iter(result.truth.values()))
        error = poses['position'][:, :2] - np.stack([np.interp(
            poses['stamp_ns'], t, true[:, k]) for k in (0, 1)], axis=1)
        error_m = np.hypot(*error.T)
        along = np.sqrt(np.einsum('ni,nij,nj->n', error, poses['covariance'][:, :2, :2], error))
        counted.append((len(poses), int(are_wrong(
            error_m, along / np.maximum(error_m, 1e-9)).sum())))
    for kind in KINDS:
        for seed in with_progress_bar(range(passes), kind):
            result = one_random_pass('boxes', kind, seed)
            counted.append((int((~result.ambiguous).sum()), int(result.unflagged_and_wrong.sum())))
    return counted


def cost():
    """Time of a frame with two vehicles relative to one vehicle, for banks of equal size."""
    settings, network = settings_for('vehicle').track, NETWORKS[2]
    model, C = vehicle_model(settings.vehicle, network), np.tile(3.6e-17 * np.eye(3), (2, 1, 1))
    frame = FieldFrame(0, np.full((2, 3), 2e-8), C, np.full(2, 4), np.zeros(2), True)
    filters = [BankFilter(network, model, settings, n) for n in (1, 2)]
    one = start_vehicle(settings.vehicle, network, frame, settings.background_std,
                        filters[0].observation.own_covariance).rows(np.arange(N_HYP))
    n = len(model.state_names)
    two = one.copy()
    two.x = np.insert(one.x, [n] * n, one.x[::-1, :n], axis=1)
    two.P = np.zeros((N_HYP, two.x.shape[1], two.x.shape[1]))
    others = np.append(np.arange(n), np.arange(2 * n, two.x.shape[1]))
    two.P[:, others[:, None], others] = one.P
    two.P[:, n:2 * n, n:2 * n] = one.P[::-1, :n, :n]
    two.label, two.kind = (np.stack([a, a[::-1]], axis=1) for a in (one.label, one.kind))
    best = [np.inf, np.inf]
    for _ in range(RUNS):
        for k, bank in enumerate((one, two)):
            b = bank.copy()
            begin = time.perf_counter()
            filters[k].advance(b, frame, 0.08)
            filters[k].run_along(b, [frame] * 25, [0.08] * 25,
                                 np.repeat(b.x[:, None], 25, axis=1), passes=3, step=0.5,
                                 first_is_updated=True)
            best[k] = min(best[k], time.perf_counter() - begin)
    return best[1] / best[0]


def main():
    """Print the figures; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--data', type=Path, metavar='FOLDER', default=BUSY)
    parser.add_argument('--seeds', type=int, default=3, help='number of worlds of each kind')
    parser.add_argument('--passes', type=int, default=33,
                        help='number of single vehicles of each kind')
    args = parser.parse_args()
    figures = Figures('busy')
    print('Several vehicles at once')
    counted = np.array([*recordings(figures, args.data), *simulated(figures, args.seeds),
                        *single_vehicles(args.passes)])
    unflagged, wrong = counted.sum(axis=0)
    figures.add('poses without a flag that are wrong', wrong / unflagged, '', MAX_WRONG,
                note=f' ({wrong} of {unflagged})')
    figures.add('two vehicles together over one', cost(), 'times', MAX_COST)
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
