"""Two sensors of coarse resolution half a metre apart: speed and direction from three methods.

The series of 40 passes is a study; `make test` runs a few of them.
"""

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.align.stage import frame_period
from mag_tracking.stages.settings import AlignSettings
from support.close_pairs import PAIR, estimates_of, readings_of

SEEDS = range(40)


def counts(found):
    """Numbers of (answers, right directions, speeds within 10 %, errors within 3 std).

    `found` is [(true velocity, (velocity, its standard deviation))] [m/s].
    """
    v = np.array([truth for truth, _ in found])
    answer, std = np.array([a for _, a in found]).T
    return (len(v), int((answer * v > 0).sum()), int((np.abs(answer / v - 1.0) < 0.1).sum()),
            int((np.abs(answer - v) <= 3.0 * std).sum()))


def delay_of(a):
    """(velocity along x, its standard deviation) [m/s] from the delay between the sensors."""
    along = np.cos(a.delay.heading)
    return a.delay.speed * along, a.delay.speed_std


@pytest.mark.study
def test_speed_and_direction_of_forty_passes_reach_the_aims():
    """Aims: 36 of 40 passes answered, all directions right, 95 % of the errors within 3 std."""
    passes = [estimates_of(seed) for seed in SEEDS]
    rows = {'fit': [(a.truth, a.fit) for a in passes if a.fit is not None],
            'delay': [(a.truth, delay_of(a)) for a in passes if not a.delay.reason],
            'track': [(a.truth, a.track) for a in passes if a.track is not None],
            'smoothed': [(a.truth, a.smoothed) for a in passes if a.smoothed is not None]}
    found = {name: counts(row) for name, row in rows.items()}
    for name, (n, right, near, consistent) in found.items():
        print(f'close pair, {name}: {n} of 40 answer; direction right {right}, speed within 10 % '
              f'{near}, error within three standard deviations {consistent}')
    for name in ('fit', 'delay'):
        n, right, _, consistent = found[name]
        assert n >= 36 and right == n and consistent >= 0.95 * n
    # Range and moment are hardly observable with two sensors so close to each other.
    assert all(a.ambiguous for a in passes if a.track is not None)


@pytest.mark.study
@pytest.mark.xfail(strict=True, reason='unknown; perhaps because the filter assumes independent '
                   'model errors at the two sensors')
def test_the_speed_of_a_track_at_a_close_pair_reaches_the_aims():
    """Aims, filtered and smoothed: 90 % of the speeds within 10 %, 95 % of the errors within 3
    std."""
    found = [estimates_of(seed) for seed in SEEDS]
    for name in ('track', 'smoothed'):
        n, _, near, consistent = counts([(a.truth, getattr(a, name)) for a in found])
        assert near >= 0.9 * n and consistent >= 0.95 * n


@pytest.mark.parametrize('seed', [2, 9, 20])
def test_speed_and_direction_of_a_few_passes_are_right(seed):
    a = estimates_of(seed)
    for answer, std in (a.fit, delay_of(a)):
        assert abs(answer / a.truth - 1.0) < 0.1 and abs(answer - a.truth) <= 3.0 * std
    assert a.track[0] * a.truth > 0.0


def test_frames_of_a_close_pair_are_shorter_than_its_delay():
    assert frame_period(AlignSettings(), PAIR) == 0.02


def test_a_glitch_on_a_constant_axis_is_not_its_resolution():
    """The first change of the axis is a glitch of 98 uT, which is not taken as the resolution."""
    readings, *_ = readings_of(10)
    pipeline = Pipeline(PAIR, settings_for('vehicle'))
    frames = [r for r in pipeline.feed(readings) + pipeline.flush() if hasattr(r, 'n_samples')]
    C = np.einsum('kjii->kji', np.array([f.covariance for f in frames]))
    known = np.isfinite(C)
    assert known.mean() > 0.9 and (C[known] > 0.0).all()
    # Steps of 1 uT have a noise of 1 uT / sqrt(12); 0.3 s without a change count as one reading.
    assert np.sqrt(C[known].max()) < 3.0 * np.sqrt(60.0 / 12.0) * 1e-6
