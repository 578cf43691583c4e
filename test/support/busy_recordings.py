"""Tracking of recordings with several vehicles at once, and comparison with the true vehicles.

`test/data/busy` contains some of the nine recordings; the argument `folder` selects another folder.
"""

import json
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mag_tracking.event_records import VehiclePassage
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.run import RecordingSource, run
from support.bundled import DATA
from support.busy_worlds import Score, score
from support.passes import network_of

BUSY = DATA / 'busy'
NAMES = tuple(sorted(p.name.removesuffix('.truth.json') for p in BUSY.glob('*.truth.json')))


class TrackedRecording(NamedTuple):
    """Tracking results of a recording."""

    score: Score
    poses: list[Track]
    pipeline: Pipeline
    smoothed: list[SmoothedPose]
    """Smoothed poses of complete tracks."""
    passages: list[VehiclePassage]


def network_of_recording(name, folder=BUSY):
    """Network of a recording, with the sensor positions and the Earth field of its truth file."""
    truth = json.loads((folder / f'{name}.truth.json').read_text())
    return replace(network_of(truth['sensors_m']),
                   earth_field=np.array(truth['earth_field_T']))


class _Records:
    """Sink that collects all records."""

    def __init__(self, records):
        self._records = records

    def add(self, step):
        self._records += step.records


def tracked_recording(name, folder=BUSY, changes=None):
    """Track a recording; return a `TrackedRecording`."""
    network = network_of_recording(name, folder)
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    source, records = RecordingSource(Recording(folder / f'{name}.mcap'), network), []
    run(source, pipeline, [_Records(records)])
    poses = [r for r in records if isinstance(r, Track) and not r.ended]
    vehicles = [(stamps / 1e9, position[:, :2])
                for stamps, position, _ in source.reader.truth_arrays().values()]
    return TrackedRecording(score(poses, vehicles), poses, pipeline,
                            [r for r in records if isinstance(r, SmoothedPose) and r.complete],
                            [r for r in records if isinstance(r, VehiclePassage)])


def correctly_counted(name, passages, folder=BUSY):
    """Match passages and vehicles within 1 s and in the same direction: [(passage, vehicle)]."""
    truth, out = json.loads((folder / f'{name}.truth.json').read_text()), []
    unmatched = list(truth['vehicles'])
    for p in passages:
        def time_error(vehicle, time=p.stamp_ns / 1e9 - truth['epoch_s']):
            return abs(vehicle['cpa_time_s'] - time)

        near = [v for v in unmatched
                if (v['direction'] > 0) == p.forward and time_error(v) < 1.0]
        if near:
            unmatched.remove(best := min(near, key=time_error))
            out.append((p, best))
    return out
