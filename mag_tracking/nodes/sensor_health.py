"""The health of each sensor as diagnostics, over the latest minute or two."""

import math
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from mag_tracking.stages.health import Finding, SensorHealth
from mag_tracking.stages.stage import NS

TERM_S = 60.0
"""[s] What was wrong is forgotten after one to two of these."""
SILENT_S = 2.0
"""[s] A sensor of which nothing came for longer is silent."""
LONGEST_DELAY_S = 86400.0
"""[s] Stamps that are older are of a replay, of which no delay is known."""


class HealthDiagnostics:
    """Looks at the raw readings of a network; `statuses` says how the sensors are."""

    def __init__(self, network, max_field):
        self._network, self._max_field = network, max_field
        self._term_ends = time.monotonic() + TERM_S
        self._heard, self._adopted = dict.fromkeys(network.names), dict.fromkeys(network.names)
        self._relearnt = dict.fromkeys(network.names, 0)
        self._past = {name: None for name in network.names}
        self._present = {name: SensorHealth() for name in network.names}

    def add(self, sample, now_ns):
        """A raw reading that came at `now_ns`."""
        received = now_ns if abs(now_ns - sample.stamp_ns) < LONGEST_DELAY_S * NS else None
        self._present[sample.sensor].add(sample.stamp_ns, sample.field, received)
        self._heard[sample.sensor] = time.monotonic()

    def statuses(self, node, calibrate):
        """[DiagnosticStatus], one a sensor; `calibrate` is the `Calibrate` stage."""
        if time.monotonic() > self._term_ends:
            self._term_ends = time.monotonic() + TERM_S
            self._past, self._present = self._present, {
                name: SensorHealth() for name in self._network.names}
        for name, background in calibrate.backgrounds().items():
            if background.n_relearnt != self._relearnt[name]:
                self._relearnt[name] = background.n_relearnt
                self._adopted[name] = time.monotonic()
        return [self._status(node, j, name, calibrate)
                for j, name in enumerate(self._network.names)]

    def _findings(self, j, name):
        """What is wrong with a sensor, the worst first."""
        heard = self._heard[name]
        if heard is None or time.monotonic() - heard > SILENT_S:
            what = 'nothing has come' if heard is None else \
                f'silent for {time.monotonic() - heard:.0f} s'
            return [Finding(True, name, what, 'look at its cable, its driver and the topic '
                            f'{self._network.topics[j]}')]
        found = {}
        adopted = self._adopted[name]
        if adopted is not None and time.monotonic() - adopted < 2.0 * TERM_S:
            found[''] = Finding(False, name, 'a steady change was taken for its background',
                                'a parked vehicle, or something that was put beside it')
        for health in (self._past[name], self._present[name]):
            if health is not None and health.counts['readings']:
                for f in health.findings(name, self._network.noise_std[j], self._max_field):
                    found.setdefault(f.what, f)
        return sorted(found.values(), key=lambda f: not f.serious)

    def _status(self, node, j, name, calibrate):
        """The DiagnosticStatus of one sensor."""
        found = self._findings(j, name)
        level = DiagnosticStatus.OK
        if found:
            level = DiagnosticStatus.ERROR if found[0].serious else DiagnosticStatus.WARN
        health = self._present[name]
        if not health.counts['readings'] and self._past[name] is not None:
            health = self._past[name]
        background = calibrate.backgrounds()[name]
        c, n = health.counts, max(1, health.counts['readings'])
        values = {
            'rate [Hz]': health.rate, 'lost': c['lost'],
            'delay [ms]': 1e3 * health.delay_s[0],
            'noise [nT]': _numbers(1e9 * health.noise_std),
            'field [uT]': _numbers(1e6 * health.field),
            'saturated': c['saturated'], 'spikes': c['spikes'],
            'share of missing axes': (c['x'] + c['y'] + c['z']) / (3 * n),
            'background': 'frozen' if background.frozen else
                          'ready' if background.ready else 'learning',
            'background drift [nT/s]': _numbers(1e9 * background.drift),
            'backgrounds taken anew': background.n_relearnt}
        return DiagnosticStatus(
            level=level, name=f'{node}: {name}', hardware_id=name,
            message=f'{found[0].what}; {found[0].advice}' if found else 'running',
            values=[KeyValue(key=k, value=v if isinstance(v, str) else _number(v))
                    for k, v in values.items()]
            + [KeyValue(key='also', value=f.what) for f in found[1:]])


def _number(value):
    """Short text of a number."""
    return '' if math.isnan(value) else f'{value:.4g}'


def _numbers(values):
    """Short text of numbers."""
    return ' '.join(_number(v) or '-' for v in np.asarray(values, dtype=float))
