"""Accuracy and consistency of tracks of extended vehicles.

Simulated cars and trucks, each a cloud of sixty dipoles, are tracked as points and with the default
kinds of vehicles, at two frame rates, with perfect and with imperfect sensors. The figures are the
RMS error within 5 m, the error at the closest point and the ANEES per axis, for tracks that are not
ambiguous at their closest point. For each bundled vehicle recording, the error at the closest point
is averaged over eight starts of the frame grid. There are no aims.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path as FilePath

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.analysis.track_errors import pass_errors
from mag_tracking.analysis.track_log import SmoothedLog, TrackLog
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.simulation.scenario import Path, random_vehicle
from support.samples import one, recorded, simulate
from support.scenario import SensorErrorModel

ROOT = FilePath(__file__).resolve().parents[2]
NETWORK = ROOT / 'config' / 'network.yaml'
POINT = {'track.vehicle.kinds.names': ['car'], 'track.vehicle.kinds.car.length': 0.0,
         'track.vehicle.kinds.car.length_std': 0.0, 'track.vehicle.kinds.car.difference_std': 0.0,
         'track.vehicle.kinds.car.near_field_length': 1.0}
UNCALIBRATED = SensorErrorModel(1.2e-8, 1e-6, 4e-9, np.deg2rad(5), 0.015)
STUDIES = (
    ('cars, as points, 12.5 Hz, perfect sensors', 'car', POINT, SensorErrorModel()),
    ('cars, 12.5 Hz, perfect sensors', 'car', {}, SensorErrorModel()),
    ('cars, 12.5 Hz, sensors turned 5 degrees, clocks 15 ms apart', 'car', {}, UNCALIBRATED),
    ('cars, 100 Hz, perfect sensors', 'car', {'align.period_s': 0.01}, SensorErrorModel()),
    ('trucks, as points, 12.5 Hz, perfect sensors', 'truck', POINT, SensorErrorModel()),
    ('trucks, 12.5 Hz, perfect sensors', 'truck', {}, SensorErrorModel()))


def longest_track(samples, network, changes):
    """Track samples; return (longest `TrackLog`, its `SmoothedLog`), or None without a track."""
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    logs, smoothed, frame = {}, {}, None
    for record in [r for s in samples for r in pipeline.feed(one(s))] + pipeline.flush():
        if isinstance(record, FieldFrame):
            frame = record
        elif isinstance(record, Track):
            logs.setdefault(record.id, TrackLog(record.id)).add(record, frame)
        elif isinstance(record, SmoothedPose):
            smoothed.setdefault(record.id, SmoothedLog(record.id)).add(record)
    if not logs:
        return None
    log = max(logs.values(), key=lambda log: len(log.stamp_ns))
    return log, smoothed.get(log.id)


def vehicle(seed, kind):
    """Draw (body, path, duration [s]) of a pass; every second vehicle turns at the sensors."""
    rng = np.random.default_rng(1000 + seed)
    if kind == 'car':
        body = random_vehicle(rng, length=rng.uniform(3.6, 4.8), moment=rng.uniform(300.0, 600.0))
    else:
        body = random_vehicle(rng, length=rng.uniform(8.0, 13.0), width=2.4, height=2.8,
                              moment=rng.uniform(1200.0, 2200.0))
    lane, is_turning = rng.uniform(0.8, 1.6), seed % 2
    speed = rng.uniform(4.0, 6.5) if is_turning else rng.uniform(7.0, 20.0)
    start_distance = 6.0 * speed + (15.0 if is_turning else 25.0)
    if not is_turning:
        return body, Path(np.array([-start_distance, -lane]), 0.0, speed), 6.0 + 50.0 / speed + 2.0
    radius = rng.uniform(4.0, 6.5)
    turn_distance = start_distance + rng.uniform(3.5, 5.5) - radius
    return (body, Path(np.array([-start_distance, -lane]), 0.0, speed, turn_distance,
                       -0.5 * np.pi, radius), 6.0 + 40.0 / speed + 2.0)


def one_pass(seed, kind, changes, flaws):
    """Track a pass; return (filtered errors, smoothed errors, is ambiguous at the CPA).

    Returns None without a track.
    """
    network = read_network(NETWORK)
    body, path, duration = vehicle(seed, kind)
    samples, t, position, _ = simulate(network, body, path, 100.0, duration,
                                       np.random.default_rng(seed), flaws)
    found = longest_track(samples, network, changes)
    if found is None:
        return None
    log, smoothed = found
    truth = (np.round(t * 1e9).astype(np.int64), np.c_[position, np.zeros(len(t))],
             np.zeros((len(t), 4)))
    closest = int(np.argmin([abs(s / 1e9 - t[np.hypot(*position.T).argmin()])
                             for s in log.stamp_ns]))
    return (pass_errors(log, truth, network.centre), pass_errors(smoothed, truth, network.centre),
            bool(log.ambiguous[closest]))


def simulated(figures, pool, name, kind, changes, flaws, n=40):
    """Track `n` passes of one kind, record the figures and print a line."""
    jobs = [pool.submit(one_pass, seed, kind, changes, flaws) for seed in range(n)]
    found = [job.result() for job in tqdm(jobs, desc=name, disable=None, leave=False)]
    unambiguous = [f for f in found if f is not None and not f[2]]
    filtered, smoothed = [f[0] for f in unambiguous], [f[1] for f in unambiguous]
    closest = np.array([e['closest'] for e in filtered])
    anees, anees_smoothed = (np.array([e['anees'] for e in errors])
                             for errors in (filtered, smoothed))
    rms = np.array([(e['rms'], s['rms']) for e, s in zip(filtered, smoothed, strict=True)
                    if e['rms'] is not None])
    for label, value, unit in (('RMS within 5 m', np.median(rms[:, 0]), 'm'),
                               ('RMS within 5 m, smoothed', np.median(rms[:, 1]), 'm'),
                               ('error at the closest point', np.median(closest), 'm'),
                               ('ANEES', anees.mean(), '')):
        figures.record(f'{name}: {label}', value, unit, note=f'{len(unambiguous)} of {n} passes')
    print(f'  {name}: {len(unambiguous)} of {n} tracked and unambiguous; RMS error within 5 m '
          f'{np.median(rms[:, 0]):.2f} m, smoothed {np.median(rms[:, 1]):.2f} m (ratio '
          f'{np.median(rms[:, 1] / rms[:, 0]):.2f}); at the closest point '
          f'{np.median(closest):.2f} m, 90 % below {np.quantile(closest, 0.9):.2f} m; '
          f'ANEES mean {anees.mean():.1f}, median {np.median(anees):.1f}, smoothed '
          f'{anees_smoothed.mean():.1f}, {np.median(anees_smoothed):.1f}', flush=True)


def frame_grid_study(figures, n=8, period=0.08):
    """Track the bundled recordings for `n` starts of the frame grid, and print the errors."""
    network = read_network(NETWORK)
    print(f'error at the closest point for {n} starts of the frame grid')
    for path in sorted((ROOT / 'test' / 'data' / 'vehicles').glob('*.mcap')):
        reader = SampleReader(Recording(path), network)
        samples = recorded(reader)
        truth = next(iter(reader.truth_arrays().values()))
        begin, closest = samples[0].stamp_ns, []
        for k in tqdm(range(n), desc=path.stem, disable=None, leave=False):
            later_samples = [s for s in samples if s.stamp_ns - begin >= k * period / n * 1e9]
            found = longest_track(later_samples, network, {})
            if found is not None:
                closest.append([pass_errors(log, truth, network.centre)['closest']
                                for log in found])
        filtered, smoothed = np.array(closest).T
        figures.record(f'{path.stem}: error at the closest point, mean of {n} frame grids',
                       filtered.mean(), 'm', note=f'{filtered.min():.2f} to {filtered.max():.2f} m')
        print(f'  {path.stem}: {len(closest)} of {n} tracked; mean {filtered.mean():.2f} m, '
              f'{filtered.min():.2f} .. {filtered.max():.2f} m; smoothed {smoothed.mean():.2f} m, '
              f'{smoothed.min():.2f} .. {smoothed.max():.2f} m', flush=True)


def main():
    """Run both studies and print their results."""
    figures = Figures('extended_target')
    print('simulated vehicles, half of them turning')
    with ProcessPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        for study in STUDIES:
            simulated(figures, pool, *study)
    frame_grid_study(figures)
    figures.save()
    return 0


if __name__ == '__main__':
    sys.exit(main())
