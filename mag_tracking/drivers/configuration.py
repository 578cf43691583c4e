"""The drivers file: which devices there are, how they speak, and which sensors they carry.

    roadside:
      transport: serial
      serial: {port: /dev/ttyUSB0, baud: 115200}
      framing: text
      text: {fields: [sensor, sequence, ticks, x, y, z], checksum: nmea}
      clock: {tick_s: 1.0e-6, wrap: 4294967296}
      unit: nT
      sensors: {A: mag_1, B: mag_2}

A kind is a name in `KINDS`, or `package.module:Class` of one's own, a class with
an attribute `SETTINGS` and the methods of `reading.Transport`, `Framing` or
`Device`; `CLOCK` and `DRIVER`, mappings of settings, say what is so for every
device of a framing or kind. Its settings stand under its own name, or under `transport_settings`,
`framing_settings`, `device_settings`.
"""

import importlib
import re
from collections.abc import Iterable, Mapping
from os import PathLike
from typing import Any, TypeVar

from mag_tracking.drivers.device_clock import ClockSettings
from mag_tracking.drivers.driver import IGNORED, Driver
from mag_tracking.drivers.framed_device import FramedDevice
from mag_tracking.drivers.reading import Device
from mag_tracking.drivers.settings import DriverSettings
from mag_tracking.errors import SettingsError
from mag_tracking.network.sensor_network import SensorNetwork
from mag_tracking.settings import replace
from mag_tracking.yaml_file import is_text, read_yaml, shown

_HERE = 'mag_tracking.drivers'
KINDS = {
    'transport': {'serial': f'{_HERE}.transports.serial_port:SerialPort',
                  'udp': f'{_HERE}.transports.udp:UdpSocket',
                  'mqtt': f'{_HERE}.transports.mqtt:MqttTopics'},
    'framing': {'text': f'{_HERE}.framings.text:TextFraming',
                'json': f'{_HERE}.framings.json_objects:JsonFraming',
                'binary': f'{_HERE}.framings.binary:BinaryFraming',
                'xsens': f'{_HERE}.framings.xsens:XsensFraming'},
    'device': {'i2c': f'{_HERE}.transports.i2c:I2cDevice',
               'simulator': f'{_HERE}.simulated_device:SimulatedDevice'},
}

METHODS = {'transport': ('open', 'read', 'close'), 'framing': ('parse',),
           'device': ('open', 'read', 'close')}
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_/]*')
Settings = TypeVar('Settings', ClockSettings, DriverSettings)


def read_drivers(path: str | PathLike[str], network: SensorNetwork | None = None) -> list[Driver]:
    """The drivers that a file describes.

    Parameters
    ----------
    path : path
    network : SensorNetwork, optional
        Where it is given, every sensor has to be one of it.

    Returns a list of `Driver`, none of which is open. Raises SettingsError, which
    names the file and the device.
    """
    content = read_yaml(path, SettingsError)
    if not isinstance(content, Mapping) or not content:
        raise SettingsError(f'{path}: expected a mapping of devices, got {shown(content)}')
    try:
        drivers = [driver_of(name, entry) for name, entry in content.items()]
        _check_sensors(drivers, network)
    except SettingsError as error:
        raise SettingsError(f'{path}: {error}') from error
    return drivers


def kind_of(role: str, name: object) -> Any:
    """The class of a kind of transport, framing or device; raises SettingsError."""
    target = KINDS[role].get(name, name) if isinstance(name, str) else ''
    module, colon, leaf = target.partition(':')
    if not colon:
        raise SettingsError(f'{role}: expected {", ".join(KINDS[role])} or '
                            f'package.module:Class, got {shown(name)}')
    try:
        cls = getattr(importlib.import_module(module), leaf)
    # A module of somebody else's may fail with anything.
    except Exception as error:
        raise SettingsError(f'{role}: {name}: {type(error).__name__}: {error}') from error
    lacking = [what for what in ('SETTINGS', *METHODS[role]) if not hasattr(cls, what)]
    if lacking:
        raise SettingsError(f'{role}: {name} has no {", ".join(lacking)}')
    return cls


def driver_of(name: object, entry: object) -> Driver:
    """The `Driver` of one entry of the file; raises SettingsError that names the device."""
    if not isinstance(name, str) or not isinstance(entry, Mapping):
        raise SettingsError(f'{name}: expected a mapping of settings, got {shown(entry)}')
    if not is_text(name):
        raise SettingsError(f'{shown(name)} is not a device name: it contains a lone surrogate')
    rest = dict(entry)
    try:
        device = _device(rest)
        clock = replace(_usual(ClockSettings(), device, 'CLOCK'), _group(rest, 'clock'))
        sensors = _sensors(rest)
        for unit in ('unit', 'acceleration_unit'):
            if isinstance(rest.get(unit), (int, float)) and not isinstance(rest[unit], bool):
                rest[unit] = repr(rest[unit])
        settings = replace(_usual(DriverSettings(), device, 'DRIVER'), rest)
        return Driver(name, device, settings, clock, sensors)
    except SettingsError as error:
        raise SettingsError(f'{name}: {error}') from error


def _usual(settings: Settings, device: Device, name: str) -> Settings:
    """`settings` with what the device's class says of all of its kind."""
    return replace(settings, getattr(device, name, {}))


def _device(rest: dict[str, Any]) -> Device:
    """The device that an entry describes; takes what it used out of `rest`."""
    if 'device' in rest:
        if 'transport' in rest or 'framing' in rest:
            raise SettingsError('a device has no transport and no framing beside it')
        device: Device = _made('device', rest)
        return device
    for role in ('transport', 'framing'):
        if role not in rest:
            raise SettingsError(f'there is no {role} (one of {", ".join(KINDS[role])}), and no '
                                f'device (one of {", ".join(KINDS["device"])})')
    return FramedDevice(_made('transport', rest), _made('framing', rest))


def _made(role: str, rest: dict[str, Any]) -> Any:
    """The transport, framing or device of an entry, with its settings."""
    kind = rest.pop(role)
    cls = kind_of(role, kind)
    group = kind if kind in KINDS[role] else f'{role}_settings'
    return cls(replace(cls.SETTINGS(), _group(rest, group)))


def _group(rest: dict[str, Any], name: str) -> Mapping[str, Any]:
    """The mapping of settings under `name`, with the name before each; taken out of `rest`."""
    group = rest.pop(name, {})
    if not isinstance(group, Mapping):
        raise SettingsError(f'{name}: expected a mapping of settings, got {shown(group)}')
    return group


def _sensors(rest: dict[str, Any]) -> dict[str, str]:
    """{name at the device: name in the network}."""
    if 'sensor' in rest:
        if 'sensors' in rest:
            raise SettingsError('sensor and sensors exclude each other')
        sensors = {'': rest.pop('sensor')}
    else:
        sensors = rest.pop('sensors', None)
    if not isinstance(sensors, Mapping) or not sensors:
        raise SettingsError('expected `sensor: mag_1`, or `sensors:` with the name in the network '
                            f'for each name at the device, got {shown(sensors)}')
    for key, value in sensors.items():
        if isinstance(key, bool) or not isinstance(key, (str, int)):
            raise SettingsError(f'sensors: {shown(key)} is no name; put it in quotes')
        if not is_text(str(key)):
            raise SettingsError(f'sensors: {shown(key)} is not a name: it has a lone surrogate')
        if not isinstance(value, str) or not (value == IGNORED or _NAME.fullmatch(value)):
            raise SettingsError(f'sensors: {key}: expected the name of a sensor (letters, digits, '
                                f'_ and /), or - to ignore it, got {shown(value)}')
    out = {str(key): value for key, value in sensors.items()}
    if len(out) < len(sensors):
        raise SettingsError('sensors: two of them have the same name at the device')
    return out


def _check_sensors(drivers: Iterable[Driver], network: SensorNetwork | None) -> None:
    """Each sensor comes from one device only, and is one of the network; or SettingsError."""
    owner: dict[str, str] = {}
    for driver in drivers:
        for key, sensor in driver.sensors.items():
            if sensor == IGNORED:
                continue
            if sensor in owner:
                raise SettingsError(f'{driver.name}: sensor {sensor} comes from {owner[sensor]} '
                                    'already')
            owner[sensor] = f'{driver.name} ({key})' if key else driver.name
            if network is not None and sensor not in network.names:
                raise SettingsError(f'{driver.name}: sensor {sensor} is not in the network, whose '
                                    f'sensors are {", ".join(network.names)}')


def settings_by_kind() -> dict[str, Any]:
    """{group in the file: its settings with their defaults}, for the reference."""
    out = {'': DriverSettings(), 'clock': ClockSettings()}
    for role, kinds in KINDS.items():
        for name in kinds:
            out[name] = kind_of(role, name).SETTINGS()
    return out
