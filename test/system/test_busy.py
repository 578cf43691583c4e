"""Several vehicles at once: recordings with ground truth, and simulated worlds."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import binom

from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from support import busy_recordings, busy_worlds
from support.bundled import NETWORK_FILE
from support.counters import count_of
from support.marks import studied
from support.random_passes import SIMULATORS, one_random_pass, random_pass
from support.samples import scenario

MAX_WRONG_FRACTION = 0.01
"""Aim: maximum fraction of wrong poses among unflagged poses."""
AIMS = {'meeting_2_sensors': (15, 1.0, 4.0), 'following_2_sensors': (16, 0.9, 4.0),
        'traffic_2_sensors': (11, np.inf, np.inf), 'traffic_4_sensors': (11, np.inf, np.inf)}
"""{recording: (minimum number of vehicles, maximum median RMS error [m], maximum median NEES)}."""

IN_EVERY_TEST = ('meeting_2_sensors', 'traffic_2_sensors')

tracked_recording = cache(busy_recordings.tracked_recording)


@pytest.mark.parametrize('name', studied(AIMS, kept=IN_EVERY_TEST))
def test_every_vehicle_of_a_recording_is_tracked(name):
    found, rms, nees = AIMS[name]
    got, poses, pipeline, *_ = tracked_recording(name)
    assert got.is_found.sum() >= found, str(got)
    assert np.nanmedian(got.rms) <= rms and np.nanmedian(got.nees) <= nees, str(got)
    assert got.n_extra == 0, str(got)
    # No track has two poses with the same timestamp, and every track is counted.
    assert len({(p.id, p.stamp_ns) for p in poses}) == len(poses)
    assert pipeline.track.counts['tracks'] == len({p.id for p in poses})


@pytest.mark.parametrize('name', studied(AIMS, kept=IN_EVERY_TEST))
def test_every_vehicle_of_a_recording_is_counted(name):
    """Each vehicle is counted in the right direction, and no other passage is counted."""
    passages = tracked_recording(name).passages
    right = busy_recordings.correctly_counted(name, passages)
    assert len(right) >= AIMS[name][0] and len(right) == len(passages)
    assert [p.number for p in passages] == list(range(1, len(passages) + 1))
    assert (np.diff([p.stamp_ns for p in passages]) > 0).all()
    trucks = [(p.vehicle_class == 'truck') == (v['length_m'] > 6.0) for p, v in right]
    assert np.count_nonzero(trucks) >= binom.ppf(0.01, len(trucks), 0.95)


def test_smoothed_poses_of_new_targets_are_near_the_published_ones():
    """The smoother is linearised at the position of initiation; otherwise errors reach 50 m."""
    n = 0
    for name in IN_EVERY_TEST:
        got = tracked_recording(name)
        published = {(p.id, p.stamp_ns): p for p in got.poses if not p.ambiguous}
        for s in got.smoothed:
            p = published.get((s.id, s.stamp_ns))
            if p is not None:
                n += 1
                distance = np.hypot(*(s.position - p.position)[:2])
                assert distance < 5.0 * np.sqrt(np.trace(p.covariance[:2, :2])) + 3.0
    assert n > 150


def test_poses_without_a_flag_are_rarely_wrong():
    scores = [tracked_recording(name).score for name in IN_EVERY_TEST]
    n_unflagged, n_wrong = (sum(getattr(s, of) for s in scores)
                            for of in ('n_unflagged', 'n_wrong'))
    assert n_unflagged > 250 and n_wrong <= MAX_WRONG_FRACTION * n_unflagged


@pytest.mark.study
def test_a_tracker_of_one_vehicle_at_a_time_misses_vehicles():
    """Without joint tracks, which a setting disables, vehicles are missed."""
    score, poses, pipeline, *_ = busy_recordings.tracked_recording(
        'meeting_2_sensors', changes={'track.max_joint_targets': 1})
    assert score.is_found.sum() <= 10
    assert count_of(pipeline.track.counts, 'of new') == 0


@pytest.mark.study
@pytest.mark.parametrize('simulator', SIMULATORS)
@pytest.mark.parametrize('pattern', ['meeting', 'following', 'traffic'])
def test_vehicles_of_both_simulators_are_tracked(pattern, simulator):
    """The aim for two sensors is to track nine of ten vehicles."""
    scores = [busy_worlds.tracked(busy_worlds.busy(pattern, 2, simulator, seed))[0]
              for seed in range(3)]
    found = np.concatenate([s.is_found for s in scores])
    assert found.sum() >= binom.ppf(0.01, len(found), 0.9), [str(s) for s in scores]
    assert sum(s.n_extra for s in scores) <= 0.05 * len(found)


@pytest.mark.study
@pytest.mark.timeout(900)
@pytest.mark.parametrize('simulator', SIMULATORS)
@pytest.mark.parametrize('kind', ['car', 'truck'])
def test_one_vehicle_is_rarely_tracked_as_two(kind, simulator):
    """Duplicate tracks are more frequent for trucks, because the model of a truck is less
    complete."""
    network, n = read_network(NETWORK_FILE), 25
    new = []
    for seed in range(n):
        body, course, duration, flaws = random_pass(simulator, kind, seed)
        readings, *_ = scenario.simulate(network, body, course, 100.0, duration,
                                         np.random.default_rng(seed), flaws)
        pipeline = Pipeline(network, settings_for('vehicle'))
        pipeline.feed(readings)
        new.append(count_of(pipeline.track.counts, 'of new'))
    assert np.count_nonzero(new) <= (0 if kind == 'car' else 0.1 * n), new


def test_new_targets_beyond_the_maximum_are_counted():
    """Ten vehicles pass in seven seconds, but at most two targets are tracked jointly."""
    rng = np.random.default_rng(4)
    plan = [(12.0 + 0.7 * k, 1 - 2 * (k % 2), rng.uniform(8.0, 12.0)) for k in range(10)]
    world = busy_worlds.world(
        busy_worlds.NETWORKS[4], [busy_worlds.passing(rng, 'clouds', *p) for p in plan], 26.0, rng,
        rate=50.0)
    pipeline = Pipeline(world.network, settings_for('vehicle', {'track.max_joint_targets': 2}))
    n_max = 0
    for start in range(0, len(world.readings), 800):
        pipeline.feed(world.readings.part(slice(start, start + 800)))
        bank = pipeline.track.bank
        n_max = max(n_max, 0 if bank is None else bank.label.reshape(len(bank), -1).shape[1])
    assert n_max == 2
    assert count_of(pipeline.track.counts, 'too many') > 0


@pytest.mark.study
@pytest.mark.parametrize('seed', [1, 14])
def test_wrong_smoothed_poses_of_a_truck_tracked_as_two_are_flagged(seed):
    """Some filtered poses have no flag; no smoothed pose without a flag is wrong."""
    got = one_random_pass('clouds', 'truck', seed)
    assert got.smoothed_wrong == 0 and not got.ambiguous.all()
