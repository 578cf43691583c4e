"""calibration_node: raw magnetic fields in, calibrated ones out."""

import datetime
import sys
from functools import partial
from pathlib import Path

from mag_tracking_msgs.msg import CalibrationState, FieldReadings
from mag_tracking_msgs.srv import Calibrate as CalibrateService
from mag_tracking_msgs.srv import Survey as SurveyService
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.errors import NetworkError, OutputError, RecordingError
from mag_tracking.io.calibration_state import calibration_dict
from mag_tracking.io.message_types import CALIBRATED_READINGS, RAW_READINGS
from mag_tracking.io.network_file import write_network
from mag_tracking.io.schema import (
    acceleration_of,
    readings_dict,
    sample_dict,
    sample_of,
    samples_of,
)
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.nodes.stage_node import LATCHED, STREAM, StageNode
from mag_tracking.stages.calibrate import Calibrate
from mag_tracking.stages.survey import Survey, with_noise


class CalibrationNode(StageNode):
    """Subscribes to each sensor's topic; publishes it with `_calibrated` behind its name."""

    OWN_PARAMETERS = (*StageNode.OWN_PARAMETERS, 'save_as')

    def __init__(self, **node_arguments):
        super().__init__('calibration_node', 'calibrate', **node_arguments)
        self.settings = declare_settings(self, self.settings, 'survey', self.OWN_PARAMETERS)
        self._save_as = self.declare_parameter('save_as', '').value
        self._stage = Calibrate(self.network, self.settings.calibrate)
        self._survey = Survey(self.network, self.settings.survey)
        self._health = HealthDiagnostics(self.network, self.settings)
        self._publishers_by_sensor = {}
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self._publishers_by_sensor[sensor] = self.publisher(
                MagneticField, f'{topic}_calibrated', STREAM)
            self.subscription(MagneticField, topic, partial(self._take, sensor), self.input_qos)
        for sensor, topic in zip(self.network.names, self.network.imu_topics, strict=True):
            if topic is not None:
                self.subscription(Imu, topic, partial(self._shaken, sensor), self.input_qos)
        self._readings = self.publisher(FieldReadings, CALIBRATED_READINGS, STREAM)
        self.subscription(FieldReadings, RAW_READINGS, self._take_many, STREAM)
        self._state = self.publisher(CalibrationState, '~/calibration', LATCHED)
        self._published = None
        self.create_timer(1.0, self._publish_state)
        self.create_timer(0.9 / len(self.network), lambda: self._health.look_at_next(
            self.get_name(), self._stage))
        self.create_service(CalibrateService, '~/calibrate', self._calibrate)
        self.create_service(SurveyService, '~/survey', self._solve)

    def stages(self):
        return {'calibrate': self._stage, 'survey': self._survey}

    def statuses(self):
        return self._health.statuses(self.get_name(), self._stage)

    def _take(self, sensor, message):
        """One raw reading."""
        now_ns = self.get_clock().now().nanoseconds
        for sample in self._calibrated(sample_of(message, sensor), now_ns):
            self._publishers_by_sensor[sensor].publish(
                to_message(MagneticField, sample_dict(sample, message.header.frame_id)))

    def _take_many(self, message):
        """Raw readings of many sensors; they go on together."""
        try:
            raw = samples_of(message)
        except RecordingError as error:
            self._stage.counts['rejected: bad readings'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        now_ns = self.get_clock().now().nanoseconds
        samples = [s for r in raw for s in self._calibrated(r, now_ns)]
        if samples:
            self._readings.publish(to_message(FieldReadings, readings_dict(samples)))

    def _calibrated(self, raw, now_ns):
        """What the stage makes of one raw reading, which came at `now_ns`."""
        if raw.sensor in self._publishers_by_sensor:
            self._health.add(raw, now_ns)
        return self._stage.feed(raw)

    def _shaken(self, sensor, message):
        """One acceleration."""
        self._survey.feed(acceleration_of(message, sensor))

    def _publish_state(self):
        """The calibration, where it has changed."""
        now = self.get_clock().now().nanoseconds
        content = calibration_dict(self._stage, self.network, now)
        if repr(content['sensors']) != self._published:
            self._published = repr(content['sensors'])
            self._state.publish(to_message(CalibrationState, content))

    def _calibrate(self, request, response):
        """Learn anew, as the service asks."""
        try:
            self._stage.forget(tuple(request.sensors))
        except NetworkError as error:
            response.success, response.message = False, str(error)
            return response
        response.success = True
        response.message = f'learning {", ".join(request.sensors) or "all sensors"} anew'
        return response

    def _solve(self, request, response):
        """Orientations and clocks, as the service asks; tracks that run keep theirs to the end."""
        # Of a sensor near which a target stands, what was learnt before it came.
        fields = {name: self._stage.background(name) for name, b in
                  self._stage.backgrounds().items()
                  if b.ready and self._stage.last_stamp_ns(name) is not None}
        if not fields or not self._survey.counts['accelerations']:
            response.message = 'no background has been learnt yet' if not fields else \
                f'no acceleration has come on {", ".join(filter(None, self.network.imu_topics))}'
            return response
        date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds')
        found = self._survey.solve(fields, date)
        network = with_noise(found.network, self._stage)
        if request.save:
            path = self._save_as or self._beside()
            try:
                write_network(path, network, 'Written by calibration_node.')
            except OutputError as error:
                response.message = str(error)
                return response
        self.network = network
        self._stage.renew(network)
        self._health.renew(network)
        self._publish_state()
        response.success = True
        response.message = ('in force' + (f', and saved in {path}, to be given at the next start'
                                           if request.save else '')
                            + f'; clocks against {found.reference or "none: no knock was felt"}')
        response.warnings = found.warnings()
        response.warnings += [f'{name}: no background has been learnt: its heading stays as stated'
                              for name in network.names if name not in fields]
        for text in response.warnings:
            self.get_logger().warning(text)
        return response

    def _beside(self):
        """A file beside the network file, which somebody wrote by hand."""
        path = Path(self.get_parameter('network').value)
        return path.with_name(f'{path.stem}_calibrated.yaml')


def main(arguments=None):
    """Run the node."""
    sys.exit(stage_node.main(CalibrationNode, arguments))


if __name__ == '__main__':
    main()
