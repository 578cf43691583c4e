"""Offsets of clocks, folded over passes."""

import numpy as np
import pytest

from mag_tracking.stages.track.clock_evidence import MEMORY, ClockEvidence
from mag_tracking.stages.track.rigid_pass import RigidPass

TWO = np.arange(2)


def a_pass(offset, std=0.02, speed=15.0, misfit=1.0, reference=0, bent=100.0):
    """Of two sensors, or of as many as `offset` has numbers."""
    offsets = np.insert(np.atleast_1d(offset).astype(float), reference, 0.0)
    stds = np.where(np.arange(len(offsets)) == reference, 0.0, std)
    return RigidPass(100.0, bent, 100.0 * misfit, 100, 1.0, reference, offsets, stds, np.zeros(3),
                     np.array([speed, 0.0, 0.0]))


def evidence(passes, rows=TWO, n_sensors=2):
    clocks = ClockEvidence(n_sensors)
    for one in passes:
        clocks.add(one, rows)
    return clocks


def test_passes_that_agree_name_the_clock_that_is_ahead():
    clocks = evidence([a_pass(0.1)] * 4)
    assert (clocks.apart.ahead, clocks.apart.behind, clocks.apart.n_passes) == (1, 0, 4)
    assert clocks.apart.offset_s == pytest.approx(0.1, rel=1e-6) and clocks.apart_s > 0.0
    text = clocks.apart.text(('left', 'right'))
    assert 'right seems 100 ms ahead of that of left' in text and '4 passes' in text
    assert 'clock_offset of right: 0.100 more' in text
    # Seen from the other sensor.
    assert evidence([a_pass(-0.1, reference=1)] * 4).apart.ahead == 1


def test_offsets_as_large_as_their_deviations_name_none():
    """In one of a thousand networks at most, where the deviations are true."""
    rng = np.random.default_rng(1)
    std = float(np.hypot(0.02, 0.5 / 15.0))
    named = sum(evidence([a_pass(std * rng.standard_normal()) for _ in range(10)]).apart is not None
                for _ in range(300))
    assert named <= 1


def test_a_single_pass_names_but_does_not_doubt_later_tracks():
    clocks = evidence([a_pass(0.3)])
    assert clocks.apart is not None and clocks.apart_s == 0.0
    assert 'one pass' in clocks.apart.text(('left', 'right'))


def test_an_offset_that_moves_a_target_by_less_than_a_metre_is_none():
    assert evidence([a_pass(0.05)] * 100).apart is None
    assert evidence([a_pass(0.05, speed=30.0)] * 100).apart is not None


@pytest.mark.parametrize('no_clock', [{'misfit': 2.0}, {'bent': 10.0}, {'speed': 1.0}])
def test_a_pass_of_no_straight_or_of_a_slow_path_says_nothing(no_clock):
    assert evidence([a_pass(0.4, **no_clock)] * 5).apart is None


def test_clocks_that_were_set_are_believed_after_some_passes():
    clocks = evidence([a_pass(0.2)] * 50)
    n = 0
    while clocks.apart is not None:
        clocks.add(a_pass(0.0), TWO)
        n += 1
    print(f'{n} passes after the clocks were set')
    assert n < 2 * MEMORY


def test_clocks_are_compared_over_sensors_that_never_felt_the_same_vehicle():
    """Between the first and the second, and the second and the third; the third is ahead."""
    clocks = ClockEvidence(3)
    for _ in range(5):
        clocks.add(a_pass(0.0), np.array([0, 1]))
        clocks.add(a_pass(0.2), np.array([1, 2]))
    assert clocks.apart.ahead == 2
