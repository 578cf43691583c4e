"""Vectorised decoding of messages, compared with the decoder of single messages."""

import struct

import numpy as np
import pytest

from mag_tracking.messages.message_arrays import magnetic_fields, poses
from mag_tracking.messages.schema import header_dict, magnetic_field_dicts, reading_of
from mag_tracking.messages.types import MAGNETIC_FIELD, POSE, RawMessage, decode, encoder, schema_of
from mag_tracking.records import Readings


def message(k, frame='mag_1', covariance=None):
    """CDR bytes of message `k`; each message is different."""
    rng = np.random.default_rng(k)
    readings = Readings.single('mag_1', 1_790_000_000_000_000_000 + 12_345_678 * k,
                               1e-5 * rng.standard_normal(3), covariance)
    (_, content), = magnetic_field_dicts(readings, frame)
    return encoder(MAGNETIC_FIELD)(content)


def read(messages):
    """`FieldArrays` of the concatenated bytes of `messages`."""
    ends = np.cumsum([len(m) for m in messages], dtype=np.int64)
    return magnetic_fields(b''.join(messages), ends - [len(m) for m in messages], ends)


def decoded(data):
    """`Readings` of one message by the decoder of single messages."""
    return reading_of(decode(RawMessage('/mag', MAGNETIC_FIELD, 0, data,
                                        schema_of(MAGNETIC_FIELD))), 'mag_1')


@pytest.mark.parametrize('frames', [
    ['mag_1'], ['', 'a', 'ab', 'abc', 'abcd', 'a much longer name']])
@pytest.mark.parametrize('known', ['none', 'all', 'some'])
def test_arrays_equal_the_decoded_messages(frames, known):
    C = [None if known == 'none' or known == 'some' and k % 3 else (k + 1.0) * 1e-16 * np.eye(3)
         for k in range(40)]
    data = [message(k, frames[k % len(frames)], C[k]) for k in range(40)]
    found, expected = read(data), Readings.joined(decoded(m) for m in data)
    assert found.is_decoded.all()
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
    np.testing.assert_array_equal(found.field, expected.field)
    assert (found.covariance is None) == (expected.covariance is None)
    if expected.covariance is not None:
        np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_unknown_and_nan_covariances_are_distinguished():
    unknown, nan = np.zeros((3, 3)), np.full((3, 3), np.nan)
    unknown[0, 0] = -1.0
    # NaN is an unknown covariance in `Readings`, but a fault in a message.
    data = [message(0, covariance=1e-16 * np.eye(3)), message(1, covariance=unknown),
            message(2)[:-72] + nan.tobytes()]
    found, expected = read(data), Readings.joined(decoded(m) for m in data)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert np.isnan(found.covariance[1]).all() and not found.covariance[2].any()


@pytest.mark.parametrize('damage', [
    lambda m: b'', lambda m: m[:3], lambda m: m[:15], lambda m: m[:40], lambda m: m[:-1],
    lambda m: b'\x00\x00' + m[2:], lambda m: b'\x07' + m[1:],
    lambda m: m[:12] + struct.pack('<I', 2**31 + 5) + m[16:],
    lambda m: m[:12] + struct.pack('<I', 0) + m[16:],
    lambda m: m[:16] + b'\xff' + m[17:], lambda m: m[:21] + b'x' + m[22:]])
def test_damaged_or_unusual_messages_are_left_to_the_decoder(damage):
    data = [message(k) for k in range(5)]
    undamaged = read(data)
    data[2] = damage(data[2])
    found = read(data)
    assert found.is_decoded.tolist() == [True, True, False, True, True]
    others = found.is_decoded
    np.testing.assert_array_equal(found.field[others], undamaged.field[others])
    np.testing.assert_array_equal(found.stamp_ns[others], undamaged.stamp_ns[others])


def test_no_messages_give_empty_arrays():
    found = read([])
    assert found.is_decoded.shape == (0,) and found.field.shape == (0, 3)
    assert found.covariance is None


def test_random_bytes_are_decoded_or_skipped():
    """Truncated messages with random bytes cause neither errors nor reads beyond a message."""
    rng = np.random.default_rng(3)
    data = [message(k)[:rng.integers(0, 130)] + rng.bytes(int(rng.integers(0, 40)))
            for k in range(2000)]
    found = read(data)
    for m, is_decoded, field in zip(data, found.is_decoded, found.field, strict=True):
        if is_decoded:
            np.testing.assert_array_equal(field, decoded(m).field[0])


def pose_message(k, frame):
    """CDR bytes of geometry_msgs/PoseStamped `k`; each message is different."""
    numbers = np.random.default_rng(k).standard_normal(7).tolist()
    return encoder(POSE)({'header': header_dict(10**18 + 7 * k, frame), 'pose': {
        'position': dict(zip('xyz', numbers, strict=False)),
        'orientation': dict(zip('xyzw', numbers[3:], strict=True))}})


def poses_of(messages, frame='map'):
    """`PoseArrays` of the concatenated bytes of `messages`."""
    ends = np.cumsum([len(m) for m in messages], dtype=np.int64)
    return poses(b''.join(messages), ends - [len(m) for m in messages], ends, frame)


@pytest.mark.parametrize('frame', ['map', '', 'a much longer name', 'möp'])
def test_poses_of_a_frame_equal_the_decoded_messages(frame):
    """Only poses in the frame are decoded, even if another frame name has the same length."""
    frames = ['map', 'utm', '', 'a', 'a much longer name', 'möp', 'odom']
    data = [pose_message(k, frames[k % len(frames)]) for k in range(28)]
    found = poses_of(data, frame)
    assert found.is_decoded.tolist() == [frames[k % len(frames)] == frame for k in range(28)]
    for k in np.flatnonzero(found.is_decoded):
        expected = decode(RawMessage('/p', POSE, 0, data[k], schema_of(POSE)))
        p, q = expected.pose.position, expected.pose.orientation
        assert found.pose[k].tolist() == [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        assert found.stamp_ns[k] == (expected.header.stamp.sec * 10**9
                                     + expected.header.stamp.nanosec)


@pytest.mark.parametrize('damage', [
    lambda m: b'', lambda m: m[:3], lambda m: m[:15], lambda m: m[:40], lambda m: m[:-1],
    lambda m: b'\x00\x00' + m[2:], lambda m: b'\x07' + m[1:],
    lambda m: m[:12] + struct.pack('<I', 2**31 + 5) + m[16:],
    lambda m: m[:12] + struct.pack('<I', 0) + m[16:], lambda m: m[:19] + b'x' + m[20:]])
def test_damaged_or_unusual_poses_are_left_to_the_decoder(damage):
    data = [pose_message(k, 'map') for k in range(5)]
    data[2] = damage(data[2])
    assert poses_of(data).is_decoded.tolist() == [True, True, False, True, True]
