"""Sample streams of sensors whose clocks step."""

import numpy as np

from support.samples import MagSample

C = 1.44e-16 * np.eye(3)


def sample(t, j):
    return MagSample(t, f'mag_{j + 1}', np.ones(3), C)


def stream(n, begin, end, step=10, skip=()):
    """List [(index of the sensor, timestamp)] of the samples of `n` sensors with the interval
    `step`."""
    return [(j, t + j) for t in range(begin, end, step) for j in range(n) if j not in skip]


def with_clock_step(arrivals, which, begin, end, by):
    """Copy arrivals; from `begin` to `end`, the clocks of the sensors `which` are ahead by `by`."""
    return [(j, t + by if j in which and begin <= t < end else t) for j, t in arrivals]


def wild(rng, n, length):
    """Generate (sensor, timestamp) with clock steps, dead sensors, time jumps and gaps."""
    offset, t, dead = [0] * n, 0, set()
    for _ in range(length):
        t += int(rng.choice([0, 1, 10, 10, 10, 400, 700, 5000],
                            p=[.1, .2, .2, .2, .2, .05, .04, .01]))
        j = int(rng.integers(n))
        chance = rng.random()
        if chance < 0.02:
            offset[j] = int(rng.choice([0, 0, 600, 1000, 1000, -2000, 50_000]))
        elif chance < 0.03:
            dead = {int(k) for k in np.flatnonzero(rng.random(n) < 0.3)}
        elif chance < 0.04:
            t = int(rng.integers(0, t + 1))
        if j not in dead:
            yield j, t + offset[j]
