"""Report of a replay: map with time slider, curves and tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.apps.replay import Run
from mag_tracking.apps.replay_notes import notes_of
from mag_tracking.files import replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report.metrics import interpolate_truth
from mag_tracking.report.page import NOTE, REPORT, Note, Page, Table, report_html
from mag_tracking.report.page_scene import (
    MAX_SENSORS,
    MAX_TRACKS,
    facts_of,
    max_poses_of,
    path_entry,
    scene_of,
    strongest_sensors,
    thin_poses,
    track_entry,
)
from mag_tracking.report.road import Road, road_of
from mag_tracking.report.track_log import TrackLog


def write_report(run: Run, network: SensorNetwork, out: Path) -> Path:
    """Write the report of a replay to `report.html`."""
    path = out / REPORT
    replace_text(path, report_html(replay_page(run, network)))
    return path


def replay_page(run: Run, network: SensorNetwork) -> Page:
    """Create the page of a replay."""
    summary, logs = run.summary, list(run.logs.values())
    notes, scene = notes_of(summary), None
    if summary['interrupted']:
        notes.insert(0, Note(NOTE, 'the replay was interrupted; results are incomplete'))
    if logs:
        scene = _scene(run, network, logs[:MAX_TRACKS], notes)
    counts = summary['counts']
    numbers = (quantity(counts['align'].get('frames', 0), 'frame'),
               quantity(counts['detect'].get('onsets', 0), 'detection'),
               quantity(len(summary['disturbances']), 'disturbance'))
    return Page(f'{summary["recording"]}: {quantity(len(logs), "track")}', ', '.join(numbers),
                notes, scene,
                tables=[_sensor_table(summary, run, network)])


def _scene(run: Run, network: SensorNetwork, logs: Sequence[TrackLog],
           notes: list[Note]) -> dict[str, Any]:
    """Create the map of the tracks; append a note to `notes` for each omission."""
    if len(logs) < len(run.logs):
        notes.append(Note(NOTE, f'the page shows the first {len(logs)} of {len(run.logs)} tracks'))
    max_poses = max_poses_of(logs)
    if any(len(log.stamp_ns) > max_poses for log in logs):
        notes.append(Note(NOTE, f'the page shows {max_poses} poses per track; poses.csv contains '
                          'all poses'))
    if len(network) > MAX_SENSORS:
        notes.append(Note(NOTE, f'fields are shown for the {MAX_SENSORS} sensors (of '
                          f'{len(network)}) with the strongest field of each track'))
    begin_ns = min(log.stamp_ns[0] for log in logs)
    entries = {t['id']: t for t in run.summary['tracks']}
    tracks = []
    for log in logs:
        rows, facts = thin_poses(log, max_poses), entries[log.id]
        entry = track_entry(log, begin_ns, strongest_sensors(log), rows)
        entry['facts'] = facts_of(facts)
        if log.id in run.smoothed:
            path = np.array(run.smoothed[log.id].position)
            entry['smoothed'] = path_entry(log.id, path[::-(-len(path) // max_poses)])
        if 'truth' in facts:
            entry['truth'] = path_entry(log.id, interpolate_truth(
                run.truth[facts['truth']['name']], [log.stamp_ns[k] for k in rows]))
        tracks.append(entry)
    return scene_of(network, begin_ns, max(log.stamp_ns[-1] for log in logs), tracks,
                    _road(run, network, logs))


def _road(run: Run, network: SensorNetwork, logs: Sequence[TrackLog]) -> Road:
    """Road along the smoothed paths of the vehicles whose tracks ended unambiguously."""
    paths = [np.array(run.smoothed[log.id].position)[:, :2] for log in logs
             if log.kind[-1] and not log.ambiguous[-1] and log.id in run.smoothed]
    return road_of(network.positions[:, :2], paths)


def _sensor_table(summary: Mapping[str, Any], run: Run, network: SensorNetwork) -> Table:
    """Table of the background, readings, noise and position of each sensor."""
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
