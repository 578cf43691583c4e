"""What goes through a node: how much, how late, and whether somebody still sends and listens."""

import time
from collections.abc import Callable, Collection

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from mag_tracking.nodes.sensor_graph import shortened
from mag_tracking.stages.health.sensor_health import MAX_LIVE_DELAY_S
from mag_tracking.stages.health.window import quantiles
from mag_tracking.units import NS

SILENT_S = 2.0
"""[s] A sensor or a node of which nothing came for longer is silent."""
PATIENCE_S = 8.0
"""[s] Grace period for the first message, longer than learning a background takes."""
MAX_BUSY = 0.95
"""Largest share of the time that a node can spend on messages and keep up."""
LATE_S = 1.0
"""[s] A median latency above this is a fault: such poses are too old for control."""
MAX_RECORDED = 10_000
"""Messages between two reports whose times are kept; a second of a thousand sensors has less."""


class Flow:
    """The messages that a node takes from a `source`: the sensors, or the step before."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.topics: list[str] = []
        """Absolute names, as remapped."""
        self.batches: list[str] = []
        """Topics that may take their place."""
        self._began = time.monotonic()
        self.heard: float | None = None
        """`time.monotonic()` [s] of the latest message, or None."""
        self.n_lost = 0
        self._n, self._told_lost = 0, 0
        self._ages: list[float] = []
        self._age_s: float | None = None
        self._busy_s, self._reported = 0.0, time.monotonic()

    def note(self, stamp_ns: int, came_ns: int, began: float) -> None:
        """A message of `stamp_ns`, which came at `came_ns`, has been worked off since `began`.

        That is in seconds by the monotonic clock.
        """
        self._n += 1
        self.heard = time.monotonic()
        took_s = self.heard - began
        self._busy_s += took_s
        self._age_s = (came_ns - stamp_ns) / NS + took_s
        if len(self._ages) < MAX_RECORDED:
            self._ages.append(self._age_s)

    @property
    def n_ages(self) -> int:
        """How many messages the latency of the next report is of."""
        return len(self._ages)

    @property
    def is_live(self) -> bool:
        """Whether the latest message was of the present, not of a recording."""
        return self._age_s is not None and abs(self._age_s) < MAX_LIVE_DELAY_S

    def status(self, node: str, is_there: Callable[[], bool]) -> DiagnosticStatus:
        """The DiagnosticStatus of what came since the last one.

        `is_there` is a function: whether somebody would still send.
        """
        now = time.monotonic()
        elapsed, self._reported = max(now - self._reported, 1e-9), now
        ages, self._ages = self._ages, []
        news, self._told_lost = self.n_lost - self._told_lost, self.n_lost
        level, message = DiagnosticStatus.OK, 'running'
        busy = self._busy_s / elapsed
        middle, late = quantiles([a for a in ages if abs(a) < MAX_LIVE_DELAY_S], 0.5, 0.99)
        if self.heard is None:
            message = f'waiting for {shortened(self.topics)}'
            if now - self._began > PATIENCE_S:
                level = DiagnosticStatus.WARN
                message = f'nothing has come on {shortened(self.topics)}' + (
                    '' if is_there() else ', which nobody publishes')
        elif now - self.heard > SILENT_S:
            level = DiagnosticStatus.WARN
            message = f'nothing has come from {self.source} for {now - self.heard:.0f} s'
            if not is_there():
                level = DiagnosticStatus.ERROR
                message += ', and it has gone; does it still run?'
        elif news:
            level = DiagnosticStatus.WARN
            message = f'{news} messages from {self.source} did not fit the queue'
        elif busy > MAX_BUSY or middle > LATE_S:
            level = DiagnosticStatus.WARN
            message = f'{self.source}: {100.0 * busy:.0f} % busy' + (
                f', {1e3 * middle:.0f} ms behind: this computer is too slow, or its clock is not '
                'that of the sensors' if middle > LATE_S else ': this computer is too slow')
        values = {'messages': self._n, 'lost in the queue': self.n_lost,
                  'latency, median [ms]': f'{1e3 * middle:.4g}',
                  'latency, 99 % [ms]': f'{1e3 * late:.4g}',
                  'busy [%]': f'{100.0 * busy:.3g}'}
        self._busy_s = 0.0
        return DiagnosticStatus(
            level=level, name=f'{node}: from {self.source}', hardware_id='magnetometer network',
            message=message, values=[KeyValue(key=k, value=str(v)) for k, v in values.items()])


class Listener:
    """The node of the next step, `role`, which subscribes to a topic.

    It may have any name: it is known by the type of message that it publishes. Others that
    subscribe, such as recorders, come and go.
    """

    def __init__(self, role: str, topic: str, publishes: str) -> None:
        self.role, self.topic, self._publishes = role, topic, publishes
        self._seen: set[str] = set()

    def status(self, node: str, names: Collection[str],
               types_of: Callable[[str], Collection[str]]) -> DiagnosticStatus:
        """The DiagnosticStatus of the next step.

        Parameters
        ----------
        node : str
            Title of the node that reports.
        names : collection of str
            Nodes that subscribe to the topic now.
        types_of : function
            {node: types of the messages that it publishes}.
        """
        self._seen |= {name for name in set(names) - self._seen
                       if self._publishes in types_of(name)}
        gone = sorted(self._seen - set(names))
        is_gone = bool(gone) and not self._seen.intersection(names)
        message = 'running' if self._seen else \
            f'no {self.role} node subscribes to {self.topic} yet'
        return DiagnosticStatus(
            level=DiagnosticStatus.ERROR if is_gone else DiagnosticStatus.OK,
            name=f'{node}: to {self.role}', hardware_id='magnetometer network',
            message=f'{", ".join(gone)} has gone; does it still run?' if is_gone else message)
