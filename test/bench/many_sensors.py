"""Duration and memory of the start of a track within the range of 32 sensors.

    PYTHONPATH=test python -m bench.many_sensors

A simulated car passes 32 sensors, whose mounting and model errors are estimated. The track uses the
default number of sensors, or all sensors. The figures are the time of the start (aim: 2 s), the
peak memory of the process (aim: 500 MB) and the mean time of a frame. Each case runs on one thread,
in a separate process.
"""

import json
import os
import resource
import subprocess
import sys
import time

from bench.start import ONE_THREAD

os.environ.update(ONE_THREAD)

import numpy as np  # noqa: E402  (the thread counts have to be set before NumPy is loaded)

from bench.figures import Figures  # noqa: E402
from mag_tracking.pipeline import Pipeline, settings_for  # noqa: E402
from mag_tracking.simulation.scenario import Path  # noqa: E402
from support.networks import line_network  # noqa: E402
from support.samples import one, simulate  # noqa: E402
from support.scenario import point_body  # noqa: E402

N_SENSORS, SPEED = 32, 15.0
FRAMES = 20
"""Number of measured frames of the track."""


def measure_case(max_sensors):
    """Track the car; print the times [s] of start and frame and the memory [MB] as JSON."""
    network = line_network(N_SENSORS, tilt=0.02)
    path = Path(np.array([-60.0, -1.5]), 0.0, SPEED)
    samples, *_ = simulate(network, point_body([200.0, -150.0, 80.0], 5.0, 0.5), path, 50.0,
                           12.0, np.random.default_rng(1))
    pipeline = Pipeline(network, settings_for('vehicle', {
        'track.max_sensors': max_sensors} if max_sensors else {}))
    track, starts, frames = pipeline.track, [], []
    feed = track.feed

    def timed(frame):
        was_running, n_tracks = track.bank is not None, track.counts['tracks']
        start = time.perf_counter()
        out = feed(frame)
        duration = time.perf_counter() - start
        if was_running:
            frames.append(duration)
        elif track.counts['tracks'] > n_tracks:
            starts.append(duration)
        return out
    track.feed = timed
    for sample in samples:
        pipeline.feed(one(sample))
        if len(frames) >= FRAMES:
            break
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(json.dumps({'start': starts[0], 'frame': float(np.mean(frames)), 'memory': megabytes}))


def main():
    """Print the figures; return 1 if an aim is missed."""
    if len(sys.argv) > 1:
        measure_case(int(sys.argv[1]))
        return 0
    figures = Figures('many_sensors')
    print(f'a car along {N_SENSORS} sensors; mounting and model error are estimated')
    for name, max_sensors in (('default sensors of a track', 0), ('all', N_SENSORS)):
        found = json.loads(subprocess.run(
            [sys.executable, '-m', 'bench.many_sensors', str(max_sensors)], check=True,
            capture_output=True, text=True).stdout)
        figures.add(f'{name}: start', found['start'], 's', 2.0)
        figures.add(f'{name}: peak memory', found['memory'], 'MB', 500.0)
        figures.add(f'{name}: frame, mean', 1e3 * found['frame'], 'ms')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
