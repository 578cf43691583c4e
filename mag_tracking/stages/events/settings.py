"""Settings of single-sensor pass events."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class EventsSettings:
    """Settings of single-sensor pass events."""

    max_sensors: int = param(
        4, 'Maximum number of sensors of a network for which detection_node publishes the passes '
        'at each sensor on ~/events. 0 disables ~/events.', '', (0, 1000))
