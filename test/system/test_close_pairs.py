"""Two coarse sensors half a metre apart: speed and direction by fit, delay and track.

The whole row of 40 passes is a study; `make test` has a few.
"""

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.align.frame_period import frame_period
from mag_tracking.stages.align.settings import AlignSettings
from support.close_pairs import PAIR, answers, readings_of

SEEDS = range(40)


def counts(found):
    """(n, right direction, speed within 10 %, within three deviations) of [(truth, answer)]."""
    v = np.array([truth for truth, _ in found])
    answer, std = np.array([a for _, a in found]).T
    return (len(v), int((answer * v > 0).sum()), int((np.abs(answer / v - 1.0) < 0.1).sum()),
            int((np.abs(answer - v) <= 3.0 * std).sum()))


def delay_of(a):
    """The answer of the delay, as the others."""
    along = np.cos(a.delay.heading)
    return a.delay.speed * along, a.delay.speed_std


@pytest.mark.study
def test_speed_and_direction_of_forty_passes():
    """Aims: direction 40 of 40; speed within 10 %; error within three deviations in 95 %."""
    all_of = [answers(seed) for seed in SEEDS]
    rows = {'fit': [(a.truth, a.fit) for a in all_of if a.fit is not None],
            'delay': [(a.truth, delay_of(a)) for a in all_of if not a.delay.reason],
            'track': [(a.truth, a.track) for a in all_of if a.track is not None],
            'smoothed': [(a.truth, a.smoothed) for a in all_of if a.smoothed is not None]}
    found = {name: counts(row) for name, row in rows.items()}
    for name, (n, right, near, honest) in found.items():
        print(f'close pair, {name}: {n} of 40 answer; direction right {right}, speed within 10 % '
              f'{near}, within three deviations {honest}')
    for name in ('fit', 'delay'):
        n, right, _, honest = found[name]
        assert n >= 36 and right == n and honest >= 0.95 * n
    # Two sensors at one place hardly tell range and size.
    assert all(a.ambiguous for a in all_of if a.track is not None)


@pytest.mark.study
@pytest.mark.xfail(strict=True, reason='unknown; perhaps because the filter takes the errors of '
                   'its model at the two sensors for independent')
def test_the_track_of_a_close_pair_knows_its_speed():
    """Aims as above, for the filtered and the smoothed track."""
    found = [answers(seed) for seed in SEEDS]
    for name in ('track', 'smoothed'):
        n, _, near, honest = counts([(a.truth, getattr(a, name)) for a in found])
        assert near >= 0.9 * n and honest >= 0.95 * n


@pytest.mark.parametrize('seed', [2, 9, 20])
def test_a_few_passes(seed):
    a = answers(seed)
    for answer, std in (a.fit, delay_of(a)):
        assert abs(answer / a.truth - 1.0) < 0.1 and abs(answer - a.truth) <= 3.0 * std
    assert a.track[0] * a.truth > 0.0


def test_frames_are_shorter_than_the_delay():
    assert frame_period(AlignSettings(), PAIR) == 0.02


def test_a_glitch_while_an_axis_rests_is_no_step_of_it():
    """A glitch of 98 microtesla was taken for the step of an axis that had not changed yet."""
    readings, *_ = readings_of(10)
    pipeline = Pipeline(PAIR, settings_for('vehicle'))
    frames = [r for r in pipeline.feed(readings) + pipeline.flush() if hasattr(r, 'n_samples')]
    C = np.einsum('kjii->kji', np.array([f.covariance for f in frames]))
    known = np.isfinite(C)
    assert known.mean() > 0.9 and (C[known] > 0.0).all()
    # 1 microtesla over the root of 12, and a rest of 0.3 s at 200 Hz counts as one reading.
    assert np.sqrt(C[known].max()) < 3.0 * np.sqrt(60.0 / 12.0) * 1e-6
