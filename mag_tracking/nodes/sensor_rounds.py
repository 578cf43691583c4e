"""Periodic work for each sensor: health, calibration state, stored background.

The sensors are processed one after another. Work on all sensors at once would delay the readings.
"""

from collections.abc import Callable, Iterator

from diagnostic_msgs.msg import DiagnosticStatus
from mag_tracking_msgs.msg import SensorCalibration

from mag_tracking.messages.network import sensor_dict
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.background_store import BackgroundStore
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.stages.calibrate.stage import Calibrate


class SensorRounds:
    """Processes the sensors of a network one after another, in steps of similar duration.

    `is_live` returns whether the readings are live and not replayed. `publish_status` is called
    with the status of a sensor, `publish_states` with the list of all sensors' `SensorCalibration`,
    which is reused.
    """

    def __init__(self, node: str, network: SensorNetwork, stage: Calibrate,
                 health: HealthDiagnostics, store: BackgroundStore, is_live: Callable[[], bool],
                 publish_status: Callable[[DiagnosticStatus], None],
                 publish_states: Callable[[list[SensorCalibration]], None]) -> None:
        self._node, self._stage, self._health, self._store = node, stage, health, store
        self._is_live = is_live
        self._publish_status, self._publish_states = publish_status, publish_states
        self._is_step_due = False
        self._reported_doubts: set[tuple[int, tuple[int, int | None]]] = set()
        self.begin(network)

    def begin(self, network: SensorNetwork) -> None:
        """Begin a new round with a network, which replaces the previous one."""
        self._network = network
        self._steps = self._rounds()
        self._states = [self._state(j) for j in range(len(network))]

    def tick(self) -> None:
        """Make the next step due after the next readings; if a step is still due, run it first."""
        if self._is_step_due:
            self._step()
        self._is_step_due = True

    def step_if_due(self) -> None:
        """Run the next step of the round if it is due."""
        if self._is_step_due:
            self._step()

    def report_doubts(self) -> None:
        """Publish the calibration at once if a background becomes or ceases to be doubtful.

        The tracker flags tracks as ambiguous only after it has received the new calibration.
        """
        latest_doubts = {(j, doubt) for j, name in enumerate(self._network.names)
                         if (doubt := self._stage.latest_doubt(name)) is not None}
        if changed := latest_doubts - self._reported_doubts:
            for j, _ in changed:
                self._states[j] = self._state(j)
            self.publish()
        self._reported_doubts = latest_doubts

    def _step(self) -> None:
        """Run the next step of the round."""
        self._is_step_due = False
        next(self._steps)

    def publish(self) -> None:
        """Publish the latest calibration of all sensors."""
        self._publish_states(self._states)

    def _state(self, j: int) -> SensorCalibration:
        """Return the current calibration of sensor `j` as a message."""
        return to_message(SensorCalibration, sensor_dict(self._stage, self._network, j))

    def _rounds(self) -> Iterator[None]:
        """Run endless rounds over the sensors; yield after each step."""
        while True:
            self._health.begin_round(self._stage)
            yield
            for j in range(len(self._network)):
                self._health.update(j)
                self._states[j] = self._state(j)
                self._store.update(self._network, j)
                yield
                self._publish_status(self._health.status(self._node, j, self._stage))
                yield
            self.publish()
            yield
            self._store.write_if_due(self._is_live())
            yield
