"""Timestamps as drivers and loggers spoil them: functions of the true times (n,) ns of a sensor."""

import numpy as np

from mag_tracking.units import NS

EPOCH_NS = 1_790_000_000 * NS


def regular(rate, n=256, phase_s=0.0031):
    """True times (n,) [ns] of regular readings."""
    return EPOCH_NS + np.round((np.arange(n) / rate + phase_s) * NS).astype(np.int64)


def coarse(step_s):
    """The clock has steps of `step_s`."""
    step_ns = round(step_s * NS)
    return lambda stamps: stamps // step_ns * step_ns


def packets(n, is_first=False):
    """`n` readings have the timestamp of the last, or the first, of them."""
    def modify(stamps):
        k = np.arange(len(stamps)) // n * n
        return stamps[k if is_first else np.minimum(k + n - 1, len(stamps) - 1)]
    return modify


def bursts(n, spacing_s=1e-4):
    """`n` readings arrive together, and their timestamps are the times of arrival."""
    def modify(stamps):
        return packets(n)(stamps) + np.arange(len(stamps)) % n * round(spacing_s * NS)
    return modify


def nanoseconds_in(unit_s):
    """The nanoseconds of the timestamps are written in another unit."""
    return lambda stamps: stamps // NS * NS + stamps % NS // round(unit_s * NS)
