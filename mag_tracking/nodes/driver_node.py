"""driver_node: reads devices and publishes magnetic fields and accelerations.

A lifecycle node: configuration reads the drivers file, activation opens the devices. With
`autostart` (the default), the node configures and activates itself at startup.
"""

if __name__ == '__main__':
    # Does not return. Without this, a signal during the imports below would cause a traceback.
    from mag_tracking.nodes.start import driver_node

    driver_node()

import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import FieldReadings
from rclpy.lifecycle import State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.drivers.configuration import read_drivers
from mag_tracking.drivers.driver import IGNORED, Driver, serve
from mag_tracking.errors import SettingsError
from mag_tracking.messages.schema import acceleration_dict, magnetic_field_dicts, readings_dict
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.driver_health import DriverDiagnostics
from mag_tracking.nodes.managed_node import ManagedNode
from mag_tracking.nodes.ros_params import fixed_parameter
from mag_tracking.nodes.stage_node import PUBLISHER_QOS, RESULT_QOS
from mag_tracking.nodes.steady_timer import steady_timer
from mag_tracking.records import AccelerationSample, Readings

STOP_TIMEOUT_S = 15.0
"""[s] Maximum time for all drivers to stop. Disconnecting from an MQTT broker that does not answer
takes several seconds."""


class DriverNode(ManagedNode):
    """Runs one thread per device, which publishes the readings of the device.

    Raises MagTrackingError if `autostart` is set and the settings are invalid.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__('driver_node', **node_arguments)
        self._path = fixed_parameter(self, 'drivers', '', 'Path of the drivers file.')
        self._network_path = fixed_parameter(self, 'network', '', 'Path of the network file.')
        self._readings_publisher = self.create_publisher(
            FieldReadings, RAW_READINGS, PUBLISHER_QOS) if fixed_parameter(
                self, 'batches', False, 'Publish the readings of many sensors in one message '
                '(FieldReadings).') else None
        self._drivers: list[Driver] = []
        self._threads: list[threading.Thread] = []
        self._publishers_by_sensor: dict[str, tuple[Publisher, Publisher]] = {}
        self._stop_event: threading.Event | None = None
        self._diagnostics_publisher = self.create_publisher(
            DiagnosticArray, '/diagnostics', RESULT_QOS)
        self._health = DriverDiagnostics(self)
        steady_timer(self, 1.0, self._publish_diagnostics)
        self.start_automatically()

    def prepare(self) -> None:
        """Read the drivers file and advertise the topics of the sensors.

        Raises SettingsError if parameter `drivers` is empty or the drivers file is invalid, and
        NetworkError if the network file is invalid.
        """
        if not self._path:
            raise SettingsError('driver_node: parameter drivers is empty; set it to the path of a '
                                'drivers file')
        network = read_network(self._network_path) if self._network_path else None
        self._drivers = read_drivers(self._path, network)
        for driver in self._drivers:
            for sensor in set(driver.sensors.values()) - {IGNORED}:
                self._publishers_by_sensor[sensor] = self._advertise(sensor, network)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Open each device in a thread; fail if one of a previous activation still runs."""
        if self._threads:
            self.get_logger().error(f'driver {self._threads[0].name} is still stopping; activate '
                                    'the node again later')
            return TransitionCallbackReturn.FAILURE
        # A new event for each activation, so that a thread that is still stopping does not resume.
        self._stop_event = threading.Event()
        self._threads = [threading.Thread(
            target=serve, args=(driver, self._publish, self._stop_event.is_set),
            name=driver.name, daemon=True) for driver in self._drivers]
        for thread in self._threads:
            thread.start()
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Close the devices."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Release the drivers and withdraw the topics."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Close the devices, release the drivers and withdraw the topics."""
        self._stop()
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> None:
        """Stop the threads; each closes its device."""
        self._stop()
        # `destroy_node` does not wait again for threads that did not stop in time.
        self._threads = []

    def destroy_node(self) -> None:
        """Close the devices and destroy the node."""
        self.close()
        ManagedNode.destroy_node(self)

    def _advertise(self, sensor: str,
                   network: SensorNetwork | None) -> tuple[Publisher, Publisher]:
        """Create the publishers of the field and the acceleration of a sensor."""
        topic, imu_topic = f'{sensor}/imu/mag', f'{sensor}/imu/data_raw'
        if network is not None:
            j = network.names.index(sensor)
            topic, imu_topic = network.topics[j], network.imu_topics[j] or imu_topic
        return (self.create_publisher(MagneticField, topic, PUBLISHER_QOS),
                self.create_publisher(Imu, imu_topic, PUBLISHER_QOS))

    def _publish(self, readings: Readings, accelerations: list[AccelerationSample]) -> None:
        """Publish readings, in one message if `batches` is set, and accelerations."""
        if self._readings_publisher is None:
            for sensor, content in magnetic_field_dicts(readings):
                self._publishers_by_sensor[sensor][0].publish(to_message(MagneticField, content))
        elif len(readings):
            self._readings_publisher.publish(to_message(FieldReadings, readings_dict(readings)))
        for acceleration in accelerations:
            self._publishers_by_sensor[acceleration.sensor][1].publish(
                to_message(Imu, acceleration_dict(acceleration, acceleration.sensor)))

    def _stop(self) -> None:
        """Stop the threads and wait, at most `STOP_TIMEOUT_S`, until their devices are closed."""
        if self._stop_event is not None:
            self._stop_event.set()
        end = time.monotonic() + STOP_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
            if thread.is_alive():
                self.get_logger().error(f'driver {thread.name} did not stop within '
                                        f'{STOP_TIMEOUT_S:g} s')
        self._threads = [thread for thread in self._threads if thread.is_alive()]

    def _release(self) -> None:
        """Release the drivers and withdraw the topics."""
        for pair in self._publishers_by_sensor.values():
            for publisher in pair:
                self.destroy_publisher(publisher)
        self._drivers, self._publishers_by_sensor = [], {}

    def _publish_diagnostics(self) -> None:
        """Publish the state of the devices."""
        array = DiagnosticArray(status=self._health.statuses(
            self._drivers, {thread.name for thread in self._threads if thread.is_alive()},
            self._stop_event is not None and not self._stop_event.is_set()))
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(array)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a process; return its exit status."""
    return stage_node.main(DriverNode, arguments)
