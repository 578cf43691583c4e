"""Correct plurals in messages and in the summaries of results."""

import dataclasses

import pytest

import mag_tracking as mt
from mag_tracking.apps.replay_notes import notes_of
from mag_tracking.quantities import occurrences, quantity
from mag_tracking.stages.track.evidence import LOST
from mag_tracking.stages.track.manager import UNCERTAIN_ORIENTATIONS
from mag_tracking.stages.track.smoothing import NOT_SMOOTHED
from support.bundled import NETWORK_FILE, QUICK, vehicle_path


@pytest.mark.parametrize('n, track, passes', [
    (0, '0 tracks', '0 passes'), (1, '1 track', '1 pass'), (2, '2 tracks', '2 passes')])
def test_the_noun_agrees_with_the_number(n, track, passes):
    assert quantity(n, 'track') == track and quantity(n, 'pass', 'passes') == passes


def test_a_single_occurrence_is_once():
    assert [occurrences(n) for n in (0, 1, 2)] == ['0 times', 'once', '2 times']


def test_the_noun_event_agrees_with_the_number():
    result = mt.events(vehicle_path('straight_car_right'), NETWORK_FILE, QUICK)
    assert 'EventsResult(2 events: ' in repr(result)
    one = dataclasses.replace(result, events=result.events[:1])
    assert 'EventsResult(1 event: ' in repr(one)


def test_the_noun_vehicle_agrees_with_the_number():
    result = mt.traffic(vehicle_path('straight_car_right'), NETWORK_FILE, QUICK)
    assert repr(result).startswith('TrafficResult(1 vehicle, ')
    no_vehicles = dataclasses.replace(result, vehicles=())
    assert repr(no_vehicles) == 'TrafficResult(0 vehicles, no line was crossed)'


def test_the_nouns_track_and_detection_agree_with_the_number():
    result = mt.track(vehicle_path('straight_car_right'), NETWORK_FILE, settings=QUICK)
    assert repr(result).startswith('TrackingResult(1 track, ') and ' 1 detection)' in repr(result)


SUMMARY = {
    'sensors': {}, 'diagnoses': [], 'tracks': [], 'close_network': False, 'target': 'vehicle',
    'frames_too_long': None, 'lanes': None, 'clocks_apart': None, 'unflagged_poses': None,
    'disturbances': []}


@pytest.mark.parametrize('n, beginnings', [
    (1, ('1 track lost its target: ', '1 sensor has an ', '1 track was not smoothed: ')),
    (2, ('2 tracks lost their target: ', '2 sensors have an ',
         '2 tracks were not smoothed: '))])
def test_nouns_in_notes_agree_with_the_number(n, beginnings):
    counts = {f'tracks ended: {LOST}': n,
              UNCERTAIN_ORIENTATIONS: n,
              NOT_SMOOTHED: n}
    texts = [note.text for note in notes_of({**SUMMARY, 'counts': {'track': counts}})]
    assert all(text.startswith(b) for text, b in zip(texts, beginnings, strict=True)), texts
