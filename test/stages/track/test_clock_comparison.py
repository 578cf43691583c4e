"""Clock comparison: clock offsets estimated from several passes."""

import numpy as np
import pytest

from mag_tracking.stages.track.cross_check import MEMORY_PASSES, ClockComparison
from mag_tracking.stages.track.pass_samples import RigidPass

FIRST_TWO = np.arange(2)


def rigid_pass_of(offset, std=0.02, speed=15.0, misfit=1.0, reference=0,
                  bent_cost=100.0):
    """`RigidPass` with these clock offsets [s] relative to the sensor `reference`.

    `offset` has no entry for the reference.
    """
    offsets = np.insert(np.atleast_1d(offset).astype(float), reference, 0.0)
    stds = np.where(np.arange(len(offsets)) == reference, 0.0, std)
    return RigidPass(0, 100.0, bent_cost, 100.0 * misfit, 100, 1.0, reference, offsets, stds,
                     np.zeros(3), np.array([speed, 0.0, 0.0]), np.zeros((0, 6)))


def comparison_of(passes, rows=FIRST_TWO, n_sensors=2):
    clocks = ClockComparison(n_sensors)
    for rigid_pass in passes:
        clocks.add(rigid_pass, rows)
    return clocks


def test_consistent_passes_identify_the_clock_that_is_ahead():
    clocks = comparison_of([rigid_pass_of(0.1)] * 4)
    largest = clocks.largest_offset
    assert (largest.sensor, largest.reference, largest.n_passes) == (1, 0, 4)
    assert clocks.largest_offset.offset_s == pytest.approx(0.1, rel=1e-6)
    assert clocks.largest_offset_s(FIRST_TWO) == pytest.approx(0.1, rel=1e-6)
    text = clocks.largest_offset.text(('left', 'right'))
    assert 'right is 100 ms' in text and '4 passes' in text
    assert 'right by 0.100 s' in text
    # The result is the same with the other sensor as the reference.
    assert comparison_of([rigid_pass_of(-0.1, reference=1)] * 4).largest_offset.sensor == 1


@pytest.mark.parametrize('offset, message', [(-0.2, 'behind the'),
                                             (0.2, 'ahead of')])
def test_the_wrong_clock_of_several_is_identified(offset, message):
    """Each sensor is the reference of the passes once."""
    for reference in range(4):
        true = np.array([0.0, 0.0, offset, 0.0])
        rigid_pass = rigid_pass_of(np.delete(true - true[reference], reference),
                                   reference=reference)
        clocks = comparison_of([rigid_pass] * 3, np.arange(4), 4)
        assert clocks.largest_offset.sensor == 2 and clocks.largest_offset.reference is None
        assert clocks.largest_offset.offset_s == pytest.approx(offset, abs=0.01)
        assert message in clocks.largest_offset.text('abcd')
        assert clocks.largest_offset_s(np.arange(4)) == pytest.approx(0.2, abs=0.01)


def test_offsets_within_their_standard_deviations_identify_no_clock():
    """At 60 m/s, all of these offsets move a vehicle by more than a metre, but offsets above four
    standard deviations are rare."""
    rng = np.random.default_rng(1)
    std = float(np.hypot(0.05, 0.5 / 60.0))
    n_identified = sum(
        comparison_of([rigid_pass_of(std * rng.standard_normal(), std=0.05, speed=60.0)
                       for _ in range(4)]).largest_offset is not None for _ in range(300))
    assert n_identified <= 1
    # Offsets that are four times as large identify a clock.
    assert sum(comparison_of([rigid_pass_of(4.0 * std * rng.standard_normal(), std=0.05, speed=60.0)
                              for _ in range(4)]).largest_offset is not None
               for _ in range(100)) > 10


def test_a_single_pass_identifies_a_clock_but_does_not_flag_later_tracks():
    clocks = comparison_of([rigid_pass_of(0.3)])
    assert clocks.largest_offset is not None and clocks.largest_offset_s(FIRST_TWO) == 0.0
    assert 'one pass' in clocks.largest_offset.text(('left', 'right'))


def test_passes_of_other_sensors_do_not_count_for_a_clock():
    """Ten passes compare the first two clocks. One or two passes compare the next two clocks, which
    differ."""
    clocks = comparison_of([rigid_pass_of(0.0)] * 10, FIRST_TWO, 4)
    clocks.add(rigid_pass_of(0.3), np.array([2, 3]))
    assert clocks.largest_offset_s(np.arange(4)) == 0.0
    clocks.add(rigid_pass_of(0.3), np.array([2, 3]))
    assert clocks.largest_offset_s(np.arange(4)) > 0.2
    assert clocks.largest_offset_s(FIRST_TWO) == 0.0


def test_an_offset_that_moves_a_target_by_less_than_a_metre_is_ignored():
    assert comparison_of([rigid_pass_of(0.05)] * 100).largest_offset is None
    assert comparison_of([rigid_pass_of(0.05, speed=30.0)] * 100).largest_offset is not None
    # A small offset does not hide a larger offset of another sensor.
    clocks = comparison_of([rigid_pass_of([0.05, 0.2])] * 100, np.arange(3), 3)
    assert clocks.largest_offset.sensor == 2


@pytest.mark.parametrize('changes', [{'misfit': 2.0}, {'bent_cost': 10.0}, {'speed': 1.0},
                                     {'offset': 1.9}])
def test_a_bent_slow_or_unexplained_pass_identifies_no_clock(changes):
    assert comparison_of([rigid_pass_of(**{'offset': 0.45, 'std': 0.01, **changes})] * 5
                         ).largest_offset is None


def test_corrected_clocks_are_accepted_after_some_passes():
    clocks = comparison_of([rigid_pass_of(0.2)] * 50)
    n = 0
    while clocks.largest_offset is not None:
        clocks.add(rigid_pass_of(0.0), FIRST_TWO)
        n += 1
    print(f'corrected clocks accepted after {n} passes')
    assert n < MEMORY_PASSES // 2


def test_clocks_of_sensors_without_a_common_pass_are_compared():
    """Some passes compare the first and second sensor, others the second and third. The third clock
    is ahead."""
    clocks = ClockComparison(3)
    for _ in range(5):
        clocks.add(rigid_pass_of(0.0), np.array([0, 1]))
        clocks.add(rigid_pass_of(0.2), np.array([1, 2]))
    assert clocks.largest_offset.sensor == 2
