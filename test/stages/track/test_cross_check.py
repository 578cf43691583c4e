"""Cross-check of a track with fits to the whole pass: schedule, doubts and differences."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.cross_check import ClockComparison, CrossCheck
from mag_tracking.stages.track.pass_samples import RigidPass
from support import spoiler
from support.bundled import LINEARISED_ONCE
from support.passes import network_of
from support.situation_worlds import ambient_world
from support.situations import simulated_world
from support.steady_frames import ROAD, STRAIGHT, state_at, steady_frames

FAST_PATH = np.where(np.arange(10) == 3, 60.0, STRAIGHT)


def run_check(check, frames, path=STRAIGHT):
    """Check a track on `path`; return [(time [s], doubts, number of fits so far)] after each
    frame."""
    out, n, latest = [], 0, None
    for frame in frames:
        check.add(frame, state_at(frame.stamp_ns / 1e9, path))
        found = check.doubts(0.0)
        n += check.latest is not latest
        latest = check.latest
        out.append((frame.stamp_ns / 1e9, found, n))
    return out


def test_fits_follow_the_cpa_at_increasing_intervals():
    rows = run_check(CrossCheck(ROAD), steady_frames(np.random.default_rng(1)))
    times = [t for (t, _, n), (_, _, before) in zip(rows[1:], rows[:-1], strict=True) if n > before]
    print(f'fits at {times} s')
    assert min(times) > 0.0 and 2 <= len(times) <= 6
    assert (np.diff(times, n=2) >= 0.0).all()
    assert not any(found for _, found, _ in rows)


@pytest.mark.parametrize('of_frames, path, expected', [
    ({'clocks': (0.3,)}, STRAIGHT, doubts.CLOCKS_APART),
    ({'path': FAST_PATH}, FAST_PATH, doubts.FRAMES_TOO_LONG),
    ({'change': lambda B: np.clip(B, -3e-7, 3e-7)}, STRAIGHT, doubts.NO_STEADY_PATH)])
def test_faults_found_in_the_whole_pass_flag_the_track(of_frames, path, expected):
    """The doubt begins after the vehicle has passed, and persists."""
    check = CrossCheck(ROAD)
    rows = run_check(check, steady_frames(np.random.default_rng(2), **of_frames), path)
    assert not rows[15][1]
    assert all(expected in found for _, found, _ in rows[-8:]) and check.is_doubtful


def test_clock_offsets_of_earlier_passes_flag_a_track_from_its_first_frame():
    check = CrossCheck(ROAD)
    frame = steady_frames(np.random.default_rng(3))[0]
    check.add(frame, state_at(frame.stamp_ns / 1e9))
    assert check.doubts(0.1) == {doubts.CLOCKS_APART}
    # This offset moves the vehicle by less than a metre.
    assert check.doubts(0.04) == set()


def test_the_end_of_a_track_updates_the_clock_comparison():
    clocks, check = ClockComparison(2), CrossCheck(ROAD)
    run_check(check, steady_frames(np.random.default_rng(4), clocks=(0.3,)))
    for _ in range(2):
        check.finish(clocks, np.arange(2))
    assert clocks.largest_offset.sensor == 1
    assert clocks.largest_offset_s(np.arange(2)) == pytest.approx(0.3, abs=0.05)


def test_a_check_without_frames_has_no_doubts():
    check = CrossCheck(ROAD)
    assert check.doubts(1.0) == set()
    clocks = ClockComparison(2)
    check.finish(clocks, np.arange(2))
    assert clocks.largest_offset is None and not check.is_doubtful


def test_a_long_track_is_checked_at_its_cpa():
    """The track has 100 frames per second, until half a minute after the CPA."""
    check, n, latest = CrossCheck(ROAD), 0, None
    for frame in steady_frames(np.random.default_rng(6), clocks=(0.3,), period_s=0.01, until_s=30):
        check.add(frame, state_at(frame.stamp_ns / 1e9))
        found = check.doubts(0.0)
        n += check.latest is not latest
        latest = check.latest
    print(f'{n} fits')
    assert doubts.CLOCKS_APART in found and n <= 12


def test_a_fit_stays_valid_if_later_frames_allow_none():
    """One of two sensors stops measuring."""
    check = CrossCheck(ROAD)
    frames = steady_frames(np.random.default_rng(7), clocks=(0.3,), until_s=6.0)
    for frame in frames:
        silent = frame.stamp_ns > 0.5e9
        check.add(replace(frame, field=np.where([[silent], [False]], np.nan, frame.field)),
                  state_at(frame.stamp_ns / 1e9))
        found = check.doubts(0.0)
    assert doubts.CLOCKS_APART in found


def records_of(readings, network, **changes):
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    records = pipeline.feed(readings) + pipeline.flush()
    return [r for r in records if not getattr(r, 'ended', False)], pipeline


def test_the_cross_check_can_be_disabled():
    world = simulated_world('clocks 200 ms apart', 'clouds', 1)
    for on in (True, False):
        records, pipeline = records_of(world.readings, world.network,
                                       **{'track.cross_check': on})
        assert any(doubts.CLOCKS_APART in t.doubts for t in records if isinstance(t, Track)) is on
        # The smoothed poses of the whole track are ambiguous.
        assert all(t.ambiguous for t in records if isinstance(t, SmoothedPose)) is on


def test_the_third_car_past_a_wrong_clock_is_flagged_from_its_first_pose():
    rng = np.random.default_rng(5)
    world = ambient_world(rng, 'clouds', None, 75.0, cars=3)
    readings = spoiler.apply(world.readings, spoiler.delayed('mag_2', 0.25))
    records, pipeline = records_of(readings, world.network, **LINEARISED_ONCE)
    tracks = [r for r in records if isinstance(r, Track)]
    last = [r for r in records if isinstance(r, Track | SmoothedPose)
            and r.id == max(t.id for t in tracks)]
    assert all(doubts.CLOCKS_APART in t.doubts for t in last if isinstance(t, Track))
    assert all(t.ambiguous for t in last)
    print(pipeline.track.clock_warning)
    assert 'of mag_2' in pipeline.track.clock_warning
    correct, pipeline = records_of(world.readings, world.network, **LINEARISED_ONCE)
    assert not any(doubts.CLOCKS_APART in t.doubts for t in correct if isinstance(t, Track))
    assert pipeline.track.clock_warning == ''


def test_the_difference_of_a_track_is_its_distance_from_the_fitted_path():
    """After the pass the difference stays constant."""
    check = CrossCheck(ROAD)
    slow = np.where(np.arange(10) == 3, 14.0, STRAIGHT)
    distances, states = [], []
    for frame in steady_frames(np.random.default_rng(9), until_s=6.0):
        t = frame.stamp_ns / 1e9
        check.add(frame, state_at(t, slow if t > 0.0 else STRAIGHT))
        found = check.doubts(0.0)
        distances.append(np.hypot(*check.difference[:2]))
        # A difference larger than the length of a long vehicle means another position.
        assert found == ({doubts.ANOTHER_PLACE} if distances[-1] > 8.0 else set())
        if check.latest is None:
            assert distances[-1] == 0.0
        elif t < 3.0:
            # A long row also explains the pass at another speed; the nearer path is used.
            assert 3.0 * t - 1.0 < distances[-1] < 6.0 * t + 1.0
        states.append((frame.stamp_ns, state_at(t), np.eye(6)))
    assert distances[-1] == distances[-20] > 15.0 and check.is_doubtful
    # Smoothed states have their own differences; these states are on the true path.
    far = [(stamp_ns, state_at(stamp_ns / 1e9, slow), P) for stamp_ns, _, P in states]
    assert all(np.hypot(*d[:2]) < 2.0 for d in check.differences(states))
    far_distances = [np.hypot(*d[:2]) for d in check.differences(far)]
    assert len(far_distances) == len(states) and far_distances[0] > 5.0 \
        and far_distances[-1] == far_distances[-20] > 15.0
    # If the fit covers none of the states, the latest difference of the running track is used.
    assert check.differences(far[-3:]) == [check.difference] * 3


def test_smoothed_states_before_the_fitted_pass_have_the_difference_of_its_start():
    check = CrossCheck(ROAD)
    run_check(check, steady_frames(np.random.default_rng(9)))
    slow = np.where(np.arange(10) == 3, 14.0, STRAIGHT)
    states = [(round(t * 1e9), state_at(t, slow), np.eye(6)) for t in (-6.0, -4.5, -3.9, -3.0)]
    first, second, third, fourth = check.differences(states)
    assert first is second is third and np.hypot(*first[:2]) > np.hypot(*fourth[:2]) > 10.0


def test_a_fit_keeps_the_time_of_its_own_peak():
    """Two sensors that the vehicle passes later measure a stronger field, so later fits have a
    later peak."""
    network = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0], [12.0, -3.5, 0.0], [12.0, 3.5, 0.0]])
    path = np.where(np.arange(10) == 3, 8.0, np.where(np.arange(10) == 4, 0.0, STRAIGHT))
    check, distances, peaks = CrossCheck(network), [], set()
    for frame in steady_frames(np.random.default_rng(3), network, path, until_s=4.0):
        state = state_at(frame.stamp_ns / 1e9, path)
        check.add(frame, state)
        assert check.doubts(0.0) == set()
        distances.append(np.hypot(*check.difference[:2]))
        if check.latest is not None:
            peaks.add(check.latest.stamp_ns)
    print(f'largest difference {max(distances):.2f} m')
    assert len(peaks) > 1 and max(distances) < 1.5


def test_a_pass_that_begins_at_its_peak_has_no_difference():
    check = CrossCheck(ROAD)
    late = [f for f in steady_frames(np.random.default_rng(2), until_s=3.0) if f.stamp_ns > 3e8]
    assert not any(found for _, found, _ in run_check(check, late))
    assert len(check.latest.straight_paths) and not check.difference.any()


def test_the_difference_is_included_in_published_covariances(monkeypatch):
    """The difference of each state is patched to five metres along x."""
    difference = np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    monkeypatch.setattr(RigidPass, 'difference', lambda *_: difference)
    world = simulated_world('a car', 'clouds', 0)
    records, _ = records_of(world.readings, world.network, **LINEARISED_ONCE)
    for kind, fraction in ((Track, 0.3), (SmoothedPose, 1.0)):
        std = np.array([np.sqrt(r.covariance[0, 0]) for r in records if isinstance(r, kind)])
        print(f'{kind.__name__}: {std.round(1)} m')
        assert np.mean(std > 5.0 - 1e-6) >= fraction
    # Poses before the pass do not include the difference.
    assert std.size and min(np.sqrt(r.covariance[0, 0]) for r in records
                            if isinstance(r, Track)) < 2.0
    without, _ = records_of(world.readings, world.network, **{'track.cross_check': False})
    assert not any(r.covariance[0, 0] > 24.0 for r in without if isinstance(r, SmoothedPose))
