"""Settings of what every driver does, and the units of what a device says."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

FIELD_UNITS = {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7}
"""{unit: tesla}."""
ACCELERATION_UNITS = {'m/s2': 1.0, 'g': 9.80665, 'mg': 9.80665e-3}
"""{unit: m/s^2}."""
STAMPED_BY = ('auto', 'ticks', 'sequence', 'arrival')


@dataclass(frozen=True)
class DriverSettings:
    """Settings of what every driver does."""

    unit: str = param(
        'T', 'Unit of the field: T, mT, uT, nT, G, mG, or the tesla of one count.')
    acceleration_unit: str = param(
        'm/s2', 'Unit of the acceleration: m/s2, g, mg, or the m/s^2 of one count.')
    stamp_by: str = param(
        'auto', 'What a reading is stamped by: ticks, sequence (the count of a device that '
        'measures at a steady rate), arrival, or auto: its ticks if it has any, else arrival.')
    sequence_wrap: int = param(
        0, 'The number at which the count of readings goes back to 0; 0 = never.', '',
        (0, 2**64))
    retry_s: float = param(
        0.1, 'A device that is lost is opened again after so long, twice that the next time, '
        'and so on.', 's', (1e-3, 60.0))
    max_retry_s: float = param(
        1.0, 'It is never waited longer than that.', 's', (1e-3, 3600.0))
    batch_s: float = param(
        0.0, 'Readings are gathered for so long before they go on: with `batches` they are one '
        'message then.', 's', (0.0, 1.0))
    silence_timeout_s: float = param(
        10.0, 'A device of which nothing comes for so long is closed and opened again; 0 = '
        'never.', 's', (0.0, 86400.0))


def scale_of(unit: str, units: Mapping[str, float], name: str) -> float:
    """What one of `unit` is in SI: a name in `units`, or a number.

    Raises SettingsError, which calls the setting `name`.
    """
    if unit in units:
        return units[unit]
    try:
        scale = float(unit)
    except ValueError:
        scale = float('nan')
    if not np.isfinite(scale) or scale == 0.0:
        raise SettingsError(f'{name}: {unit!r} is neither a number nor one of '
                            f'{", ".join(units)}')
    return scale
