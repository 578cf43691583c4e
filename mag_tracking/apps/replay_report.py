"""Report of a replay: notes, map with time slider, curves and tables."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.analysis.track_errors import interpolate_truth
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps.replay import Run
from mag_tracking.network import SensorNetwork
from mag_tracking.physics import bounds
from mag_tracking.quantities import quantity
from mag_tracking.report import page_scene
from mag_tracking.report.page import NOTE, WARNING, Note, Page, Table
from mag_tracking.report.road import road_of
from mag_tracking.results.result_folder import REPORT
from mag_tracking.run import no_track_reason
from mag_tracking.stages.track.evidence import LOST
from mag_tracking.stages.track.manager import UNCERTAIN_ORIENTATIONS
from mag_tracking.stages.track.running_track import BELOW_SENSORS
from mag_tracking.stages.track.smoothing import NOT_SMOOTHED
from mag_tracking.units import NS

COUNTED = (
    (f'tracks ended: {LOST}', 'track lost its target', 'tracks lost their target',
     ': check the orientations in the network file; other possible causes are simultaneous '
     'targets, or a kind of target that the settings do not include'),
    (BELOW_SENSORS, 'vehicle appears', 'vehicles appear', ' to pass below the sensors: two sensors '
     'are exchanged, or the sensors are mounted upside down; check topics, positions and '
     'orientations in the network file'),
    *((f'tracks ended: {reason}', 'track', 'tracks', f' ended: {reason}; {bounds.ADVICE}')
      for reason in bounds.REASONS),
    (UNCERTAIN_ORIENTATIONS, 'sensor has', 'sensors have', ' an orientation uncertainty of more '
     'than 15 degrees in the network file: calibrate the network'),
    (NOT_SMOOTHED, 'track was', 'tracks were', ' not smoothed: too long (track.max_smoothing_s), '
     'too many frames for the number of sensors, or a change of the sensors'))
"""Warnings about counts of the tracker: (cause, singular, plural, rest of the text)."""


def write_report(run: Run, network: SensorNetwork, out: Path) -> Path:
    """Write the report of a replay to `report.html`."""
    summary, logs = run.summary, list(run.logs.values())
    notes, scene = notes_of(summary), None
    if summary['interrupted']:
        notes.insert(0, Note(NOTE, 'the replay was interrupted; results are incomplete'))
    if logs:
        scene = _scene(run, network, logs[:page_scene.MAX_TRACKS], notes)
    counts = summary['counts']
    numbers = (quantity(counts['align'].get('frames', 0), 'frame'),
               quantity(counts['detect'].get('onsets', 0), 'detection'),
               quantity(len(summary['disturbances']), 'disturbance'))
    path = out / REPORT
    Page(f'{summary["recording"]}: {quantity(len(logs), "track")}', ', '.join(numbers), notes,
         scene, tables=[_sensor_table(summary, run, network)]).write(path)
    return path


def _scene(run: Run, network: SensorNetwork, logs: Sequence[TrackLog],
           notes: list[Note]) -> dict[str, Any]:
    """Create the map of the tracks; append a note to `notes` for each omission."""
    if len(logs) < len(run.logs):
        notes.append(Note(NOTE, f'the page shows the first {len(logs)} of {len(run.logs)} tracks'))
    max_poses = page_scene.max_poses_of(logs)
    if any(len(log.stamp_ns) > max_poses for log in logs):
        notes.append(Note(NOTE, f'the page shows {max_poses} poses per track; poses.csv contains '
                          'all poses'))
    if len(network) > page_scene.MAX_SENSORS:
        notes.append(Note(NOTE, f'fields are shown for the {page_scene.MAX_SENSORS} sensors (of '
                          f'{len(network)}) with the strongest field of each track'))
    begin_ns = min(log.stamp_ns[0] for log in logs)
    entries = {t['id']: t for t in run.summary['tracks']}
    tracks = []
    for log in logs:
        rows, facts = page_scene.thin_poses(log, max_poses), entries[log.id]
        entry = page_scene.track_entry(log, begin_ns, page_scene.strongest_sensors(log), rows)
        entry['facts'] = page_scene.facts_of(facts)
        if log.id in run.smoothed:
            path = np.array(run.smoothed[log.id].position)
            entry['smoothed'] = page_scene.path_entry(path[::-(-len(path) // max_poses)])
        if 'truth' in facts:
            entry['truth'] = page_scene.path_entry(interpolate_truth(
                run.truth[facts['truth']['name']], [log.stamp_ns[k] for k in rows]))
        tracks.append(entry)
    # The road is along the vehicles whose tracks ended unambiguously.
    road = road_of(network.positions[:, :2], [
        np.array(run.smoothed[log.id].position)[:, :2] for log in logs
        if log.kind[-1] and not log.ambiguous[-1] and log.id in run.smoothed])
    return page_scene.scene_of(network, begin_ns, max(log.stamp_ns[-1] for log in logs), tracks,
                               road)


def _sensor_table(summary: Mapping[str, Any], run: Run, network: SensorNetwork) -> Table:
    innovations = [t['nis_by_sensor'] for t in summary['tracks']]
    rows = []
    for j, (name, s) in enumerate(summary['sensors'].items()):
        noise = [v for v in s.get('noise_std', []) if v is not None]
        state = ('stuck' if s['stuck'] else 'no background' if not s['ready'] else
                 'doubtful at times' if s['doubtful_ns'] else 'ready')
        nis = [sensor_nis[name] for sensor_nis in innovations if sensor_nis[name] is not None]
        rows.append([
            name, state, s['accepted'], s['rejected'],
            1e9 * float(np.mean(noise)) if noise else None, s['times_relearnt'],
            float(np.mean(nis)) if nis else None, *network.positions[j].tolist()])
    return Table('Sensors', ['sensor', 'background', 'readings used', 'rejected', 'noise [nT]',
                             'relearnt', 'NIS per axis', 'x [m]', 'y [m]', 'z [m]'], rows)


def notes_of(summary: Mapping[str, Any]) -> list[Note]:
    """Create the notes on a replay from the content of `summary.json`."""
    return [*_notes(summary), *(Note(NOTE, _describe_disturbance(d))
                                for d in summary['disturbances'])]


def _notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Notes on diagnoses and backgrounds, limitations of the tracks, and wrong poses."""
    for diagnosis in summary['diagnoses']:
        yield Note(WARNING if diagnosis['serious'] else NOTE, diagnosis['text'])
    for name, s in summary['sensors'].items():
        if s['quiet_stretch_s'] is not None:
            begin, end = s['quiet_stretch_s']
            yield Note(NOTE, f'no quiet interval at the start: the most frequent level of '
                       f'{name}, from {begin:.1f} to {end:.1f} s, is used as its background')
    counts = summary['counts']['track']
    reason = no_track_reason(counts)
    if reason:
        yield Note(NOTE, reason)
    elif len(summary['sensors']) == 1 and summary['tracks']:
        yield Note(NOTE, 'range and moment are based on the settings (track.single_sensor_prior): '
                   'the scale is not observable with a single sensor')
    if summary['close_network'] and summary['target'] == 'vehicle' and summary['tracks']:
        yield Note(NOTE, 'all sensors are within two metres: range and moment are poorly '
                   'observable, and all tracks are ambiguous; use the speed and direction from the '
                   'delays between the sensors')
    if summary['lanes'] and summary['target'] == 'vehicle' and counts.get('tracks', 0):
        yield Note(NOTE, summary['lanes'])
    for warning in (summary['frames_too_long'], summary['clocks_apart']):
        if warning:
            yield Note(WARNING, warning)
    for cause, one, several, text in COUNTED:
        if n := counts.get(cause, 0):
            yield Note(WARNING, quantity(n, one, several) + text)
    poses = summary['unflagged_poses']
    if poses and poses['n']:
        yield Note(NOTE, f'unambiguous poses: {poses["n"]}, of which {poses["wrong"]} '
                   f'({poses["wrong"] / poses["n"]:.1%}) are wrong (error above 2 m and above '
                   'three standard deviations)'
                   + (f'; {poses["without_truth"]} more without ground truth'
                      if poses['without_truth'] else ''))


def _describe_disturbance(d: Mapping[str, Any]) -> str:
    duration = (d['stamp_ns'] - d['begin_ns']) / NS
    extent = 'uniform over the network' if d['uniform'] > 0.5 else 'different at each sensor'
    return (f'disturbance {d["id"]}: {duration:.1f} s, up to {1e9 * d["largest"]:.3g} nT at '
            f'{", ".join(d["sensors"]) or "no individual sensor"}, {extent}; not explained by a '
            f'single target (track {d["track_id"]})')
