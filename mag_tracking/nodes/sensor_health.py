"""Diagnostics of the health of each sensor over the last one to two minutes."""

import math
import os
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from numpy.typing import ArrayLike
from rclpy.node import Node

from mag_tracking.apps.doctor import TIME_CAUSES, HostStalls, load_findings, network_findings
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.connections import SILENCE_TIMEOUT_S, no_message_finding, topic_findings
from mag_tracking.pipeline import Settings
from mag_tracking.records import Readings, plain
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health import findings
from mag_tracking.stages.health.diagnosis import Cause, Diagnosis, Finding, ranked
from mag_tracking.stages.health.sensor_health import MAX_LIVE_DELAY_S, WINDOW, SensorHealth
from mag_tracking.stages.health.window import ReadingBuffer

WINDOW_S = 60.0
"""[s] Length of an evaluation window; a fault is reported until the end of the next window."""
MIN_READINGS = 64
"""Number of readings in the current window below which the previous window is reported."""
STARTUP_S = 3.0
"""[s] Time after the start during which a silent sensor is not a fault."""
LEARNING_TIMEOUT_FACTOR = 3.0
"""A background that is unknown after this multiple of the learning time, plus 5 s, is a fault."""


class HealthDiagnostics:
    """Monitors the raw readings of a network; `node` resolves the sensor topics and examines their
    publishers; with `is_replayed`, old timestamps are not a fault."""

    def __init__(self, network: SensorNetwork, settings: Settings, node: Node,
                 is_replayed: bool = False) -> None:
        self._node, self._is_replayed = node, is_replayed
        self._topics = dict(zip(network.names, map(node.resolve_topic_name, network.topics),
                                strict=True))
        self._settings = settings
        self._index = {name: j for j, name in enumerate(network.names)}
        # Time of the latest reading by the monotonic clock [s]; NaN before the first reading.
        self._last_received = np.full(len(network), np.nan)
        self._frozen_since_ns: dict[str, int] = {}
        # Time since which each background has been unknown, by the monotonic clock [s].
        self._unready_since: dict[str, float] = {}
        self._network_findings: dict[str, list[Finding]] = {}
        # Number of relearnt backgrounds at the start of the previous and the current window.
        self._relearnt_counts: list[dict[str, int]] = [dict.fromkeys(network.names, 0)] * 2
        self.use_network(network)

    def use_network(self, network: SensorNetwork) -> None:
        """Begin the windows with a network, or another calibration of the same sensors."""
        self._network = network
        self._clock_ns = network.clock_offset_ns
        # Earlier timestamps were corrected with the clock offsets of the previous network.
        self._buffer = ReadingBuffer(len(network), WINDOW // 2)
        self._previous_window: dict[str, SensorHealth | None] = dict.fromkeys(network.names)
        self._current_window = {name: SensorHealth() for name in network.names}
        self._stalls, self._previous_stalls = HostStalls(), HostStalls()
        # Findings of each sensor that an overloaded computer explains.
        self._late_findings: dict[str, list[Finding]] = {}
        self._start_time = time.monotonic()
        self._window_end = self._start_time + WINDOW_S

    def add(self, readings: Readings, now_ns: int) -> None:
        """Add raw readings and their arrival time; sensors outside the network are ignored."""
        indices = readings.rows(self._index)
        self._stalls.add(now_ns, readings.names)
        self._last_received[indices[indices >= 0]] = time.monotonic()
        # Readings of unknown sensors (index -1) get a wrong offset, but are not used.
        stamps, field, i = readings.stamp_ns - self._clock_ns[indices], plain(readings.field), 0
        while (i := self._buffer.add(indices, stamps, field, now_ns, i)) < len(indices):
            self.update(indices[i])

    def update(self, j: int) -> None:
        """Evaluate the buffered readings of sensor `j`."""
        self._current_window[self._network.names[j]].add_batch(*self._buffer.pop(j))

    def begin_round(self, calibrate: Calibrate) -> None:
        """Compare the sensors, before `status` is called for each; begin a new window if due."""
        for name, health in self._current_window.items():
            if health.faults != (faults := calibrate.driver_faults.of(name)):
                # Earlier statistics include the faulty readings.
                self._previous_window[name] = None
                self._current_window[name] = SensorHealth(faults=faults)
        self._compare(calibrate)
        if time.monotonic() > self._window_end:
            self._window_end = time.monotonic() + WINDOW_S
            self._previous_window, self._current_window = \
                {**self._current_window}, {name: SensorHealth(faults=health.faults)
                                           for name, health in self._current_window.items()}
            self._stalls, self._previous_stalls = HostStalls(), self._stalls
            self._relearnt_counts = [self._relearnt_counts[1], {
                name: b.n_relearnt for name, b in calibrate.backgrounds().items()}]

    def _compare(self, calibrate: Calibrate) -> None:
        """Compare the sensors and the Earth's field; note when backgrounds were frozen."""
        for name, background in calibrate.backgrounds().items():
            if not background.frozen:
                self._frozen_since_ns.pop(name, None)
            elif (last := calibrate.last_stamp_ns(name)) is not None:
                self._frozen_since_ns.setdefault(name, last)
        health = {name: self._reported_window(name) for name in self._network.names}
        calibrate.timestamps.compare_clocks({
            name: clock for name, h in health.items() if (clock := h.clock) is not None})
        self._network_findings = {name: [] for name in self._network.names}
        for finding in network_findings(self._network, self._settings.survey, calibrate, health):
            if finding.subject in self._network_findings:
                self._network_findings[finding.subject].append(finding)

    def _reported_window(self, name: str) -> SensorHealth:
        """Return a sensor's current window; the previous window if the current one is sparse."""
        previous, current = self._previous_window[name], self._current_window[name]
        return previous if previous is not None and current.counts['readings'] < MIN_READINGS \
            else current

    def _diagnoses(self, j: int, name: str, calibrate: Calibrate) -> list[Diagnosis]:
        """Diagnoses of a sensor, most serious first."""
        silent_s = time.monotonic() - self._last_received[j]
        graph_findings = topic_findings(self._node, name, self._topics[name])
        if not silent_s <= SILENCE_TIMEOUT_S:
            return ranked([*graph_findings, *self._silence_findings(name, silent_s)])
        found = [*graph_findings, *self._network_findings[name], *self._clock_findings(name)]
        # A background that is being learnt is not a fault until the timeout.
        timeout_s = 5.0 + LEARNING_TIMEOUT_FACTOR * self._settings.calibrate.learn_s
        if calibrate.backgrounds()[name].ready:
            self._unready_since.pop(name, None)
        unready_since = self._unready_since.setdefault(name, time.monotonic())
        if calibrate.backgrounds()[name].ready or time.monotonic() - unready_since > timeout_s:
            found += findings.background_findings(
                name, calibrate, self._frozen_since_ns.get(name), self._relearnt_counts[0][name])
        found += findings.covariance_findings(name, self._topics[name], calibrate)
        found += findings.driver_findings(name, calibrate)
        in_windows: dict[Cause, Finding] = {}
        for health in (self._previous_window[name], self._current_window[name]):
            if health is not None and health.counts['readings']:
                for f in health.findings(name, self._network.noise_std[j],
                                         self._settings.calibrate.max_field,
                                         not self._is_replayed):
                    in_windows.setdefault(f.cause, f)
        reported = self._reported_window(name)
        rate = reported.rate / reported.faults.repetition
        found += findings.rate_findings(name, rate, self._network, self._settings.track)
        found += in_windows.values()
        self._late_findings[name] = [f for f in found if f.cause in TIME_CAUSES]
        if not self._is_replayed and self._late_findings[name]:
            late = [f for of_sensor in self._late_findings.values() for f in of_sensor]
            found += [*load_findings(late, self._network.names, os.getloadavg()[0],
                                     os.cpu_count() or 1),
                      *self._stalls.findings(), *self._previous_stalls.findings()]
        return ranked(found)

    def _silence_findings(self, name: str, silent_s: float) -> list[Finding]:
        """Return the fault of a silent sensor, if any; without readings, `silent_s` is NaN."""
        topic = self._topics[name]
        if not math.isnan(silent_s):
            return [Finding(True, name, f'silent for {silent_s:.0f} s', 'check its cable, its '
                            f'driver and the topic {topic}', Cause.NO_MESSAGES)]
        # Nodes that are launched together do not start at the same time.
        if time.monotonic() - self._start_time < STARTUP_S:
            return []
        return [no_message_finding(self._node, name, topic, self._topics)]

    def _clock_findings(self, name: str) -> list[Finding]:
        """Return a fault if a sensor's timestamps differ from the computer's time by over a day."""
        delay_s = self._reported_window(name).delay_s[0]
        if self._is_replayed or not abs(delay_s) > MAX_LIVE_DELAY_S:
            return []
        days = abs(delay_s) / 86400.0
        difference = f'{days / 365.25:.0f} years' if days > 730.0 else \
            'a day' if days < 1.5 else f'{days:.0f} days'
        return [Finding(False, name, f'its timestamps are {difference} '
                        f'{"behind" if delay_s > 0.0 else "ahead of"} the clock of this computer',
                        'for a recording, set use_sim_time (--use-sim-time); otherwise set the '
                        'clock of the device, or let its driver use the time of arrival',
                        Cause.CLOCK_DIFFERS)]

    def is_awaited(self, name: str) -> bool:
        """Whether no reading of a sensor has been received yet."""
        return bool(np.isnan(self._last_received[self._index[name]]))

    def status(self, node: str, j: int, calibrate: Calibrate) -> DiagnosticStatus:
        """Diagnostics of sensor `j`, as of its latest `update`, under the title of the `node`."""
        name = self._network.names[j]
        diagnoses = self._diagnoses(j, name, calibrate)
        level = DiagnosticStatus.OK
        if diagnoses:
            level = DiagnosticStatus.ERROR if diagnoses[0].serious else DiagnosticStatus.WARN
        health = self._reported_window(name)
        background = calibrate.backgrounds()[name]
        c, n = health.counts, max(1, health.counts['readings'])
        values: dict[str, str | float] = {
            'rate [Hz]': health.rate, 'lost': c['lost'],
            'delay [ms]': 1e3 * health.delay_s[0],
            'noise [nT]': _numbers(1e9 * health.noise_std),
            'field [uT]': _numbers(1e6 * health.field),
            'saturated': c['saturated'], 'spikes': c['spikes'],
            'fraction of missing axes': (c['x'] + c['y'] + c['z']) / (3 * n),
            'background': 'doubtful' if background.doubtful else
                          'frozen' if background.frozen else
                          'ready' if background.ready else 'learning',
            'background drift [nT/s]': _numbers(1e9 * background.drift),
            'backgrounds relearnt': background.n_relearnt}
        return DiagnosticStatus(
            level=level, name=f'{node}: {name}', hardware_id=name,
            message=f'{diagnoses[0].finding.fault}; {diagnoses[0].finding.advice}' if diagnoses else
            f'waiting for {self._topics[name]}' if self.is_awaited(name) else 'running',
            values=[KeyValue(key=k, value=v if isinstance(v, str) else _number(v))
                    for k, v in values.items()]
            + [KeyValue(key='also', value=d.finding.fault) for d in diagnoses[1:]]
            + [KeyValue(key='therefore', value=f.fault) for d in diagnoses for f in d.consequences])


def _number(value: float) -> str:
    """Format a number; NaN becomes an empty string."""
    return '' if math.isnan(value) else f'{value:.4g}'


def _numbers(values: ArrayLike) -> str:
    """Format several numbers; NaN becomes a dash."""
    return ' '.join(_number(v) or '-' for v in np.asarray(values, dtype=float))
