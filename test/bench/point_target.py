"""`make bench`: how far a point target carries on vehicles that are none.

Two questions behind the errors in the README. How far off is the point target on
simulated four-metre cars, with perfect sensors and with such as one buys? And how much
of a recording's error hangs on where the grid of frames happens to begin?
"""

import sys
from pathlib import Path as FilePath

import numpy as np
from tqdm import tqdm

from mag_tracking.io.bag import Recording
from mag_tracking.io.network_file import read_network
from mag_tracking.io.samples import SampleReader
from mag_tracking.io.simulator import Imperfections, Path, random_vehicle, simulate
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.report.metrics import pass_errors
from mag_tracking.report.track_log import TrackLog

ROOT = FilePath(__file__).resolve().parents[2]
SENSORS = {
    'perfect': Imperfections(),
    'turned 5 degrees, clocks 15 ms apart': Imperfections(1.2e-8, 1e-6, 4e-9, np.deg2rad(5), 0.015),
}


def longest_track(samples, network):
    """The `TrackLog` of the track with most poses, or None."""
    pipeline, logs, frame = Pipeline(network, settings_for('vehicle')), {}, None
    for record in (r for s in samples for r in pipeline.feed(s)):
        if isinstance(record, FieldFrame):
            frame = record
        elif isinstance(record, Track):
            logs.setdefault(record.id, TrackLog(record.id)).add(record, frame)
    return max(logs.values(), key=lambda log: len(log.stamp_ns), default=None)


def car(seed):
    """Body and path of a simulated car: straight through, or turning in front of the sensors."""
    rng = np.random.default_rng(1000 + seed)
    body = random_vehicle(rng, length=rng.uniform(3.6, 4.8), moment=rng.uniform(300.0, 600.0))
    lane, turns = rng.uniform(0.8, 1.6), seed % 2
    speed = rng.uniform(4.0, 6.5) if turns else rng.uniform(7.0, 20.0)
    away = 6.0 * speed + (15.0 if turns else 25.0)
    if not turns:
        return body, Path(np.array([-away, -lane]), 0.0, speed), 6.0 + 50.0 / speed + 2.0
    radius = rng.uniform(4.0, 6.5)
    before = away + rng.uniform(3.5, 5.5) - radius
    return (body, Path(np.array([-away, -lane]), 0.0, speed, before, -0.5 * np.pi, radius),
            6.0 + 40.0 / speed + 2.0)


def simulated(network, n=40):
    """Print the errors of `n` simulated cars for each kind of sensors."""
    print(f'point target on {n} simulated cars of 3.6 to 4.8 m, half of them turning')
    for kind, flaws in SENSORS.items():
        found = []
        for seed in tqdm(range(n), desc=kind, disable=None, leave=False):
            body, path, duration = car(seed)
            samples, t, position, _ = simulate(network, body, path, 100.0, duration,
                                               np.random.default_rng(seed), flaws)
            log = longest_track(samples, network)
            if log is None:
                continue
            truth = (np.round(t * 1e9).astype(np.int64),
                     np.c_[position, np.zeros(len(t))], np.zeros((len(t), 4)))
            found.append(pass_errors(log, truth, network.centre))
        closest = np.array([e['closest'] for e in found])
        anees = np.array([e['anees'] for e in found])
        print(f'  sensors {kind}: {len(found)} tracked; at the closest point median '
              f'{np.median(closest):.2f} m, nine tenths below {np.quantile(closest, 0.9):.2f} m, '
              f'below 0.5 m {np.mean(closest < 0.5):.0%}; ANEES median {np.median(anees):.1f}',
              flush=True)


def grids(network, n=8, period=0.08):
    """Print the errors of the bundled recordings for `n` beginnings of the grid of frames."""
    print(f'error at the closest point for {n} beginnings of the grid of frames')
    for path in sorted((ROOT / 'test' / 'data' / 'vehicles').glob('*.mcap')):
        reader = SampleReader(Recording(path), network)
        samples = list(reader.samples())
        truth = next(iter(reader.truth_arrays().values()))
        begin, closest = samples[0].stamp_ns, []
        for k in tqdm(range(n), desc=path.stem, disable=None, leave=False):
            late = [s for s in samples if s.stamp_ns - begin >= k * period / n * 1e9]
            log = longest_track(late, network)
            if log is not None:
                closest.append(pass_errors(log, truth, network.centre)['closest'])
        print(f'  {path.stem}: {len(closest)} of {n} tracked; mean {np.mean(closest):.2f} m, '
              f'{min(closest):.2f} .. {max(closest):.2f} m', flush=True)


def main():
    """Print both studies."""
    network = read_network(ROOT / 'config' / 'network.yaml')
    simulated(network)
    grids(network)
    return 0


if __name__ == '__main__':
    sys.exit(main())
