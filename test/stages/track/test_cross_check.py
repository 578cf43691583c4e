"""When a second opinion is formed, and what it says of a track."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.clock_comparison import ClockComparison
from mag_tracking.stages.track.cross_check import CrossCheck
from mag_tracking.stages.track.rigid_pass import RigidPass
from support import spoiler
from support.bundled import LINEARISED_ONCE
from support.passes import network_of
from support.situation_worlds import ambient_world
from support.situations import made
from support.steady_frames import ROAD, STRAIGHT, state_at, steady_frames

FAST = np.where(np.arange(10) == 3, 60.0, STRAIGHT)


def heard(opinion, frames, path=STRAIGHT):
    """[(seconds, doubts, how many opinions by then)] of frame after frame."""
    out, n, latest = [], 0, None
    for frame in frames:
        opinion.add(frame, state_at(frame.stamp_ns / 1e9, path))
        found = opinion.doubts(0.0)
        n += opinion.latest is not latest
        latest = opinion.latest
        out.append((frame.stamp_ns / 1e9, found, n))
    return out


def test_opinions_follow_the_closest_point_ever_more_rarely():
    said = heard(CrossCheck(ROAD), steady_frames(np.random.default_rng(1)))
    times = [t for (t, _, n), (_, _, before) in zip(said[1:], said[:-1], strict=True) if n > before]
    print(f'opinions at {times} s')
    assert min(times) > 0.0 and 2 <= len(times) <= 6
    assert (np.diff(times, n=2) >= 0.0).all()
    assert not any(found for _, found, _ in said)


@pytest.mark.parametrize('of_frames, path, expected', [
    ({'clocks': (0.3,)}, STRAIGHT, doubts.CLOCKS_APART),
    ({'path': FAST}, FAST, doubts.FRAMES_TOO_LONG),
    ({'change': lambda B: np.clip(B, -3e-7, 3e-7)}, STRAIGHT, doubts.NO_STEADY_PATH)])
def test_what_the_whole_pass_tells_doubts_the_track(of_frames, path, expected):
    """Once it has passed, and for good."""
    opinion = CrossCheck(ROAD)
    said = heard(opinion, steady_frames(np.random.default_rng(2), **of_frames), path)
    assert not said[15][1]
    assert all(expected in found for _, found, _ in said[-8:]) and opinion.is_doubtful


def test_clocks_that_earlier_passes_found_apart_doubt_a_track_from_its_first_frame():
    opinion = CrossCheck(ROAD)
    frame = steady_frames(np.random.default_rng(3))[0]
    opinion.add(frame, state_at(frame.stamp_ns / 1e9))
    assert opinion.doubts(0.1) == {doubts.CLOCKS_APART}
    # Less than a metre.
    assert opinion.doubts(0.04) == set()


def test_a_track_that_ends_tells_of_its_clocks():
    clocks, opinion = ClockComparison(2), CrossCheck(ROAD)
    heard(opinion, steady_frames(np.random.default_rng(4), clocks=(0.3,)))
    for _ in range(2):
        opinion.conclude(clocks, np.arange(2))
    assert clocks.apart.sensor == 1
    assert clocks.apart_s(np.arange(2)) == pytest.approx(0.3, abs=0.05)


def test_no_frame_is_no_opinion():
    opinion = CrossCheck(ROAD)
    assert opinion.doubts(1.0) == set()
    clocks = ClockComparison(2)
    opinion.conclude(clocks, np.arange(2))
    assert clocks.apart is None and not opinion.is_doubtful


def test_a_long_track_is_judged_by_its_closest_point():
    """At 100 frames a second, and for half a minute after it."""
    opinion, n, latest = CrossCheck(ROAD), 0, None
    for frame in steady_frames(np.random.default_rng(6), clocks=(0.3,), period_s=0.01, until_s=30):
        opinion.add(frame, state_at(frame.stamp_ns / 1e9))
        found = opinion.doubts(0.0)
        n += opinion.latest is not latest
        latest = opinion.latest
    print(f'{n} opinions')
    assert doubts.CLOCKS_APART in found and n <= 12


def test_an_opinion_stands_where_later_frames_allow_none():
    """One of two sensors falls silent."""
    opinion = CrossCheck(ROAD)
    frames = steady_frames(np.random.default_rng(7), clocks=(0.3,), until_s=6.0)
    for frame in frames:
        silent = frame.stamp_ns > 0.5e9
        opinion.add(replace(frame, field=np.where([[silent], [False]], np.nan, frame.field)),
                    state_at(frame.stamp_ns / 1e9))
        found = opinion.doubts(0.0)
    assert doubts.CLOCKS_APART in found


def tracks_of(readings, network, **changes):
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    records = pipeline.feed(readings) + pipeline.flush()
    return [r for r in records if not getattr(r, 'ended', False)], pipeline


def test_it_can_be_switched_off():
    a_world = made('clocks 200 ms apart', 'clouds', 1)
    for on in (True, False):
        records, pipeline = tracks_of(a_world.readings, a_world.network,
                                      **{'track.cross_check': on})
        assert any(doubts.CLOCKS_APART in t.doubts for t in records if isinstance(t, Track)) is on
        # Smoothed poses are of the whole track.
        assert all(t.ambiguous for t in records if isinstance(t, SmoothedPose)) is on


def test_the_third_car_past_a_wrong_clock_is_doubted_from_its_first_pose():
    rng = np.random.default_rng(5)
    a_world = ambient_world(rng, 'clouds', None, 75.0, cars=3)
    readings = spoiler.apply(a_world.readings, spoiler.delayed('mag_2', 0.25))
    records, pipeline = tracks_of(readings, a_world.network, **LINEARISED_ONCE)
    tracks = [r for r in records if isinstance(r, Track)]
    last = [r for r in records if isinstance(r, Track | SmoothedPose)
            and r.id == max(t.id for t in tracks)]
    assert all(doubts.CLOCKS_APART in t.doubts for t in last if isinstance(t, Track))
    assert all(t.ambiguous for t in last)
    print(pipeline.track.clocks_apart)
    assert 'the clock of mag_2 is' in pipeline.track.clocks_apart
    right, pipeline = tracks_of(a_world.readings, a_world.network, **LINEARISED_ONCE)
    assert not any(doubts.CLOCKS_APART in t.doubts for t in right if isinstance(t, Track))
    assert pipeline.track.clocks_apart == ''


def test_a_track_that_goes_another_way_than_its_pass_differs_by_that():
    """After the pass it still differs by what it did at its end."""
    opinion = CrossCheck(ROAD)
    slow = np.where(np.arange(10) == 3, 14.0, STRAIGHT)
    away, states = [], []
    for frame in steady_frames(np.random.default_rng(9), until_s=6.0):
        t = frame.stamp_ns / 1e9
        opinion.add(frame, state_at(t, slow if t > 0.0 else STRAIGHT))
        found = opinion.doubts(0.0)
        away.append(np.hypot(*opinion.difference[:2]))
        # Farther than a long vehicle is long, it is another place.
        assert found == ({doubts.ANOTHER_PLACE} if away[-1] > 8.0 else set())
        if opinion.latest is None:
            assert away[-1] == 0.0
        elif t < 3.0:
            # A long row explains it at another speed, too: the nearer one counts.
            assert 3.0 * t - 1.0 < away[-1] < 6.0 * t + 1.0
        states.append((frame.stamp_ns, state_at(t), np.eye(6)))
    assert away[-1] == away[-20] > 15.0 and opinion.is_doubtful
    # Smoothed states have differences of their own: these are where the vehicle was.
    far = [(stamp_ns, state_at(stamp_ns / 1e9, slow), P) for stamp_ns, _, P in states]
    assert all(np.hypot(*d[:2]) < 2.0 for d in opinion.differences(states))
    of_far = [np.hypot(*d[:2]) for d in opinion.differences(far)]
    assert len(of_far) == len(states) and of_far[0] > 5.0 and of_far[-1] == of_far[-20] > 15.0
    # Without one that the opinion covers, they have that of the filter.
    assert opinion.differences(far[-3:]) == [opinion.difference] * 3


def test_before_the_pass_is_judged_smoothed_states_differ_by_what_they_do_at_its_begin():
    opinion = CrossCheck(ROAD)
    heard(opinion, steady_frames(np.random.default_rng(9)))
    slow = np.where(np.arange(10) == 3, 14.0, STRAIGHT)
    states = [(round(t * 1e9), state_at(t, slow), np.eye(6)) for t in (-6.0, -4.5, -3.9, -3.0)]
    first, second, third, fourth = opinion.differences(states)
    assert first is second is third and np.hypot(*first[:2]) > np.hypot(*fourth[:2]) > 10.0


def test_an_opinion_stays_one_of_its_own_peak():
    """The second two sensors feel the vehicle later, and more."""
    network = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0], [12.0, -3.5, 0.0], [12.0, 3.5, 0.0]])
    path = np.where(np.arange(10) == 3, 8.0, np.where(np.arange(10) == 4, 0.0, STRAIGHT))
    opinion, away, peaks = CrossCheck(network), [], set()
    for frame in steady_frames(np.random.default_rng(3), network, path, until_s=4.0):
        state = state_at(frame.stamp_ns / 1e9, path)
        opinion.add(frame, state)
        assert opinion.doubts(0.0) == set()
        away.append(np.hypot(*opinion.difference[:2]))
        if opinion.latest is not None:
            peaks.add(opinion.latest.stamp_ns)
    print(f'largest difference {max(away):.2f} m')
    assert len(peaks) > 1 and max(away) < 1.5


def test_a_pass_that_begins_at_its_strongest_does_not_tell_where_the_vehicle_was():
    opinion = CrossCheck(ROAD)
    late = [f for f in steady_frames(np.random.default_rng(2), until_s=3.0) if f.stamp_ns > 3e8]
    assert not any(found for _, found, _ in heard(opinion, late))
    assert len(opinion.latest.straight_paths) and not opinion.difference.any()


def test_what_leads_elsewhere_is_in_the_covariance_of_tracks_and_smoothed_poses(monkeypatch):
    """Here every path is said to lead five metres away, along x."""
    away = np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    monkeypatch.setattr(RigidPass, 'difference', lambda *_: away)
    a_world = made('a car', 'clouds', 0)
    records, _ = tracks_of(a_world.readings, a_world.network, **LINEARISED_ONCE)
    for kind, share in ((Track, 0.3), (SmoothedPose, 1.0)):
        std = np.array([np.sqrt(r.covariance[0, 0]) for r in records if isinstance(r, kind)])
        print(f'{kind.__name__}: {std.round(1)} m')
        assert np.mean(std > 5.0 - 1e-6) >= share
    # Not before the pass.
    assert std.size and min(np.sqrt(r.covariance[0, 0]) for r in records
                            if isinstance(r, Track)) < 2.0
    without, _ = tracks_of(a_world.readings, a_world.network, **{'track.cross_check': False})
    assert not any(r.covariance[0, 0] > 24.0 for r in without if isinstance(r, SmoothedPose))
