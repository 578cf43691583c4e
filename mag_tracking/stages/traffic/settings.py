"""Settings of the traffic statistics."""

from dataclasses import dataclass

from mag_tracking.settings import USER, param


@dataclass(frozen=True)
class VehicleClass:
    """Share, moment and length of a class of vehicles; the defaults are those of cars."""

    name: str
    share: float = param(0.8, 'Prior proportion of the class in the traffic.', '', (1e-9, 1.0))
    moment: float = param(
        440.0, 'Median magnetic moment. TSP14 Table V lists 335 to 581 for cars and 1734 to 1897 '
        'for trucks and buses.', 'A m^2', (1e-6, 1e6))
    moment_spread: float = param(
        0.5, 'Standard deviation of the natural logarithm of the moment.', '', (0.01, 10.0))
    length: float = param(
        3.2, 'Median length of the row of dipoles. TSP14 Table II lists 2.1 to 5.0 for small '
        'vehicles and 9.1 to 11.3 for large ones.', 'm', (0.01, 1000.0))
    length_spread: float = param(
        0.35, 'Standard deviation of the natural logarithm of the length.', '', (0.01, 10.0))


@dataclass(frozen=True)
class LineSettings:
    """Position and direction of a counting line."""

    name: str
    heading_deg: float = param(
        0.0, 'Forward direction of travel across the line, measured anticlockwise from x. The line '
        'is perpendicular to this direction.', 'deg', (-360.0, 360.0), level=USER)
    offset: float = param(
        0.0, 'Distance of the line from the centre of the network, along its heading.', 'm',
        (-10000.0, 10000.0), level=USER)
    half_width: float = param(
        15.0, 'Half the length of the line. Vehicles that pass beyond its ends are not counted.',
        'm', (0.1, 10000.0), level=USER)


@dataclass(frozen=True)
class TrafficSettings:
    """Settings of counting lines, vehicle classes and intervals."""

    interval_s: float = param(
        60.0, 'Length of the summary intervals, which are aligned to UTC.', 's', (1.0, 86400.0),
        level=USER)
    lines: tuple[LineSettings, ...] = param(
        (LineSettings('road'),), 'Names of the counting lines. A vehicle is counted once on each '
        'line that it crosses.', level=USER)
    classes: tuple[VehicleClass, ...] = param(
        (VehicleClass('motorcycle', 0.05, 60.0, 0.7, 1.0, 0.5), VehicleClass('car'),
         VehicleClass('truck', 0.15, 1800.0, 0.4, 10.0, 0.35)),
        'Names of the vehicle classes. A new class has the values of cars where none are given.')
