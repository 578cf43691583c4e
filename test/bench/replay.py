"""Speed of replays relative to real time, on one thread.

    PYTHONPATH=test python -m bench.replay [--minutes 60]

The command `replay` processes five minutes of a road with thirty vehicles and two sensors (aim: 40
times real time), and a quiet road with two sensors at 100 Hz (aim: 600 times). The processing time
of the frames of a track is measured with the bundled vehicle recordings. The aims are a mean of
5 ms and a maximum of 15 ms.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.start import COMMAND, ONE_THREAD

os.environ.update(ONE_THREAD)

import numpy as np  # noqa: E402  (the thread counts have to be set before NumPy is loaded)

from bench.figures import Figures  # noqa: E402
from mag_tracking.network.file import read_network  # noqa: E402
from mag_tracking.pipeline import Pipeline, settings_for  # noqa: E402
from mag_tracking.recording.reader import Recording  # noqa: E402
from mag_tracking.recording.sample_reader import SampleReader  # noqa: E402
from support.bundled import DATA, NETWORK_FILE, VEHICLES, vehicle_path  # noqa: E402
from support.quiet_road import write_quiet_road  # noqa: E402

ROAD = DATA / 'two_way_road' / 'two_way_road.mcap'


def road_network(folder):
    """Write a network file with sensors at y = -5.5 and 5.5 m, for the road; return its path."""
    path = folder / 'network.yaml'
    path.write_text(NETWORK_FILE.read_text().replace('4.5', '5.5'))
    assert np.abs(read_network(path).positions[:, 1]).tolist() == [5.5, 5.5]
    return path


def speed_of_replay(recording, network_file, folder):
    """Speed of the command `replay` relative to real time, without figures."""
    start = time.perf_counter()
    subprocess.run([*COMMAND, 'replay', str(recording), '--network', str(network_file), '--out',
                    str(folder / 'out'), '--no-figures'], check=True, capture_output=True)
    duration, opened = time.perf_counter() - start, Recording(recording)
    return (opened.end_ns - opened.start_ns) / 1e9 / duration


def frame_times():
    """Track the bundled vehicles; return processing times [s] of frames.

    The first array is of frames during a track, the second of frames that start a track.
    """
    network, frames, starts = read_network(NETWORK_FILE), [], []
    for name in VEHICLES:
        pipeline = Pipeline(network, settings_for('vehicle'))
        feed = pipeline.track.feed

        def timed(frame, feed=feed, pipeline=pipeline):
            was_running, n_tracks = pipeline.track.bank is not None, pipeline.track.counts['tracks']
            start = time.perf_counter()
            out = feed(frame)
            duration = time.perf_counter() - start
            if was_running:
                frames.append(duration)
            elif pipeline.track.counts['tracks'] > n_tracks:
                starts.append(duration)
            return out
        pipeline.track.feed = timed
        for readings in SampleReader(Recording(vehicle_path(name)), network).readings():
            pipeline.feed(readings)
        pipeline.flush()
    return np.array(frames), np.array(starts)


def main():
    """Print the figures; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=60.0,
                        help='duration of the quiet road [min]')
    args = parser.parse_args()
    figures = Figures('replay')
    print('times real time, one thread, mag-tracking replay --no-figures')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        times = [speed_of_replay(ROAD, road_network(folder), folder) for _ in range(3)]
        figures.add('a road with 30 vehicles in 5 minutes', np.median(times), '', 40.0, True,
                    f'  ({min(times):.1f} .. {max(times):.1f})')
        quiet = folder / 'quiet' / 'quiet.mcap'
        write_quiet_road(quiet, read_network(NETWORK_FILE), 60.0 * args.minutes)
        figures.add('a quiet road, two sensors at 100 Hz',
                    speed_of_replay(quiet, NETWORK_FILE, folder), '', 600.0, True,
                    f'  ({args.minutes:g} minutes)')
    frames, starts = frame_times()
    print(f'frames of tracks of two sensors ({len(frames)}), and starts of tracks ({len(starts)})')
    figures.add('a frame, mean', 1e3 * frames.mean(), 'ms', 5.0)
    figures.add('a frame, longest', 1e3 * frames.max(), 'ms', 15.0)
    figures.add('a start, mean', 1e3 * starts.mean(), 'ms')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
