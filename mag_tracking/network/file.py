"""Network file (`network.yaml`): geometry and calibration of a sensor network."""

import datetime
import json
import re
from collections.abc import Collection, Iterable
from os import PathLike
from typing import Any

import numpy as np
import yaml

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import NetworkError
from mag_tracking.files import is_utf8_encodable, read_yaml, replace_text, short_repr
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.network import CalibrationRecord, SensorNetwork
from mag_tracking.network.geomagnetic import Site, decimal_year, earth_field
from mag_tracking.network.topics import TOPIC_NAME_PATTERN

_SENSOR_NAME_PATTERN = re.compile(r'[A-Za-z0-9_.-]+')
_KEYS_OF_0_1_0 = {'stated': 'nominal', 'stated_std_deg': 'nominal_std_deg'}
_FRAME_PATTERN = re.compile(r'[A-Za-z0-9_./-]+')
_TOP_KEYS = {'frame', 'earth_field', 'site', 'sensors'}
_SITE_KEYS = ('latitude', 'longitude', 'height', 'date', 'x_azimuth_deg')
_SENSOR_KEYS = {'position', 'orientation', 'orientation_std_deg', 'clock_offset', 'noise_std',
                'background', 'offset', 'correction', 'topic', 'imu_topic', 'calibrated'}

_MAX_COORDINATE = 1e8
"""Maximum absolute coordinate of a position [m]; covers all frames on Earth."""

_MIN_NOISE_STD = 1e-15
"""Minimum standard deviation of the noise [T]."""

_MAX_CLOCK_OFFSET = 3600.0
"""Maximum clock offset that is corrected [s]. A clock with a larger offset must be set."""


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
    position = _parse_vector(f'{label}: position', entry['position'], (3,))
    if np.abs(position).max() > _MAX_COORDINATE:
        raise NetworkError(f'{label}: position: {position.tolist()} m is too far from the '
                           'origin for any place on Earth; positions are in metres')
    quaternion = _parse_vector(f'{label}: orientation',
                               entry.get('orientation', [0, 0, 0, 1]), (4,))
    R_ws = _parse_rotation(f'{label}: orientation', quaternion)
    topic = _check_topic(label, 'topic', entry.get('topic', f'{name}/imu/mag'))
    # REP-145: the accelerometer topic data_raw and the magnetometer topic mag share a namespace.
    default_imu_topic = topic.removesuffix('/mag') + '/data_raw' if topic.endswith('/mag') else None
    imu_topic = entry.get('imu_topic', default_imu_topic)
    return {'positions': position, 'R_ws': R_ws, 'topics': topic,
            'imu_topics': None if imu_topic is None else _check_topic(label, 'imu_topic',
                                                                      imu_topic),
            'noise_std': _parse_noise(label, entry.get('noise_std')),
            'background': _parse_field(label, 'background', entry.get('background')),
            'offset': _parse_field(label, 'offset', entry.get('offset')),
            'correction': _parse_correction(label, entry.get('correction')),
            'orientation_std': _parse_orientation_std(label, entry.get('orientation_std_deg')),
            'clock_offset': _parse_clock_offset(label, entry.get('clock_offset', 0.0)),
            'calibrated': _parse_calibration(label, entry.get('calibrated'))}


def _parse_noise(label: str, noise: object) -> FloatArray | None:
    """Parse the noise standard deviation (3,) [T], one or three numbers; None if missing."""
    if noise is None:
        return None
    numbers = noise if isinstance(noise, list) else [noise]
    std = _parse_vector(f'{label}: noise_std', numbers, (1, 3)) * np.ones(3)
    if not ((std >= _MIN_NOISE_STD) & (std < 1e-3)).all():
        raise NetworkError(f'{label}: noise_std must be at least a femtotesla and below a '
                           f'millitesla, got {std.tolist()} T')
    return std


def _parse_field(label: str, key: str, value: object) -> FloatArray | None:
    """Parse a field (3,) [T], three numbers of at most 0.1 T; None if missing."""
    if value is None:
        return None
    B = _parse_vector(f'{label}: {key}', value, (3,))
    if np.abs(B).max() > 0.1:
        raise NetworkError(f'{label}: {key}: {B.tolist()} T exceeds 0.1 T; is the value in '
                           'microtesla or gauss?')
    return B


def _parse_correction(label: str, value: object) -> FloatArray | None:
    """Parse the correction matrix (3, 3), nine numbers; None if missing."""
    if value is None:
        return None
    matrix = _parse_vector(f'{label}: correction', value, (9,)).reshape(3, 3)
    singular_values = np.linalg.svd(matrix, compute_uv=False)
    if not singular_values[-1] > 0.02 * singular_values[0]:
        raise NetworkError(f'{label}: correction: {matrix.ravel().tolist()} is singular or almost '
                           'singular')
    return matrix


def _parse_orientation_std(label: str, value: object) -> FloatArray | None:
    """Convert one or three orientation standard deviations [deg] to (3,) [rad]; None if missing."""
    if value is None:
        return None
    numbers = value if isinstance(value, list) else [value]
    std = _parse_vector(f'{label}: orientation_std_deg', numbers, (1, 3)) * np.ones(3)
    if not ((std > 0.0) & (std <= 180.0)).all():
        raise NetworkError(f'{label}: orientation_std_deg must be above 0 and at most 180 degrees, '
                           f'got {std.tolist()}')
    return np.deg2rad(std)


def _parse_clock_offset(label: str, value: object) -> float:
    """Parse the clock offset [s]."""
    offset = _parse_vector(f'{label}: clock_offset', [value], (1,))[0]
    if abs(offset) > _MAX_CLOCK_OFFSET:
        raise NetworkError(f'{label}: clock_offset: {offset} s exceeds {_MAX_CLOCK_OFFSET:g} s; '
                           "set the sensor's clock")
    return float(offset)


def _parse_calibration(label: str, value: Any) -> CalibrationRecord | None:
    """Parse the calibration record of a sensor; None if missing."""
    if value is None:
        return None
    label = f'{label}: calibrated'
    if isinstance(value, dict):
        # Version 0.1.0 wrote `stated` instead of `nominal`.
        value = {key if (new := _KEYS_OF_0_1_0.get(key, key)) in value else new: v
                 for key, v in value.items()}
    _check_keys(label, value, {'date', 'by', 'clock_offset_std', 'nominal', 'nominal_std_deg'})
    for key in ('date', 'by'):
        if not isinstance(value.get(key), str) or not is_utf8_encodable(value[key]):
            raise NetworkError(f"{label}: {key} must be a string ('...'), "
                               f'got {short_repr(value.get(key))}')
    std, orientation = value.get('clock_offset_std'), value.get('nominal')
    std = float('nan') if std is None else float(_parse_vector(label, [std], (1,))[0])
    if std < 0.0:
        raise NetworkError(f'{label}: clock_offset_std: {std} s is negative')
    if orientation is not None:
        orientation = _parse_vector(f'{label}: nominal', orientation, (4,))
        _parse_rotation(f'{label}: nominal', orientation)
        orientation = tuple(orientation.tolist())
    nominal_std = _parse_orientation_std(label, value.get('nominal_std_deg'))
    return CalibrationRecord(value['date'], value['by'], std, orientation,
                             None if nominal_std is None else tuple(nominal_std.tolist()))


def _parse_rotation(label: str, q: FloatArray) -> FloatArray:
    """Convert a quaternion to a rotation matrix (3, 3); raises NetworkError if it is invalid."""
    try:
        return rotation_from_quaternion(q)
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
    if earth is not None:
        earth = _parse_vector('earth_field', earth, (3,))
        if np.linalg.norm(earth) > 1e-3:
            raise NetworkError(f'earth_field: {earth.tolist()} T exceeds a millitesla; is the '
                               'value in microtesla or gauss?')
    if site is None:
        return earth
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
        return earth_field(Site(latitude, longitude, height, decimal_year(date), azimuth))
    except ValueError as error:
        raise NetworkError(f'site: {error}') from error
    except ModuleNotFoundError as error:
        raise NetworkError('site: the World Magnetic Model requires pygeomag: run pip install '
                           'pygeomag, or set earth_field instead') from error


def _yaml_floats(values: Iterable[float]) -> str:
    """Format floats as a YAML flow sequence."""
    return '[' + ', '.join(_yaml_float(v) for v in values) + ']'


def _yaml_float(value: float) -> str:
    """Format a float with a decimal point, which YAML 1.1 requires before an exponent."""
    text = repr(float(value))
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text


def _sensor_lines(network: SensorNetwork, i: int) -> list[str]:
    """Format the entry of sensor `i` as lines of YAML."""
    lines = [f'  {_yaml_string(network.names[i])}:',
             f'    position: {_yaml_floats(network.positions[i])}',
             f'    orientation: {_yaml_floats(quaternion_from_rotation(network.R_ws[i]))}']
    std = network.orientation_std[i]
    if std is not None:
        lines.append(f'    orientation_std_deg: {_yaml_floats(np.rad2deg(std))}')
    if network.clock_offset[i]:
        lines.append(f'    clock_offset: {_yaml_float(network.clock_offset[i])}')
    for key in ('noise_std', 'background', 'offset', 'correction'):
        value = getattr(network, key)[i]
        if value is not None:
            lines.append(f'    {key}: {_yaml_floats(np.ravel(value))}')
    lines.append(f'    topic: {network.topics[i]}')
    lines.append(f'    imu_topic: {network.imu_topics[i] or "null"}')
    record = network.calibrated[i]
    if record is not None:
        lines += ['    calibrated:', f'      date: {json.dumps(record.date)}',
                  f'      by: {json.dumps(record.by)}']
        if not np.isnan(record.clock_offset_std):
            lines.append(f'      clock_offset_std: {_yaml_float(record.clock_offset_std)}')
        if record.nominal is not None:
            lines.append(f'      nominal: {_yaml_floats(record.nominal)}')
        if record.nominal_std is not None:
            lines.append(f'      nominal_std_deg: {_yaml_floats(np.rad2deg(record.nominal_std))}')
    return lines


def _yaml_string(text: str) -> str:
    """Format a string as YAML, with quotes if it could be parsed as another type (no, 01)."""
    return text if yaml.safe_load(text) == text else json.dumps(text)


def write_network(path: str | PathLike[str], network: SensorNetwork, comment: str = '') -> None:
    """Write a network file atomically, with a comment at its beginning; raises OutputError."""
    lines = [f'# {line}' for line in comment.splitlines()] \
        + [f'frame: {_yaml_string(network.frame)}']
    if network.earth_field is not None:
        lines.append(f'earth_field: {_yaml_floats(network.earth_field)}')
    lines.append('sensors:')
    for i in range(len(network)):
        lines += _sensor_lines(network, i)
    replace_text(path, '\n'.join(lines) + '\n')
