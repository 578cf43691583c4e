"""Compiled encoder of messages, compared with the writer of mcap_ros2."""

import io
import math

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.writer import Writer

from mag_tracking.messages.types import (
    DEFINITIONS,
    RawMessage,
    decode,
    definition,
    encoder,
    schema_of,
)

MARKER = 'visualization_msgs/msg/Marker'
HEADER = 'std_msgs/msg/Header'
TEXTS = ['', 'a', 'märz', 'sensor_12', '磁力計']
RANGES = {'bool': (0, 1), 'byte': (0, 255), **{
    f'{u}int{n}': (0, 2**n - 1) if u else (-2**(n - 1), 2**(n - 1) - 1)
    for u in ('', 'u') for n in (8, 16, 32, 64)}}


def random_value(kind, package, rng):
    """Random value of the type `kind`, as named in a message definition of `package`."""
    if kind == 'string':
        return TEXTS[rng.integers(len(TEXTS))]
    if kind.startswith('float'):
        value = rng.choice([0.0, 1.5, -2.25e-8, math.inf, math.nan, rng.standard_normal()])
        return float(np.float32(value) if kind == 'float32' else value)
    if kind in RANGES:
        low, high = RANGES[kind]
        value = rng.choice([low, high, (low + high) // 3 + 1])
        return bool(value) if kind == 'bool' else int(value)
    owner, _, leaf = kind.rpartition('/')
    return random_message(f'{owner or package}/msg/{leaf}', rng)


def random_message(name, rng):
    """Random message as nested dicts; some fields are missing."""
    content = {}
    for line in DEFINITIONS[name].splitlines():
        kind, field = line.split()[:2]
        if '=' in line or rng.uniform() < 0.15:
            continue
        base, bracket, length = kind.partition('[')
        n = int(length[:-1] or rng.integers(4)) if bracket else None
        values = [random_value(base, name.partition('/')[0], rng) for _ in range(n or 1)]
        content[field] = values[0] if n is None else values[:n]
    return content


def encoded_by_mcap_ros2(name, messages):
    """CDR bytes of each message from the writer of mcap_ros2."""
    stream = io.BytesIO()
    writer = Writer(stream)
    schema = writer.register_msgdef(name, definition(name))
    for k, message in enumerate(messages):
        writer.write_message('/topic', schema, message, log_time=k)
    writer.finish()
    stream.seek(0)
    return [message.data for _, _, message in make_reader(stream).iter_messages()]


@pytest.mark.parametrize('name', DEFINITIONS)
def test_encoded_bytes_equal_those_of_mcap_ros2(name):
    rng = np.random.default_rng(len(name))
    messages = [random_message(name, rng) for _ in range(12)]
    assert [encoder(name)(message) for message in messages] == encoded_by_mcap_ros2(name, messages)


def test_missing_fields_have_the_defaults_of_the_definition():
    empty = decode(RawMessage('/markers', MARKER, 0, encoder(MARKER)({'pose': None}),
                              schema_of(MARKER)))
    orientation = empty.pose.orientation
    assert (orientation.x, orientation.w) == (0.0, 1.0)
    assert empty.text == '' and empty.points == [] and empty.frame_locked is False


@pytest.mark.parametrize('name, message, error', [
    (HEADER, {'stamp': {'sec': 2**31}}, ValueError),
    (HEADER, {'stamp': {'sec': -2**31 - 1}}, ValueError),
    (HEADER, {'stamp': {'sec': 2**80}}, OverflowError),
    (HEADER, {'stamp': {'nanosec': -1}}, OverflowError),
    (HEADER, {'stamp': {'sec': 'soon'}}, ValueError),
    (HEADER, {'stamp': 7}, TypeError),
    (HEADER, {'stamp': {'sec': []}}, TypeError),
    (HEADER, {'frame_id': '\ud800'}, UnicodeEncodeError),
    ('geometry_msgs/msg/Point', {'x': 'far'}, ValueError),
    ('std_msgs/msg/ColorRGBA', {'r': 1e39}, OverflowError),
    ('geometry_msgs/msg/Point', {'x': {}}, TypeError),
    ('geometry_msgs/msg/PoseWithCovariance', {'covariance': [0.0] * 35}, ValueError),
    ('geometry_msgs/msg/PoseWithCovariance', {'covariance': 'nothing'}, TypeError),
    ('nav_msgs/msg/Path', {'poses': {'x': 1.0}}, TypeError),
    ('nav_msgs/msg/Path', {'poses': 3}, TypeError)])
def test_values_of_a_wrong_type_or_range_are_refused(name, message, error):
    with pytest.raises(error):
        encoder(name)(message)


def test_an_error_names_the_field():
    with pytest.raises(ValueError, match='^header: stamp: sec: beyond .*: 2147483648$'):
        encoder('geometry_msgs/msg/PoseStamped')({'header': {'stamp': {'sec': 2**31}}})
    with pytest.raises(ValueError, match='^covariance: expected 36 elements, got 35$'):
        encoder('geometry_msgs/msg/PoseWithCovariance')({'covariance': [0.0] * 35})


def test_values_are_converted_as_in_python():
    point = encoder('geometry_msgs/msg/Point')
    assert point({'x': '1.5', 'y': 2, 'z': True}) == point({'x': 1.5, 'y': 2.0, 'z': 1.0})
    time = encoder('builtin_interfaces/msg/Time')
    assert time({'sec': np.int32(5), 'nanosec': 7.9}) == time({'sec': 5, 'nanosec': 7})
    header = encoder(HEADER)
    assert header({'frame_id': 12}) == header({'frame_id': '12'})
