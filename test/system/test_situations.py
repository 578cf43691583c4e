"""Situations that violate the assumptions of the tracker: poses without a flag are not wrong.

`bench.situations` prints a table of more runs.
"""

import functools

import pytest

from mag_tracking.stages.track import doubts
from support.marks import studied
from support.random_passes import SIMULATORS
from support.situations import SITUATIONS, verdict

IN_EVERY_TEST = ('a bicycle', 'a sensor knocked', 'a car, four sensors')
EXPECTED_DOUBTS = {
    'a trolley at 1.3 m/s': doubts.FELT_BY_ONE_SENSOR,
    'a bicycle': doubts.FELT_BY_ONE_SENSOR,
    'a tram line switched': doubts.DISTURBANCE_MODEL,
    'a temperature step': doubts.SENSORS_ROTATED,
    'a sensor knocked': doubts.INNOVATIONS,
    'stops for 5 s': doubts.HEIGHT,
}
"""{situation: doubt expected at some of its poses}."""
RUNS = 3

MISSED_AIMS = {
    'clocks 200 ms apart': 'clock offset: the four wrong poses are within 0.5 s of the closest '
                           'point, before the whole pass reveals the offset',
    'a car with a trailer': 'some poses belong to the car alone, 2 to 3 m ahead of the middle '
                            'of both, until the trailer has passed; the cause of the others is '
                            'unknown',
    'one follows, four sensors': 'in one of six runs two cars 9 m apart are tracked as a truck '
                                 'between them for 0.8 s, until the second one is found',
    'one overtakes': 'two cars side by side are tracked as a truck of 8 to 12 m',
}
"""{situation: cause of the missed aim}, verified by runs without that cause or by inspection of the
wrong poses."""

MISSED_EVENT_AIMS = {
    'a car that turns': '226 of 241 poses: the other 15 are or were flagged for their height',
    'a tram line switched': 'five of six; the cause is unknown and persists without new_targets',
}
"""{situation: cause of the missed aim for events}."""

RIGHT_WITHOUT_DOUBTS = {'a car': 199, 'a truck': 249, 'a car that turns': 241,
                        'a car of 25 to 40 m/s': 128, 'a U-turn': 125, 'a car, four sensors': 67}
"""{situation: number of right unflagged poses in these runs, without the comparison of tracks with
other explanations}. With the comparison, at least 95 % of this number must remain."""


@functools.cache
def verdicts(name, runs):
    return [verdict(name, simulator, seed) for seed in range(runs) for simulator in SIMULATORS]


@pytest.mark.parametrize('name', studied(
    list(SITUATIONS), kept=IN_EVERY_TEST,
    also=lambda name: [pytest.mark.xfail(strict=True, reason=MISSED_AIMS[name])]
    if name in MISSED_AIMS else ()))
def test_poses_without_a_flag_are_not_wrong(name):
    found = verdicts(name, 1 if name in IN_EVERY_TEST else RUNS)
    n_unflagged, n_wrong = sum(v.n_unflagged for v in found), sum(v.n_wrong for v in found)
    assert n_wrong <= SITUATIONS[name].aim * n_unflagged


@pytest.mark.parametrize('name', studied(EXPECTED_DOUBTS, kept=IN_EVERY_TEST))
def test_poses_have_the_expected_doubt(name):
    of_all = [d for v in verdicts(name, 1) for d in v.doubts]
    assert sum(EXPECTED_DOUBTS[name] in d for d in of_all) > 0.1 * len(of_all)


@pytest.mark.parametrize('name', studied(
    [n for n, s in SITUATIONS.items() if s.group in ('nothing', 'control')], kept=IN_EVERY_TEST,
    also=lambda name: [pytest.mark.xfail(strict=True, reason=MISSED_EVENT_AIMS[name])]
    if name in MISSED_EVENT_AIMS else ()))
def test_disturbances_are_events_and_cars_are_not(name):
    found = verdicts(name, 1 if name in IN_EVERY_TEST else RUNS)
    if SITUATIONS[name].group == 'control':
        # A wrongly learnt background after a release counts as a disturbance.
        assert sum(v.n_false_disturbances for v in found) == 0
        right = sum(v.n_unflagged - v.n_wrong for v in found)
        assert right >= 0.95 * RIGHT_WITHOUT_DOUBTS[name]
    else:
        # A run without a detection has no events.
        tracked = [v for v in found if v.n_tracks]
        assert sum(v.n_disturbances > 0 for v in tracked) >= 0.9 * len(tracked)
        assert sum(v.n_unflagged for v in found) == 0
