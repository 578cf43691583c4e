"""Checks of the readings of each sensor: lost readings, several sources, a weak field."""

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from mag_tracking.records import Readings
from mag_tracking.units import NS

MAX_REMEMBERED = 1000
"""Maximum number of stored sequence numbers. An older number indicates a restarted sequence."""
MAX_GAP = 1_000_000
"""Largest gap counted as loss. A larger gap is counted as a jump of the sequence."""


class SequenceCheck:
    """Checks the sequence numbers of one sensor, which return to 0 at `wrap` (0: never)."""

    def __init__(self, wrap: int) -> None:
        self._wrap = wrap
        self.counts: Counter[str] = Counter()
        self.pause()

    def pause(self) -> None:
        """Start a new sequence, so that numbers skipped during a pause are not counted as lost."""
        self._newest_number: int | None = None
        self._values: dict[int, bytes] = {}
        self._lost_numbers: dict[int, bool] = {}

    def is_new(self, sequence: int, values: bytes) -> bool:
        """Record a reading; return whether it is not a duplicate (the same number and values).

        Skipped numbers are counted as lost; the count is corrected if they arrive late. An older
        number that is neither lost nor a duplicate restarts the sequence.
        """
        if sequence < 0 or self._wrap and sequence >= self._wrap:
            self.counts['sequence numbers out of range'] += 1
            return True
        distance = (1 if self._newest_number is None
                    else self._distance(sequence, self._newest_number))
        if distance > MAX_GAP:
            self.counts['sequence jumps'] += 1
            self.pause()
        elif distance > 0:
            self._record_gap(sequence, distance - 1)
        elif sequence in self._lost_numbers:
            del self._lost_numbers[sequence]
            self.counts['lost'] -= 1
            self.counts['late arrivals'] += 1
        elif self._values.get(sequence) == values:
            self.counts['duplicates'] += 1
            return False
        else:
            self.counts['sequence restarts'] += 1
            self.pause()
            distance = 1
        if distance > 0:
            self._newest_number = sequence
        self._values[sequence] = values
        _trim(self._values)
        return True

    def _distance(self, sequence: int, last: int) -> int:
        """Signed distance from `last` to `sequence`; negative if `sequence` is older."""
        distance = sequence - last
        if self._wrap:
            distance = (distance + self._wrap // 2) % self._wrap - self._wrap // 2
        return distance

    def _record_gap(self, sequence: int, n: int) -> None:
        if n:
            self.counts['lost'] += n
        for number in range(sequence - min(n, MAX_REMEMBERED), sequence):
            self._lost_numbers[number % self._wrap if self._wrap else number] = True
        _trim(self._lost_numbers)


def _trim(memory: dict[int, bytes] | dict[int, bool]) -> None:
    while len(memory) > MAX_REMEMBERED:
        del memory[next(iter(memory))]


RELEASE_TIMEOUT_S = 5.0
"""[s] Silence after which a source is forgotten, unless its readings are further apart."""
MAX_INTERVALS = 3.0
"""Silence after which a source is forgotten, in mean intervals between its readings."""
MAX_SENDERS = 64
"""Maximum number of sources that are observed. The one that was silent longest is dropped first."""
MAX_NAMED = 4
"""Maximum number of sources named in a message."""
WINDOW = 10
"""Number of seconds over which the steadiness of a source is measured."""
MIN_SECONDS = 2
"""Minimum number of complete seconds for a measurement of the steadiness."""
ROUNDING_VARIANCE = 0.25
"""Variance of the readings in a second of a regular source, whose period is no part of a second."""
MARGIN = 0.2
"""Difference of steadiness above which another source is selected."""
Source: TypeAlias = tuple[str, str]
"""(name of the sensor at the device, source of the arrival)."""


class _Sender:
    """Numbers of readings of one source in successive seconds."""

    def __init__(self, now_ns: int) -> None:
        self.first_ns = self.last_ns = now_ns
        self.n = 0
        # Standard deviation over mean of the readings per second. It is near 0 for a steady source,
        # and more than 1 for a source that sends a reading every few seconds.
        self.unsteadiness = math.inf
        self._end_ns, self._n_in_second = now_ns + NS, 0
        self._counts: deque[int] = deque(maxlen=WINDOW)

    def add(self, now_ns: int) -> None:
        """Add a reading."""
        if now_ns >= self._end_ns:
            self.advance(now_ns)
        self._n_in_second += 1
        self.n += 1
        self.last_ns = now_ns

    def advance(self, now_ns: int) -> None:
        """Complete the seconds before `now_ns`, and update the steadiness."""
        n_complete = (now_ns - self._end_ns) // NS + 1
        if n_complete <= 0:
            return
        self._counts.append(self._n_in_second)
        self._counts.extend([0] * min(n_complete - 1, WINDOW))
        self._end_ns, self._n_in_second = self._end_ns + n_complete * NS, 0
        mean = sum(self._counts) / len(self._counts)
        self.unsteadiness = math.inf
        if mean and len(self._counts) >= MIN_SECONDS:
            variance = (sum((n - mean)**2 for n in self._counts) / len(self._counts)
                        + ROUNDING_VARIANCE)
            self.unsteadiness = math.sqrt(variance) / mean

    def rate_hz(self) -> float:
        """Mean rate of the readings; 0 for a single reading."""
        elapsed_ns = self.last_ns - self.first_ns
        return (self.n - 1) * NS / elapsed_ns if elapsed_ns > 0 else 0.0

    def is_silent(self, now_ns: int) -> bool:
        """Whether the source can be forgotten."""
        rate = self.rate_hz()
        timeout_s = max(RELEASE_TIMEOUT_S, MAX_INTERVALS / rate if rate else 0.0)
        return now_ns - self.last_ns > timeout_s * NS


class SingleSource:
    """Selects the steadiest source of a sensor's readings and counts `changes`.

    The first source remains selected until it has been silent for `RELEASE_TIMEOUT_S` and for
    `MAX_INTERVALS` of its intervals, or another source is steadier by `MARGIN`. Stray messages
    therefore do not block the device, and two equal sources do not alternate.
    """

    def __init__(self) -> None:
        self.changes = 0
        self.selected: Source | None = None
        # In the order of the latest readings, except for the selected source.
        self._senders: OrderedDict[Source, _Sender] = OrderedDict()

    def accepts(self, source: Source, now_ns: int) -> bool:
        """Update the selection at a monotonic time; return whether `source` is selected."""
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = _Sender(now_ns)
            if len(self._senders) > MAX_SENDERS:
                del self._senders[next(s for s in self._senders if s != self.selected)]
        sender.add(now_ns)
        if source == self.selected:
            return True
        self._senders.move_to_end(source)
        if self._is_better(sender, now_ns):
            self.changes += self.selected is not None
            self.selected = source
        return source == self.selected

    def _is_better(self, sender: _Sender, now_ns: int) -> bool:
        if self.selected is None or self.selected not in self._senders:
            return True
        selected = self._senders[self.selected]
        selected.advance(now_ns)
        return selected.is_silent(now_ns) or sender.unsteadiness + MARGIN < selected.unsteadiness

    def rates_hz(self, now_ns: int) -> dict[Source, float]:
        """Forget silent sources other than the selected one; return the rates of the others."""
        silent = {s for s, sender in self._senders.items() if sender.is_silent(now_ns)}
        for source in silent - {self.selected}:
            del self._senders[source]
        return {source: sender.rate_hz() for source, sender in self._senders.items()
                if source not in silent}


def contest(sensor: str, selected: Source | None, rates_hz: Mapping[Source, float]) -> str:
    """Describe the sources of a sensor with the remedy; empty if there is at most one."""
    if len(rates_hz) < 2:
        return ''
    others = sorted(rates_hz.keys() - {selected}, key=rates_hz.__getitem__, reverse=True)
    sources = [selected] * (selected in rates_hz) + others
    texts = [_label(source) + (' (one reading' if not rates_hz[source] else
                               f' ({rates_hz[source]:.3g} Hz')
             + (', used)' if source == selected else ', refused)')
             for source in sources[:MAX_NAMED] if source is not None]
    if len(sources) > MAX_NAMED:
        texts.append(f'and {len(sources) - MAX_NAMED} more')
    by_name = len({source for _, source in rates_hz}) == 1
    name, source = max(rates_hz, key=rates_hz.__getitem__)
    return (f'{sensor}: {len(sources)} sources send its readings: {", ".join(texts)}; select one, '
            f'as in sensors: {{{name if by_name else source}: {sensor}}}')


def _label(source: Source) -> str:
    return ' from '.join(part for part in source if part) or 'a source without a name'


WEAK_FIELD = 10e-6
"""[T] Largest field of a weak sensor. The Earth's field is 22 to 67 uT; a smaller field suggests a
wrong unit, such as gauss instead of microtesla."""
WEAK_S = 5.0
"""[s] Time for which the field of a weak sensor stays below `WEAK_FIELD`."""


class FieldStrength:
    """Finds sensors whose field stays below `WEAK_FIELD`, and judges each once."""

    def __init__(self) -> None:
        self._judged: set[str] = set()
        self._since_ns: dict[str, int] = {}

    def add(self, readings: Readings) -> list[str]:
        """Return the sensors that are judged as weak; readings with a missing axis are skipped."""
        if self._judged.issuperset(readings.names):
            return []
        weak = []
        strength = np.linalg.norm(readings.field, axis=1)
        for j in np.unique(readings.sensor[~np.isnan(strength)]).tolist():
            name, own = readings.names[j], readings.sensor == j
            if name in self._judged:
                continue
            since_ns = self._since_ns.setdefault(name, int(readings.stamp_ns[own].min()))
            is_weak = bool(np.nanmax(strength[own]) < WEAK_FIELD)
            if is_weak and readings.stamp_ns[own].max() - since_ns >= WEAK_S * NS:
                weak.append(name)
            if not is_weak or name in weak:
                self._judged.add(name)
        return weak
