"""Work on each sensor in turn: its health, its calibration state, its stored background.

Done for all sensors at once it would delay the readings.
"""

from collections.abc import Callable, Iterator

from diagnostic_msgs.msg import DiagnosticStatus
from mag_tracking_msgs.msg import SensorCalibration

from mag_tracking.messages.calibration_state import sensor_dict
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.background_store import BackgroundStore
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.stages.calibrate.stage import Calibrate


class SensorRounds:
    """Rounds over the sensors of a network, in steps that take about the same time.

    Parameters
    ----------
    stage : Calibrate
    health : HealthDiagnostics
    store : BackgroundStore
    is_live : function
        Whether the readings are of the present, not of a recording.
    publish_status : function
        Takes the `DiagnosticStatus` of one sensor.
    publish_states : function
        Takes the `SensorCalibration` of all sensors; the list is reused.
    """

    def __init__(self, node: str, network: SensorNetwork, stage: Calibrate,
                 health: HealthDiagnostics, store: BackgroundStore, is_live: Callable[[], bool],
                 publish_status: Callable[[DiagnosticStatus], None],
                 publish_states: Callable[[list[SensorCalibration]], None]) -> None:
        self._node, self._stage, self._health, self._store = node, stage, health, store
        self._is_live = is_live
        self._publish_status, self._publish_states = publish_status, publish_states
        self._is_due = False
        self._reported: set[tuple[int, tuple[int, int | None]]] = set()
        self.begin(network)

    def begin(self, network: SensorNetwork) -> None:
        """Begin a round; `network` is the one from now on."""
        self._network = network
        self._steps = self._rounds()
        self._states = [self._state(j) for j in range(len(network))]

    def tick(self) -> None:
        """A step is due: it is done after the next readings, or at the next tick."""
        if self._is_due:
            self._step()
        self._is_due = True

    def step_if_due(self) -> None:
        """Do the step that is due."""
        if self._is_due:
            self._step()

    def report_doubts(self) -> None:
        """Publish immediately if a background becomes doubtful or certain again.

        The tracker flags tracks only after it has received this.
        """
        backgrounds = self._stage.backgrounds()
        latest = {(j, times[-1]) for j, name in enumerate(self._network.names)
                  if (times := backgrounds[name].doubtful_times)}
        if changed := latest - self._reported:
            for j, _ in changed:
                self._states[j] = self._state(j)
            self.publish()
        self._reported = latest

    def _step(self) -> None:
        """Go on with the round."""
        self._is_due = False
        next(self._steps)

    def publish(self) -> None:
        """Publish the latest known calibration of all sensors."""
        self._publish_states(self._states)

    def _state(self, j: int) -> SensorCalibration:
        """How sensor `j` is calibrated."""
        return to_message(SensorCalibration, sensor_dict(self._stage, self._network, j))

    def _rounds(self) -> Iterator[None]:
        """Compare all sensors, report on each, publish and store; again and again."""
        while True:
            self._health.begin_round(self._stage)
            yield
            for j in range(len(self._network)):
                self._health.look(j)
                self._states[j] = self._state(j)
                self._store.update(self._network, j)
                yield
                self._publish_status(self._health.status(self._node, j, self._stage))
                yield
            self.publish()
            yield
            self._store.write_if_due(self._is_live())
            yield
