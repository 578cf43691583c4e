"""Results of the tracker and the doctor for bundled vehicle recordings with faults."""

import dataclasses
import functools

import numpy as np

import mag_tracking as mt
from mag_tracking.analysis.track_errors import interpolate_truth
from mag_tracking.apps.doctor import Doctor
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.calibrate.prescan import prescan
from support.bundled import DATA, NETWORK_FILE, vehicle_path
from support.spoiler import apply

MIN_HEADING_COSINE = np.cos(np.deg2rad(45.0))
"""Cosine of the largest permitted angle between tracked and true velocity at the CPA."""


ROADS = {'two_way_road_start': (DATA / 'two_way_road', NETWORK_FILE),
         'corridor_8_sensors': (DATA / 'corridor', DATA / 'corridor' / 'network.yaml')}
"""{name: (folder, network file)} of the recordings that are not in `VEHICLES`."""


@functools.cache
def recorded(name):
    """Read a bundled vehicle recording; return `RecordedReadings`."""
    if name in ROADS:
        folder, network = ROADS[name]
        return mt.read_recording(folder / f'{name}.mcap', network)
    return mt.read_recording(vehicle_path(name), NETWORK_FILE)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Tracking results of a recording with faults, for the track closest to the truth."""

    result: mt.TrackingResult
    detected: int
    tracked: bool
    heading: float
    """Cosine of the angle between true and tracked velocity at the CPA."""
    ambiguous: bool
    """Whether the track is ambiguous at the CPA."""
    closest: float
    nees: float
    """NEES per axis."""

    @property
    def direction_is_right(self):
        return self.tracked and self.heading > MIN_HEADING_COSINE


def outcome(name, *faults, network=NETWORK_FILE, settings=None):
    """Track the bundled recording `name` with `faults`; return the `Outcome`."""
    source = recorded(name)
    readings = apply(source.readings, *faults)
    result = mt.track(dataclasses.replace(source, readings=readings), network,
                      settings=settings)
    detected = int(result.detections['onset'].sum())
    errors = {k: e for k in result.tracks if (e := result.errors(k)) is not None}
    if not errors:
        return Outcome(result, detected, False, np.nan, True, np.nan, np.nan)
    best = min(errors, key=lambda k: errors[k]['closest'])
    poses = result.poses[result.poses['track_id'] == best]
    truth = result.truth[errors[best]['name']]
    true = interpolate_truth(truth, poses['stamp_ns'])[:, :2]
    before = interpolate_truth(truth, poses['stamp_ns'] - 100_000_000)[:, :2]
    k = int(np.nanargmin(np.hypot(*true.T)))
    v, w = true[k] - before[k], poses['velocity'][k, :2]
    return Outcome(result, detected, True, float(v @ w / np.linalg.norm(v) / np.linalg.norm(w)),
                   bool(poses['ambiguous'][k]), errors[best]['closest'], errors[best]['anees'])


def findings(name, *faults):
    """Findings of the doctor, as strings, for the bundled recording `name` with `faults`."""
    network = mt.read_network(ROADS[name][1] if name in ROADS else NETWORK_FILE)
    settings = settings_for('vehicle')
    readings = apply(recorded(name).readings, *faults)
    doctor = Doctor(Pipeline(network, settings, 'calibrate'))
    prescan([readings], network, settings.calibrate).apply(doctor.calibrate)
    doctor.feed(readings)
    return [str(f) for f in doctor.findings()]
