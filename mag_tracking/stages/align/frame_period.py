"""How long a frame is, where the setting leaves that to the geometry."""

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE
from mag_tracking.stages.align.settings import AlignSettings

USUAL_S = 0.08
"""[s] T10 section 6.3 decimates to 12.5 Hz, with sensors nine metres apart."""
MIN_FRAME_S = 0.02
"""[s] Shorter frames cost more than they tell: tracking takes a core at 100 of them a second."""
MIN_PERIOD_S = 1e-4
"""[s] No sensor is read more often."""
FASTEST = 20.0
"""[m/s] Frames are made for targets up to this speed."""


def shortest_delay(network: SensorNetwork) -> tuple[float, str, str] | None:
    """(delay [s], one sensor, the other), of the two that a fast target passes the soonest.

    None where there are no two places; one above another is one place.
    """
    shortest, found = np.inf, None
    for j, place in enumerate(network.positions):
        distance = np.linalg.norm((network.positions[:j] - place)[:, :2], axis=1)
        distance[distance <= MIN_DELAY_BASELINE] = np.inf
        if distance.min(initial=np.inf) < shortest:
            i = int(np.argmin(distance))
            shortest, found = float(distance[i]), (network.names[i], network.names[j])
    return None if found is None else (shortest / FASTEST, *found)


def frame_period(settings: AlignSettings, network: SensorNetwork) -> float:
    """[s] Length of a frame: as set, or by the geometry where it is set to 0.

    A frame that is longer than the delay between two sensors mixes what both felt. With a close
    network it is half as long as the delay; a larger one does not live on that delay, and short
    frames cost time. Where the sensors are read in turn the period is the longest of a round.

    Raises SettingsError for a frame that is shorter than any reading.
    """
    if 0.0 < settings.period_s < MIN_PERIOD_S:
        raise SettingsError(f'align.period_s: {settings.period_s:g} s is shorter than '
                            f'{MIN_PERIOD_S:g} s; 0 = by the geometry')
    if settings.period_s:
        return settings.period_s
    shortest = shortest_delay(network)
    if settings.burst or shortest is None or not network.is_compact:
        return USUAL_S
    return min(USUAL_S, max(MIN_FRAME_S, 0.5 * shortest[0]))


def too_long(settings: AlignSettings, network: SensorNetwork) -> str | None:
    """A sentence where a frame was set longer than a target needs between two sensors; or None.

    Where the sensors are read in turn a frame is one round of them, whatever it takes.
    """
    shortest, period = shortest_delay(network), frame_period(settings, network)
    if not settings.period_s or settings.burst or shortest is None or period <= shortest[0]:
        return None
    delay, one, other = shortest
    return (f'a frame of {1e3 * period:.0f} ms is longer than the {1e3 * delay:.0f} ms that a '
            f'target of {FASTEST:.0f} m/s needs from {one} to {other}: speed and direction suffer '
            '(align.period_s; 0 = by the geometry)')
