"""Settings of the traffic statistics."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class TrafficSettings:
    """Settings of counting lines, vehicle classes and intervals."""

    line_names: tuple[str, ...] = param(
        ('road',), 'Names of the counting lines. A vehicle is counted once on each line that it '
        'crosses. The other line_* settings have one value per line, in the same order.')
    line_headings_deg: tuple[float, ...] = param(
        (0.0,), 'Forward direction of travel across each line, measured anticlockwise from x. The '
        'line is perpendicular to this direction.', 'deg', (-360.0, 360.0))
    line_offsets: tuple[float, ...] = param(
        (0.0,), 'Distance of each line from the centre of the network, along its heading.',
        'm', (-10000.0, 10000.0))
    line_half_widths: tuple[float, ...] = param(
        (15.0,), 'Half the length of each line. Vehicles that pass beyond its ends are not '
        'counted.', 'm', (0.1, 10000.0))
    interval_s: float = param(
        60.0, 'Length of the summary intervals, which are aligned to UTC.', 's', (1.0, 86400.0))
    class_names: tuple[str, ...] = param(
        ('motorcycle', 'car', 'truck'), 'Names of the vehicle classes. The other class_* '
        'settings have one value per class, in the same order.')
    class_shares: tuple[float, ...] = param(
        (0.05, 0.8, 0.15), 'Prior proportion of each class in the traffic.', '', (1e-9, 1.0))
    class_moments: tuple[float, ...] = param(
        (60.0, 440.0, 1800.0), 'Median magnetic moment of each class. TSP14 Table V lists 335 to '
        '581 for cars and 1734 to 1897 for trucks and buses.', 'A m^2', (1e-6, 1e6))
    class_moment_spreads: tuple[float, ...] = param(
        (0.7, 0.5, 0.4), 'Standard deviation of the natural logarithm of the moment of each class.',
        '', (0.01, 10.0))
    class_lengths: tuple[float, ...] = param(
        (1.0, 3.2, 10.0), 'Median length of the row of dipoles of each class. TSP14 Table II lists '
        '2.1 to 5.0 for small vehicles and 9.1 to 11.3 for large ones.', 'm', (0.01, 1000.0))
    class_length_spreads: tuple[float, ...] = param(
        (0.5, 0.35, 0.35), 'Standard deviation of the natural logarithm of the length of each '
        'class.', '', (0.01, 10.0))


PER_LINE = ('line_headings_deg', 'line_offsets', 'line_half_widths')
"""Settings with one value per line."""
PER_CLASS = ('class_shares', 'class_moments', 'class_moment_spreads', 'class_lengths',
             'class_length_spreads')
"""Settings with one value per class."""
