"""Whether a field grew as that of a target which comes from afar."""

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.approach import GROWTH_RATIO, SENSED_LEVEL, Approach
from support.situations import made

STD = 1e-8


def frames(sizes):
    """Frames of one sensor whose fields are of these sizes, in deviations of an axis."""
    for k, size in enumerate(sizes):
        field = np.array([[size, 0.0, 0.0]]) * STD * np.sqrt(3.0)
        yield FieldFrame(k, field, np.eye(3)[None] * STD**2, np.ones(1, dtype=np.int64),
                         np.zeros(1))


def is_doubted(sizes):
    approach = Approach()
    return [approach.add(frame) for frame in frames(sizes)]


def test_a_field_that_grows_with_the_cube_of_a_distance_is_not_doubted():
    """At any speed that takes two frames or more from the threshold to ten times as much."""
    for step in (0.02, 0.05, 0.1, 0.2):
        distance = np.arange(2.0, 0.2, -step)
        assert not any(is_doubted(SENSED_LEVEL * GROWTH_RATIO * (0.4 / distance)**3))


@pytest.mark.parametrize('sizes', [
    2.0 * GROWTH_RATIO * SENSED_LEVEL * np.linspace(0.0, 1.0, 30)**2,
    np.concatenate([np.full(10, 0.5), np.linspace(0.5, 40.0, 30)])])
def test_a_field_that_grows_otherwise_is_doubted_once(sizes):
    """From rest beside a sensor; steadily, as a current or a temperature."""
    assert sum(is_doubted(sizes)) == 1


def test_a_jump_is_too_short_to_tell_and_a_fall_is_that_of_a_first_sensor():
    jump = np.where(np.arange(30) < 12, 0.5, 30.0 * SENSED_LEVEL)
    rises = 2.0 * GROWTH_RATIO * SENSED_LEVEL * np.linspace(0.0, 1.0, 30)**2
    falls = np.where(np.arange(30) == 15, 0.5 * rises, rises)
    assert not any(is_doubted(jump)) and not any(is_doubted(falls))


def test_what_begins_loud_or_stays_quiet_says_nothing():
    assert not any(is_doubted(np.linspace(2.0 * SENSED_LEVEL, 30.0 * SENSED_LEVEL, 20)))
    assert not any(is_doubted(np.full(20, 2.0 * SENSED_LEVEL)))


@pytest.mark.parametrize('name, is_expected', [('there at the start, leaves', True),
                                               ('a car', False)])
def test_a_car_that_leaves_its_place_is_doubted_for_it_and_one_that_passes_is_not(
        name, is_expected):
    a_world = made(name, 'clouds', 0)
    pipeline = Pipeline(a_world.network, settings_for('vehicle'))
    poses = [r for r in pipeline.feed(a_world.readings) + pipeline.flush() if isinstance(r, Track)]
    assert poses
    assert (doubts.NOT_SEEN_APPROACHING in poses[-1].doubts) == is_expected
