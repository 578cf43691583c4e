"""State of each sensor that changes with every reading: one structured array for all sensors.

Compiled code reads and writes it reading by reading, Python block by block.
"""

import numpy as np
from numba import from_dtype

from mag_tracking.arrays import StructArray
from mag_tracking.units import NEVER

RECENT = 8
"""Differences between consecutive readings that a spike is compared with."""
MOST_HELD = 3
"""A spike has at most so many readings; what lasts longer is a step."""

SENSOR = np.dtype([
    # From the network file: clock offset, hard iron, soft iron.
    ('clock_offset_ns', np.int64), ('offset', np.float64, 3), ('has_correction', np.int64),
    ('correction', np.float64, (3, 3)),
    # Background line and noise of one reading, as `background.RunningBackground` has fitted them.
    ('is_ready', np.int64), ('centre', np.float64), ('mean', np.float64, 3),
    ('slope', np.float64, 3), ('horizon', np.float64), ('noise', np.float64, (3, 3)),
    ('noise_std', np.float64, 3),
    # Variance of that line while it is provisional, else 0.
    ('level_variance', np.float64, 3),
    # First and latest timestamp; one that is too far ahead and not confirmed yet; whether a stored
    # background may be restored at the next reading.
    ('first_ns', np.int64), ('last_ns', np.int64), ('unconfirmed_ns', np.int64),
    ('is_restorable', np.int64), ('accepted', np.int64),
    # Repetition: the latest reading, the length of the present run of equal ones, and how often a
    # reading was equal to the one before, or was not.
    ('last', np.float64, 3), ('run', np.int64), ('repeats', np.float64), ('changes', np.float64),
    # Resolution (`resolution`): the latest value of each raw axis, since when it rests on it and
    # for how many readings, how often it stayed the same or changed, its smallest change, and the
    # variance of what the steps add; how many readings a decimated one is of.
    ('raw', np.float64, 3), ('rest_since_ns', np.int64, 3), ('n_rest', np.int64, 3),
    ('n_same', np.int64, 3), ('n_changed', np.int64, 3),
    ('step', np.float64, 3), ('step_variance', np.float64, 3),
    ('n_averaged', np.float64),
    # Covariances of the messages: the latest standard deviations, and how many were overruled.
    ('stated_std', np.float64, 3), ('n_overruled', np.int64),
    # Spikes: the latest reading that passed, the differences before it, and the readings that are
    # held; of those `n_released` have passed and wait for their use.
    ('before_ns', np.int64), ('before', np.float64, 3), ('n_steps', np.int64),
    ('steps', np.float64, (RECENT, 3)), ('n_held', np.int64), ('n_released', np.int64),
    ('held_ns', np.int64, MOST_HELD + 1), ('held_field', np.float64, (MOST_HELD + 1, 3)),
    ('held_steps', np.float64, (MOST_HELD + 1, 3)), ('held_own', np.int64, MOST_HELD + 1),
    ('held_covariance', np.float64, (MOST_HELD + 1, 3, 3)),
    # Blocks: length of a block, by which share the first is longer (NaN: blocks are not staggered,
    # and each is judged at once), when the present one ends, which of the two sums is collected,
    # and whether the other is complete.
    ('length', np.float64), ('phase', np.float64), ('end', np.float64),
    ('now', np.int64), ('is_full', np.int64),
    # Both sums, relative to their first reading; of each pair of axes, over the readings that have
    # both.
    ('n', np.int64, 2), ('time', np.float64, 2), ('origin', np.float64, (2, 3)),
    ('count', np.float64, (2, 3, 3)), ('sum', np.float64, (2, 3, 3)),
    ('product', np.float64, (2, 3, 3)),
])
"""State of one sensor, in [T] and [s], or [ns] where the name says so."""

SENSORS = from_dtype(SENSOR)[::1]
"""numba's type of a (n,) array of SENSOR."""


def new_sensors(n: int) -> StructArray:
    """(n,) SENSOR without any reading."""
    sensors = np.zeros(n, SENSOR)
    for name in ('first_ns', 'last_ns', 'unconfirmed_ns', 'before_ns'):
        sensors[name] = NEVER
    for name in ('last', 'before', 'end', 'noise_std', 'noise', 'raw', 'stated_std'):
        sensors[name] = np.nan
    sensors['step'], sensors['n_averaged'] = np.inf, 1.0
    return sensors
