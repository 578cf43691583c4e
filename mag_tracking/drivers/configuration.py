"""Reader of the drivers file, which lists devices, their protocols and their sensors.

    roadside:
      transport: serial
      serial: {port: /dev/ttyUSB0, baud: 115200}
      framing: text
      text: {fields: [sensor, sequence, ticks, x, y, z], checksum: nmea}
      clock: {tick_s: 1.0e-6, wrap: 4294967296}
      unit: nT
      sensors: {A: mag_1, B: mag_2}

The kind of a transport, framing or device is a name in `KINDS`, with its settings under that name,
or `package.module:Class`, with its settings under `transport_settings`, `framing_settings` or
`device_settings`. Such a class has an attribute `SETTINGS` and the methods of `reading.Transport`,
`Framing` or `Device`; a transport also has the class attribute `is_message_oriented`. Optional
attributes `CLOCK` and `DRIVER` are defaults of clock and driver settings for every such device.
"""

import dataclasses
import importlib
import re
from collections.abc import Collection, Iterable, Mapping
from os import PathLike
from typing import Any

from mag_tracking.drivers.device_clock import ClockSettings
from mag_tracking.drivers.driver import IGNORED, Driver
from mag_tracking.drivers.reading import Device, FramedDevice
from mag_tracking.drivers.settings import DriverSettings
from mag_tracking.errors import SettingsError
from mag_tracking.files import is_utf8_encodable, read_yaml, short_repr
from mag_tracking.network.sensor_network import SensorNetwork
from mag_tracking.settings import closest_name, replace

_PACKAGE = 'mag_tracking.drivers'
KINDS = {
    'transport': {'serial': f'{_PACKAGE}.transports.serial_port:SerialPort',
                  'udp': f'{_PACKAGE}.transports.udp:UdpSocket',
                  'mqtt': f'{_PACKAGE}.transports.mqtt:MqttTopics'},
    'framing': {'text': f'{_PACKAGE}.framings.text:TextFraming',
                'json': f'{_PACKAGE}.framings.json_objects:JsonFraming',
                'binary': f'{_PACKAGE}.framings.binary:BinaryFraming',
                'xsens': f'{_PACKAGE}.framings.xsens:XsensFraming'},
    'device': {'i2c': f'{_PACKAGE}.transports.i2c:I2cDevice',
               'simulator': f'{_PACKAGE}.simulated_device:SimulatedDevice'},
}
REQUIRED_MEMBERS = {'transport': ('is_message_oriented', 'open', 'read', 'close'),
                    'framing': ('parse',), 'device': ('open', 'read', 'close')}
_ENTRY_KEYS = frozenset(('clock', 'sensor', 'sensors', *KINDS))
"""Keys of a device other than the driver settings and the groups of its kinds."""
_NAME_PATTERN = re.compile(r'[A-Za-z][A-Za-z0-9_/]*')


def read_drivers(path: str | PathLike[str], network: SensorNetwork | None = None) -> list[Driver]:
    """Read a drivers file; the SettingsError of an invalid entry names file and device."""
    content = read_yaml(path, SettingsError)
    if not isinstance(content, Mapping) or not content:
        raise SettingsError(f'{path}: expected a mapping of devices, got {short_repr(content)}')
    try:
        _check_devices(content)
        drivers = [driver_of(name, entry) for name, entry in content.items()]
        _check_sensors(drivers, network)
    except SettingsError as error:
        raise SettingsError(f'{path}: {error}') from error
    return drivers


def load_class(role: str, name: object) -> Any:
    """Import the class of a 'transport', 'framing' or 'device' (`role`), whose `name` is a key of
    `KINDS[role]` or package.module:Class."""
    target = KINDS[role].get(name, name) if isinstance(name, str) else ''
    module, colon, class_name = target.partition(':')
    if not colon:
        raise SettingsError(f'{role}: expected {", ".join(KINDS[role])} or '
                            f'package.module:Class, got {short_repr(name)}')
    try:
        cls = getattr(importlib.import_module(module), class_name)
    # A third-party module may raise any error.
    except Exception as error:
        raise SettingsError(
            f'{role}: {name} cannot be loaded: {type(error).__name__}: {error}') from error
    missing_members = [member for member in ('SETTINGS', *REQUIRED_MEMBERS[role])
                       if not hasattr(cls, member)]
    if missing_members:
        raise SettingsError(f'{role}: {name} is incomplete: it lacks {", ".join(missing_members)}')
    return cls


def driver_of(name: object, entry: object) -> Driver:
    """Create a driver from an entry of a drivers file."""
    if not isinstance(name, str) or not isinstance(entry, Mapping):
        raise SettingsError(f'{name}: expected a mapping of settings, got {short_repr(entry)}')
    if not is_utf8_encodable(name):
        raise SettingsError(f'{short_repr(name)} is not a device name: it is not valid Unicode')
    options = dict(entry)
    try:
        kinds = [kind for role in KINDS if isinstance(kind := options.get(role), str)]
        _check_places(options, {*_ENTRY_KEYS, *_names(DriverSettings())}, kinds)
        device = _device(options, kinds)
        clock = _with_group(replace(ClockSettings(), getattr(device, 'CLOCK', {})), options,
                            'clock', kinds)
        sensors = _pop_sensors(options)
        for unit in ('unit', 'acceleration_unit'):
            if isinstance(options.get(unit), (int, float)) and not isinstance(options[unit], bool):
                options[unit] = repr(options[unit])
        settings = replace(replace(DriverSettings(), getattr(device, 'DRIVER', {})), options)
        return Driver(name, device, settings, clock, sensors)
    except SettingsError as error:
        raise SettingsError(f'{name}: {error}') from error


def _device(options: dict[str, Any], kinds: Collection[str]) -> Device:
    if 'device' in options:
        if 'transport' in options or 'framing' in options:
            raise SettingsError('device cannot be combined with transport or framing; remove '
                                'either device, or transport and framing')
        roles: tuple[str, ...] = ('device',)
    else:
        roles = ('transport', 'framing')
    for role in roles:
        if role not in options:
            raise SettingsError(f'{role} is missing; set it to one of {", ".join(KINDS[role])}, or '
                                f'set device to one of {", ".join(KINDS["device"])} instead')
    classes = {role: load_class(role, options[role]) for role in roles}
    groups = {role: options[role] if options[role] in KINDS[role] else f'{role}_settings'
              for role in roles}
    _check_groups(options, groups, kinds)
    parts: list[Any] = []
    for role, group in groups.items():
        del options[role]
        settings = _with_group(classes[role].SETTINGS(), options, group, kinds)
        try:
            parts.append(classes[role](settings))
        except SettingsError as error:
            raise SettingsError(f'{group}: {error}') from error
    return parts[0] if 'device' in groups else FramedDevice(*parts)


def _with_group(settings: Any, options: dict[str, Any], name: str, kinds: Collection[str]) -> Any:
    """Return `settings` with the changes of a group, which is removed from `options`."""
    group = options.pop(name, {})
    if not isinstance(group, Mapping):
        raise SettingsError(f'{name}: expected a mapping of settings, got {short_repr(group)}')
    try:
        _check_places(group, _names(settings), kinds)
        return replace(settings, group)
    except SettingsError as error:
        raise SettingsError(f'{name}: {error}') from error


def _check_groups(options: Mapping[str, Any], groups: Mapping[str, str], kinds: Collection[str]
                  ) -> None:
    """Raise SettingsError if `options` has a group that is unknown, or that no kind uses."""
    permitted = {*_ENTRY_KEYS, *_names(DriverSettings()), *groups.values()}
    for name in [name for name in options if name not in permitted]:
        role = next((role for role in KINDS if name in (*KINDS[role], f'{role}_settings')), '')
        if role:
            change = f', or change {role}' if role in groups else ''
            raise SettingsError(f'{name} is not used by the device, which uses '
                                f'{" and ".join(kinds)}; remove {name}{change}')
        if isinstance(options[name], Mapping):
            similar = closest_name(str(name).lower(), [*groups.values(), 'clock'])
            raise SettingsError(f'unknown group {name}' + (
                f'; did you mean {similar}?' if similar else
                f'; the groups are {", ".join(groups.values())} and clock'))


def _pop_sensors(options: dict[str, Any]) -> dict[str, str]:
    """Remove the sensors from `options` and return {name at the device: network name}."""
    if 'sensor' in options:
        if 'sensors' in options:
            raise SettingsError('sensor and sensors are mutually exclusive; remove one of them')
        sensors = {'': options.pop('sensor')}
    else:
        sensors = options.pop('sensors', None)
    if not isinstance(sensors, Mapping) or not sensors:
        raise SettingsError('expected `sensor: mag_1`, or `sensors:` with the network name of each '
                            f'sensor of the device, got {short_repr(sensors)}')
    for key, value in sensors.items():
        if isinstance(key, bool) or not isinstance(key, (str, int)):
            raise SettingsError(f'sensors: {short_repr(key)} is not a name; put it in quotes')
        if not is_utf8_encodable(str(key)):
            raise SettingsError(f'sensors: {short_repr(key)} is not a name: it is not valid '
                                'Unicode')
        if not isinstance(value, str) or not (value == IGNORED or _NAME_PATTERN.fullmatch(value)):
            label = f'sensors: {key}' if key != '' else 'sensor'
            raise SettingsError(f'{label}: expected a sensor name (letters, digits, _ and '
                                f'/), or - to ignore the sensor, got {short_repr(value)}')
    network_names = {str(key): value for key, value in sensors.items()}
    if len(network_names) < len(sensors):
        names = [str(key) for key in sensors]
        duplicate = next(name for name in names if names.count(name) > 1)
        raise SettingsError(f'sensors: the name {duplicate} at the device appears twice; remove '
                            'one')
    return network_names


def _check_sensors(drivers: Iterable[Driver], network: SensorNetwork | None) -> None:
    owner: dict[str, str] = {}
    for driver in drivers:
        for key, sensor in driver.sensors.items():
            if sensor == IGNORED:
                continue
            if sensor in owner:
                raise SettingsError(f'{driver.name}: sensor {sensor} is already assigned to '
                                    f'{owner[sensor]}')
            owner[sensor] = f'{driver.name} ({key})' if key else driver.name
            if network is not None and sensor not in network.names:
                raise SettingsError(f'{driver.name}: sensor {sensor} is not in the network, whose '
                                    f'sensors are {", ".join(network.names)}')


def _names(settings: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(settings)}


def _groups_of(name: object) -> list[str]:
    """Groups of settings that contain `name`; '' stands for the top level of a device."""
    if name in _ENTRY_KEYS:
        return ['']
    return [group for group, settings in settings_by_kind().items() if name in _names(settings)]


def _joined(groups: Collection[str]) -> str:
    *others, last = groups
    return f'{", ".join(others)} or {last}' if others else last


def _check_places(names: Iterable[object], permitted: Collection[str],
                  kinds: Collection[str]) -> None:
    """Raise SettingsError if one of the `names` is not permitted here but in another group."""
    for name in names:
        groups = [] if name in permitted else _groups_of(name)
        if '' in groups:
            raise SettingsError(f'{name} is misplaced; move it to the top level of the device')
        used_groups = [group for group in groups if group in (*kinds, 'clock')]
        if used_groups:
            raise SettingsError(f'{name} is misplaced; move it to {_joined(used_groups)}, as in '
                                f'{used_groups[0]}: {{{name}: ...}}')
        if groups:
            raise SettingsError(f'{name} is misplaced; it is a setting of {_joined(groups)}, but '
                                f'the device uses {" and ".join(kinds) or "no transport"}')


def _check_devices(content: Mapping[object, object]) -> None:
    """Raise SettingsError if the top level of a file contains settings of a device."""
    for name, entry in content.items():
        if isinstance(entry, Mapping):
            # A device may have the name of a group.
            is_setting = not any(role in entry for role in KINDS) and name in settings_by_kind()
            groups = [''] if is_setting else []
        else:
            groups = _groups_of(name)
        if groups:
            hint = '' if '' in groups else f', under {_joined(groups)}'
            raise SettingsError(f'{name} is misplaced; the top level of the file contains devices. '
                                f'Move {name} into a device{hint}')


def settings_by_kind() -> dict[str, Any]:
    """Default settings by group in the drivers file; '' is the top level of a device."""
    settings = {'': DriverSettings(), 'clock': ClockSettings()}
    for role, kinds in KINDS.items():
        for name in kinds:
            settings[name] = load_class(role, name).SETTINGS()
    return settings
