"""Network file (`network.yaml`): geometry and calibration of a sensor network.

The Earth's field at a site is that of the World Magnetic Model, evaluated by pygeomag with the
coefficients of NOAA and the British Geological Survey; T10 section 6.3.1 uses its declination.
"""

import datetime
import json
import re
from collections.abc import Callable, Collection
from os import PathLike
from typing import Any

import numpy as np
import yaml

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import NetworkError
from mag_tracking.files import is_utf8_encodable, read_yaml, replace_text, short_repr
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.network import CalibrationRecord, SensorNetwork
from mag_tracking.network.sensor_network import TOPIC_NAME_PATTERN
from mag_tracking.settings import yaml_value

_SENSOR_NAME_PATTERN = re.compile(r'[A-Za-z0-9_.-]+')
_KEYS_OF_0_1_0 = {'stated': 'nominal', 'stated_std_deg': 'nominal_std_deg'}
_FRAME_PATTERN = re.compile(r'[A-Za-z0-9_./-]+')
_TOP_KEYS = {'frame', 'earth_field', 'site', 'sensors'}
_SITE_KEYS = ('latitude', 'longitude', 'height', 'date', 'x_azimuth_deg')
_SENSOR_KEYS = {'position', 'orientation', 'orientation_std_deg', 'clock_offset', 'noise_std',
                'background', 'offset', 'correction', 'topic', 'imu_topic', 'calibrated'}

COEFFICIENTS = 'wmm/WMM_2025.COF'
"""Coefficient file of WMM2025, relative to the pygeomag package."""
FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
"""Period of validity of WMM2025, decimal years."""


def _is_regular(matrix: FloatArray) -> bool:
    """Whether a matrix (9,), in row-major order, is far from singular."""
    singular_values = np.linalg.svd(matrix.reshape(3, 3), compute_uv=False)
    return bool(singular_values[-1] > 0.02 * singular_values[0])


_FIELD = ((3,), lambda B: np.abs(B).max() <= 0.1,
          ': {} T exceeds 0.1 T; is the value in microtesla or gauss?')
_NUMBERS: dict[str, tuple[tuple[int, ...], Callable[[FloatArray], Any], str]] = {
    'position': ((3,), lambda r: np.abs(r).max() <= 1e8,
                 ': {} m is too far from the origin for any place on Earth; positions are in '
                 'metres'),
    'noise_std': ((1, 3), lambda std: ((std >= 1e-15) & (std < 1e-3)).all(),
                  ' must be at least a femtotesla and below a millitesla, got {} T'),
    'background': _FIELD, 'offset': _FIELD,
    'correction': ((9,), _is_regular, ': {} is singular or almost singular'),
    'orientation_std_deg': ((1, 3), lambda std: ((std > 0.0) & (std <= 180.0)).all(),
                            ' must be above 0 and at most 180 degrees, got {}'),
    'clock_offset': ((1,), lambda offset: abs(offset[0]) <= 3600.0,
                     ": {0[0]} s exceeds 3600 s; set the sensor's clock"),
    'earth_field': ((3,), lambda B: np.linalg.norm(B) <= 1e-3,
                    ': {} T exceeds a millitesla; is the value in microtesla or gauss?')}
"""Lengths, validity and error of the numbers of a key; one may stand for three equal ones."""


def _numbers(prefix: str, key: str, value: object) -> FloatArray:
    """Convert the value of a key in `_NUMBERS` to an array."""
    lengths, are_valid, error = _NUMBERS[key]
    is_single = lengths == (1,) or 1 in lengths and not isinstance(value, list)
    numbers = _parse_vector(f'{prefix}{key}', [value] if is_single else value, lengths)
    if 3 in lengths:
        numbers = numbers * np.ones(3)
    if not are_valid(numbers):
        raise NetworkError(f'{prefix}{key}{error.format(numbers.tolist())}')
    return numbers


def _parse_vector(label: str, value: object, lengths: tuple[int, ...]) -> FloatArray:
    """Convert a list of finite numbers, whose length must be in `lengths`, to an array."""
    if not isinstance(value, list) or len(value) not in lengths:
        raise NetworkError(f'{label}: expected {" or ".join(map(str, lengths))} numbers, '
                           f'got {short_repr(value)}')
    for v in value:
        # YAML 1.1 parses exponents without a point (1e-8) or without a sign (1.0e8) as strings.
        if isinstance(v, str):
            raise NetworkError(f'{label}: {short_repr(v)} is a string; write numbers as 1.0e-8 or '
                               '1.0e+8')
        if isinstance(v, bool) or not isinstance(v, (int, float)) or not abs(v) < 1e300:
            raise NetworkError(f'{label}: {short_repr(v)} is not a finite number')
    return np.array(value, dtype=float)


def _check_keys(label: str, mapping: object, keys: Collection[str]) -> None:
    """Raise NetworkError if `mapping` is not a mapping or has a key that is not in `keys`."""
    if not isinstance(mapping, dict):
        raise NetworkError(f'{label}: expected a mapping (key: value), got {short_repr(mapping)}')
    for key in mapping:
        if key not in keys:
            raise NetworkError(f'{label}: unknown key {short_repr(key)}; expected one of '
                               f'{", ".join(sorted(keys))}')


def _parse_sensor(name: str, entry: Any) -> dict[str, Any]:
    """Parse the entry of a sensor; return {attribute of `SensorNetwork`: value of this sensor}."""
    label = f'sensor {name}'
    _check_keys(label, entry, _SENSOR_KEYS)
    if 'position' not in entry:
        raise NetworkError(f'{label}: position is missing')
    entry = {'orientation': [0, 0, 0, 1], 'clock_offset': 0.0, 'topic': f'{name}/imu/mag', **entry}

    def numbers(key: str) -> FloatArray:
        return _numbers(f'{label}: ', key, entry[key])

    def optional(key: str) -> FloatArray | None:
        return None if entry.get(key) is None else numbers(key)

    position = numbers('position')
    _, R_ws = _parse_rotation(f'{label}: orientation', entry['orientation'])
    topic = _check_topic(label, 'topic', entry['topic'])
    # REP-145: the accelerometer topic data_raw and the magnetometer topic mag share a namespace.
    imu_topic = entry.get('imu_topic', topic.removesuffix('/mag') + '/data_raw'
                          if topic.endswith('/mag') else None)
    if imu_topic is not None:
        _check_topic(label, 'imu_topic', imu_topic)
    fields = {key: optional(key) for key in ('noise_std', 'background', 'offset')}
    correction, std_deg = optional('correction'), optional('orientation_std_deg')
    return {'positions': position, 'R_ws': R_ws, 'topics': topic, 'imu_topics': imu_topic, **fields,
            'correction': None if correction is None else correction.reshape(3, 3),
            'orientation_std': None if std_deg is None else np.deg2rad(std_deg),
            'clock_offset': float(numbers('clock_offset')[0]),
            'calibrated': _parse_calibration(f'{label}: calibrated', entry.get('calibrated'))}


def _parse_calibration(label: str, value: Any) -> CalibrationRecord | None:
    """Parse the calibration record of a sensor; None if missing."""
    if value is None:
        return None
    if isinstance(value, dict):
        # Version 0.1.0 wrote `stated` instead of `nominal`.
        value = {key if (new := _KEYS_OF_0_1_0.get(key, key)) in value else new: v
                 for key, v in value.items()}
    _check_keys(label, value, {'date', 'by', 'clock_offset_std', 'nominal', 'nominal_std_deg'})
    for key in ('date', 'by'):
        if not isinstance(value.get(key), str) or not is_utf8_encodable(value[key]):
            raise NetworkError(f"{label}: {key} must be a string ('...'), "
                               f'got {short_repr(value.get(key))}')
    std, nominal, nominal_std = map(value.get, ('clock_offset_std', 'nominal', 'nominal_std_deg'))
    std = float('nan') if std is None else float(_parse_vector(label, [std], (1,))[0])
    if std < 0.0:
        raise NetworkError(f'{label}: clock_offset_std: {std} s is negative')
    if nominal is not None:
        nominal = tuple(_parse_rotation(f'{label}: nominal', nominal)[0].tolist())
    if nominal_std is not None:
        nominal_std = tuple(np.deg2rad(
            _numbers(f'{label}: ', 'orientation_std_deg', nominal_std)).tolist())
    return CalibrationRecord(value['date'], value['by'], std, nominal, nominal_std)


def _parse_rotation(label: str, value: object) -> tuple[FloatArray, FloatArray]:
    """Parse a quaternion (4,) xyzw; return it and its rotation matrix (3, 3)."""
    quaternion = _parse_vector(label, value, (4,))
    try:
        return quaternion, rotation_from_quaternion(quaternion)
    except ValueError as error:
        raise NetworkError(f'{label}: {error}') from error


def _check_topic(label: str, key: str, topic: object) -> str:
    """Return `topic` if it is a valid topic name; raise NetworkError otherwise."""
    if not isinstance(topic, str) or not TOPIC_NAME_PATTERN.fullmatch(topic):
        raise NetworkError(f'{label}: {key}: {short_repr(topic)} is not a valid ROS topic: use '
                           'letters, digits and _; no part may begin with a digit')
    return topic


def read_network(path: str | PathLike[str]) -> SensorNetwork:
    """Read a network file.

    Parameters
    ----------
    path : path_like

    Returns
    -------
    SensorNetwork

    Raises
    ------
    NetworkError
        If the file is not valid. The message names the file and the key.
    """
    content = read_yaml(path, NetworkError)
    try:
        return _parse_network(content)
    except NetworkError as error:
        raise NetworkError(f'{path}: {error}') from error


def _parse_network(content: Any) -> SensorNetwork:
    """Validate the content of a network file and create the network."""
    _check_keys('the file', content, _TOP_KEYS)
    sensors = content.get('sensors')
    if not isinstance(sensors, dict) or not sensors:
        raise NetworkError('sensors: expected a mapping with at least one sensor')
    earth = _parse_earth_field(content)
    frame = content.get('frame', 'map')
    if not isinstance(frame, str) or not _FRAME_PATTERN.fullmatch(frame):
        raise NetworkError('frame: expected a name of letters, digits, _ . / and -, got '
                           f'{short_repr(frame)}')
    names = tuple(str(name) for name in sensors)
    for name in names:
        if not _SENSOR_NAME_PATTERN.fullmatch(name):
            raise NetworkError(f'{short_repr(name)} is not a valid sensor name: use letters, '
                               'digits, _ . and -')
    entries = [_parse_sensor(n, e) for n, e in zip(names, sensors.values(), strict=True)]
    attributes: dict[str, Any] = {key: tuple(e[key] for e in entries) for key in entries[0]}
    for key in ('positions', 'R_ws', 'clock_offset'):
        attributes[key] = np.array(attributes[key])
    return SensorNetwork(names, frame=frame, earth_field=earth, **attributes)


def _parse_earth_field(content: dict[str, Any]) -> FloatArray | None:
    """Earth's field (3,) [T], given or by the World Magnetic Model; None without either."""
    earth, site = content.get('earth_field'), content.get('site')
    if earth is not None and site is not None:
        raise NetworkError('earth_field and site both define the field of the Earth: remove one '
                           'of them')
    if site is None:
        return None if earth is None else _numbers('', 'earth_field', earth)
    _check_keys('site', site, _SITE_KEYS)
    missing = [key for key in _SITE_KEYS if key not in site]
    if missing:
        raise NetworkError(f'site: {missing[0]} is missing')
    date = site['date']
    if not isinstance(date, datetime.date) or isinstance(date, datetime.datetime):
        raise NetworkError('site: date: expected a date such as 2026-05-01, got '
                           f'{short_repr(date)}')
    latitude, longitude, height, azimuth = _parse_vector('site', [
        site[key] for key in ('latitude', 'longitude', 'height', 'x_azimuth_deg')], (4,))
    try:
        return earth_field(latitude, longitude, height, decimal_year(date), azimuth)
    except ValueError as error:
        raise NetworkError(f'site: {error}') from error
    except ModuleNotFoundError as error:
        raise NetworkError('site: the World Magnetic Model requires pygeomag: run pip install '
                           'pygeomag, or set earth_field instead') from error


def decimal_year(day: datetime.date) -> float:
    """Convert a date to a decimal year."""
    first = datetime.date(day.year, 1, 1)
    return day.year + (day - first).days / (datetime.date(day.year + 1, 1, 1) - first).days


def earth_field(latitude: float, longitude: float, height: float, year: float,
                x_azimuth: float) -> FloatArray:
    """Magnetic flux density (3,) of the Earth at a site, T, world frame (z up).

    Geodetic latitude [deg], longitude [deg, east positive], height above the ellipsoid [m], decimal
    year, and bearing of the x axis [deg, clockwise from true north]: 90 for ENU, or that of a road
    parallel to x. Raises ValueError outside the model, ModuleNotFoundError without pygeomag.
    """
    # Optional dependency, required only for networks that define a site instead of a field.
    from pygeomag import GeoMag

    for name, value, low, high, unit in (
            ('latitude', latitude, -90.0, 90.0, 'deg'),
            ('longitude', longitude, -180.0, 360.0, 'deg'),
            ('height', height, -1000.0, 850e3, 'm'),
            ('year', year, FIRST_YEAR, LAST_YEAR, '(WMM2025)'),
            ('x_azimuth', x_azimuth, -360.0, 360.0, 'deg')):
        if not low <= value <= high:
            raise ValueError(f'{name}: {value:g} is outside {low:g} .. {high:g} {unit}')
    field = GeoMag(coefficients_file=COEFFICIENTS).calculate(
        glat=latitude, glon=longitude, alt=height * 1e-3, time=year)
    north, east, down = np.array([field.x, field.y, field.z]) * 1e-9
    azimuth = np.deg2rad(x_azimuth)
    return np.array([north * np.cos(azimuth) + east * np.sin(azimuth),
                     north * np.sin(azimuth) - east * np.cos(azimuth), -down])


def _number_lines(indent: str, values: dict[str, Any]) -> list[str]:
    """Format the numbers and arrays that are not None as lines of YAML."""
    return [f'{indent}{key}: ' + yaml_value(tuple(map(float, np.ravel(value))) if np.ndim(value)
                                            else float(value))
            for key, value in values.items() if value is not None]


def _sensor_lines(network: SensorNetwork, i: int) -> list[str]:
    """Format the entry of sensor `i` as lines of YAML."""
    std, record = network.orientation_std[i], network.calibrated[i]
    lines = [f'  {_yaml_string(network.names[i])}:', *_number_lines('    ', {
        'position': network.positions[i], 'orientation': quaternion_from_rotation(network.R_ws[i]),
        'orientation_std_deg': None if std is None else np.rad2deg(std),
        'clock_offset': network.clock_offset[i] or None,
        **{key: getattr(network, key)[i]
           for key in ('noise_std', 'background', 'offset', 'correction')}}),
        f'    topic: {network.topics[i]}', f'    imu_topic: {network.imu_topics[i] or "null"}']
    if record is not None:
        lines += ['    calibrated:', f'      date: {json.dumps(record.date)}',
                  f'      by: {json.dumps(record.by)}', *_number_lines('      ', {
                      'clock_offset_std': None if np.isnan(record.clock_offset_std)
                      else record.clock_offset_std, 'nominal': record.nominal,
                      'nominal_std_deg': None if record.nominal_std is None
                      else np.rad2deg(record.nominal_std)})]
    return lines


def _yaml_string(text: str) -> str:
    """Format a string as YAML, with quotes if it could be parsed as another type (no, 01)."""
    return text if yaml.safe_load(text) == text else json.dumps(text)


def write_network(path: str | PathLike[str], network: SensorNetwork, comment: str = '') -> None:
    """Write a network file atomically, with a comment at its beginning; raises OutputError."""
    lines = [*(f'# {line}' for line in comment.splitlines()),
             f'frame: {_yaml_string(network.frame)}',
             *_number_lines('', {'earth_field': network.earth_field}), 'sensors:',
             *(line for i in range(len(network)) for line in _sensor_lines(network, i))]
    replace_text(path, '\n'.join(lines) + '\n')
