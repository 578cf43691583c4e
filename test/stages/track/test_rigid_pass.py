"""Fit of a steady path to a whole pass: clock offsets, misfits and differences from tracks."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.physics.passes import N_PATH
from mag_tracking.stages.track import pass_samples
from mag_tracking.stages.track.pass_samples import MODEL_ERROR, fit_rigid_pass
from mag_tracking.units import NS
from support.steady_frames import FOUR, ROAD, STRAIGHT, TURNS, state_at, steady_frames


def fit_of(frames, network=ROAD, path=STRAIGHT):
    """`RigidPass` fitted from a start with errors of half a metre and a tenth of the speed."""
    c, s = np.cos(path[4]), np.sin(path[4])
    start = np.array([path[0] + 0.5, path[1], 0.5, 0.9 * path[3] * c, 0.9 * path[3] * s, 0.0])
    return fit_rigid_pass(network, frames, 0, start[None])


@pytest.mark.parametrize('offset', [0.0, 0.1, -0.2, 0.35])
def test_the_clock_offset_of_the_other_sensor_is_found(offset):
    """The error is within three standard deviations, which include a model error that is absent
    here."""
    fit = fit_of(steady_frames(np.random.default_rng(1), clocks=(offset,)))
    # The second sensor has the stronger field, so it is the reference of the clocks.
    assert fit.reference == 1
    assert abs(fit.offset[0] + offset) < 3.0 * fit.offset_std[0] < 0.1
    assert fit.is_explained and fit.needs_clock_offsets is (offset != 0.0)


def test_offsets_have_the_sign_of_a_clock_that_is_ahead():
    for nearer, sign in ((1.0, -1.0), (-1.0, 1.0)):
        path = np.where(np.arange(N_PATH) == 1, nearer, STRAIGHT)
        fit = fit_of(steady_frames(np.random.default_rng(1), path=path, clocks=(0.1,)), path=path)
        assert fit.reference == (1 if nearer > 0.0 else 0)
        assert np.nansum(fit.offset) == pytest.approx(0.1 * sign, abs=0.03)


def test_standard_deviations_of_clock_offsets_cover_their_errors():
    """The data contain noise but no model error, so the standard deviations are too large."""
    rng = np.random.default_rng(2)
    z = []
    for _ in range(30):
        fit = fit_of(steady_frames(rng))
        z.append(np.nansum(fit.offset) / np.nansum(fit.offset_std))
    print(f'mean squared error of the clock, in variances: {np.mean(np.square(z)):.2f}')
    # A chi-square variable with 30 degrees of freedom exceeds this limit once in two hundred times.
    assert np.mean(np.square(z)) < 1.8


def test_several_clocks_are_compared_despite_a_dead_axis():
    def dead(B):
        B = B.copy()
        B[:, 2, 1] = np.nan
        return B

    fit = fit_of(steady_frames(np.random.default_rng(3), FOUR, clocks=(0.0, 0.15, 0.0),
                               change=dead), FOUR)
    offsets = fit.offset - fit.offset[0]
    np.testing.assert_allclose(offsets, [0.0, 0.0, 0.15, 0.0], atol=0.02)
    assert fit.needs_clock_offsets


def test_a_turn_is_not_a_clock_offset():
    fit = fit_of(steady_frames(np.random.default_rng(4), path=TURNS), path=TURNS)
    assert not fit.needs_clock_offsets and not fit.is_straight
    assert fit.misfit < 1.2


@pytest.mark.parametrize('change', [
    lambda B: np.clip(B, -0.3 * np.abs(B).max(), 0.3 * np.abs(B).max()),
    lambda B: B + np.roll(B, 9, axis=0)[:, ::-1],
    lambda B: B * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])])
def test_no_steady_path_explains_a_faulty_field(change):
    """The fields are: a clipped field, a second vehicle in the other lane, and a flipped axis."""
    fit = fit_of(steady_frames(np.random.default_rng(5), change=change))
    assert fit.misfit > 1.5 and not fit.needs_clock_offsets


def test_a_model_error_of_the_assumed_magnitude_is_accepted():
    rng = np.random.default_rng(6)
    fit = fit_of(steady_frames(rng, change=lambda B: B * (1.0 + MODEL_ERROR * rng.standard_normal(
        B.shape))))
    assert fit.misfit < 1.3 and not fit.needs_clock_offsets


@pytest.mark.parametrize('change', [
    lambda B: np.where(np.arange(2)[:, None] == 0, np.nan, B),
    lambda B: np.full_like(B, np.nan)])
def test_a_fit_needs_two_sensors_and_enough_frames(change):
    assert fit_of(steady_frames(np.random.default_rng(7), change=change)) is None
    assert fit_of(steady_frames(np.random.default_rng(7))[:4]) is None


def test_the_cpa_is_that_of_the_nearest_sensor():
    fit = fit_of(steady_frames(np.random.default_rng(8)))
    distances = np.linalg.norm(fit.closest(ROAD.positions) - ROAD.positions, axis=1)
    assert distances.min() == pytest.approx(3.5, abs=0.2)
    assert fit.speed == pytest.approx(20.0, rel=0.1)


def test_the_difference_from_the_nearest_path_is_horizontal():
    fit = replace(fit_of(steady_frames(np.random.default_rng(9))), straight_paths=np.array(
        [[0.0, 1.0, 0.5, 10.0, 0.0, 0.1], [0.0, 5.0, 0.5, 20.0, 0.0, 0.1]]))
    state = np.array([21.0, 2.0, 3.0, 11.0, 0.5, 0.0])
    np.testing.assert_allclose(fit.difference(2 * NS, state), [1.0, 1.0, 0.0, 1.0, 0.5, 0.0])
    np.testing.assert_allclose(fit.difference(NS, state), [1.0, -3.0, 0.0, -9.0, 0.5, 0.0])
    assert not replace(fit, straight_paths=np.zeros((0, 6))).difference(2 * NS, state).any()


def test_paths_that_explain_a_pass_are_near_the_true_path():
    fit = fit_of(steady_frames(np.random.default_rng(9)))
    assert len(fit.straight_paths) == 2
    for x in fit.straight_paths:
        assert np.hypot(*(x - state_at(0.0))[:2]) < 0.5
        assert np.hypot(*(x - state_at(0.0))[3:5]) < 1.0
    # No straight path explains a turning vehicle.
    assert not len(fit_of(steady_frames(np.random.default_rng(4), path=TURNS),
                          path=TURNS).straight_paths)


@pytest.mark.parametrize('limit, value', [('MAX_DISTANCE', 3.0), ('MAX_SPEED', 15.0)])
def test_paths_that_are_too_far_or_too_fast_are_rejected(monkeypatch, limit, value):
    """The vehicle passes one sensor at 3.5 m and the other at 5.5 m, at 20 m/s."""
    monkeypatch.setattr(pass_samples, limit, value)
    fit = fit_of(steady_frames(np.random.default_rng(9)))
    assert fit.misfit < 1.3 and not len(fit.straight_paths)


def test_a_path_near_one_sensor_is_accepted(monkeypatch):
    monkeypatch.setattr(pass_samples, 'MAX_DISTANCE', 4.5)
    assert len(fit_of(steady_frames(np.random.default_rng(9))).straight_paths) == 2
