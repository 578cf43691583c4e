"""Length of a frame; by default it follows from the geometry of the network."""

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE
from mag_tracking.stages.align.settings import AlignSettings

DEFAULT_PERIOD_S = 0.08
"""[s] T10 section 6.3 decimates to 12.5 Hz, with sensors nine metres apart."""
MIN_AUTO_PERIOD_S = 0.02
"""[s] Shorter frames add little information: at 100 frames per second, tracking occupies a core."""
MIN_PERIOD_S = 1e-4
"""[s] Minimum frame length; no sensor is read more often."""
MAX_TARGET_SPEED = 20.0
"""[m/s] Frames are designed for targets up to this speed."""


def shortest_delay(network: SensorNetwork) -> tuple[float, str, str] | None:
    """Shortest time that a fast target takes between two sensors.

    Parameters
    ----------
    network : SensorNetwork

    Returns
    -------
    (float, str, str) or None
        Delay [s] and the names of the two sensors. None if all sensors are at one place, seen from
        above.
    """
    shortest, found = np.inf, None
    for j, place in enumerate(network.positions):
        distance = np.linalg.norm((network.positions[:j] - place)[:, :2], axis=1)
        distance[distance <= MIN_DELAY_BASELINE] = np.inf
        if distance.min(initial=np.inf) < shortest:
            i = int(np.argmin(distance))
            shortest, found = float(distance[i]), (network.names[i], network.names[j])
    return None if found is None else (shortest / MAX_TARGET_SPEED, *found)


def frame_period(settings: AlignSettings, network: SensorNetwork) -> float:
    """Length of a frame: the setting, or a length that fits the geometry if the setting is 0.

    A frame that is longer than the delay between two sensors mixes their signals. In a close
    network the frame is half as long as that delay. A larger network does not depend on the delay,
    and short frames cost time. With sensors that are read in turn, the period is the maximum length
    of a round.

    Parameters
    ----------
    settings : AlignSettings
    network : SensorNetwork

    Returns
    -------
    float, s

    Raises
    ------
    SettingsError
        If the frame is shorter than any sample interval.
    """
    if 0.0 < settings.period_s < MIN_PERIOD_S:
        raise SettingsError(f'align.period_s: {settings.period_s:g} s is shorter than the minimum '
                            f'of {MIN_PERIOD_S:g} s; set 0 for an automatic period')
    if settings.period_s:
        return settings.period_s
    shortest = shortest_delay(network)
    if settings.burst or shortest is None or not network.is_compact:
        return DEFAULT_PERIOD_S
    return min(DEFAULT_PERIOD_S, max(MIN_AUTO_PERIOD_S, 0.5 * shortest[0]))


def frame_period_warning(settings: AlignSettings, network: SensorNetwork) -> str | None:
    """Warning about a configured frame that is longer than a target takes between two sensors.

    Sensors that are read in turn cause no warning: their frame is one round, however long it takes.

    Parameters
    ----------
    settings : AlignSettings
    network : SensorNetwork

    Returns
    -------
    str or None
    """
    shortest, period = shortest_delay(network), frame_period(settings, network)
    if not settings.period_s or settings.burst or shortest is None or period <= shortest[0]:
        return None
    delay, one, other = shortest
    return (f'align.period_s: a frame of {1e3 * period:.0f} ms is longer than the '
            f'{1e3 * delay:.0f} ms that a target at {MAX_TARGET_SPEED:.0f} m/s takes from {one} to '
            f'{other}; speed and direction are less accurate. Set 0 for an automatic period')
