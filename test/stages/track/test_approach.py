"""Approach test: accepted and flagged growth of a field."""

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.plausibility import GROWTH_RATIO, SENSED_LEVEL, Approach
from support.situations import simulated_world

STD = 1e-8


def frames(sizes):
    """Frames of one sensor with fields of these magnitudes, in standard deviations of an axis."""
    for k, size in enumerate(sizes):
        field = np.array([[size, 0.0, 0.0]]) * STD * np.sqrt(3.0)
        yield FieldFrame(k, field, np.eye(3)[None] * STD**2, np.ones(1, dtype=np.int64),
                         np.zeros(1))


def approach_flags(sizes):
    approach = Approach()
    return [approach.add(frame) for frame in frames(sizes)]


def test_a_field_that_grows_with_the_inverse_cube_of_distance_is_accepted():
    """The speed does not matter if the field takes at least two frames to grow tenfold."""
    for step in (0.02, 0.05, 0.1, 0.2):
        distance = np.arange(2.0, 0.2, -step)
        assert not any(approach_flags(SENSED_LEVEL * GROWTH_RATIO * (0.4 / distance)**3))


@pytest.mark.parametrize('sizes', [
    2.0 * GROWTH_RATIO * SENSED_LEVEL * np.linspace(0.0, 1.0, 30)**2,
    np.concatenate([np.full(10, 0.5), np.linspace(0.5, 40.0, 30)])])
def test_a_field_that_grows_differently_is_flagged_once(sizes):
    """The first field belongs to a target that starts next to a sensor. The second field grows
    linearly, like the field of a current or the effect of a temperature change."""
    assert sum(approach_flags(sizes)) == 1


def test_a_sudden_jump_and_an_intermediate_drop_are_accepted():
    jump = np.where(np.arange(30) < 12, 0.5, 30.0 * SENSED_LEVEL)
    rises = 2.0 * GROWTH_RATIO * SENSED_LEVEL * np.linspace(0.0, 1.0, 30)**2
    falls = np.where(np.arange(30) == 15, 0.5 * rises, rises)
    assert not any(approach_flags(jump)) and not any(approach_flags(falls))


def test_a_field_that_starts_large_or_stays_small_is_accepted():
    assert not any(approach_flags(np.linspace(2.0 * SENSED_LEVEL, 30.0 * SENSED_LEVEL, 20)))
    assert not any(approach_flags(np.full(20, 2.0 * SENSED_LEVEL)))


@pytest.mark.parametrize('name, is_expected', [('there at the start, leaves', True),
                                               ('a car', False)])
def test_a_car_that_leaves_its_place_is_flagged_and_a_passing_car_is_not(name, is_expected):
    world = simulated_world(name, 'clouds', 0)
    pipeline = Pipeline(world.network, settings_for('vehicle'))
    poses = [r for r in pipeline.feed(world.readings) + pipeline.flush() if isinstance(r, Track)]
    assert poses
    assert (doubts.NOT_SEEN_APPROACHING in poses[-1].doubts) == is_expected
