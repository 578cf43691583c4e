"""calibration_node: converts raw magnetic fields to calibrated fields."""

if __name__ == '__main__':
    from mag_tracking.nodes.start import calibration_node

    calibration_node()

import datetime
import time
from functools import partial
from pathlib import Path
from typing import Any

from mag_tracking_msgs.msg import CalibrationState, FieldReadings, SensorCalibration
from mag_tracking_msgs.srv import Calibrate as CalibrateService
from mag_tracking_msgs.srv import Survey as SurveyMessage
from sensor_msgs.msg import Imu, MagneticField
from tf2_msgs.msg import TFMessage

from mag_tracking.calibration.survey import Survey, with_measured_noise
from mag_tracking.errors import NetworkError, OutputError, SettingsError
from mag_tracking.files import checked_path
from mag_tracking.messages import schema
from mag_tracking.messages.standard import sensor_transform_dicts
from mag_tracking.messages.types import CALIBRATED_READINGS, CALIBRATION_STATE, RAW_READINGS
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.nodes import middleware
from mag_tracking.nodes.connections import shortened
from mag_tracking.nodes.convert import has_subscribers, send
from mag_tracking.nodes.detection_node import DetectionNode
from mag_tracking.nodes.ros_params import declare_settings, fixed_parameter
from mag_tracking.nodes.scheduling import Deferred, paced_service, steady_timer
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.nodes.sensor_rounds import BackgroundStore, SensorRounds
from mag_tracking.nodes.stage_node import LATCHED_QOS, PUBLISHER_QOS, READY, STREAM_QOS, StageNode
from mag_tracking.nodes.tracker_node import TrackerNode
from mag_tracking.recording import background_file
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.stage import Stage

MIN_INTERVAL_S = 0.5
"""[s] Minimum interval between surveys, each of which delays the readings."""
MIN_STEP_S = 0.01
"""[s] Minimum interval between the steps of a round, which takes at least one second."""
DEFERRAL_S = 0.0055
"""[s] Delay of deferred work after a batch of readings has been published. It leaves the processor
cores to the tracker until the tracker has computed a pose, even with a hundred sensors."""


class CalibrationNode(StageNode):
    """Calibrates the readings of each sensor; of `next_steps`, the detection node receives the
    calibrated readings directly, and the tracker node the intervals of doubtful backgrounds."""

    def __init__(self, next_steps: tuple[DetectionNode, TrackerNode] | None = None,
                 **node_arguments: Any) -> None:
        super().__init__('calibration_node', 'calibrate', **node_arguments)
        self._next_steps = next_steps
        self.settings = declare_settings(self, self.settings, 'survey')
        self._stage = Calibrate(self.network, self.settings.calibrate, survey=self.settings.survey)
        self._store = BackgroundStore(self._state_path(), self._stage, self.settings.calibrate,
                                      self.get_logger())
        self._store.restore(self.network)
        self._survey = Survey(self.network, self.settings.survey)
        self._save_as = self._output_path('save_as', fixed_parameter(
            self, 'save_as', '', 'Network file to which a survey is saved. If empty, '
            '<network>_calibrated.yaml is used.') or f'{self.network_path.stem}_calibrated.yaml')
        self._survey_end_time = -MIN_INTERVAL_S
        self._health = HealthDiagnostics(self.network, self.settings, self, self.is_replayed)
        self._health_backlog: list[tuple[Readings, int]] = []
        self._deferred = Deferred(self, DEFERRAL_S, self._do_deferred_work)
        self._connect()
        self._rounds = SensorRounds(
            self.diagnostics.title, self.network, self._stage, self._health, self._store,
            self._is_live, lambda status: self.diagnostics.publish([status]),
            self._publish_states)
        steady_timer(self, max(1.0 / (2 * len(self.network) + 3), MIN_STEP_S), self._rounds.tick)
        paced_service(self, CalibrateService, '~/calibrate', self._handle_calibrate)
        paced_service(self, SurveyMessage, '~/survey', self._handle_survey)
        self.report_state()

    def _connect(self) -> None:
        """Subscribe to the sensors and advertise the outputs."""
        self._publishers_by_sensor = {}
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self._publishers_by_sensor[sensor] = self.publisher(
                MagneticField, f'{topic}_calibrated', PUBLISHER_QOS)
            self.subscription(MagneticField, topic, partial(self._receive, sensor), self.input_qos,
                              source='sensors')
        for sensor, imu_topic in zip(self.network.names, self.network.imu_topics, strict=True):
            if imu_topic is not None:
                self.subscription(Imu, imu_topic, partial(self._receive_acceleration, sensor),
                                  self.input_qos)
        self._readings_publisher = self.publisher(FieldReadings, CALIBRATED_READINGS, PUBLISHER_QOS)
        self.subscription(FieldReadings, RAW_READINGS, self._receive_batch, STREAM_QOS,
                          source='sensors', batches=True)
        if self._next_steps is None:
            self.monitor_subscriber('detection', CALIBRATED_READINGS,
                                    'mag_tracking_msgs/msg/NetworkFrame')
        self._state_publisher = self.publisher(CalibrationState, CALIBRATION_STATE, LATCHED_QOS)
        self._transform_publisher = self.create_publisher(
            TFMessage, '/tf_static', LATCHED_QOS) if fixed_parameter(
                self, 'publish_sensor_tf', True, 'Publish static transforms from the world frame '
                'to each sensor.') else None
        self._publish_transforms()

    def _publish_transforms(self) -> None:
        """Publish a static transform for each sensor, if `publish_sensor_tf` is set."""
        # The child frame has the name of the sensor: the `frame_id` of its messages may name a
        # robot link that another node publishes, and a frame cannot have two parents.
        if self._transform_publisher is not None:
            send(self._transform_publisher, {'transforms': sensor_transform_dicts(
                self.network, self.get_clock().now().nanoseconds)})

    def _state_path(self) -> Path | None:
        """Path of the background file; None during a replay or if storage is off."""
        name = fixed_parameter(self, 'state_file', '', 'File in which backgrounds are stored for a '
                               'restart. If empty, a file below $ROS_HOME or ~/.ros is used.')
        if self.is_replayed or not self.settings.calibrate.max_resume_gap_s:
            return None
        if not name:
            return background_file.default_path(self.network_path, self.get_fully_qualified_name())
        path = self._output_path('state_file', name)
        if path.exists() and not background_file.is_background_file(path):
            raise SettingsError(f'calibration_node: parameter state_file: {path} exists and is not '
                                'a background file; choose another name, or delete it')
        return path

    def _output_path(self, parameter: str, name: str) -> Path:
        """Resolve `name` in the network file's folder; raise SettingsError if it is disallowed."""
        prefix = f'calibration_node: parameter {parameter}: '
        network_folder = self.network_path.parent
        state_root = background_file.state_folder().resolve()
        path = checked_path(network_folder / name, SettingsError)
        folder = path.parent.resolve()
        if not path.name or path.name == '..' or path.is_dir():
            raise SettingsError(f'{prefix}{name!r} is not a file name')
        if folder / path.name == self.network_path:
            raise SettingsError(f'{prefix}{path} is the network file, which must not be '
                                'overwritten')
        if folder != network_folder and not folder.is_relative_to(state_root):
            raise SettingsError(f'{prefix}{path} must be in the folder of the network file, '
                                f'{network_folder}, or below {state_root}')
        return folder / path.name

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """Stages whose counts are published in diagnostics, by name."""
        return {'calibrate': self._stage, 'survey': self._survey}

    def state(self) -> str:
        """State of the node: waiting for sensors, learning backgrounds, ready, or a combination."""
        waiting = [topic for name, topic in zip(self.network.names, self.sensor_topics,
                                                strict=True) if self._health.is_awaited(name)]
        learning = [name for name in self._stage.unready() if not self._health.is_awaited(name)]
        parts = [f'waiting for {shortened(waiting)}'] if waiting else []
        if learning:
            parts.append(f'learning backgrounds, {self.settings.calibrate.learn_s:g} s')
        elif len(waiting) < len(self.network):
            parts.append(READY)
        return ', '.join(parts)

    def queues(self) -> dict[str, int]:
        """Number of queued readings of each stage, by name."""
        return {'calibrate': self._stage.n_held}

    def _is_live(self) -> bool:
        """Whether the readings are live and not replayed from a recording."""
        return self.flows['sensors'].is_live

    def _receive(self, sensor: str, message: MagneticField) -> None:
        """Calibrate a raw reading and publish the resulting readings, if any."""
        raw = schema.reading_of(message, sensor)
        publisher = self._publishers_by_sensor[sensor]
        for calibrated in self._calibrate_readings(raw):
            if self._next_steps is None or has_subscribers(publisher):
                for _, content in schema.magnetic_field_dicts(calibrated, message.header.frame_id):
                    send(publisher, content)
        self._health_backlog.append((raw, self.now_ns))
        self._do_deferred_work()

    def _receive_batch(self, message: FieldReadings) -> None:
        """Calibrate a batch of raw readings and publish the result as one message."""
        raw = self.converted(lambda: schema.readings_of(message), self._stage, 'readings')
        if raw is None:
            return
        for calibrated in self._calibrate_readings(raw):
            if self._next_steps is None or has_subscribers(self._readings_publisher):
                send(self._readings_publisher, schema.readings_dict(calibrated))
        self._health_backlog.append((raw, self.now_ns))
        self._deferred.request()

    def _calibrate_readings(self, raw: Readings) -> list[Readings]:
        """Calibrate readings; pass the result and the doubtful intervals to any `next_steps`."""
        calibrated = self._stage.feed(raw)
        if self._next_steps is not None:
            detection, tracker = self._next_steps
            tracker.set_input_doubts(self._stage.input_doubts())
            detection.set_relearnt(self._stage.backgrounds())
            for readings in calibrated:
                detection.receive_readings(readings)
        return calibrated

    def _do_deferred_work(self) -> None:
        """Run deferred work, health checks and a due step of the rounds; report changed doubts."""
        self._stage.idle()
        if self._next_steps is not None:
            self._next_steps[1].idle()
        backlog, self._health_backlog = self._health_backlog, []
        for raw, now_ns in backlog:
            self._health.add(raw, now_ns)
        self._rounds.step_if_due()
        self._rounds.report_doubts()

    def _receive_acceleration(self, sensor: str, message: Imu) -> None:
        """Pass an acceleration to the survey."""
        self._survey.feed(schema.acceleration_of(message, sensor))

    def _publish_states(self, states: list[SensorCalibration]) -> None:
        """Publish the calibration of all sensors."""
        message = CalibrationState(sensors=states)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.network.frame
        self._state_publisher.publish(message)

    def _handle_calibrate(self, request: CalibrateService.Request,
                          response: CalibrateService.Response) -> CalibrateService.Response:
        """Handle ~/calibrate: discard backgrounds and learn them again."""
        try:
            self._stage.forget(tuple(request.sensors))
        except NetworkError as error:
            response.success, response.message = False, str(error)
            return response
        self._store.drop(request.sensors or self.network.names, self._is_live())
        response.success = True
        response.message = (f'learning the backgrounds of '
                            f'{", ".join(request.sensors) or "all sensors"} again')
        return response

    def _handle_survey(self, request: SurveyMessage.Request,
                       response: SurveyMessage.Response) -> SurveyMessage.Response:
        """Handle ~/survey: update clock offsets now, and orientations from the next track on."""
        if time.monotonic() - self._survey_end_time < MIN_INTERVAL_S:
            response.message = f'a survey has just been run; try again in {MIN_INTERVAL_S:g} s'
            return response
        network = self._solved_survey(request.save, response)
        self._survey_end_time = time.monotonic()
        if network is None:
            return response
        self.network = network
        self._stage.update_network(network)
        self._publish_transforms()
        self._health.use_network(network)
        self._rounds.begin(network)
        self._rounds.publish()
        self._store.drop(network.names, self._is_live())
        for warning in response.warnings:
            self.get_logger().warning(warning)
        return response

    def _solved_survey(self, save: bool, response: SurveyMessage.Response) -> SensorNetwork | None:
        """Solve a survey, save it if `save`, and fill in the response; None if it failed."""
        # If a target is near a sensor, the background was measured before its arrival.
        fields = {name: self._stage.background(name)
                  for name, background in self._stage.backgrounds().items()
                  if background.certain and self._stage.last_stamp_ns(name) is not None}
        if not fields:
            response.message = 'no background has been learnt yet; keep targets away for a while'
            return None
        if not self._survey.counts['accelerations']:
            response.message = 'no acceleration received on ' + ', '.join(
                map(self.resolve_topic_name, filter(None, self.network.imu_topics)))
            return None
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds')
        solution = self._survey.solve(fields, date)
        surveyed = with_measured_noise(solution.network, self._stage.backgrounds())
        if save:
            try:
                write_network(self._save_as, surveyed, 'Written by calibration_node.')
            except OutputError as error:
                response.message = str(error)
                return None
        response.success = True
        response.message = (
            'the result is in use'
            + (f' and saved to {self._save_as}; use that file at the next start' if save else '')
            + f'; clock reference: {solution.reference or "none, because no knock was detected"}')
        response.warnings = [*solution.warnings(), *(
            f'{name}: no background has been learnt; its heading remains as in the network file'
            for name in surveyed.names if name not in fields)]
        return surveyed


main = partial(middleware.main, CalibrationNode)
