"""Bounds: tracks and fits of readings with wrong times or units report no impossible numbers."""

import dataclasses

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.analysis.correlated_motion import correlated_motion
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.physics.bounds import (
    MAX_MOMENT,
    MAX_SPEED,
    REASONS,
    TOO_FAST,
    TOO_ROTATED,
    TOO_STRONG,
    are_possible,
    impossible_reason,
)
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from support.bundled import NETWORK_FILE
from support.spoilt_runs import recorded


def test_states_beyond_the_bounds_have_a_reason():
    x, zero = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    for velocity, moment in ((1.01 * MAX_SPEED * x, zero), (zero, -1.01 * MAX_MOMENT * x),
                             (np.full(3, np.nan), zero)):
        assert impossible_reason(velocity, moment) in REASONS
        assert not are_possible(velocity, moment)
    assert impossible_reason(zero, zero, np.array([[np.nan, np.nan, np.nan], [0.0, -2.0, 0.0]]))
    assert not impossible_reason(0.99 * MAX_SPEED * x, 0.99 * MAX_MOMENT * x, np.zeros((2, 3)))


@pytest.mark.parametrize('bound, value, reason', [
    ('MAX_SPEED', 5.0, TOO_FAST), ('MAX_MOMENT', 100.0, TOO_STRONG),
    ('MAX_MOUNTING', 0.02, TOO_ROTATED)])
def test_a_track_that_becomes_impossible_ends_with_the_reason(monkeypatch, bound, value, reason):
    """The bound is lowered, so that the filter of a car exceeds it."""
    monkeypatch.setattr(f'mag_tracking.physics.bounds.{bound}', value)
    pipeline = Pipeline(mt.read_network(NETWORK_FILE), settings_for('vehicle'))
    records = pipeline.feed(recorded('straight_car_right').readings) + pipeline.flush()
    assert pipeline.track.counts[f'tracks ended: {reason}'] > 0
    for pose in (r for r in records if isinstance(r, Track | SmoothedPose)):
        assert not impossible_reason(pose.velocity, pose.moment, getattr(pose, 'mounting', None))
        if isinstance(pose, Track):
            assert are_possible(pose.hypotheses.states[:, 3:], pose.hypotheses.moments).all()


def test_a_delay_of_an_impossible_speed_gives_the_reason():
    """Two sensors 10 m apart measure the same pulse 20 ms apart: 500 m/s."""
    network = dataclasses.replace(mt.read_network(NETWORK_FILE), positions=np.array(
        [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    t, rng = np.arange(0.0, 4.0, 0.005), np.random.default_rng(1)
    pulses = [1e-6 * np.exp(-0.5 * ((t - 2.0 - lag) / 0.1)**2) for lag in (0.0, 0.02)]
    field = np.concatenate([np.outer(p, [1.0, 0.5, -0.8]) for p in pulses])
    data = PassData(network, 0, np.tile(t, 2), np.repeat([0, 1], len(t)),
                    field + 1e-8 * rng.standard_normal(field.shape),
                    np.tile(1e-16 * np.eye(3), (2 * len(t), 1, 1)))
    motion = correlated_motion(data)
    assert motion.reason.startswith(TOO_FAST) and np.isnan(motion.speed)
