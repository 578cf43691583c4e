"""Notes on a replay: warnings, limits and disturbances."""

from collections.abc import Iterator, Mapping
from typing import Any

from mag_tracking.report.page import NOTE, WARNING, Note
from mag_tracking.stages.track.evidence import LOST
from mag_tracking.stages.track.manager import ALONE, NO_SCALE
from mag_tracking.units import NS


def notes_of(summary: Mapping[str, Any]) -> list[Note]:
    """Notes on a run.

    Parameters
    ----------
    summary : dict
        Content of `summary.json`.
    """
    return [*_input_notes(summary), *_limit_notes(summary), *_truth_notes(summary),
            *(Note(NOTE, _disturbance_text(d)) for d in summary['disturbances'])]


def _input_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Notes on topics, readings and sensors."""
    sensors = summary['sensors']
    for topic in summary['missing_topics']:
        yield Note(WARNING, f'nothing on {topic}')
    if summary['no_detection_reason']:
        yield Note(NOTE, f'nothing was detected with the settings for a {summary["target"]}: '
                   f'{summary["no_detection_reason"]}')
    for what, n in {**summary['rejected'], **summary['lost']}.items():
        yield Note(WARNING, f'{what}: {n}')
    stuck = [name for name, s in sensors.items() if s['stuck']]
    if stuck:
        yield Note(WARNING, f'{", ".join(stuck)}: an axis does not vary (see mag-tracking doctor)')
    waiting = [name for name, s in sensors.items() if not s['ready'] and not s['stuck']]
    if waiting:
        yield Note(WARNING, f'no background was learnt for {", ".join(waiting)}: the field was not '
                   'steady for long enough; give background and noise_std in the network file')
    for name, s in sensors.items():
        if s['quiet_stretch_s'] is not None:
            begin, end = s['quiet_stretch_s']
            yield Note(NOTE, f'the recording does not begin quietly: the background of {name} is '
                       f'its most frequent level, at {begin:.1f} to {end:.1f} s')


def no_track_reason(counts: Mapping[str, int]) -> str | None:
    """One sentence where one sensor alone measured; `counts` of the tracker."""
    if counts.get(NO_SCALE, 0) or counts.get(ALONE, 0) and not counts.get('tracks', 0):
        return ('no track: one sensor does not tell the scale. `mag-tracking events` describes '
                'what passes without it; where the settings are true of the vehicles here, '
                'track.single_sensor_prior: true takes the scale from them')
    return None


def _limit_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """Notes on the limits of the tracks and their causes."""
    counts = summary['counts']['track']
    why = no_track_reason(counts)
    if why:
        yield Note(NOTE, why)
    elif len(summary['sensors']) == 1 and summary['tracks']:
        yield Note(NOTE, 'range and size are those of the settings (track.single_sensor_prior): '
                   'one sensor does not tell the scale')
    if summary['close_network'] and summary['target'] == 'vehicle' and summary['tracks']:
        yield Note(NOTE, 'all sensors are within two metres: they hardly tell range and size, so '
                   'the tracks are always ambiguous; speed and direction are those of the delay')
    if summary['frames_too_long']:
        yield Note(WARNING, summary['frames_too_long'])
    if summary['clocks_apart']:
        yield Note(WARNING, summary['clocks_apart'])
    lost = counts.get(f'tracks ended: {LOST}', 0)
    if lost:
        yield Note(WARNING, f'{lost} of the tracks lost their target: an orientation in the '
                   'network file is wrong, there were two targets at once, or it was none of the '
                   'kinds that the settings know')
    hardly = counts.get('sensors whose orientation is hardly known', 0)
    if hardly:
        yield Note(WARNING, f'{hardly} sensors may be turned by more than 15 degrees, as the '
                   'network file says: calibrate them')
    too_long = counts.get('tracks too long to smooth', 0)
    if too_long:
        yield Note(WARNING, f'{too_long} tracks were too long to smooth (track.max_smoothing_s, '
                   'or too many frames for so many sensors)')


def _truth_notes(summary: Mapping[str, Any]) -> Iterator[Note]:
    """How far poses without a flag can be relied on."""
    found = summary['unflagged_poses']
    if found and found['n']:
        yield Note(NOTE, f'poses without a flag: {found["n"]}, of which {found["wrong"]} '
                   f'({found["wrong"] / found["n"]:.1%}) are wrong: off by more than 2 m and by '
                   'more than three standard deviations'
                   + (f'; {found["without_truth"]} more at times without a true pose'
                      if found['without_truth'] else ''))


def _disturbance_text(d: Mapping[str, Any]) -> str:
    """A disturbance in a sentence."""
    lasted = (d['stamp_ns'] - d['begin_ns']) / NS
    over = 'over the whole network' if d['uniform'] > 0.5 else 'at each sensor on its own'
    return (f'disturbance {d["id"]}: {lasted:.1f} s, up to {1e9 * d["largest"]:.3g} nT at '
            f'{", ".join(d["sensors"]) or "no sensor alone"}, {over}; no single target explains it '
            f'(track {d["track_id"]})')
