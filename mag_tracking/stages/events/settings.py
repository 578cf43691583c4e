"""Settings of the events."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class EventsSettings:
    """Settings of the events."""

    max_sensors: int = param(
        4, 'Nodes: in networks of at most so many sensors detection_node describes what passes '
        'each sensor on ~/events; 0 = never.', '', (0, 1000))
