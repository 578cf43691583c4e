"""The binary protocol of Xsens' MTi and MTx, as a framing.

A message is the preamble 0xFA, the address 0xFF, its kind (MID), the length of DATA
(one byte, or 0xFF and two bytes), DATA, and a byte that makes the sum of all but the
preamble a multiple of 256. One wrong message of 256 passes such a sum, so:

- A message must be one that a device sends: MTData2, MTData, WakeUp, Error, or an answer,
  whose MID is that of the question plus one and so odd; and not longer than the settings
  allow.
- The packets in MTData2 must fill it, and MTData must be as long as the settings say.
- Where a right data message begins inside another message, that other one is none: it was
  garbage, or it lost some of its bytes and took in those of its successor.

So no true data message is lost to a false one that begins before it, with two exceptions: both
together are longer than the longest frame, and the false one is a data message too; or a data
message that lost one single byte ends, and is right, with the preamble of the next.
A false one that meets no true one can still pass. What is not taken is searched again from the
byte behind its preamble.

Sources: Xsens, "MT Low Level Communication Protocol Documentation", MT0101P, revision
2019.A: message structure and message listing; Xsens, "MTi User Manual", MT0605P, section
5.3.2: acknowledgements.
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from mag_tracking.drivers.framings.xsens_data import (
    TICK_S,
    Content,
    MTDataLayout,
    read_mtdata2,
)
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

_PREAMBLE = b'\xfa'
_START = b'\xfa\xff'
_MTDATA, _MTDATA2, _WAKE_UP, _ERROR = 0x32, 0x36, 0x3E, 0x42
_DATA_MESSAGES = (_MTDATA, _MTDATA2)
_EXTENDED = 0xFF
_MAX_OVERHEAD = 7
"""Bytes of a message with extended length that are not DATA."""


@dataclass(frozen=True)
class XsensSettings:
    """Settings of the Xsens protocol."""

    max_message: int = param(
        512, 'Bytes of data in the longest message; a longer one is taken for garbage.',
        'bytes', (254, 4096))
    mtdata: tuple[str, ...] = param(
        ('none',), 'Blocks in the messages MTData of an MTi or MTx of the first generation, as its '
        'output mode and output settings say, in this order: temp, acc, gyr, mag, quaternion or '
        'euler or matrix, analog_1, analog_2, status, counter; none = it does not send MTData.')
    mtdata_format: str = param('float', 'Format of the numbers in MTData: float or fp12.20.')


class _Message(NamedTuple):
    """A message in a window of bytes; it may end behind what has come."""

    mid: int
    begin: int
    """Of DATA."""
    end: int
    """Behind the checksum."""


class _Step(NamedTuple):
    """What became of the message that may begin at a place."""

    length: int
    """Bytes that are done with; 0 = more are needed to tell."""
    taken: bool
    causes: tuple[str, ...] = ()
    reading: Reading | None = None


_WAIT = _Step(0, False)
_REFUSE = _Step(1, False)


def _is_from_device(mid: int) -> bool:
    """Whether a device sends such messages."""
    return mid % 2 == 1 or mid in (_MTDATA, _MTDATA2, _WAKE_UP, _ERROR)


def _message_at(window: bytes, place: int, longest: int) -> _Message | None:
    """The message that may begin there, or None where none can.

    While its head is not whole, MID is -1 and the end is one byte behind the window.
    """
    head = window[place:place + 6]
    if not head.startswith(_START[:len(head)]):
        return None
    if len(head) > 2 and not _is_from_device(head[2]):
        return None
    if len(head) < 4 or head[3] == _EXTENDED and len(head) < 6:
        return _Message(-1, len(window), len(window) + 1)
    size, begin = head[3], place + 4
    if size == _EXTENDED:
        size, begin = head[4] << 8 | head[5], place + 6
    if size > longest:
        return None
    return _Message(head[2], begin, begin + size + 1)


def _sum_is_right(window: bytes, place: int, message: _Message) -> bool:
    """Whether all but the preamble adds up to a multiple of 256."""
    return sum(window[place + 1:message.end]) % 256 == 0


class XsensFraming:
    """Finds readings in what an MTi or MTx sends; see `Framing`.

    A reading has the field in arbitrary units (1 = the field's size where Xsens calibrated
    the sensor), the acceleration in m/s^2, the packet counter as sequence (modulo 2^16), and
    SampleTimeFine as ticks (10 kHz); each if the device sends it. A message with neither field
    nor acceleration gives none, and is counted; its number will seem to be lost.

    Raises SettingsError where `mtdata` or `mtdata_format` describe no message.
    """

    SETTINGS = XsensSettings
    CLOCK = {'tick_s': TICK_S, 'wrap': 2**32}
    DRIVER = {'sequence_wrap': 2**16}

    def __init__(self, settings: XsensSettings) -> None:
        self._longest = settings.max_message
        self._layout: MTDataLayout | None = None
        if tuple(settings.mtdata) != ('none',):
            self._layout = MTDataLayout(settings.mtdata, settings.mtdata_format)
        elif settings.mtdata_format != 'float':
            raise SettingsError(f'mtdata_format is {settings.mtdata_format!r}, but mtdata says '
                                'that there is no MTData')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """All readings in `data`, bytes; see `Framing.parse`."""
        readings: list[Reading] = []
        rejected: Counter[str] = Counter()
        position = 0
        longest = self._longest + _MAX_OVERHEAD
        while True:
            start = data.find(_START, position)
            if start < 0:
                start = len(data) - data.endswith(_PREAMBLE, position)
            rejected['bytes between frames'] += start - position
            position = start
            if start == len(data):
                break
            window = data[start:start + longest]
            step = self._step(window, not final and len(window) < longest)
            if step.length == 0:
                break
            position += step.length
            if not step.taken:
                rejected['bytes between frames'] += step.length
            rejected.update(step.causes)
            if step.reading is not None:
                readings.append(step.reading)
        return Parsed(tuple(readings), position, {c: n for c, n in rejected.items() if n})

    def _step(self, window: bytes, more: bool) -> _Step:
        """What becomes of the message at the beginning of `window`; `more` = more may come."""
        message = _message_at(window, 0, self._longest)
        if message is None:
            return _REFUSE
        if message.end > len(window):
            return _WAIT if more else _REFUSE
        if not _sum_is_right(window, 0, message):
            return _REFUSE._replace(causes=('frames with a wrong checksum',))
        content = self._data_content(window, message)
        if content is None and message.mid == _MTDATA2:
            return _REFUSE._replace(causes=('MTData2 messages whose packets do not fit',))
        inside = self._step_inside(window, message, content is not None, more)
        if inside is not None:
            return inside
        if content is None:
            return _Step(message.end, True, (self._cause(window, message),))
        return _Step(message.end, True, content.causes, content.reading)

    def _step_inside(self, window: bytes, outer: _Message, outer_is_data: bool,
                     more: bool) -> _Step | None:
        """The step if `outer` is not to be taken, or not yet, for what begins in it; else None."""
        refused = _REFUSE._replace(causes=('messages in which another begins',))
        place = 0
        while True:
            # A data message is not kept waiting for the byte behind it, though its checksum might
            # be a preamble; it would come late once in 256 times.
            place = self._next_inside(window, place + 1, outer.end, outer_is_data)
            if place < 0:
                return None
            inner = _message_at(window, place, self._longest)
            if inner is None or inner.mid not in (-1, *_DATA_MESSAGES):
                continue
            if inner.end > len(window):
                if more:
                    return _WAIT
                if len(window) == self._longest + _MAX_OVERHEAD and not outer_is_data:
                    return refused
            elif (_sum_is_right(window, place, inner)
                  and self._data_content(window, inner) is not None):
                return refused

    @staticmethod
    def _next_inside(window: bytes, place: int, end: int, whole: bool) -> int:
        """Where the next start begins before `end`, -1 = nowhere; `whole` = both its bytes."""
        found = window.find(_START, place, end if whole else end + 1)
        if found < 0 and not whole and end == len(window) and window.endswith(_PREAMBLE, place):
            return end - 1
        return found

    def _data_content(self, window: bytes, message: _Message) -> Content | None:
        """The `Content` of a data message that is made as it should be, else None."""
        data = window[message.begin:message.end - 1]
        if message.mid == _MTDATA2:
            return read_mtdata2(data)
        if message.mid == _MTDATA and self._layout is not None and len(data) == self._layout.size:
            return self._layout.read(data)
        return None

    def _cause(self, window: bytes, message: _Message) -> str:
        """How a message that gives nothing is counted."""
        if message.mid == _MTDATA:
            if self._layout is None:
                return 'MTData messages, of which the settings say that there are none'
            return 'MTData messages of another length than the settings say'
        if message.mid == _ERROR:
            if message.end - message.begin < 2:
                return 'error messages without a code'
            return f'error messages with code 0x{window[message.begin]:02X}'
        return f'other messages: 0x{message.mid:02X}'
