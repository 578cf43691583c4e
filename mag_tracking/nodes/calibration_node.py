"""calibration_node: raw magnetic fields in, calibrated ones out."""

import sys
from functools import partial

from mag_tracking_msgs.msg import CalibrationState
from mag_tracking_msgs.srv import Calibrate as CalibrateService
from sensor_msgs.msg import MagneticField

from mag_tracking.errors import NetworkError
from mag_tracking.io.schema import calibration_dict, sample_dict, sample_of
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import LATCHED, STREAM, StageNode
from mag_tracking.stages.calibrate import Calibrate


class CalibrationNode(StageNode):
    """Subscribes to each sensor's topic; publishes it with `_calibrated` behind its name."""

    def __init__(self, **node_arguments):
        super().__init__('calibration_node', 'calibrate', **node_arguments)
        self._stage = Calibrate(self.network, self.settings.calibrate)
        self._publishers_by_sensor = {}
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self._publishers_by_sensor[sensor] = self.publisher(
                MagneticField, f'{topic}_calibrated', STREAM)
            self.subscription(MagneticField, topic, partial(self._take, sensor), self.input_qos)
        self._state = self.publisher(CalibrationState, '~/calibration', LATCHED)
        self._published = None
        self.create_timer(1.0, self._publish_state)
        self.create_service(CalibrateService, '~/calibrate', self._calibrate)

    def stages(self):
        return {'calibrate': self._stage}

    def _take(self, sensor, message):
        """One raw reading."""
        for sample in self._stage.feed(sample_of(message, sensor)):
            self._publishers_by_sensor[sensor].publish(
                to_message(MagneticField, sample_dict(sample, message.header.frame_id)))

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


def main(arguments=None):
    """Run the node."""
    sys.exit(stage_node.main(CalibrationNode, arguments))


if __name__ == '__main__':
    main()
