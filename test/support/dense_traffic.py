"""Dense traffic that leaves no quiet interval at the beginning of a recording."""

import dataclasses

import numpy as np

from mag_tracking.units import NS
from support.spoilt_runs import recorded


def traffic(gap, begin=0.0, end=np.inf, size=2e-6, seed=0):
    """Create a function t [s] -> field (3,) [T] of random vehicles at intervals of about `gap`
    [s]."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.7, 1.3, 200) * gap) + begin
    times, sizes = times[times < end], size * rng.normal(size=(200, 3))
    return lambda t: (sizes[:len(times)] / (1.0 + ((t - times[:, None]) / 0.25)**2)**2.5).sum(0)


def dense_traffic(seconds):
    """Fault for `support.spoiler` that adds dense traffic to the first `seconds` of a recording."""
    def modify(readings):
        t = (readings.stamp_ns - readings.stamp_ns.min()) / NS
        of = [traffic(1.5, begin=-1.0, end=seconds, seed=j) for j in range(len(readings.names))]
        added = [of[j](s) for j, s in zip(readings.sensor.tolist(), t, strict=True)]
        return dataclasses.replace(readings, field=readings.field + np.array(added))
    return modify


def after_dense_traffic(name, seconds):
    """`Readings` of the bundled recording `name` with dense traffic in the first `seconds`."""
    return dense_traffic(seconds)(recorded(name).readings)
