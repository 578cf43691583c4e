"""Units and time constants: internal quantities are in SI units, timestamps in integer nanoseconds.

Tables, drivers files and device lines use the unit names of this module.
"""

import math
import re
import unicodedata
from fractions import Fraction

from mag_tracking.errors import SettingsError

NS = 1_000_000_000
"""Nanoseconds per second."""
NEVER = -2**63
"""Timestamp of an event that has not happened: the smallest int64 [ns]."""
LATEST_NS = 2**31 * NS
"""Upper bound of the timestamps in ROS headers [ns]. Differences of timestamps between -LATEST_NS
and LATEST_NS fit into int64, and no such timestamp equals `NEVER`."""
FIELD_UNITS = {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7}
"""Tesla per unit."""
TIME_UNITS = {'s': NS, 'ms': 10**6, 'us': 10**3, 'ns': 1, 'min': 60 * NS, 'h': 3600 * NS,
              'd': 86400 * NS}
"""Nanoseconds per unit."""
MAX_SCALE = 100.0
"""[T per count] A larger number is meant as counts per unit."""
_FIELD_NAMES = {
    'T': 't tesla teslas', 'mT': 'mt millitesla', 'uT': 'ut mut microtesla',
    'nT': 'nt nanotesla gamma gammas \u03b3',
    'G': 'g ga gs gauss', 'mG': 'mg mga mgs mgauss milligauss'}
_TIME_NAMES = {
    's': 's sec secs second seconds', 'ms': 'ms msec msecs milli millis millisecond milliseconds',
    'us': 'us mus usec usecs micros microsecond microseconds',
    'ns': 'ns nsec nsecs nanos nanosec nanosecond nanoseconds', 'min': 'min minute minutes',
    'h': 'h hour hours', 'd': 'd day days'}
_FIELD_OF, _TIME_OF = ({name: unit for unit, names in table.items() for name in names.split()}
                       for table in (_FIELD_NAMES, _TIME_NAMES))
_NUMBER = r'([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)'
_COUNT = r'(?:counts?|lsb|digits?|ticks?)'
_PER_UNIT = re.compile(rf'{_NUMBER}\s*{_COUNT}?\s*(?:/|\bper\b)\s*(\S+)', re.IGNORECASE).fullmatch
_PER_COUNT = re.compile(rf'([+-]?){_NUMBER}\s*([^\s/0-9.]+)(?:\s*(?:/|\bper\b)\s*{_COUNT})?',
                        re.IGNORECASE).fullmatch


def field_unit(text: str) -> str | None:
    """Key of `FIELD_UNITS` that a text names in any usual spelling ('µT', 'uT', '[nT]',
    'Gauss')."""
    name = _plain_name(text)
    # 'MT' is not millitesla, and 'MG' is not milligauss.
    return None if name[:1] == 'M' and len(name) == 2 else _FIELD_OF.get(name.lower())


def time_unit(text: str) -> str | None:
    """Key of `TIME_UNITS` that a text names in any usual spelling, such as 'ms', 'millis' or
    'µs'."""
    return _TIME_OF.get(_plain_name(text).lower())


def unit_since_1970(value: float) -> str | None:
    """Unit ('s', 'ms', 'us' or 'ns') in which a number is a time of this century since 1970."""
    return next((unit for unit in ('s', 'ms', 'us', 'ns')
                 if 9e8 <= value * TIME_UNITS[unit] / NS <= LATEST_NS / NS), None)


def _plain_name(text: str) -> str:
    """Remove brackets and white space from the name of a unit, and write the micro sign as u."""
    # The first replacement repairs UTF-8 that was decoded as Latin-1.
    text = unicodedata.normalize('NFKC', text.replace('\u00c2\u00b5', '\u00b5'))
    return re.sub(r'[\s()\[\]<>{}_-]', '', text).replace('\u03bc', 'u')


def field_scale(text: str, name: str = 'unit') -> float:
    """Convert the unit of a field to tesla; `name` is the setting in the error message.

    The text is a unit such as 'uT', counts per unit such as '1090/G', unit per count such as '0.15
    uT', or tesla per count such as '1.5e-8'. Raises SettingsError if it is neither a unit nor a
    number other than 0, or exceeds `MAX_SCALE`.
    """
    text = text.strip()
    if unit := field_unit(text):
        return FIELD_UNITS[unit]
    scale = math.nan
    if (match := _PER_UNIT(text)) and (unit := field_unit(match[2])) and float(match[1]):
        scale = FIELD_UNITS[unit] / float(match[1])
    elif (match := _PER_COUNT(text)) and (unit := field_unit(match[3])):
        scale = float(match[1] + match[2]) * FIELD_UNITS[unit]
    else:
        try:
            scale = float(text)
        except ValueError:
            pass
    if not math.isfinite(scale) or scale == 0.0:
        raise SettingsError(f'{name}: {text!r} is neither one of {", ".join(FIELD_UNITS)}, nor a '
                            'number of counts per unit such as 1090/G, nor a number other than 0 '
                            '(tesla per count)')
    if abs(scale) > MAX_SCALE:
        raise SettingsError(f'{name}: {text} means {scale:g} tesla per count; for {text} counts '
                            f'per gauss, write {text}/G')
    return scale


def time_scale(text: str, name: str = 'time unit') -> Fraction:
    """Convert a unit of time to nanoseconds; `name` is the setting in the error message.

    The text is a unit such as 'ms', ticks per unit such as '32768/s', or seconds per tick such as
    '1e-4'. Raises SettingsError if it is neither a unit nor a positive number.
    """
    text = text.strip()
    if unit := time_unit(text):
        return Fraction(TIME_UNITS[unit])
    try:
        if (match := _PER_UNIT(text)) and (unit := time_unit(match[2])):
            return TIME_UNITS[unit] / Fraction(match[1])
        scale = Fraction(text) * NS
    except (ValueError, ZeroDivisionError):
        scale = Fraction(0)
    if scale <= 0:
        raise SettingsError(f'{name}: expected one of {", ".join(TIME_UNITS)}, ticks per unit such '
                            f'as 32768/s, or seconds per tick, got {text!r}')
    return scale
