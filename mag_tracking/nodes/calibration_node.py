"""calibration_node: raw magnetic fields in, calibrated ones out."""

if __name__ == '__main__':
    # Does not return: a signal during the imports below would end in a traceback.
    from mag_tracking.nodes.start import calibration_node

    calibration_node()

import datetime
import time
from functools import partial
from pathlib import Path

from mag_tracking_msgs.msg import CalibrationState, FieldReadings, SensorCalibration
from mag_tracking_msgs.srv import Calibrate as CalibrateService
from mag_tracking_msgs.srv import Survey as SurveyService
from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.errors import NetworkError, OutputError, RecordingError
from mag_tracking.messages.calibration_state import sensor_dict
from mag_tracking.messages.schema import (
    acceleration_of,
    readings_dict,
    sample_dict,
    sample_of,
)
from mag_tracking.messages.types import CALIBRATED_READINGS, RAW_READINGS
from mag_tracking.network.file import write_network
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.deferred import Later
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.nodes.stage_node import LATCHED, SENT, STREAM, StageNode
from mag_tracking.recording.background_file import (
    background_text,
    read_backgrounds,
    usual_path,
    write_backgrounds,
)
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.survey.stage import Survey, with_noise

SHORTEST_TURN_S = 0.01
"""[s] All sensors have their turns once a second, or where they are too many for that, in steps
that come so often."""
REST_S = 0.0055
"""[s] What need not come before many readings are published comes so long behind: until the pose is
there, which takes about that long of a hundred sensors, those who make it are to have the cores."""
KEEP_EVERY_S = 5.0
"""[s] The backgrounds are written down so often, or oftener where `calibrate.resume_s` is short."""


class CalibrationNode(StageNode):
    """Subscribes to each sensor's topic; publishes it with `_calibrated` behind its name."""

    OWN_PARAMETERS = (*StageNode.OWN_PARAMETERS, 'save_as', 'state_file')

    def __init__(self, **node_arguments):
        super().__init__('calibration_node', 'calibrate', **node_arguments)
        self.settings = declare_settings(self, self.settings, 'survey', self.OWN_PARAMETERS)
        self._save_as = self.declare_parameter('save_as', '').value
        self._stage = Calibrate(self.network, self.settings.calibrate)
        self._state_file = self._place_of_state()
        self._kept, self._write_again = {}, 0.0
        self._resume()
        self._survey = Survey(self.network, self.settings.survey)
        self._health = HealthDiagnostics(self.network, self.settings)
        self._unseen, self._later = [], Later(self, REST_S, self._do_the_rest)
        self._publishers_by_sensor = {}
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self._publishers_by_sensor[sensor] = self.publisher(
                MagneticField, f'{topic}_calibrated', SENT)
            self.subscription(MagneticField, topic, partial(self._take, sensor), self.input_qos,
                              source='sensors')
        for sensor, topic in zip(self.network.names, self.network.imu_topics, strict=True):
            if topic is not None:
                self.subscription(Imu, topic, partial(self._shaken, sensor), self.input_qos)
        self._readings = self.publisher(FieldReadings, CALIBRATED_READINGS, SENT)
        self.subscription(FieldReadings, RAW_READINGS, self._take_many, STREAM, source='sensors')
        self.expect('detection_node', CALIBRATED_READINGS)
        self._state = self.publisher(CalibrationState, '~/calibration', LATCHED)
        self._turns, self._turn_is_due = self._rounds(), False
        self.create_timer(max(1.0 / (2 * len(self.network) + 3), SHORTEST_TURN_S), self._tick)
        self.create_service(CalibrateService, '~/calibrate', self._calibrate)
        self.create_service(SurveyService, '~/survey', self._solve)

    def _place_of_state(self):
        """Path of the file of backgrounds; None where none is kept.

        Who plays a recording has no business with what the sensors do now.
        """
        place = self.declare_parameter('state_file', '', ParameterDescriptor(
            read_only=True, description='File in which the backgrounds are kept for a restart; '
            'left out: below $ROS_HOME, or ~/.ros.')).value
        if self.is_replayed or not self.settings.calibrate.resume_s:
            return None
        return Path(place) if place else usual_path(
            self.get_parameter('network').value, self.get_fully_qualified_name())

    def _resume(self):
        """Go on from the backgrounds that were kept; the first readings decide."""
        if self._state_file is None:
            return
        try:
            kept, refused = read_backgrounds(
                self._state_file, self.network, self.settings.calibrate)
        except RecordingError as error:
            self.get_logger().warning(f'what was learnt before is not used: {error}')
            return
        for name, why in refused.items():
            self.get_logger().warning(f'what was learnt of {name} before is not used: {why}')
        self._stage.resume(kept)
        if kept:
            self.get_logger().info(
                f'goes on with the backgrounds of {", ".join(kept)}, where their readings go on '
                f'within {self.settings.calibrate.resume_s:g} s; ~/calibrate learns anew')

    def stages(self):
        return {'calibrate': self._stage, 'survey': self._survey}

    def queues(self):
        return {'calibrate': self._stage.n_held}

    def _tick(self):
        """It is time for a turn: behind the next readings, where it holds up none; or else now."""
        if self._turn_is_due:
            self._next_turn()
        self._turn_is_due = True

    def _next_turn(self):
        """Go on with the round."""
        self._turn_is_due = False
        next(self._turns)

    def _rounds(self):
        """Compare all sensors, say how each is, and then how all are calibrated; again and again.

        In steps that take about the same time: all at once would hold up the readings.
        """
        while True:
            self._health.begin_round(self._stage)
            yield
            states = []
            for j in range(len(self.network)):
                self._health.look(j)
                states.append(to_message(
                    SensorCalibration, sensor_dict(self._stage, self.network, j)))
                self._keep(j)
                yield
                self.publish_statuses([self._health.status(self.get_name(), j, self._stage)])
                yield
            self._publish_state(states)
            yield
            self._write_kept()
            yield

    def _keep(self, j):
        """Note the background of sensor `j`, if there is one to keep."""
        kept = None if self._state_file is None else self._stage.kept(self.network.names[j])
        if kept is None:
            self._kept.pop(self.network.names[j], None)
        else:
            self._kept[self.network.names[j]] = background_text(
                kept, self.network, j, self.settings.calibrate)

    def _write_kept(self):
        """Write down what has been noted, if it is time to."""
        now = time.monotonic()
        if self._state_file is None or now < self._write_again or not self.flows['sensors'].is_live:
            return
        self._write_again = now + min(KEEP_EVERY_S, self.settings.calibrate.resume_s / 4.0)
        try:
            write_backgrounds(self._state_file, self._kept)
        except OutputError as error:
            self.get_logger().warning(f'backgrounds are not kept for a restart: {error}',
                                      throttle_duration_sec=60.0)

    def _keep_no_more(self, sensors):
        """Forget also in the file what was kept of `sensors`."""
        for name in sensors:
            self._kept.pop(name, None)
        self._write_again = 0.0
        self._write_kept()

    def _take(self, sensor, message):
        """One raw reading."""
        raw = sample_of(message, sensor)
        for sample in self._stage.feed(raw):
            self._publishers_by_sensor[sensor].publish(
                to_message(MagneticField, sample_dict(sample, message.header.frame_id)))
        self._unseen.append((Readings.of([raw]), self.now_ns))
        self._do_the_rest()

    def _take_many(self, message):
        """Raw readings of many sensors; they go on together."""
        raw = self.readings_of(message, self._stage)
        if raw is None:
            return
        calibrated = self._stage.feed_many(raw)
        if len(calibrated):
            self._readings.publish(to_message(FieldReadings, readings_dict(calibrated)))
        self._unseen.append((raw, self.now_ns))
        self._later.ask()

    def _do_the_rest(self):
        """Learn from what has come, look at it, and say a little more of the sensors."""
        self._stage.settle()
        unseen, self._unseen = self._unseen, []
        for raw, now_ns in unseen:
            self._health.add(raw, now_ns)
        if self._turn_is_due:
            self._next_turn()

    def _shaken(self, sensor, message):
        """One acceleration."""
        self._survey.feed(acceleration_of(message, sensor))

    def _publish_state(self, states):
        """The calibration of all sensors, [SensorCalibration]."""
        message = CalibrationState(sensors=states)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.network.frame
        self._state.publish(message)

    def _calibrate(self, request, response):
        """Learn anew, as the service asks."""
        try:
            self._stage.forget(tuple(request.sensors))
        except NetworkError as error:
            response.success, response.message = False, str(error)
            return response
        self._keep_no_more(request.sensors or self.network.names)
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
        self._publish_state([to_message(SensorCalibration, sensor_dict(self._stage, network, j))
                             for j in range(len(network))])
        self._turns = self._rounds()
        self._keep_no_more(network.names)
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
    """Run the node; returns the exit status."""
    return stage_node.main(CalibrationNode, arguments)
