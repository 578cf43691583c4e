"""Frame period, by default derived from the geometry of the network."""

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE
from mag_tracking.stages.align.settings import AlignSettings

DEFAULT_PERIOD_S = 0.08
"""[s] Default frame period: 12.5 Hz, as in T10 section 6.3 for sensors nine metres apart."""
MIN_AUTO_PERIOD_S = 0.02
"""[s] Minimum automatic frame period. Shorter frames add little information, and at 100 frames per
second tracking occupies a whole core."""
MIN_PERIOD_S = 1e-4
"""[s] Minimum configurable frame period; no sensor has a shorter sample interval."""
MAX_TARGET_SPEED = 20.0
"""[m/s] Frames are designed for targets up to this speed."""


def shortest_delay(network: SensorNetwork) -> tuple[float, str, str] | None:
    """Shortest time [s] in which a target at `MAX_TARGET_SPEED` travels between two sensors, and
    their names; None if all sensors have nearly the same horizontal position."""
    shortest, pair = np.inf, None
    for j, position in enumerate(network.positions):
        distance = np.linalg.norm((network.positions[:j] - position)[:, :2], axis=1)
        distance[distance <= MIN_DELAY_BASELINE] = np.inf
        if distance.min(initial=np.inf) < shortest:
            i = int(np.argmin(distance))
            shortest, pair = float(distance[i]), (network.names[i], network.names[j])
    return None if pair is None else (shortest / MAX_TARGET_SPEED, *pair)


def frame_period(settings: AlignSettings, network: SensorNetwork) -> float:
    """Frame period [s]: the setting, or a period derived from the geometry if the setting is 0.

    A frame that is longer than the delay between two sensors mixes their signals. In a compact
    network, the derived period is therefore half the shortest delay, within `MIN_AUTO_PERIOD_S` and
    `DEFAULT_PERIOD_S`. In a larger network, tracking does not use this delay, and the default
    period saves computing time. In burst mode, the period is the maximum duration of a round.
    Raises SettingsError if the setting is below `MIN_PERIOD_S`.
    """
    if 0.0 < settings.period_s < MIN_PERIOD_S:
        raise SettingsError(f'align.period_s: {settings.period_s:g} s is shorter than the minimum '
                            f'of {MIN_PERIOD_S:g} s; set it to 0 for an automatic period')
    if settings.period_s:
        return settings.period_s
    shortest = shortest_delay(network)
    if settings.burst or shortest is None or not network.is_compact:
        return DEFAULT_PERIOD_S
    return min(DEFAULT_PERIOD_S, max(MIN_AUTO_PERIOD_S, 0.5 * shortest[0]))


def frame_period_warning(settings: AlignSettings, network: SensorNetwork) -> str | None:
    """Warning if the setting exceeds the travel time of a target between two sensors, except in
    burst mode, where a frame is one round of the sensors."""
    shortest, period = shortest_delay(network), frame_period(settings, network)
    if not settings.period_s or settings.burst or shortest is None or period <= shortest[0]:
        return None
    delay, first, second = shortest
    return (f'align.period_s: a frame of {1e3 * period:.0f} ms is longer than the '
            f'{1e3 * delay:.0f} ms that a target at {MAX_TARGET_SPEED:.0f} m/s takes from {first} '
            f'to {second}, which makes speed and direction less accurate; set align.period_s to 0 '
            'for an automatic period')
