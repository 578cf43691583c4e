"""Many samples at once give the frames that they give one by one."""

import numpy as np
from conftest import line_network
from hypothesis import given, settings
from hypothesis import strategies as st
from test_align import disorder

from mag_tracking.records import Readings
from mag_tracking.settings import replace
from mag_tracking.stages.align import Align, AlignSettings


@settings(max_examples=100)
@given(st.integers(0, 10 ** 6))
def test_many_at_once_give_the_frames_of_one_by_one(seed):
    n, rng = 1 + seed % 6, np.random.default_rng(seed)
    wanted = replace(AlignSettings(), {
        'burst': bool(rng.integers(2)), 'period_s': float(rng.choice([0.01, 0.03, 0.2])),
        'max_wait_s': float(rng.choice([0.02, 0.1, 60.0])),
        'ahead_s': float(rng.choice([0.0, 0.05, 0.5])),
        'most_pending': int(rng.choice([5, 100, 10000]))})
    one, many, frames, held = *(Align(line_network(n), wanted) for _ in range(2)), ([], []), []
    for s in disorder(rng, n):
        frames[0].extend(one.flush() if s is None else one.feed(s))
        if s is not None:
            held.append(s)
        if s is None or rng.uniform() < 0.1:
            frames[1].extend(many.feed_many(Readings.of(held)))
            held = []
        if s is None:
            frames[1].extend(many.flush())
    assert one.counts == many.counts and len(frames[0]) == len(frames[1])
    for name in ('stamp_ns', 'field', 'covariance', 'n_samples', 'time_offset'):
        a, b = ([getattr(f, name) for f in some] for some in frames)
        np.testing.assert_array_equal(a, b)
