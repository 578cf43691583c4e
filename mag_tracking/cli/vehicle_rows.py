"""Table of vehicles, as `replay` and `fit` print it: one row per vehicle."""

from datetime import UTC, datetime

import numpy as np

from mag_tracking.units import NS

Estimate = tuple[float, float]
"""Value and standard deviation; NaN if unknown."""
UNKNOWN = (np.nan, np.nan)


def time_of(stamp_ns: float) -> str:
    """Format the time of day of a timestamp (UTC)."""
    time = datetime.fromtimestamp(stamp_ns / NS, tz=UTC)
    return f'{time:%H:%M:%S}.{time.microsecond // 10000:02d}'


def vehicle_row(label: str, time: str, kind: str, direction: str, speed: Estimate,
                closest: Estimate, verdict: str) -> str:
    """Format a row; `closest` is the distance from the centre of the sensors [m]."""
    return _row(label, time, kind, direction, _text(speed), _text(closest), verdict)


def _text(estimate: Estimate) -> str:
    """Format a value and its standard deviation, as far as they are known."""
    value, std = estimate
    return '-' if np.isnan(value) else f'{value:.2f}' if np.isnan(std) else \
        f'{value:.2f} ± {std:.2f}'


def _row(*cells: str) -> str:
    """Align the cells of a row."""
    label, time, kind, direction, speed, closest, verdict = (cell or '-' for cell in cells)
    return (f'  {label:<9}  {time:<11}  {kind:<9}  {direction:<10}  {speed:>14}  {closest:>14}  '
            f'{verdict}')


HEADER = _row('vehicle', 'time', 'kind', 'direction', 'speed [m/s]', 'closest [m]', 'verdict')
"""Header of the table."""
