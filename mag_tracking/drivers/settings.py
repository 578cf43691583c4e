"""Settings common to all drivers, and the units of field and acceleration."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

ACCELERATION_UNITS = {'m/s2': 1.0, 'g': 9.80665, 'mg': 9.80665e-3}
"""Factor from each unit to m/s²."""
STAMPED_BY = ('auto', 'ticks', 'sequence', 'arrival')


@dataclass(frozen=True)
class DriverSettings:
    """Settings common to all drivers."""

    unit: str = param(
        'T', 'Unit of the field: T, mT, uT, nT, G, mG, counts per unit such as 1090/G, or a number '
        '(tesla per count).')
    acceleration_unit: str = param(
        'm/s2', 'Unit of the acceleration: m/s2, g, mg, or a number (m/s^2 per count).')
    stamp_by: str = param(
        'auto', 'Source of the timestamps: ticks (device clock), sequence (sample counter of a '
        'device with a steady rate), arrival (time of arrival at the host), or auto (ticks if the '
        'device sends any, otherwise arrival).')
    sequence_wrap: int = param(
        0, 'Number at which the sequence number returns to 0; 0 if it never does.', '', (0, 2**64))
    retry_s: float = param(
        0.1, 'Delay before a lost device is reopened. It doubles after every failed attempt.', 's',
        (1e-3, 60.0))
    max_retry_s: float = param(
        1.0, 'Maximum delay between two attempts to reopen a device.', 's', (1e-3, 3600.0))
    batch_s: float = param(
        0.0, 'Interval over which readings are collected before they are passed on; the '
        'option `batches` publishes them in one message.', 's', (0.0, 1.0))
    silence_timeout_s: float = param(
        10.0, 'Interval without data after which a device is closed and reopened; 0 disables the '
        'timeout.', 's', (0.0, 86400.0))


def acceleration_scale(unit: str) -> float:
    """Convert a key of `ACCELERATION_UNITS` or a number to m/s² per count; raises SettingsError."""
    if unit in ACCELERATION_UNITS:
        return ACCELERATION_UNITS[unit]
    try:
        scale = float(unit)
    except ValueError:
        scale = float('nan')
    if not np.isfinite(scale) or scale == 0.0:
        raise SettingsError(f'acceleration_unit: {unit!r} is neither a number other than 0 nor '
                            f'one of {", ".join(ACCELERATION_UNITS)}')
    return scale
