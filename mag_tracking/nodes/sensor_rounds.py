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
        Takes the `SensorCalibration` of all sensors.
    """

    def __init__(self, node: str, network: SensorNetwork, stage: Calibrate,
                 health: HealthDiagnostics, store: BackgroundStore, is_live: Callable[[], bool],
                 publish_status: Callable[[DiagnosticStatus], None],
                 publish_states: Callable[[list[SensorCalibration]], None]) -> None:
        self._node, self._stage, self._health, self._store = node, stage, health, store
        self._is_live = is_live
        self._publish_status, self._publish_states = publish_status, publish_states
        self._is_due = False
        self._told: set[tuple[int, int]] = set()
        self.begin(network)

    def begin(self, network: SensorNetwork) -> None:
        """Begin a round; `network` is the one from now on."""
        self._network = network
        self._steps = self._rounds()
        self._states = self.states()

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
        """Publish before its turn where a background has become doubtful: a track that waits for
        the round would be sure meanwhile.
        """
        backgrounds = self._stage.backgrounds()
        begun = {(j, begin) for j, name in enumerate(self._network.names)
                 for begin, end in backgrounds[name].doubtful_times[-1:] if end is None}
        if news := begun - self._told:
            for j, _ in news:
                self._states[j] = self._state(j)
            self._publish_states(self._states)
        self._told = begun

    def _step(self) -> None:
        """Go on with the round."""
        self._is_due = False
        next(self._steps)

    def states(self) -> list[SensorCalibration]:
        """How all sensors are calibrated."""
        return [self._state(j) for j in range(len(self._network))]

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
            self._publish_states(self._states)
            yield
            self._store.write_if_due(self._is_live())
            yield
