"""Which chip is where, as it stands in the settings: name:chip:address@multiplexer.channel."""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from mag_tracking.drivers.chips.chip import Place
from mag_tracking.errors import SettingsError

ENTRY = re.compile(r'(?P<name>[^:]+):(?P<chip>[^:]+):0x(?P<address>[0-9a-fA-F]{2})'
                   r'(@0x(?P<multiplexer>[0-9a-fA-F]{2})\.(?P<channel>[0-7]))?')


class Sensor(NamedTuple):
    """One entry."""

    name: str
    chip: str
    place: Place


def sensors_of(entries: Sequence[str], known: Collection[str]) -> list[Sensor]:
    """The `Sensor`s of all entries.

    Parameters
    ----------
    entries : sequence of str
    known : collection of str
        Names of chips; every other has to be a module.Class.

    Raises SettingsError for an entry that is none, and for two that exclude each other.
    """
    sensors = [sensor_of(entry, known) for entry in entries]
    multiplexers = {s.place.multiplexer for s in sensors} - {None}
    for i, sensor in enumerate(sensors):
        if sensor.place.address in multiplexers:
            raise SettingsError(f'sensors: {sensor.name}: address {sensor.place.address:#04x} is '
                                'that of a multiplexer')
        for other in sensors[:i]:
            if other.name == sensor.name:
                raise SettingsError(f'sensors: {sensor.name} is there twice')
            if _both_answer(sensor.place, other.place):
                raise SettingsError(f'sensors: {other.name} and {sensor.name} both answer at '
                                    f'{sensor.place}')
    return sensors


def _both_answer(one: Place, other: Place) -> bool:
    """What is on the bus itself also hears what goes through a multiplexer."""
    return one.address == other.address and (
        one == other or None in (one.multiplexer, other.multiplexer))


def sensor_of(entry: str, known: Collection[str]) -> Sensor:
    """The `Sensor` of one entry; raises SettingsError."""
    match = ENTRY.fullmatch(entry)
    if match is None:
        raise SettingsError('sensors: expected name:chip:0xNN or name:chip:0xNN@0xNN.channel, '
                            f'got {entry!r}')
    name, chip = match['name'], match['chip']
    if chip not in known and '.' not in chip:
        raise SettingsError(f'sensors: {name}: chip {chip} is none of {", ".join(known)}, nor a '
                            'module.Class')
    address = _address(name, 'address', match['address'], 0x08)
    if match['multiplexer'] is None:
        return Sensor(name, chip, Place(address))
    multiplexer = _address(name, 'multiplexer', match['multiplexer'], 0x70)
    return Sensor(name, chip, Place(address, multiplexer, int(match['channel'])))


def _address(name: str, what: str, digits: str, lowest: int) -> int:
    """An address from `lowest` on; raises SettingsError."""
    address = int(digits, 16)
    if not lowest <= address <= 0x77:
        raise SettingsError(f'sensors: {name}: {what} {address:#04x} is outside {lowest:#04x} .. '
                            '0x77')
    return address
