"""Search for new targets during a track: triggers, doubts and joint tracks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.stages.track.joint import (
    ACCEPT_NATS,
    CONFIDENT_NATS,
    IMPROBABLE,
    LONG_INTERVAL_S,
    LONG_VEHICLE,
    MIN_INTERVAL_S,
    REPEATED_NATS,
    JointExplanation,
    NewTargetEvidence,
)
from mag_tracking.stages.track.member import members_in_order
from mag_tracking.stages.track.steady_search import in_order_of
from mag_tracking.stages.track.window_search import inserted, overlap_depth
from mag_tracking.units import NS
from support import busy_worlds
from support.busy_worlds import NETWORKS, passing, world
from support.counters import count_of

PERIOD = round(0.08 * NS)


def searches(nis, n=20, rejected=False, is_long=False):
    """[(frame, reason)] of the searches that are triggered in `n` frames with the NIS `nis`."""
    evidence, found = NewTargetEvidence(), []
    for k in range(n):
        evidence.add(nis, 6, k * PERIOD, rejected, is_long)
        reason = evidence.due(k * PERIOD)
        found += [] if reason is None else [(k, reason)]
    return found


def test_consistent_innovations_trigger_no_search():
    assert searches(6.0) == []


@pytest.mark.parametrize('innovations', [{'nis': 30.0}, {'nis': 1.0, 'rejected': True}])
def test_improbable_innovations_and_rejected_sensors_trigger_a_search(innovations):
    found = searches(**innovations)
    assert {reason for _, reason in found} == {IMPROBABLE}
    # A search takes longer than a frame, so it is not triggered in every frame.
    assert np.diff([k for k, _ in found]).min() * PERIOD >= MIN_INTERVAL_S * NS


def test_a_long_vehicle_triggers_searches_at_increasing_intervals():
    found = searches(6.0, n=60, is_long=True)
    assert {reason for _, reason in found} == {LONG_VEHICLE}
    intervals = np.diff([k for k, _ in found]) * PERIOD / NS
    assert intervals[0] >= LONG_INTERVAL_S and (np.diff(intervals) > 0.0).all()


def test_a_less_probable_target_is_accepted_when_it_is_found_twice():
    evidence, between = NewTargetEvidence(), 0.5 * (REPEATED_NATS + ACCEPT_NATS)
    assert evidence.accepts(ACCEPT_NATS + 0.1)
    assert [evidence.accepts(odds) for odds in (between, between)] == [False, True]
    assert [evidence.accepts(odds) for odds in (between, 0.0, between)] == [False] * 3


def joint_of(velocities, odds, replaced=None, adds=True):
    """`JointExplanation` of vehicles with seven states each and these velocities (n, 2) [m/s]."""
    n = len(velocities)
    x = np.zeros((1, n, 7))
    x[0, :, 3:5] = velocities
    bank = FilterBank(x.reshape(1, -1), np.eye(7 * n)[None], np.zeros(1),
                      np.zeros((1, n), dtype=int), np.zeros((1, n), dtype=int), np.arange(1),
                      np.zeros((1, 2)))
    return JointExplanation(bank, None, None, odds, replaced, adds)


@pytest.mark.parametrize('odds, replaced, flagged', [
    (CONFIDENT_NATS - 1.0, None, (0, 1)), (CONFIDENT_NATS + 1.0, None, ()),
    (CONFIDENT_NATS + 1.0, 0, (0, 1))])
def test_weak_explanations_and_replacements_of_a_vehicle_by_two_are_flagged(
        odds, replaced, flagged):
    """Both vehicles drive in the same direction."""
    assert joint_of([[10.0, 0.0], [10.0, 0.0]], odds, replaced).doubtful(7) == flagged


@pytest.mark.parametrize('new', [[0.0, 10.0], [8.0, 8.0], [19.0, 0.0], [5.0, 0.0]])
@pytest.mark.parametrize('n_before', [1, 2])
def test_vehicles_that_cross_or_overtake_fast_are_flagged_up_to_sixty_nats(new, n_before):
    """The limit does not depend on the number of earlier vehicles."""
    velocities = [[10.0, 0.0], [-9.0, 1.0]][:n_before] + [new]
    all_members = tuple(range(n_before + 1))
    assert joint_of(velocities, 59.0).doubtful(7) == all_members
    assert joint_of(velocities, 61.0).doubtful(7) == ()


@pytest.mark.parametrize('new', [
    [-10.0, 2.0], [14.0, -1.0], [6.0, 0.0], [17.0, 0.0], [9.5, 4.0], [-30.0, 0.0], [-2.0, 0.0]])
def test_vehicles_that_meet_or_overtake_are_flagged_up_to_fifteen_nats_only(new):
    """Vehicles that meet may have any speed."""
    assert joint_of([[10.0, 0.0], new], 14.0).doubtful(7) == (0, 1)
    assert joint_of([[10.0, 0.0], new], 16.0).doubtful(7) == ()


@pytest.mark.parametrize('standing', [[0.0, 0.0], [0.3, 0.9], [0.9, 0.0]])
def test_a_stationary_vehicle_has_no_direction(standing):
    for velocities in ([standing, [10.0, 0.0]], [[10.0, 0.0], standing], [standing, standing]):
        assert joint_of(velocities, 16.0).doubtful(7) == ()


def test_directions_of_earlier_vehicles_are_not_compared():
    """The paths of the two earlier vehicles cross. The new vehicle's heading is within 26 degrees
    of both."""
    before, new = [[10.0, 4.8], [10.0, -4.8]], [10.0, 0.0]
    assert joint_of([*before, new], 16.0).doubtful(7) == ()
    assert joint_of([new, *before], 16.0).doubtful(7) == (0, 1, 2)


@pytest.mark.parametrize('first, second, flagged', [
    ([0.0, 10.0], [10.0, 0.0], (0, 1, 2)), ([10.0, 0.0], [0.0, 10.0], (0, 1, 2)),
    ([-10.0, 0.0], [10.0, 0.0], ()), ([-10.0, 0.0], [-11.0, 0.0], (1, 2))])
def test_two_vehicles_that_replace_one_are_compared_with_all_others(first, second, flagged):
    """The first vehicle is unrelated; the last two replace another vehicle."""
    assert joint_of([[12.0, 0.0], first, second], 16.0, 0).doubtful(7) == flagged


def test_only_a_vehicle_at_another_position_is_flagged():
    for velocity in ([0.0, 10.0], [9.0, 0.0]):
        joint = joint_of([[10.0, 0.0], velocity], 16.0, 0, adds=False)
        assert joint.doubtful(7) == (1,)


def test_the_best_hypothesis_determines_the_doubts():
    joint = joint_of([[10.0, 0.0], [0.0, 10.0]], 16.0)
    bank = joint.bank
    both = FilterBank(np.vstack([bank.x, joint_of([[10.0, 0.0], [11.0, 0.0]], 0.0).bank.x]),
                      np.tile(bank.P, (2, 1, 1)), np.log([0.1, 0.9]), np.tile(bank.label, (2, 1)),
                      np.tile(bank.kind, (2, 1)), np.arange(2), np.zeros((2, 2)))
    assert JointExplanation(both, None, None, 16.0, None, True).doubtful(7) == ()


def test_overlap_of_vehicles_is_measured_along_a_lane():
    path = np.zeros((2, 2 * 7))
    path[:, 3], path[:, 10] = 10.0, 10.0
    path[:, 6], path[:, 13] = 3.0, 5.0
    for ahead, aside, depth in ((20.0, 0.0, 0.0), (3.0, 0.0, 2.0), (3.0, 3.5, 0.0)):
        path[:, 7], path[:, 8] = [20.0, ahead], aside
        # Half the lengths of both rows add up to 4 m, and the bodies require one more metre.
        assert overlap_depth(path, 7, 2, 6) == pytest.approx(depth)


def test_an_inserted_block_is_uncorrelated_with_the_covariance():
    P = inserted(np.full((3, 3), 2.0), np.full((2, 2), 5.0), 1)
    rows = [0, 3, 4]
    assert (P[np.ix_(rows, rows)] == 2.0).all() and (P[1:3, 1:3] == 5.0).all()
    assert not P[np.ix_(rows, [1, 2])].any()


def test_a_pair_is_returned_in_the_order_of_the_first_pair():
    first = np.array([[0.0, 0.0], [10.0, 0.0]])
    for pair in (first + 1.0, (first + 1.0)[::-1]):
        np.testing.assert_array_equal(in_order_of(first, pair), first + 1.0)


def test_a_single_member_is_the_marginal_of_the_joint_state():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((2, 9, 9))
    bank = FilterBank(rng.standard_normal((2, 9)), root @ np.swapaxes(root, 1, 2),
                      np.log([0.4, 0.6]), np.array([[0, 1], [2, 1]]), np.array([[1, 0], [1, 2]]),
                      np.arange(2), np.zeros((2, 1)))
    for i, others in ((0, 1), (1, 0)):
        columns = [*range(3 * i, 3 * i + 3), 6, 7, 8]
        view, rest = bank.extract_target(i, 3), bank.without_target(others, 3)
        for part in (view, rest):
            np.testing.assert_array_equal(part.x, bank.x[:, columns])
            np.testing.assert_array_equal(part.P, bank.P[:, columns][:, :, columns])
            np.testing.assert_array_equal(part.label, bank.label[:, i])
            np.testing.assert_array_equal(part.kind, bank.kind[:, i])
            np.testing.assert_array_equal(part.log_w, bank.log_w)


@pytest.fixture(scope='module')
def meeting():
    """(`World`, records, pipeline) of two cars that meet at four sensors."""
    rng = np.random.default_rng(3)
    scene = world(NETWORKS[4], [passing(rng, 'clouds', 12.0, 1, 12.0),
                                passing(rng, 'clouds', 12.4, -1, 15.0)], 20.0, rng, rate=50.0)
    pipeline = Pipeline(scene.network, settings_for('vehicle'))
    return scene, pipeline.feed(scene.readings) + pipeline.flush(), pipeline


def test_two_vehicles_that_meet_keep_their_tracks(meeting):
    scene, records, pipeline = meeting
    tracks = [r for r in records if isinstance(r, Track)]
    assert {t.id for t in tracks} == {1, 2} and count_of(pipeline.track.counts, 'of new') == 1
    score = busy_worlds.score([t for t in tracks if not t.ended],
                              [(scene.t, p) for p in scene.positions])
    assert score.is_found.all() and score.rms.max() <= 1.0, str(score)
    assert sum(t.ended for t in tracks) == 2


def test_two_vehicles_that_meet_are_smoothed_together(meeting):
    """Each pose is smoothed once, in chronological order, with a mean error of at most 0.6 m."""
    scene, records, _ = meeting
    for id in (1, 2):
        poses = [r for r in records if isinstance(r, SmoothedPose) and r.id == id]
        stamps = [p.stamp_ns for p in poses]
        assert stamps == sorted(set(stamps)) and len(stamps) > 10
        error = min(busy_worlds.errors_of(poses, scene.t, position)[0].mean()
                    for position in scene.positions)
        assert error <= 0.6


def test_slow_sensors_at_staggered_times_find_a_new_target():
    """Each sensor is sampled at 5 Hz at its own times, so it contributes to less than half of the
    frames."""
    rng, n_sensors = np.random.default_rng(3), 4
    scene = world(NETWORKS[n_sensors], [passing(rng, 'clouds', 14.0, 1, 9.0),
                                        passing(rng, 'clouds', 14.5, -1, 9.0)], 24.0, rng,
                  rate=5.0)
    readings = scene.readings
    stamps = readings.stamp_ns + np.round(readings.sensor * 0.2 * NS / n_sensors).astype(np.int64)
    order = np.argsort(stamps, kind='stable')
    pipeline = Pipeline(scene.network, settings_for('vehicle'))
    pipeline.feed(replace(readings, sensor=readings.sensor[order], stamp_ns=stamps[order],
                          field=readings.field[order],
                          covariance=None if readings.covariance is None
                          else readings.covariance[order]))
    pipeline.flush()
    assert count_of(pipeline.track.counts, 'of new') == 1


def test_joint_tracks_do_not_depend_on_batches(meeting):
    scene, records, _ = meeting
    pipeline = Pipeline(scene.network, settings_for('vehicle'))
    again = []
    for start in range(0, len(scene.readings), 37):
        again += pipeline.feed(scene.readings.part(slice(start, start + 37)))
    again += pipeline.flush()
    for kind in (Track, SmoothedPose):
        a, b = ([(r.id, r.stamp_ns, *r.position) for r in found if isinstance(r, kind)]
                for found in (records, again))
        assert a == b


@pytest.fixture(scope='module')
def following():
    """(`World`, records) of two cars in one direction; the first is out of reach before the
    second."""
    rng = np.random.default_rng(5)
    scene = world(NETWORKS[4], [passing(rng, 'clouds', 12.0, 1, 6.0),
                                passing(rng, 'clouds', 15.5, 1, 6.5)], 26.0, rng, rate=50.0)
    pipeline = Pipeline(scene.network, settings_for('vehicle'))
    return scene, pipeline.feed(scene.readings) + pipeline.flush()


def test_smoothed_poses_are_complete_after_one_of_two_vehicles_leaves(following):
    """The smoothed poses begin before the two vehicles share a joint state."""
    scene, records = following
    tracks = [r for r in records if isinstance(r, Track)]
    ends = {t.id: t.stamp_ns for t in tracks if t.ended}
    assert len(ends) == 2 and ends[1] < ends[2] - NS // 2
    for id, position in zip((1, 2), scene.positions, strict=True):
        smoothed = [r for r in records if isinstance(r, SmoothedPose) and r.id == id]
        stamps = {s.stamp_ns for s in smoothed}
        assert {t.stamp_ns for t in tracks if t.id == id} <= stamps
        error, *_, true = busy_worlds.errors_of(smoothed, scene.t, position)
        assert error[np.hypot(*true.T) < 8.0].max() <= 1.0


@pytest.mark.parametrize('is_first', [True, False])
def test_the_vehicle_at_the_earlier_positions_continues_the_track(is_first):
    positions = np.array([[0.0, 0.0], [30.0, 0.0]])

    class Known:
        """Track member whose earlier poses were at one of `positions`."""

        def distance_from(self, stamps, path):
            return float(np.hypot(*(path - positions[0 if is_first else 1]).T).mean())

    class Found:
        """Joint explanation in which two vehicles replace the second vehicle, at these
        positions."""

        replaced = 1
        bank = SimpleNamespace(best=lambda: 0)
        window = SimpleNamespace(
            paths=[np.array([[9.0, 9.0, *positions.ravel()]])] * 3,
            frames=[SimpleNamespace(stamp_ns=k) for k in range(3)])

    other, old, new = object(), Known(), object()
    order = members_in_order([other, old], new, Found, 2)
    assert order == ([other, old, new] if is_first else [other, new, old])
