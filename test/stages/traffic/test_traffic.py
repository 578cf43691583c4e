"""Traffic counting: line crossings, their order, and direction checks."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.errors import SettingsError
from mag_tracking.event_records import TrafficSummary, VehiclePassage
from mag_tracking.physics.dipole import dipole_field
from mag_tracking.stages.traffic.settings import LineSettings, TrafficSettings, VehicleClass
from mag_tracking.stages.traffic.stage import (
    AMBIGUOUS,
    CONTRADICTED,
    EXTRAPOLATED,
    TrackedFrame,
    Traffic,
)
from mag_tracking.units import NS
from support.counters import count_of
from support.passes import network_of
from support.track_records import frame, smoothed_pose, track_pose

NETWORK = network_of([[0.0, -5.0, 0.0], [0.0, 5.0, 0.0]])
STEP = 0.1


def drive(begin_s, end_s, at_s, v=10.0, y=-1.5, **changes):
    """Simulate the track of a vehicle that crosses the line at `at_s` [s]; return {step: [Track]}.

    The last step also contains the record with which the track ends.
    """
    steps = range(round(begin_s / STEP), round(end_s / STEP) + 1)
    out = {k: [track_pose(k * STEP, v * (k * STEP - at_s), y, v, **changes)] for k in steps}
    out[steps[-1]].append(replace(out[steps[-1]][0], ended=True))
    return out


def counted(*drives, settings=None, last_s=30.0, field_at=None, network=NETWORK, first_s=0.0):
    """Feed the tracks of drives to `Traffic`, frame by frame; return (records, `Traffic`)."""
    stage, out = Traffic(network, settings or TrafficSettings()), []
    for k in range(round(first_s / STEP), round(last_s / STEP) + 1):
        field = None if field_at is None else field_at(k * STEP)
        records = [r for d in drives for r in d.get(k, [])]
        out += stage.feed(TrackedFrame(frame(k * STEP, len(network), field), records))
    return out + stage.flush(), stage


def passages(records):
    return [r for r in records if isinstance(r, VehiclePassage)]


def summaries(records):
    return [r for r in records if isinstance(r, TrafficSummary)]


@pytest.mark.parametrize('v', [10.0, -10.0])
def test_a_passage_has_the_time_position_and_speed_of_the_crossing(v):
    (p,) = passages(counted(drive(2.0, 6.0, 4.037, v))[0])
    assert p.stamp_ns == pytest.approx(4.037 * NS, abs=1000) and p.forward == (v > 0)
    assert p.position == pytest.approx([0.0, -1.5, 0.5]) and p.lateral == pytest.approx(-1.5)
    assert p.speed == pytest.approx(10.0) and p.speed_std == pytest.approx(0.1, rel=0.1)
    assert (p.number, p.track_id, p.line, p.vehicle_class) == (1, 1, 'road', 'car')
    assert np.isnan(p.headway) and not p.ambiguous and p.doubts == ()


def test_a_vehicle_that_does_not_cross_is_not_counted():
    beside = drive(2.0, 6.0, 4.0, y=20.0)
    turns = drive(2.0, 6.0, 4.0)
    turns = {k: [replace(r, position=-np.abs(r.position)) for r in rs] for k, rs in turns.items()}
    for car in (beside, turns, drive(2.0, 2.5, 4.0)):
        records, stage = counted(car)
        assert passages(records) == []
        assert count_of(stage.counts, 'no line') == 1


def test_a_crossing_is_extrapolated_over_a_short_time_only():
    for begin, end in ((2.0, 3.5), (4.4, 6.0)):
        (p,) = passages(counted(drive(begin, end, 4.0))[0])
        assert p.stamp_ns == pytest.approx(4.0 * NS, abs=1000) and p.doubts == (EXTRAPOLATED,)
        assert p.ambiguous
    assert passages(counted(drive(5.1, 7.0, 4.0))[0]) == []


def test_a_vehicle_whose_track_is_lost_and_restarted_is_counted_once():
    records, stage = counted(drive(2.0, 4.3, 4.0), drive(4.6, 6.0, 4.1, id=2))
    assert len(passages(records)) == 1
    assert count_of(stage.counts, 'repeated') == 1


def test_a_restarted_track_is_counted_once_after_an_extrapolated_crossing():
    records, stage = counted(drive(2.0, 3.9, 4.1), drive(4.0, 6.0, 4.15, id=2))
    assert len(passages(records)) == 1
    assert count_of(stage.counts, 'repeated') == 1


def test_vehicles_in_two_lanes_are_counted_separately():
    records, _ = counted(drive(2.0, 4.3, 4.0), drive(4.6, 6.0, 4.3, y=4.5, id=2))
    assert [p.track_id for p in passages(records)] == [1, 2]


def test_a_vehicle_that_stops_before_the_line_is_not_extrapolated():
    assert passages(counted(drive(2.0, 3.9, 4.4, 0.5))[0]) == []


@pytest.mark.parametrize('ends', [(6.0, 6.0), (6.0, 5.5), (5.5, 6.0), (7.0, 5.0)])
def test_two_vehicles_that_meet_are_both_counted(ends):
    records, _ = counted(drive(2.0, ends[0], 4.0), drive(2.0, ends[1], 4.2, -12.0, 1.5, id=2),
                         field_at=field_of(1.0))
    assert [(p.track_id, p.forward) for p in passages(records)] == [(1, True), (2, False)]
    # The fields of the two vehicles overlap, so the directions are not checked.
    assert all(np.isnan(p.direction_error) for p in passages(records))


def test_a_passage_is_computed_from_the_smoothed_path():
    car = drive(2.0, 6.0, 4.0)
    car[60] += [smoothed_pose(t, 12.0 * (t - 3.9), v=12.0) for t in np.arange(2.0, 6.0, STEP)]
    (p,) = passages(counted(car)[0])
    assert p.stamp_ns == pytest.approx(3.9 * NS, abs=1000) and p.speed == pytest.approx(12.0)


def test_fixed_lag_poses_are_not_used_as_a_smoothed_path():
    car = drive(2.0, 6.0, 4.0)
    car[60] += [smoothed_pose(t, 12.0 * (t - 3.9), v=12.0, complete=False)
                for t in np.arange(2.0, 6.0, STEP)]
    (p,) = passages(counted(car)[0])
    assert p.stamp_ns == pytest.approx(4.0 * NS, abs=1000) and p.speed == pytest.approx(10.0)


@pytest.mark.parametrize(('at_s', 'speed'), [(4.02, 10.0), (4.08, 11.0)])
def test_a_passage_has_the_speed_of_the_pose_closest_in_time(at_s, speed):
    car = drive(2.0, 6.0, at_s)
    after = {k: [replace(r, velocity=1.1 * r.velocity) for r in rs]
             for k, rs in car.items() if k * STEP > at_s}
    (p,) = passages(counted({**car, **after})[0])
    assert p.speed == pytest.approx(speed)


def test_passages_are_in_order_and_have_headways():
    slow = drive(1.0, 12.0, 8.0, 2.0)
    fast = [drive(3.0, 6.0, 4.0, 20.0, id=2), drive(6.0, 11.0, 7.5, -15.0, id=3)]
    records, _ = counted(slow, *fast)
    found = passages(records)
    assert [p.track_id for p in found] == [2, 3, 1] and [p.number for p in found] == [1, 2, 3]
    assert found[2].headway == pytest.approx(4.0) and np.isnan(found[1].headway)


def test_an_ambiguous_pose_makes_the_passage_ambiguous():
    (p,) = passages(counted(drive(2.0, 6.0, 4.0, ambiguous=True))[0])
    assert p.ambiguous and p.doubts == (AMBIGUOUS,)


def test_several_lines_count_separately():
    settings = TrafficSettings(
        lines=(LineSettings('west', 0.0, -5.0), LineSettings('east', 180.0, -5.0),
               LineSettings('across', 90.0)))
    found = passages(counted(drive(2.0, 6.0, 4.0), settings=settings)[0])
    assert [(p.line, p.forward) for p in found] == [('west', True), ('east', False)]
    assert [p.stamp_ns / NS for p in found] == pytest.approx([3.5, 4.5])


def test_a_restart_at_an_earlier_time_gives_no_negative_headway():
    """The frames end, and the recording starts again at an earlier time."""
    stage, out = Traffic(NETWORK, TrafficSettings()), []
    for shift in (20.0, 0.0):
        car = drive(2.0, 6.0, 4.0, id=1 + int(shift == 0.0))
        for k in range(61):
            records = [replace(r, stamp_ns=r.stamp_ns + round(shift * NS)) for r in car.get(k, [])]
            out += stage.feed(TrackedFrame(frame(shift + k * STEP), records))
        out += stage.feed(TrackedFrame(None, []))
    assert [p.stamp_ns / NS for p in passages(out)] == pytest.approx([24.0, 4.0])
    assert all(np.isnan(p.headway) for p in passages(out))


def test_a_jump_back_in_time_restarts_the_counting():
    stage, out = Traffic(NETWORK, TrafficSettings()), []
    for shift in (1000.0, 0.0):
        car = drive(2.0, 6.0, 4.0, id=1 + int(shift == 0.0))
        for k in range(70):
            records = [replace(r, stamp_ns=r.stamp_ns + round(shift * NS)) for r in car.get(k, [])]
            out += stage.feed(TrackedFrame(frame(shift + k * STEP), records))
    out += stage.flush()
    assert [p.stamp_ns / NS for p in passages(out)] == pytest.approx([1004.0, 4.0])
    assert np.isnan(passages(out)[1].headway) and count_of(stage.counts, 'jumped') == 1


def test_tracks_that_end_without_a_frame_are_counted():
    stage = Traffic(NETWORK, TrafficSettings())
    car = drive(2.0, 6.0, 4.0)
    for k in range(20, 60):
        assert stage.feed(TrackedFrame(frame(k * STEP), car[k])) == []
    ended = [replace(car[59][0], ended=True)]
    assert len(passages(stage.feed(TrackedFrame(None, ended)))) == 1


def field_of(direction):
    """Create the function of time [s] that returns the field of a moving dipole at each sensor.

    The dipole moves along x (`direction` 1) or against it (-1), and crosses the line at 4 s.
    """
    def at(t):
        r = NETWORK.positions - [direction * 10.0 * (t - 4.0), -1.5, 0.2]
        return dipole_field(r, np.array([300.0, 200.0, -300.0])) + 1e-9 * np.sin(50.0 * t)

    return at


def test_the_fields_confirm_or_contradict_a_direction():
    (p,) = passages(counted(drive(2.0, 6.0, 4.0), field_at=field_of(1.0))[0])
    assert p.direction_error < 0.01 and not p.ambiguous
    (p,) = passages(counted(drive(2.0, 6.0, 4.0), field_at=field_of(-1.0))[0])
    assert p.direction_error > 0.99 and p.doubts == (CONTRADICTED,)


def test_a_sensor_in_the_lane_confirms_no_direction():
    network = network_of([[0.0, -1.0, 0.0], [30.0, 5.0, 0.0]])
    settings = TrafficSettings(lines=(LineSettings('road', offset=-15.0),))
    (p,) = passages(counted(drive(2.0, 6.0, 4.0), field_at=field_of(1.0), network=network,
                            settings=settings)[0])
    assert np.isnan(p.direction_error)


def test_a_vertical_axis_alone_confirms_no_direction():
    def at(t):
        field = field_of(1.0)(t)
        field[:, :2] = np.nan
        return field

    (p,) = passages(counted(drive(2.0, 6.0, 4.0), field_at=at)[0])
    assert np.isnan(p.direction_error)


def test_intervals_contain_every_passage_once():
    drives = [drive(begin, begin + 4.0, begin + 2.0, v, id=k)
              for k, (begin, v) in enumerate(((3.0, 10.0), (8.0, -8.0), (16.0, 12.0)), 1)]
    records, _ = counted(*drives, settings=TrafficSettings(interval_s=10.0), last_s=34.0)
    found = summaries(records)
    assert [(s.begin_ns / NS, s.end_ns / NS) for s in found] == [
        (0.0, 10.0), (10.0, 20.0), (20.0, 30.0), (30.0, 40.0)]
    assert [sum(c.count for c in s.counts) for s in found] == [1, 2, 0, 0]
    assert [s.observed_s for s in found] == pytest.approx([10.0, 10.0, 10.0, 4.0])
    forward, backward = found[1].counts
    assert (forward.forward, forward.count, forward.mean_speed) == (True, 1, pytest.approx(12.0))
    assert (backward.forward, backward.mean_speed) == (False, pytest.approx(8.0))
    assert forward.mean_headway == pytest.approx(13.0) and np.isnan(backward.mean_headway)


def test_an_interval_waits_for_tracks_that_began_in_it():
    stage, found = Traffic(NETWORK, TrafficSettings(interval_s=10.0)), {}
    car = drive(5.0, 14.0, 9.0, 2.0)
    for k in range(200):
        for s in summaries(stage.feed(TrackedFrame(frame(k * STEP), car.get(k, [])))):
            found[s.begin_ns] = k, sum(c.count for c in s.counts)
    assert found[0] == (140, 1)


def test_no_interval_is_returned_twice():
    """A crossing may be extrapolated into the previous interval."""
    late = drive(10.5, 14.0, 9.9)
    records, _ = counted(late, settings=TrafficSettings(interval_s=10.0), last_s=40.0)
    found = summaries(records)
    assert [s.begin_ns / NS for s in found] == [0.0, 10.0, 20.0, 30.0, 40.0]
    assert [sum(c.count for c in s.counts) for s in found] == [1, 0, 0, 0, 0]


def test_passages_do_not_wait_indefinitely_for_a_standing_vehicle():
    """The vehicle stops for 400 s while other vehicles pass."""
    stage, n = Traffic(NETWORK, TrafficSettings()), 0
    for k in range(4000):
        records = [track_pose(k * STEP, -8.0, id=99)]
        if k % 100 < 41:
            records += [replace(r, id=k // 100) for r in drive(0.0, 4.0, 2.0)[k % 100]]
            records = [replace(r, stamp_ns=round(k * STEP * NS)) for r in records]
        n += len(passages(stage.feed(TrackedFrame(frame(k * STEP), records))))
    assert 25 <= n < 40


def test_no_intervals_are_returned_for_a_gap_in_the_frames():
    stage, out = Traffic(NETWORK, TrafficSettings(interval_s=10.0)), []
    for t in [*np.arange(0.0, 15.0, STEP), *np.arange(1003.0, 1012.0, STEP)]:
        out += stage.feed(TrackedFrame(frame(t), []))
    out += stage.flush()
    assert [s.begin_ns / NS for s in summaries(out)] == [0.0, 10.0, 1000.0, 1010.0]
    assert summaries(out)[1].observed_s == pytest.approx(5.0, abs=0.2)


def test_magnets_are_not_counted():
    stage = Traffic(NETWORK, TrafficSettings(), counts_vehicles=False)
    assert stage.feed(TrackedFrame(frame(0.0), [])) == stage.flush() == []


def test_the_name_of_vehicles_that_match_no_class_is_refused():
    with pytest.raises(SettingsError, match="'unknown'"):
        Traffic(NETWORK, TrafficSettings(classes=(VehicleClass('unknown'),)))
