"""Samples with random transport faults."""

import numpy as np

from support.samples import MagSample

C = 1.44e-16 * np.eye(3)


def disorder(rng, n):
    """Generate samples of `n` sensors with losses, delays, reordering and invalid axes.

    A yielded None requests a flush.
    """
    arrivals = []
    for j in range(n):
        step, count = rng.choice([10.0, 10.0, 10.0, 31.7]), rng.integers(5, 80)
        t = step * (np.arange(count) + rng.choice([0.0, rng.uniform()]))
        t += rng.choice([0.0, 0.1, 6.0]) * j
        keep = rng.uniform(size=count) > rng.choice([0.0, 0.05, 0.3, 1.0], p=[0.4, 0.4, 0.15, 0.05])
        if rng.uniform() < 0.4:
            keep &= np.abs(t - rng.uniform(0.0, t[-1])) > rng.uniform(0.0, 0.5 * t[-1])
        arrival = t + rng.uniform(0.0, rng.choice([1e-9, 3.0, 30.0, 300.0]), count)
        arrival = np.maximum.accumulate(arrival) if rng.uniform() < 0.8 else arrival
        arrivals += [(a + back, ms, j) for back in [0.0, 900.0][:1 + (rng.uniform() < 0.2)]
                     for a, ms in zip(arrival[keep], t[keep], strict=True)]
    for _, ms, j in sorted(arrivals):
        field = rng.standard_normal(3)
        field[rng.uniform(size=3) < 0.2] = rng.choice([np.nan, np.nan, np.nan, np.inf])
        yield MagSample(round(1e6 * ms), f'mag_{j + 1}', field, rng.uniform() * C)
        if rng.uniform() < 0.01:
            yield None
    yield None
