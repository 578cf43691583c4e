"""calibration_node: raw magnetic fields in, calibrated ones out."""

if __name__ == '__main__':
    # Does not return: a signal during the imports below would end in a traceback.
    from mag_tracking.nodes.start import calibration_node

    calibration_node()

from functools import partial
from pathlib import Path
from typing import Any

from mag_tracking_msgs.msg import CalibrationState, FieldReadings, SensorCalibration
from mag_tracking_msgs.srv import Calibrate as CalibrateService
from mag_tracking_msgs.srv import Survey as SurveyMessage
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.errors import NetworkError, SettingsError
from mag_tracking.files import checked_path
from mag_tracking.messages.schema import (
    acceleration_of,
    magnetic_field_dicts,
    reading_of,
    readings_dict,
)
from mag_tracking.messages.types import CALIBRATED_READINGS, CALIBRATION_STATE, RAW_READINGS
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.background_store import BackgroundStore
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.deferred import Deferred
from mag_tracking.nodes.detection_node import DetectionNode
from mag_tracking.nodes.paced_service import paced_service
from mag_tracking.nodes.ros_params import declare_settings, fixed_parameter
from mag_tracking.nodes.sensor_graph import shortened
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.nodes.sensor_rounds import SensorRounds
from mag_tracking.nodes.sensor_transforms import SensorTransforms
from mag_tracking.nodes.stage_node import LATCHED, READY, SENT, STREAM, StageNode, has_subscribers
from mag_tracking.nodes.steady_timer import steady_timer
from mag_tracking.nodes.survey_service import SurveyService
from mag_tracking.nodes.tracker_node import TrackerNode
from mag_tracking.recording.background_file import (
    default_path,
    is_background_file,
    state_folder,
)
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.stage import Stage
from mag_tracking.stages.survey.stage import Survey

MIN_STEP_S = 0.01
"""[s] A round over the sensors takes a second, or where they are too many for that, its steps come
at this interval."""
DEFERRED_S = 0.0055
"""[s] Delay of deferred work after publishing many readings. A pose of a hundred sensors takes
about that long: until then the processes that compute it need the cores."""


class CalibrationNode(StageNode):
    """Subscribes to each sensor's topic; publishes it with `_calibrated` appended to its name."""

    def __init__(self, next_steps: tuple[DetectionNode, TrackerNode] | None = None,
                 **node_arguments: Any) -> None:
        """`next_steps` in the same process take calibrated readings and doubtful times directly."""
        super().__init__('calibration_node', 'calibrate', **node_arguments)
        self._next_steps = next_steps
        self.settings = declare_settings(self, self.settings, 'survey')
        self._stage = Calibrate(self.network, self.settings.calibrate)
        self._store = BackgroundStore(self._state_path(), self._stage, self.settings.calibrate,
                                      self.get_logger())
        self._store.restore(self.network)
        self._survey = Survey(self.network, self.settings.survey)
        self._survey_service = SurveyService(
            self._survey, self._stage, self._survey_path(),
            [self.resolve_topic_name(t) for t in self.network.imu_topics if t is not None])
        self._health = HealthDiagnostics(self.network, self.settings, self, self.is_replayed)
        self._unseen: list[tuple[Readings, int]] = []
        self._deferred = Deferred(self, DEFERRED_S, self._do_deferred_work)
        self._connect()
        self._rounds = SensorRounds(
            self.title, self.network, self._stage, self._health, self._store, self._is_live,
            lambda status: self.publish_statuses([status]), self._publish_states)
        steady_timer(self, max(1.0 / (2 * len(self.network) + 3), MIN_STEP_S),
                     self._rounds.tick)
        paced_service(self, CalibrateService, '~/calibrate', self._calibrate)
        paced_service(self, SurveyMessage, '~/survey', self._solve)
        self.report_state()

    def _connect(self) -> None:
        """Subscribe to the sensors and advertise what comes of them."""
        self._publishers_by_sensor = {}
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self._publishers_by_sensor[sensor] = self.publisher(
                MagneticField, f'{topic}_calibrated', SENT)
            self.subscription(MagneticField, topic, partial(self._take, sensor), self.input_qos,
                              source='sensors')
        for sensor, imu_topic in zip(self.network.names, self.network.imu_topics, strict=True):
            if imu_topic is not None:
                self.subscription(Imu, imu_topic, partial(self._take_acceleration, sensor),
                                  self.input_qos)
        self._readings = self.publisher(FieldReadings, CALIBRATED_READINGS, SENT)
        self.subscription(FieldReadings, RAW_READINGS, self._take_many, STREAM, source='sensors',
                          batches=True)
        if self._next_steps is None:
            self.expect('detection', CALIBRATED_READINGS, 'mag_tracking_msgs/msg/NetworkFrame')
        self._state = self.publisher(CalibrationState, CALIBRATION_STATE, LATCHED)
        self._tf = SensorTransforms(self) if fixed_parameter(
            self, 'publish_sensor_tf', True, 'Publish where the sensors are as static '
            'transforms.') else None
        self._publish_transforms()

    def _publish_transforms(self) -> None:
        """Publish where the sensors are."""
        if self._tf is not None:
            self._tf.publish(self.network)

    def _state_path(self) -> Path | None:
        """File in which the backgrounds are stored; None during the replay of a recording."""
        place = fixed_parameter(self, 'state_file', '', 'File in which the backgrounds are kept '
                                'for a restart; left out: below $ROS_HOME, or ~/.ros.')
        if self.is_replayed or not self.settings.calibrate.max_resume_gap_s:
            return None
        if not place:
            return default_path(self.network_path, self.get_fully_qualified_name())
        path = self._own_path('state_file', place)
        if path.exists() and not is_background_file(path):
            raise SettingsError(f'calibration_node: parameter state_file: {path} is another file '
                                'than one with backgrounds; it would be replaced')
        return path

    def _own_path(self, parameter: str, name: str) -> Path:
        """The path of a file to write; raises SettingsError for one that is not its place."""
        what = f'calibration_node: parameter {parameter}: '
        beside, below = self.network_path.parent, state_folder().resolve()
        path = checked_path(beside / name, SettingsError)
        folder = path.parent.resolve()
        if not path.name or path.name == '..' or path.is_dir():
            raise SettingsError(f'{what}{name!r} is not the name of a file')
        if folder / path.name == self.network_path:
            raise SettingsError(f'{what}{path} is the network file itself')
        if folder != beside and not folder.is_relative_to(below):
            raise SettingsError(f'{what}{path} is neither beside the network file, in {beside}, '
                                f'nor below {below}')
        return folder / path.name

    def _survey_path(self) -> Path:
        """File to which a survey is saved: beside the network file, which is written by hand."""
        save_as = fixed_parameter(self, 'save_as', '', 'Network file that a survey writes; left '
                                  'out: <network>_calibrated.yaml.')
        path = self.network_path
        return self._own_path('save_as', save_as or f'{path.stem}_calibrated.yaml')

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """{name: stage} whose counts are published."""
        return {'calibrate': self._stage, 'survey': self._survey}

    def state(self) -> str:
        """Waiting for sensors, learning their backgrounds, or ready."""
        waiting = [topic for name, topic in zip(self.network.names, self.sensor_topics,
                                                strict=True) if self._health.is_waited_for(name)]
        learning = [name for name in self._stage.unready()
                    if not self._health.is_waited_for(name)]
        parts = [f'waiting for {shortened(waiting)}'] if waiting else []
        if learning:
            parts.append(f'learning backgrounds, {self.settings.calibrate.learn_s:g} s')
        elif len(waiting) < len(self.network):
            parts.append(READY)
        return ', '.join(parts)

    def queues(self) -> dict[str, int]:
        """{name of a stage: how many records it holds}."""
        return {'calibrate': self._stage.n_held}

    def _is_live(self) -> bool:
        """Whether the readings are of the present, not of a recording."""
        return self.flows['sensors'].is_live

    def _take(self, sensor: str, message: MagneticField) -> None:
        """One raw reading."""
        raw = reading_of(message, sensor)
        publisher = self._publishers_by_sensor[sensor]
        for calibrated in self._calibrated(raw):
            if self._next_steps is None or has_subscribers(publisher):
                for _, content in magnetic_field_dicts(calibrated, message.header.frame_id):
                    publisher.publish(to_message(MagneticField, content))
        self._unseen.append((raw, self.now_ns))
        self._do_deferred_work()

    def _take_many(self, message: FieldReadings) -> None:
        """Raw readings of many sensors; they go on together."""
        raw = self.readings_of(message, self._stage)
        if raw is None:
            return
        for calibrated in self._calibrated(raw):
            if self._next_steps is None or has_subscribers(self._readings):
                self._readings.publish(to_message(FieldReadings, readings_dict(calibrated)))
        self._unseen.append((raw, self.now_ns))
        self._deferred.request()

    def _calibrated(self, raw: Readings) -> list[Readings]:
        """Calibrated readings; the next steps in this process have taken them."""
        calibrated = self._stage.feed(raw)
        if self._next_steps is not None:
            detection, tracker = self._next_steps
            tracker.doubt(self._stage.doubtful_intervals())
            for readings in calibrated:
                detection.take_readings(readings)
        return calibrated

    def _do_deferred_work(self) -> None:
        """Learn from what has come, update the health, and do a step of the round if it is due."""
        self._stage.idle()
        if self._next_steps is not None:
            self._next_steps[1].idle()
        unseen, self._unseen = self._unseen, []
        for raw, now_ns in unseen:
            self._health.add(raw, now_ns)
        self._rounds.step_if_due()
        self._rounds.report_doubts()

    def _take_acceleration(self, sensor: str, message: Imu) -> None:
        """One acceleration."""
        self._survey.feed(acceleration_of(message, sensor))

    def _publish_states(self, states: list[SensorCalibration]) -> None:
        """Publish the calibration of all sensors."""
        message = CalibrationState(sensors=states)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.network.frame
        self._state.publish(message)

    def _calibrate(self, request: CalibrateService.Request,
                   response: CalibrateService.Response) -> CalibrateService.Response:
        """Learn backgrounds again, as the service asks."""
        try:
            self._stage.forget(tuple(request.sensors))
        except NetworkError as error:
            response.success, response.message = False, str(error)
            return response
        self._store.drop(request.sensors or self.network.names, self._is_live())
        response.success = True
        response.message = f'learning {", ".join(request.sensors) or "all sensors"} anew'
        return response

    def _solve(self, request: SurveyMessage.Request,
               response: SurveyMessage.Response) -> SurveyMessage.Response:
        """Orientations and clocks, as the service asks; running tracks keep theirs to the end."""
        network = self._survey_service.solve(self.network, request.save, response)
        if network is None:
            return response
        self.network = network
        self._stage.update_network(network)
        self._publish_transforms()
        self._health.update_network(network)
        self._rounds.begin(network)
        self._rounds.publish()
        self._store.drop(network.names, self._is_live())
        for text in response.warnings:
            self.get_logger().warning(text)
        return response


def main(arguments: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return stage_node.main(CalibrationNode, arguments)
