"""Framing of the Xsens protocol: general properties of framings, and false messages."""

import random
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.drivers.framings.xsens import XsensFraming, XsensSettings
from mag_tracking.drivers.reading import Reading
from support.counters import assert_counts
from support.xsens_messages import (
    FRAME,
    LAYOUT,
    READING,
    encode_random_frame,
    garbage,
    lost_and_false,
    message,
    mtdata2,
    packet,
    stream,
)

BETWEEN = 'bytes between frames'
WRONG_CHECKSUM = 'frames with a wrong checksum'
SPLICED = 'messages that contain the start of another'
LEGACY = XsensFraming(XsensSettings(mtdata=LAYOUT))
FRAMING = XsensFraming(XsensSettings())
MAX_MESSAGE = 512 + 7


def parse_in_pieces(framing, data, sizes):
    """Parse `data` in pieces of `sizes` and a last piece; return (readings, counts)."""
    readings, counts, rest, position = [], {}, b'', 0
    sizes = [*sizes, len(data)]
    while position < len(data):
        size = sizes.pop(0)
        piece, position = rest + data[position:position + size], position + size
        parsed = framing.parse(piece, final=position >= len(data))
        rest = piece[parsed.consumed:]
        assert len(rest) < MAX_MESSAGE
        readings += parsed.readings
        for cause, n in parsed.rejected.items():
            counts[cause] = counts.get(cause, 0) + n
    assert rest == b''
    return readings, counts


# Other messages.

def test_other_messages_are_counted_by_kind_and_errors_by_code():
    sent = (message(0x3E, b'') + message(0x42, b'\x04') + message(0x42, b'\x1e\x01')
            + message(0x42, b'\x04') + message(0x42, b'') + message(0xC1, bytes(32)))
    parsed = FRAMING.parse(sent)
    assert parsed.readings == () and parsed.consumed == len(sent)
    assert_counts(parsed.rejected, {'0x3E': 1, '0x04': 2, '0x1E': 1, 'without': 1, '0xC1': 1})


@pytest.mark.parametrize('mid', [0x00, 0x30, 0x34, 0x3C, 0x40])
def test_messages_with_invalid_identifiers_are_garbage(mid):
    false = message(mid, bytes(8))
    parsed = FRAMING.parse(false + FRAME)
    assert parsed.readings == (READING,) and parsed.rejected == {BETWEEN: len(false)}
    assert FRAMING.parse(false[:3]).consumed == 3


def padded_message(size):
    """Message with `READING` and padding packets; its DATA has `size` bytes."""
    fill = size - (len(FRAME) - 5) - 9
    sent = mtdata2(READING, behind=b''.join(
        packet(0x5010, bytes(n)) for n in (fill // 3, fill // 3, fill - 2 * (fill // 3))))
    assert len(sent) == size + 7
    return sent


@pytest.mark.parametrize('size', [255, 511, 512])
def test_messages_with_extended_length_are_read_up_to_the_maximum(size):
    sent = padded_message(size)
    for n in range(1, len(sent)):
        assert FRAMING.parse(sent[:n]).consumed == 0
    parsed = FRAMING.parse(sent + FRAME)
    assert parsed.readings == (READING, READING) and parsed.rejected == {}


def test_a_message_beyond_the_maximum_length_is_garbage():
    false = padded_message(513)
    parsed = FRAMING.parse(false + FRAME)
    assert parsed.readings == (READING,) and parsed.rejected == {BETWEEN: len(false)}
    framing = XsensFraming(XsensSettings(max_message=513))
    assert framing.parse(false + FRAME).readings == (READING, READING)


# Properties of every framing.

def test_every_byte_is_parsed_counted_or_unconsumed():
    rng = random.Random(5)
    for _ in range(200):
        frames = [encode_random_frame(rng)[0] for _ in range(10)]
        # Without preambles, so that there are no false frames.
        gaps = [bytes(rng.randrange(0xFA) for _ in range(rng.randrange(20))) for _ in frames]
        last = FRAME[:rng.randrange(len(FRAME))]
        data = b''.join(a + b for a, b in zip(gaps, frames, strict=True)) + last
        parsed = LEGACY.parse(data)
        assert parsed.rejected.get(BETWEEN, 0) == sum(map(len, gaps))
        assert data[parsed.consumed:] == last
        parsed = LEGACY.parse(data, final=True)
        assert parsed.rejected.get(BETWEEN, 0) == sum(map(len, gaps)) + len(last)
        assert parsed.consumed == len(data)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.integers(0, 2**32), st.lists(st.integers(0, 90), max_size=60))
def test_chunk_boundaries_do_not_change_the_result(seed, sizes):
    data, sent, _ = stream(random.Random(seed), 25)
    whole = LEGACY.parse(data, final=True)
    assert whole.consumed == len(data) and lost_and_false(sent, whole.readings) == (0, 0)
    assert parse_in_pieces(LEGACY, data, sizes) == (list(whole.readings), dict(whole.rejected))
    assert parse_in_pieces(LEGACY, data, [1] * len(data)) == (
        list(whole.readings), dict(whole.rejected))


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 400))
def test_chunk_boundaries_in_garbage_do_not_change_the_result(seed, size):
    rng = random.Random(seed)
    data = b''.join(rng.choice((garbage(rng, 40), message(0x0D, garbage(rng, rng.randrange(99))),
                                message(0x36, packet(0x5010, garbage(rng, 80)))))
                    for _ in range(30))
    whole = LEGACY.parse(data, final=True)
    assert parse_in_pieces(LEGACY, data, [size] * len(data)) == (
        list(whole.readings), dict(whole.rejected))


def test_all_frames_between_garbage_are_found():
    data, sent, _ = stream(random.Random(1), 20_000)
    found, _ = parse_in_pieces(LEGACY, data, [500] * (len(data) // 500))
    assert len(sent) > 17_000
    assert lost_and_false(sent, found) == (0, 0)


def test_lost_and_false_counts_missing_and_additional_readings():
    a, b, c = (Reading(sequence=n) for n in range(3))
    assert lost_and_false([a, b, c], [a, b, c]) == (0, 0)
    assert lost_and_false([a, b, c], [a, c]) == (1, 0)
    assert lost_and_false([a, b], [a, c, b]) == (0, 1)
    assert lost_and_false([a, b], [a]) == (1, 0)
    assert lost_and_false([a, a], [a]) == (1, 0)


def test_the_end_of_a_datagram_leaves_no_unconsumed_bytes():
    for n in range(len(FRAME)):
        parsed = FRAMING.parse(FRAME + FRAME[:n], final=True)
        assert parsed.readings == (READING,) and parsed.consumed == len(FRAME) + n
        assert parsed.rejected == ({BETWEEN: n} if n else {})
        parsed = FRAMING.parse(FRAME + FRAME[:n])
        assert parsed.readings == (READING,) and parsed.consumed == len(FRAME)
        assert parsed.rejected == {}


@pytest.mark.parametrize('unit', [b'\xfa', b'\xfa\xff', b'\xfa\xff\x36\xfe',
                                  b'\xfa\xff\x36\xff\x02\x00', b'\xfa\xff\x0d\xff\x02\x00',
                                  b'\xfa\xff\x36\x00\xcb', b'\xfa\xff\x01\x04\xfa\xff\x01\x04'])
def test_message_starts_without_an_end_take_linear_time(unit):
    def seconds(n):
        data = unit * (n // len(unit))
        begin = time.process_time()
        assert FRAMING.parse(data, final=True).consumed == len(data)
        return time.process_time() - begin

    # A megabyte takes less than a second; the margin allows for a slow or busy machine.
    assert seconds(400_000) < 4.0


# False messages.

def false_message(mid, size, inside, at, adjust):
    """False message of type `mid`, followed by the remaining bytes of `inside`.

    DATA has `size` bytes: `at` zeros and the beginning of `inside`. The byte at the index
    `adjust` makes the checksum valid.
    """
    header = bytearray(b'\xfa\xff' + bytes([mid, size]) + bytes(at))
    rest = inside[:size + 5 - len(header)]
    header[adjust] = -(sum(header[1:]) + sum(rest)) & 0xFF
    data = bytes(header) + inside
    assert sum(data[1:size + 5]) % 256 == 0
    return data


@pytest.mark.parametrize('inside', [FRAME * 6, message(0x32, bytes(42)) + FRAME * 6])
@pytest.mark.parametrize('size', range(9, 200, 7))
def test_a_message_that_contains_another_is_rejected(inside, size):
    """The outer message ends within the inner message, with it, or after it."""
    data = false_message(0x0D, size, inside, 6, 5)
    whole = LEGACY.parse(data, final=True)
    assert whole.readings == LEGACY.parse(inside).readings
    assert whole.rejected[SPLICED] == 1
    assert whole.rejected[BETWEEN] == len(data) - len(inside)
    assert parse_in_pieces(LEGACY, data, [1] * len(data)) == (
        list(whole.readings), dict(whole.rejected))


def test_a_message_that_ends_with_the_next_preamble_is_rejected():
    header = bytearray(b'\xfa\xff\x0d\x04\x00\x00\x00\x00')
    header[4] = -(sum(header[1:]) + 0xFA) & 0xFF
    data = bytes(header) + FRAME
    parsed = FRAMING.parse(data)
    assert parsed.readings == (READING,)
    assert parsed.rejected == {SPLICED: 1, BETWEEN: 8}
    for n in range(9, len(data)):
        assert FRAMING.parse(data[:n]).consumed == 0


def test_a_reply_that_ends_with_a_preamble_is_delayed_but_a_reading_is_not():
    reply = message(0x01, b'\x00\x00\x00\x01')
    reply = message(0x01, bytes([0, 0, 0, (reply[-1] + 1 - 0xFA) & 0xFF]))
    assert reply[-1] == 0xFA
    assert FRAMING.parse(reply).consumed == 0
    rejected = {'other messages: 0x01': 1}
    assert FRAMING.parse(reply, final=True).rejected == rejected
    parsed = FRAMING.parse(reply + FRAME)
    assert parsed.readings == (READING,) and parsed.rejected == rejected
    for count in range(256):
        sent = mtdata2(READING._replace(sequence=count))
        for following in (b'', b'\xff', b'\xff\x36\x20'):
            assert len(FRAMING.parse(sent + following).readings) == 1


def test_lost_bytes_cost_no_other_message():
    """Every other message loses two or more bytes, so it extends into the next message."""
    rng = random.Random(3)
    data, sent = [], []
    while len(data) < 8000:
        frame, readings = encode_random_frame(rng)
        if not readings:
            continue
        if len(data) % 2:
            begin = rng.randrange(1, len(frame) - 2)
            frame = frame[:begin] + frame[begin + rng.randrange(2, len(frame) - begin + 1):]
        else:
            sent += readings
        data.append(frame)
    parsed = LEGACY.parse(b''.join(data), final=True)
    assert lost_and_false(sent, parsed.readings) == (0, 0)
    assert parsed.rejected[SPLICED] > 5


def test_one_wrong_byte_costs_one_message():
    before, after = READING._replace(sequence=1), READING._replace(sequence=3)
    for at in range(len(FRAME)):
        for change in (1, 0x80, 0xFF):
            wrong = bytearray(FRAME)
            wrong[at] ^= change
            data = mtdata2(before) + bytes(wrong) + mtdata2(after) * 6
            parsed = FRAMING.parse(data, final=True)
            assert parsed.readings == (before, *[after] * 6), (at, change)
            assert parsed.rejected[BETWEEN] == len(FRAME)


def test_a_frame_with_a_wrong_checksum_is_counted_and_searched():
    wrong = FRAME[:-1] + bytes([FRAME[-1] ^ 1])
    parsed = FRAMING.parse(wrong + FRAME)
    assert parsed.readings == (READING,)
    assert parsed.rejected == {WRONG_CHECKSUM: 1, BETWEEN: len(wrong)}


def test_a_possible_start_in_the_data_delays_the_message():
    """The data contain a possible start of another message, which would end later."""
    for inside, ends in ((b'\xfa\xff\x36\x20', 0x20 + 5), (b'\xfa\xff\x32\x2a', 0x2A + 5)):
        sent = mtdata2(READING, behind=packet(0x5010, bytes(3) + inside + bytes(5)))
        begins = sent.index(inside)
        data = sent + FRAME * 3
        for n in range(1, begins + ends):
            assert LEGACY.parse(data[:n]).readings == ()
        parsed = LEGACY.parse(data[:begins + ends])
        assert parsed.readings[0] == READING
        assert LEGACY.parse(sent, final=True).readings == (READING,)
        parsed = LEGACY.parse(data)
        assert parsed.readings == (READING,) * 4 and parsed.rejected == {}
    # A start that cannot become a data message causes no delay.
    for inside in (b'\xfa\xff\x0d\x20', b'\xfa\xff\x34\x20', b'\xfa\xff\x36\xff\x02\x01'):
        sent = mtdata2(READING, behind=packet(0x5010, bytes(3) + inside + bytes(5)))
        assert FRAMING.parse(sent).readings == (READING,)


def test_a_valid_checksum_in_the_data_does_not_reject_the_message():
    """The inner message has invalid packets, or a length other than configured for MTData."""
    for inside in (message(0x36, b'\x10\x20\x03\x00\x00'), message(0x32, bytes(41)),
                   message(0x31, b'')):
        sent = mtdata2(READING, behind=packet(0x5010, inside))
        parsed = LEGACY.parse(sent)
        assert parsed.readings == (READING,) and parsed.rejected == {}


def test_a_reading_waits_for_at_most_the_longest_message():
    """The data contain a possible start of a message of the maximum length."""
    inside = b'\xfa\xff\x36\xff\x02\x00'
    sent = mtdata2(READING, behind=packet(0x5010, bytes(3) + inside + bytes(5)))
    data = sent + FRAME * 20
    assert FRAMING.parse(data[:MAX_MESSAGE - 1]).readings == ()
    assert FRAMING.parse(data[:MAX_MESSAGE]).readings[0] == READING
    assert FRAMING.parse(data).readings == (READING,) * 21


def test_a_reply_that_may_contain_the_longest_message_is_rejected():
    reply = message(0x0D, bytes(3) + b'\xfa\xff\x36\xff\x02\x00' + bytes(5))
    data = reply + FRAME * 20
    assert FRAMING.parse(data[:MAX_MESSAGE - 1]).consumed == 0
    parsed = FRAMING.parse(data)
    assert parsed.readings == (READING,) * 20
    assert parsed.rejected[SPLICED] == 1 and parsed.rejected[BETWEEN] == len(reply)
    # A datagram that ends earlier cannot contain that message.
    assert FRAMING.parse(reply + FRAME, final=True).rejected == {'other messages: 0x0D': 1}


@pytest.mark.parametrize('false', [b'\xfa', b'\xfa\xff', b'\xfa\xff\x36', b'\xfa\xff\x36\xfe',
                                   b'\xfa\xff\x36\xff\x02\x00', b'\xfa\xff\x0d\xff\x02\x00'])
def test_a_false_start_delays_readings_by_at_most_the_longest_message(false):
    data = false + FRAME * 12
    rest, returned_at = b'', []
    for at in range(len(data)):
        rest += data[at:at + 1]
        parsed = FRAMING.parse(rest)
        rest = rest[parsed.consumed:]
        returned_at += [at + 1] * len(parsed.readings)
    complete_at = [len(false) + len(FRAME) * n for n in range(1, 13)]
    assert returned_at == [max(at, returned_at[0]) for at in complete_at]
    assert returned_at[0] <= max(complete_at[0], MAX_MESSAGE)
