"""The health of each sensor as diagnostics, over the latest minute or two."""

import math
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from numpy.typing import ArrayLike
from rclpy.node import Node

from mag_tracking.apps.doctor import background_findings, network_findings
from mag_tracking.apps.doctor_covariances import covariance_findings
from mag_tracking.network import SensorNetwork
from mag_tracking.network.topics import absolute
from mag_tracking.nodes.flow import SILENT_S
from mag_tracking.nodes.sensor_graph import missing_publisher, topic_findings
from mag_tracking.pipeline import Settings
from mag_tracking.records import Readings, plain
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.reading_buffer import ReadingBuffer
from mag_tracking.stages.health.sensor_health import (
    MAX_LIVE_DELAY_S,
    WINDOW,
    Finding,
    SensorHealth,
)

TERM_S = 60.0
"""[s] What was wrong is forgotten after one to two of these."""
FEW = 64
"""Readings of this term that are too few to speak of; the term before it still speaks then."""
STARTING_S = 3.0
"""[s] That nothing has come of a sensor is no fault until then."""
PATIENCE = 3.0
"""A background that has not been learnt is a fault after so many times what that takes."""


class HealthDiagnostics:
    """Looks at the raw readings of a network; `statuses` says how the sensors are.

    Parameters
    ----------
    network : SensorNetwork
    settings : Settings
    node : Node, optional
        Knows the sensors' topics as remapped, and who publishes them.
    is_replayed : bool
        Old stamps are those of a recording.
    """

    def __init__(self, network: SensorNetwork, settings: Settings, node: Node | None = None,
                 is_replayed: bool = False) -> None:
        self._node, self._is_replayed = node, is_replayed
        resolve = absolute if node is None else node.resolve_topic_name
        self._topics = {name: resolve(topic) for name, topic in zip(
            network.names, network.topics, strict=True)}
        self._settings = settings
        self._index = {name: j for j, name in enumerate(network.names)}
        # When, by the monotonic clock [s]; NaN: never.
        self._heard = np.full(len(network), np.nan)
        self._frozen_ns: dict[str, int] = {}
        # Since when it learns, by the monotonic clock [s].
        self._unready_since: dict[str, float] = {}
        self._compared: dict[str, list[Finding]] = {}
        # How many backgrounds had been taken anew when the last term began, and this one.
        self._relearnt: list[dict[str, int]] = [dict.fromkeys(network.names, 0)] * 2
        self._begin(network)

    def _begin(self, network: SensorNetwork) -> None:
        """Forget what was; `network` is the one from now on."""
        self._network = network
        self._clock_ns = network.clock_offset_ns
        # Stamps of before are by other clocks.
        self._buffer = ReadingBuffer(len(network), WINDOW // 2)
        self._past: dict[str, SensorHealth | None] = dict.fromkeys(network.names)
        self._present = self._new_term()
        self._began = time.monotonic()
        self._term_ends = self._began + TERM_S

    def _new_term(self) -> dict[str, SensorHealth]:
        """{name: SensorHealth} that has seen nothing."""
        return {name: SensorHealth() for name in self._network.names}

    def update_network(self, network: SensorNetwork) -> None:
        """Go on with another calibration of the same sensors."""
        self._begin(network)

    def add(self, readings: Readings, now_ns: int) -> None:
        """Raw `Readings` that came at `now_ns`; those of sensors of other networks are none."""
        rows = readings.rows(self._index)
        self._heard[rows[rows >= 0]] = time.monotonic()
        # A stamp of a row that is none is not used.
        stamps, field, i = readings.stamp_ns - self._clock_ns[rows], plain(readings.field), 0
        while (i := self._buffer.add(rows, stamps, field, now_ns, i)) < len(rows):
            self.look(rows[i])

    def look(self, j: int) -> None:
        """Look at what waits of sensor `j`: its `status` is as of then."""
        self._present[self._network.names[j]].add_batch(*self._buffer.pop(j))

    def statuses(self, node: str, calibrate: Calibrate) -> list[DiagnosticStatus]:
        """[DiagnosticStatus], one a sensor; `calibrate` is the `Calibrate` stage."""
        self.begin_round(calibrate)
        for j in range(len(self._network)):
            self.look(j)
        return [self.status(node, j, calibrate) for j in range(len(self._network))]

    def begin_round(self, calibrate: Calibrate) -> None:
        """Compare the sensors, and begin a term where it is time to.

        Before the `status` of each of them, which may be asked for one at a time.
        """
        self._compare(calibrate)
        if time.monotonic() > self._term_ends:
            self._term_ends = time.monotonic() + TERM_S
            self._past, self._present = {**self._present}, self._new_term()
            self._relearnt = [self._relearnt[1], {
                name: b.n_relearnt for name, b in calibrate.backgrounds().items()}]

    def _compare(self, calibrate: Calibrate) -> None:
        """Compare the sensors with each other and with the Earth."""
        for name, background in calibrate.backgrounds().items():
            if not background.frozen:
                self._frozen_ns.pop(name, None)
            elif (last := calibrate.last_stamp_ns(name)) is not None:
                self._frozen_ns.setdefault(name, last)
        health = {name: self._latest(name) for name in self._network.names}
        self._compared = {name: [] for name in self._network.names}
        for finding in network_findings(self._network, self._settings.survey, calibrate, health):
            if finding.subject in self._compared:
                self._compared[finding.subject].append(finding)

    def _latest(self, name: str) -> SensorHealth:
        """The `SensorHealth` of this term, or of the one before where this has just begun."""
        past, present = self._past[name], self._present[name]
        return past if past is not None and present.counts['readings'] < FEW else present

    def _findings(self, j: int, name: str, calibrate: Calibrate) -> list[Finding]:
        """What is wrong with a sensor, the worst first."""
        silent_s = time.monotonic() - self._heard[j]
        of_topic = [] if self._node is None else topic_findings(
            self._node, name, self._topics[name])
        if not silent_s <= SILENT_S:
            return [*of_topic, *self._silence(name, silent_s)]
        found = {f.what: f for f in (*of_topic, *self._compared[name],
                                     *self._clock_finding(name))}
        # While it learns, at the start or again, that is no fault yet.
        patience = 5.0 + PATIENCE * self._settings.calibrate.learn_s
        if calibrate.backgrounds()[name].ready:
            self._unready_since.pop(name, None)
        since = self._unready_since.setdefault(name, time.monotonic())
        if calibrate.backgrounds()[name].ready or time.monotonic() - since > patience:
            found.update({f.what: f for f in background_findings(
                name, calibrate, self._frozen_ns.get(name), self._relearnt[0][name])})
        found.update({f.what: f for f in covariance_findings(
            name, self._topics[name], calibrate)})
        for health in (self._past[name], self._present[name]):
            if health is not None and health.counts['readings']:
                for f in health.findings(name, self._network.noise_std[j],
                                         self._settings.calibrate.max_field,
                                         not self._is_replayed):
                    found.setdefault(f.what, f)
        return sorted(found.values(), key=lambda f: not f.serious)

    def _silence(self, name: str, silent_s: float) -> list[Finding]:
        """The fault of a sensor that is silent for `silent_s`; NaN where nothing has ever come."""
        topic = self._topics[name]
        if not math.isnan(silent_s):
            return [Finding(True, name, f'silent for {silent_s:.0f} s', 'look at its cable, its '
                            f'driver and the topic {topic}')]
        # Nodes that are started together do not come up at the same time.
        if time.monotonic() - self._began < STARTING_S:
            return []
        if self._node is None:
            return [Finding(True, name, 'nothing has come', 'look at its cable, its driver and the '
                            f'topic {topic}')]
        return [missing_publisher(self._node, name, topic, self._topics)]

    def _clock_finding(self, name: str) -> list[Finding]:
        """Stamps of another day than that of this computer."""
        behind_s = self._latest(name).delay_s[0]
        if self._is_replayed or not abs(behind_s) > MAX_LIVE_DELAY_S:
            return []
        days = abs(behind_s) / 86400.0
        far = f'{days / 365.25:.0f} years' if days > 730.0 else f'{days:.0f} days'
        return [Finding(False, name, f'its stamps are {far} '
                        f'{"behind" if behind_s > 0.0 else "ahead of"} the clock of this computer',
                        'for a recording set use_sim_time (--use-sim-time); else set the clock of '
                        'the device, or have its driver stamp')]

    def is_waited_for(self, name: str) -> bool:
        """Whether nothing has come of a sensor yet."""
        return bool(np.isnan(self._heard[self._index[name]]))

    def status(self, node: str, j: int, calibrate: Calibrate) -> DiagnosticStatus:
        """The DiagnosticStatus of sensor `j`, as of the latest `look` at it."""
        name = self._network.names[j]
        found = self._findings(j, name, calibrate)
        level = DiagnosticStatus.OK
        if found:
            level = DiagnosticStatus.ERROR if found[0].serious else DiagnosticStatus.WARN
        health = self._latest(name)
        background = calibrate.backgrounds()[name]
        c, n = health.counts, max(1, health.counts['readings'])
        values: dict[str, str | float] = {
            'rate [Hz]': health.rate, 'lost': c['lost'],
            'delay [ms]': 1e3 * health.delay_s[0],
            'noise [nT]': _numbers(1e9 * health.noise_std),
            'field [uT]': _numbers(1e6 * health.field),
            'saturated': c['saturated'], 'spikes': c['spikes'],
            'share of missing axes': (c['x'] + c['y'] + c['z']) / (3 * n),
            'background': 'doubtful' if background.doubtful else
                          'frozen' if background.frozen else
                          'ready' if background.ready else 'learning',
            'background drift [nT/s]': _numbers(1e9 * background.drift),
            'backgrounds taken anew': background.n_relearnt}
        return DiagnosticStatus(
            level=level, name=f'{node}: {name}', hardware_id=name,
            message=f'{found[0].what}; {found[0].advice}' if found else
            f'waiting for {self._topics[name]}' if self.is_waited_for(name) else 'running',
            values=[KeyValue(key=k, value=v if isinstance(v, str) else _number(v))
                    for k, v in values.items()]
            + [KeyValue(key='also', value=f.what) for f in found[1:]])


def _number(value: float) -> str:
    """Short text of a number."""
    return '' if math.isnan(value) else f'{value:.4g}'


def _numbers(values: ArrayLike) -> str:
    """Short text of numbers."""
    return ' '.join(_number(v) or '-' for v in np.asarray(values, dtype=float))
