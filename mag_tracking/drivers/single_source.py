"""Selection of one source of a sensor's readings, if several sources claim to be the sensor."""

import math
from collections import OrderedDict, deque
from collections.abc import Mapping
from typing import TypeAlias

from mag_tracking.units import NS

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

    The first source is selected. It remains selected until it has been silent for
    `RELEASE_TIMEOUT_S` and for `MAX_INTERVALS` of its intervals, or another source is steadier by
    `MARGIN`. Stray messages, whether before the start of the device or later, therefore do not
    block the device, and two equal sources do not alternate.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._selected: Source | None = None
        # In the order of the latest readings, except for the selected source.
        self._senders: OrderedDict[Source, _Sender] = OrderedDict()

    @property
    def selected(self) -> Source | None:
        """Selected source; None before the first reading."""
        return self._selected

    def accepts(self, source: Source, now_ns: int) -> bool:
        """Update the selection at a monotonic time; return whether `source` is selected."""
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = _Sender(now_ns)
            self._drop_oldest()
        sender.add(now_ns)
        if source == self._selected:
            return True
        self._senders.move_to_end(source)
        if self._is_better(sender, now_ns):
            self.changes += self._selected is not None
            self._selected = source
        return source == self._selected

    def _is_better(self, sender: _Sender, now_ns: int) -> bool:
        """Whether a source is preferable to the selected one."""
        if self._selected is None or self._selected not in self._senders:
            return True
        selected = self._senders[self._selected]
        selected.advance(now_ns)
        return selected.is_silent(now_ns) or sender.unsteadiness + MARGIN < selected.unsteadiness

    def _drop_oldest(self) -> None:
        """Drop the source that was silent longest, except the selected one, if there are too
        many."""
        if len(self._senders) > MAX_SENDERS:
            del self._senders[next(s for s in self._senders if s != self._selected)]

    def rates_hz(self, now_ns: int) -> dict[Source, float]:
        """Forget silent sources other than the selected one; return the rates of the others, 0 for
        a single reading."""
        silent = {s for s, sender in self._senders.items() if sender.is_silent(now_ns)}
        for source in silent - {self._selected}:
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
    """Name and origin of the readings of a source."""
    return ' from '.join(part for part in source if part) or 'a source without a name'
