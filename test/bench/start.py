"""Duration of commands, and time from the start of a process to its first pose.

    PYTHONPATH=test python -m bench.start

The figures are the median durations of `mag-tracking --help` (aim: 0.3 s) and of `mag-tracking
info` on a bundled recording (aim: 0.8 s), and the time from the start of a process to its first
pose. The aims for the first pose are 1 s with a warm and 6 s with a cold Python cache.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from support.bundled import NETWORK_FILE, vehicle_path

COMMAND = [sys.executable, '-m', 'mag_tracking.cli']
RECORDING = vehicle_path('straight_car_right')
ONE_THREAD = {name: '1' for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')}
FIRST_POSE = '''
import sys, time
start = float(sys.argv[1])
from mag_tracking.recording.reader import Recording
from mag_tracking.network.file import read_network
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
network = read_network(sys.argv[2])
pipeline = Pipeline(network, settings_for('vehicle'))
for readings in SampleReader(Recording(sys.argv[3]), network).readings():
    if any(isinstance(r, Track) for r in pipeline.feed(readings)):
        print(time.time() - start)
        break
'''


def seconds_of(*arguments, rounds=7):
    """Run a command several times; return the median duration [s]."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        subprocess.run([*COMMAND, *arguments], check=True, capture_output=True)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def first_pose(cache=None):
    """Start a process that tracks a recording; return the time [s] until its first pose.

    `cache` is the folder for compiled modules; if it is empty, Python compiles all imports.
    """
    environment = {k: v for k, v in os.environ.items() if k != 'PYTHONDONTWRITEBYTECODE'}
    if cache is not None:
        environment['PYTHONPYCACHEPREFIX'] = str(cache)
    out = subprocess.run(
        [sys.executable, '-c', FIRST_POSE, str(time.time()), str(NETWORK_FILE), str(RECORDING)],
        env={**environment, **ONE_THREAD}, check=True,
        capture_output=True, text=True)
    return float(out.stdout)


def first_pose_times(rounds):
    """Measure the times [s] to the first pose, with cold and warm cache; return both lists."""
    first_pose()
    cold, warm = [], []
    for _ in tqdm(range(rounds), desc='first pose', disable=None):
        cache = Path(tempfile.mkdtemp())
        cold.append(first_pose(cache))
        warm += [first_pose() for _ in range(2)]
        shutil.rmtree(cache)
    return cold, warm


def main():
    """Print the figures; return 1 if an aim is missed."""
    figures = Figures('start')
    print('times from the start of a process')
    figures.add('mag-tracking --help', seconds_of('--help'), 's', 0.3)
    figures.add('mag-tracking info', seconds_of('info', str(RECORDING)), 's', 0.8)
    cold, warm = first_pose_times(3)
    spread = '  ({:.2f} .. {:.2f})'
    figures.add('first pose, Python cache warm', np.median(warm), 's', 1.0,
                note=spread.format(min(warm), max(warm)))
    figures.add('first pose, Python cache cold', np.median(cold), 's', 6.0,
                note=spread.format(min(cold), max(cold)))
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
