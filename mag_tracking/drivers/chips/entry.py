"""Parser of sensor entries in the I2C settings: name:chip:address[@multiplexer.channel][:unit]."""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from mag_tracking.drivers.chips.chip import ChipLocation
from mag_tracking.drivers.chips.circuitpython import UNITS
from mag_tracking.errors import SettingsError
from mag_tracking.units import field_scale

ENTRY = re.compile(r'(?P<name>[^:]+):(?P<chip>[^:]+):0x(?P<address>[0-9a-fA-F]{2})'
                   r'(@0x(?P<multiplexer>[0-9a-fA-F]{2})\.(?P<channel>[0-7]))?(:(?P<unit>[^:]+))?')


class Sensor(NamedTuple):
    """Name, chip and location of a sensor on a bus."""

    name: str
    chip: str
    location: ChipLocation
    scale: float = 1.0
    """[T] Unit of the driver of the chip."""


def parse_sensors(entries: Sequence[str], known: Collection[str]) -> list[Sensor]:
    """Parse the entries name:chip:address[@multiplexer.channel][:unit] of a bus.

    A chip that is not in `known` must be a module.Class. Raises SettingsError if an entry is not
    valid or two conflict.
    """
    sensors = [parse_sensor(entry, known) for entry in entries]
    multiplexers = {s.location.multiplexer for s in sensors} - {None}
    for i, sensor in enumerate(sensors):
        if sensor.location.address in multiplexers:
            raise SettingsError(f'sensors: {sensor.name}: address {sensor.location.address:#04x} '
                                'is used by a multiplexer')
        for other in sensors[:i]:
            if other.name == sensor.name:
                raise SettingsError(f'sensors: {sensor.name} appears twice')
            if _conflict(sensor.location, other.location):
                raise SettingsError(f'sensors: {other.name} and {sensor.name} both answer at '
                                    f'{sensor.location}')
    return sensors


def _conflict(one: ChipLocation, other: ChipLocation) -> bool:
    """Whether both chips would answer one request; a chip directly on the bus always answers."""
    return one.address == other.address and (
        one == other or None in (one.multiplexer, other.multiplexer))


def parse_sensor(entry: str, known: Collection[str]) -> Sensor:
    """Parse one entry, as `parse_sensors` does."""
    match = ENTRY.fullmatch(entry)
    if match is None:
        raise SettingsError('sensors: expected name:chip:0xNN or name:chip:0xNN@0xNN.channel, '
                            f'followed by :unit for a CircuitPython driver, got {entry!r}')
    name, chip = match['name'], match['chip']
    if chip not in known and '.' not in chip:
        raise SettingsError(f'sensors: {name}: chip {chip} is neither one of '
                            f'{", ".join(known)} nor a module.Class')
    address = _parse_address(name, 'address', match['address'], 0x08)
    location = ChipLocation(address)
    if match['multiplexer'] is not None:
        location = ChipLocation(address, _parse_address(
            name, 'multiplexer', match['multiplexer'], 0x70), int(match['channel']))
    if chip in known:
        if match['unit'] is not None:
            raise SettingsError(f'sensors: {name}: the unit of {chip} is known; remove '
                                f':{match["unit"]}')
        return Sensor(name, chip, location)
    unit = match['unit'] or UNITS.get(chip)
    if unit is None:
        raise SettingsError(f'sensors: {name}: the unit of {chip} is not known; add it to the '
                            f'entry, as in {entry}:uT')
    return Sensor(name, chip, location, field_scale(unit, f'sensors: {name}: unit'))


def _parse_address(name: str, role: str, digits: str, lowest: int) -> int:
    """Parse the digits of an address; raises SettingsError if it is not in `lowest` .. 0x77."""
    address = int(digits, 16)
    if not lowest <= address <= 0x77:
        raise SettingsError(f'sensors: {name}: {role} {address:#04x} is outside '
                            f'{lowest:#04x} .. 0x77')
    return address
