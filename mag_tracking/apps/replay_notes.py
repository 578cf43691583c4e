"""Notes on a replay: diagnoses, limitations and disturbances."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from mag_tracking.physics import bounds
from mag_tracking.quantities import quantity
from mag_tracking.report.page import NOTE, WARNING, Note
from mag_tracking.run import no_track_reason
from mag_tracking.stages.health.diagnosis import Diagnosis
from mag_tracking.stages.track.evidence import LOST
from mag_tracking.stages.track.manager import UNCERTAIN_ORIENTATIONS
from mag_tracking.stages.track.running_track import BELOW_SENSORS
from mag_tracking.stages.track.smoothing import NOT_SMOOTHED
from mag_tracking.units import NS


def diagnosis_entries(diagnoses: Iterable[Diagnosis]) -> list[dict[str, Any]]:
    """Entries of diagnoses in `summary.json`: cause, whether it is serious, and the text."""
    return [{'cause': d.finding.cause.value, 'serious': d.serious, 'text': str(d)}
            for d in diagnoses]


def notes_of(summary: Mapping[str, Any]) -> list[Note]:
    """Create the notes on a replay from the content of `summary.json`."""
    return [*_input_notes(summary), *_limit_notes(summary), *_truth_notes(summary),
            *(Note(NOTE, _describe_disturbance(d)) for d in summary['disturbances'])]


def _input_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Notes on the diagnoses and the initial backgrounds."""
    for diagnosis in summary['diagnoses']:
        yield Note(WARNING if diagnosis['serious'] else NOTE, diagnosis['text'])
    for name, s in summary['sensors'].items():
        if s['quiet_stretch_s'] is not None:
            begin, end = s['quiet_stretch_s']
            yield Note(NOTE, f'no quiet interval at the start: the most frequent level of '
                       f'{name}, from {begin:.1f} to {end:.1f} s, is used as its background')


def _limit_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Notes on the limitations of the tracks, with causes."""
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
    if summary['frames_too_long']:
        yield Note(WARNING, summary['frames_too_long'])
    if summary['clocks_apart']:
        yield Note(WARNING, summary['clocks_apart'])
    n_lost = counts.get(f'tracks ended: {LOST}', 0)
    if n_lost:
        yield Note(WARNING, quantity(n_lost, 'track lost its target', 'tracks lost their target')
                   + ': check the orientations in the network file; other possible causes are '
                   'simultaneous targets, or a kind of target that the settings do not include')
    if n := counts.get(BELOW_SENSORS, 0):
        yield Note(WARNING, f'{quantity(n, "vehicle appears", "vehicles appear")} to pass below '
                   'the sensors: two sensors are exchanged, or the sensors are mounted upside '
                   'down; check topics, positions and orientations in the network file')
    for reason in bounds.REASONS:
        if n := counts.get(f'tracks ended: {reason}', 0):
            yield Note(WARNING, f'{quantity(n, "track")} ended: {reason}; {bounds.ADVICE}')
    n_uncertain = counts.get(UNCERTAIN_ORIENTATIONS, 0)
    if n_uncertain:
        yield Note(WARNING, quantity(n_uncertain, 'sensor has', 'sensors have')
                   + ' an orientation uncertainty of more than 15 degrees in the network file: '
                   'calibrate the network')
    n_unsmoothed = counts.get(NOT_SMOOTHED, 0)
    if n_unsmoothed:
        yield Note(WARNING, quantity(n_unsmoothed, 'track was', 'tracks were')
                   + ' not smoothed: too long (track.max_smoothing_s), too many frames for the '
                   'number of sensors, or a change of the sensors')


def _truth_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Note on the number of unambiguous poses that are wrong."""
    poses = summary['unflagged_poses']
    if poses and poses['n']:
        yield Note(NOTE, f'unambiguous poses: {poses["n"]}, of which {poses["wrong"]} '
                   f'({poses["wrong"] / poses["n"]:.1%}) are wrong (error above 2 m and above '
                   'three standard deviations)'
                   + (f'; {poses["without_truth"]} more without ground truth'
                      if poses['without_truth'] else ''))


def _describe_disturbance(d: Mapping[str, Any]) -> str:
    """Describe the duration, amplitude and extent of a disturbance in one sentence."""
    duration = (d['stamp_ns'] - d['begin_ns']) / NS
    extent = 'uniform over the network' if d['uniform'] > 0.5 else 'different at each sensor'
    return (f'disturbance {d["id"]}: {duration:.1f} s, up to {1e9 * d["largest"]:.3g} nT at '
            f'{", ".join(d["sensors"]) or "no individual sensor"}, {extent}; not explained by a '
            f'single target (track {d["track_id"]})')
