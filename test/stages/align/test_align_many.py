"""Frames do not depend on how samples are split into batches."""

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.records import Readings
from mag_tracking.settings import replace
from mag_tracking.stages.align import core
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.stages.align.stage import Align
from support.disordered_samples import disorder
from support.networks import line_network
from support.samples import batch, one


@settings(max_examples=100)
@given(st.integers(0, 10 ** 6))
def test_batches_give_the_frames_of_single_samples(seed):
    n, rng = 1 + seed % 6, np.random.default_rng(seed)
    wanted = replace(AlignSettings(), {
        'burst': bool(rng.integers(2)), 'period_s': float(rng.choice([0.01, 0.03, 0.2])),
        'max_wait_s': float(rng.choice([0.02, 0.1, 60.0])),
        'max_clock_jump_s': float(rng.choice([0.0, 0.05, 0.5])),
        'max_buffered': int(rng.choice([2, 5, 33, 10000]))})
    single, many = Align(line_network(n), wanted), Align(line_network(n), wanted)
    frames, held = ([], []), []
    for s in disorder(rng, n):
        frames[0].extend(single.flush() if s is None else single.feed(one(s)))
        if s is not None:
            held.append(s)
        if s is None or rng.uniform() < 0.1:
            frames[1].extend(many.feed(batch(held)))
            held = []
        if s is None:
            frames[1].extend(many.flush())
    assert single.counts == many.counts and len(frames[0]) == len(frames[1])
    for name in ('stamp_ns', 'field', 'covariance', 'n_samples', 'time_offset'):
        a, b = ([getattr(f, name) for f in some] for some in frames)
        np.testing.assert_array_equal(a, b)


def steady(n, n_readings, start=0, without=()):
    """`Readings`, each of all sensors but those in `without`, every 10 ms."""
    names = tuple(f'mag_{j + 1}' for j in range(n))
    there = np.array([j for j in range(n) if j not in without])
    return [Readings(names, there, np.full(len(there), 10**18 + k * 10**7),
                     np.ones((len(there), 3)), np.tile(np.eye(3), (len(there), 1, 1)))
            for k in range(start, start + n_readings)]


class CountedAlignment(core.Alignment):
    """Counts how often it gave which reason, all of them together."""

    reasons: Counter[int] = Counter()

    def hold(self, *arguments):
        reason = super().hold(*arguments)
        self.reasons[reason] += 1
        return reason


def reasons_of(stage, readings):
    """How often compiled code gave which reason."""
    CountedAlignment.reasons.clear()
    for r in readings:
        stage.feed(r)
    return Counter(CountedAlignment.reasons)


def test_a_clock_that_stepped_is_asked_about_for_a_while_only(monkeypatch):
    """A sensor whose clock steps ahead and which then dies; later it comes back."""
    monkeypatch.setattr(core, 'Alignment', CountedAlignment)
    stage = Align(line_network(4), replace(AlignSettings(), {'max_buffered': 40,
                                                             'max_wait_s': 2.0}))
    known = {core.DONE, core.COMPLETE}
    assert set(reasons_of(stage, steady(4, 100))) == known
    ahead = [Readings(('mag_4',), np.array([0]), np.array([10**18 + 10**10 + k]), np.ones((1, 3)),
                      np.eye(3)[None]) for k in range(3)]
    assert reasons_of(stage, ahead)[core.CLOCK_STEP] == 3
    for r in steady(4, 300, 100, without=(3,)):
        stage.feed(r)
    assert set(reasons_of(stage, steady(4, 100, 400, without=(3,)))) == known
    for r in steady(4, 200, 500):
        stage.feed(r)
    assert set(reasons_of(stage, steady(4, 100, 700))) == known
