"""Diagnosis: rank findings by cause, so that consequences do not hide the fault behind them."""

import enum
from collections.abc import Iterable
from dataclasses import dataclass


class Cause(enum.Enum):
    """Kind of a fault; the value names it in `summary.json`."""

    # The computer, the recording and the topics.
    OVERLOADED = 'overloaded computer'
    DAMAGED_RECORDING = 'damaged recording'
    UNDECODABLE = 'undecodable messages'
    WRONG_TYPE = 'wrong message type'
    SEVERAL_PUBLISHERS = 'several publishers'
    NO_MESSAGES = 'no messages'
    # Timestamps.
    MILLISECOND_STAMPS = 'timestamps in milliseconds'
    ZERO_STAMPS = 'timestamps of zero'
    BOOT_STAMPS = 'timestamps since the start of the device'
    COARSE_STAMPS = 'coarse timestamps'
    BURST_STAMPS = 'readings in bursts'
    PACKET_STAMPS = 'one timestamp per packet'
    CLOCK_DIFFERS = 'clock differs'
    CLOCK_STEPPED = 'clock stepped'
    TOO_FAR_AHEAD = 'timestamps too far ahead'
    BACKWARD_STAMPS = 'timestamps went back'
    DUPLICATE_STAMPS = 'duplicate timestamps'
    DELAY_VARIES = 'delay varies'
    DELAYED = 'delayed'
    RATE_TOO_LOW = 'rate too low'
    LOST = 'lost readings'
    # Values.
    NO_READING_MARK = 'mark for a missing reading'
    REPEATED = 'repeated values'
    WRONG_UNIT = 'wrong unit'
    TOO_LARGE = 'values above the limit'
    SATURATED = 'saturated'
    STUCK = 'stuck'
    DEAD_AXIS = 'dead axis'
    NO_AXIS = 'no valid axis'
    MISSING_AXIS = 'missing axis'
    INFINITE = 'infinite value'
    SPIKES = 'spikes'
    NOISY = 'noisy'
    WRONG_COVARIANCE = 'wrong covariance'
    # Comparison of the sensors with each other and with the Earth's field.
    CONTRADICTS_EARTH = "contradicts the Earth's field"
    NOT_COMPARED = 'not compared'
    # Backgrounds.
    CONSTANT = 'constant readings'
    NO_BACKGROUND = 'no background'
    DOUBTFUL_BACKGROUND = 'doubtful background'
    RELEARNT_BACKGROUND = 'relearnt background'
    FROZEN_BACKGROUND = 'frozen background'
    # Results.
    REJECTED = 'rejected samples'
    MISSED_TARGETS = 'missed targets'
    FRAMES_TOO_LONG = 'frames too long'
    NO_DETECTION = 'no detection'


@dataclass(frozen=True)
class Finding:
    """A fault, and advice on how to fix it."""

    serious: bool
    """True if the fault makes results wrong, false if it only makes them less accurate."""
    subject: str
    """Name of the sensor, stage or file."""
    fault: str
    advice: str
    cause: Cause

    def __str__(self) -> str:
        return f'{self.subject}: {self.fault}; {self.advice}'


@dataclass(frozen=True)
class Diagnosis:
    """A finding that no other finding explains, and the findings that it explains."""

    finding: Finding
    consequences: tuple[Finding, ...] = ()
    """Their advice does not apply: the fault to be fixed is that of `finding`."""

    @property
    def serious(self) -> bool:
        """Whether the finding or one of its consequences makes results wrong."""
        return self.finding.serious or any(f.serious for f in self.consequences)

    def __str__(self) -> str:
        return '; '.join([str(self.finding), *(f'therefore {f.fault}' for f in self.consequences)])


def _explained(symptoms: str, artefacts: str = '') -> tuple[set[Cause], set[Cause]]:
    """Causes of symptoms and artefacts, from their names, separated by spaces."""
    return {Cause[name] for name in symptoms.split()}, {Cause[name] for name in artefacts.split()}


_UNUSABLE = 'NO_BACKGROUND NO_DETECTION MISSED_TARGETS CONSTANT'
_STAMP_SYMPTOMS = ('DUPLICATE_STAMPS BACKWARD_STAMPS TOO_FAR_AHEAD FRAMES_TOO_LONG REJECTED '
                   'RATE_TOO_LOW RELEARNT_BACKGROUND ' + _UNUSABLE)
_STAMP_ARTEFACTS = 'CLOCK_DIFFERS CLOCK_STEPPED DELAY_VARIES DELAYED LOST SPIKES STUCK'
_WRONG_STAMPS = _explained(_STAMP_SYMPTOMS, _STAMP_ARTEFACTS)
_EXPLAINED = {
    Cause.OVERLOADED: _explained('LOST DELAY_VARIES DELAYED REJECTED', 'CLOCK_STEPPED'),
    Cause.DAMAGED_RECORDING: _explained('UNDECODABLE NO_MESSAGES LOST', 'CLOCK_STEPPED'),
    Cause.UNDECODABLE: _explained('NO_MESSAGES LOST ' + _UNUSABLE),
    Cause.WRONG_TYPE: _explained('NO_MESSAGES ' + _UNUSABLE),
    Cause.SEVERAL_PUBLISHERS: _explained('BACKWARD_STAMPS DUPLICATE_STAMPS NOISY REJECTED',
                                         'CLOCK_STEPPED DELAY_VARIES SPIKES LOST'),
    Cause.NO_MESSAGES: _explained(_UNUSABLE),
    Cause.MILLISECOND_STAMPS: _explained(
        _STAMP_SYMPTOMS, _STAMP_ARTEFACTS + ' COARSE_STAMPS PACKET_STAMPS BURST_STAMPS'),
    Cause.ZERO_STAMPS: _WRONG_STAMPS,
    Cause.BOOT_STAMPS: _WRONG_STAMPS,
    Cause.COARSE_STAMPS: _WRONG_STAMPS,
    Cause.BURST_STAMPS: _WRONG_STAMPS,
    Cause.PACKET_STAMPS: _WRONG_STAMPS,
    Cause.CLOCK_STEPPED: _explained('BACKWARD_STAMPS DUPLICATE_STAMPS TOO_FAR_AHEAD REJECTED',
                                    'DELAY_VARIES DELAYED LOST'),
    Cause.CLOCK_DIFFERS: _explained('DELAYED REJECTED'),
    Cause.RATE_TOO_LOW: _explained('DOUBTFUL_BACKGROUND FROZEN_BACKGROUND ' + _UNUSABLE,
                                   'SPIKES FRAMES_TOO_LONG'),
    Cause.NO_READING_MARK: _explained('NO_AXIS MISSING_AXIS INFINITE TOO_LARGE ' + _UNUSABLE,
                                      'WRONG_UNIT SATURATED SPIKES STUCK DEAD_AXIS NOISY'),
    Cause.REPEATED: _explained('RATE_TOO_LOW NO_DETECTION',
                               'SATURATED STUCK SPIKES NOISY WRONG_COVARIANCE'),
    Cause.WRONG_UNIT: _explained('TOO_LARGE CONTRADICTS_EARTH NOISY WRONG_COVARIANCE '
                                 + _UNUSABLE, 'SATURATED SPIKES STUCK'),
    Cause.SPIKES: _explained('TOO_LARGE'),
    Cause.TOO_LARGE: _explained(_UNUSABLE),
    Cause.SATURATED: _explained(_UNUSABLE, 'STUCK DEAD_AXIS SPIKES'),
    Cause.STUCK: _explained(_UNUSABLE),
    Cause.DEAD_AXIS: _explained('CONTRADICTS_EARTH ' + _UNUSABLE),
    Cause.NO_AXIS: _explained('MISSING_AXIS ' + _UNUSABLE),
    Cause.INFINITE: _explained(_UNUSABLE),
    Cause.CONSTANT: _explained('NO_BACKGROUND NO_DETECTION MISSED_TARGETS'),
    Cause.NO_BACKGROUND: _explained('NO_DETECTION'),
}
"""{cause: (consequences, causes whose statement is then wrong and not reported)}."""
_NETWORK_WIDE = frozenset({
    Cause.OVERLOADED, Cause.DAMAGED_RECORDING, Cause.UNDECODABLE,
    Cause.FRAMES_TOO_LONG, Cause.REJECTED, Cause.NO_DETECTION})
"""Causes that are related to findings about other subjects."""


def ranked(findings: Iterable[Finding]) -> list[Diagnosis]:
    """Attach each finding, unless an artefact, to the cause that explains it, or to the first one
    of the same cause and subject; serious diagnoses come first."""
    same_fault: dict[tuple[str, Cause], list[Finding]] = {}
    for finding in findings:
        same_fault.setdefault((finding.subject, finding.cause), []).append(finding)
    leading = [found[0] for found in same_fault.values()]
    leading = [f for f in leading if not _is_artefact(f, leading)]
    consequences: dict[Finding, list[Finding]] = {
        f: [] for f in leading if not any(_explains(g, f) for g in leading)}
    for finding in leading:
        root = finding
        while root not in consequences:
            root = next(f for f in leading if _explains(f, root))
        found = same_fault[finding.subject, finding.cause]
        consequences[root] += found[1:] if root is finding else found
    diagnoses = [Diagnosis(root, tuple(found)) for root, found in consequences.items()]
    return sorted(diagnoses, key=lambda d: not d.serious)


def _explains(a: Finding, b: Finding) -> bool:
    """Whether finding `a` explains finding `b`, as a consequence or as an artefact."""
    return any(b.cause in causes for causes in _EXPLAINED.get(a.cause, ())) \
        and (a.subject == b.subject or not _NETWORK_WIDE.isdisjoint({a.cause, b.cause}))


def _is_artefact(finding: Finding, present: Iterable[Finding]) -> bool:
    """Whether a finding is an artefact of a `present` finding that is not an artefact itself."""
    return any(_explains(f, finding) and finding.cause in _EXPLAINED[f.cause][1]
               and not _is_artefact(f, present) for f in present)
