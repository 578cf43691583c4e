"""driver_node: a lifecycle node that reads devices and publishes fields and accelerations."""

if __name__ == '__main__':
    from mag_tracking.nodes.start import driver_node

    driver_node()

import threading
import time
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from mag_tracking_msgs.msg import FieldReadings
from rclpy.lifecycle import State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from sensor_msgs.msg import Imu, MagneticField

from mag_tracking.drivers.configuration import read_drivers
from mag_tracking.drivers.driver import IGNORED, Driver, serve
from mag_tracking.errors import SettingsError
from mag_tracking.messages import schema
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.nodes import diagnostics, middleware
from mag_tracking.nodes.convert import send
from mag_tracking.nodes.middleware import ManagedNode
from mag_tracking.nodes.ros_params import fixed_parameter
from mag_tracking.nodes.scheduling import steady_timer
from mag_tracking.nodes.stage_node import PUBLISHER_QOS
from mag_tracking.records import AccelerationSample, Readings

EXPECTED_COUNTS = ('samples: ', 'late arrivals: ', 'other messages: ', 'lines that are comments',
                   'lines without the prefix', 'lines that are empty', 'retained messages skipped',
                   'conversions overwritten', 'packets not used')
"""Prefixes of counts that are reported but do not cause a warning."""
STOP_TIMEOUT_S = 15.0
"""[s] Maximum time for all drivers to stop; an MQTT broker may need several seconds."""


class DriverNode(ManagedNode):
    """Runs one thread per device, which publishes the readings of the device."""

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
        self._diagnostics = diagnostics.DiagnosticsPublisher(self)
        self._reported_counts: dict[str, dict[str, int]] = {}
        steady_timer(self, 1.0, lambda: self._diagnostics.publish(
            [self._status(driver) for driver in self._drivers]))
        self.start_automatically()

    def prepare(self) -> None:
        """Read the drivers file and advertise the topics; raises SettingsError or NetworkError."""
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

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Close the devices, release the drivers and withdraw the topics."""
        self._stop()
        return super().on_shutdown(state)

    def close(self) -> None:
        """Stop the threads; each closes its device."""
        self._stop()
        # `destroy_node` does not wait again for threads that did not stop in time.
        self._threads = []

    def destroy_node(self) -> None:
        """Close the devices and destroy the node."""
        self.close()
        ManagedNode.destroy_node(self)

    def _advertise(self, sensor: str, network: SensorNetwork | None) -> tuple[Publisher, Publisher]:
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
            for sensor, content in schema.magnetic_field_dicts(readings):
                send(self._publishers_by_sensor[sensor][0], content)
        elif len(readings):
            send(self._readings_publisher, schema.readings_dict(readings))
        for acceleration in accelerations:
            send(self._publishers_by_sensor[acceleration.sensor][1],
                 schema.acceleration_dict(acceleration, acceleration.sensor))

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

    def release(self) -> None:
        """Release the drivers and withdraw the topics."""
        for pair in self._publishers_by_sensor.values():
            for publisher in pair:
                self.destroy_publisher(publisher)
        self._drivers, self._publishers_by_sensor = [], {}

    def _status(self, driver: Driver) -> DiagnosticStatus:
        """Return the diagnostics of one device."""
        counts, examples = driver.counts(), driver.examples()
        previous = self._reported_counts.get(driver.name, {})
        increases = [f'{count}: {n - previous.get(count, 0)} more'
                     + (f', such as {examples[count]}' if count in examples else '')
                     for count, n in sorted(counts.items())
                     if n > previous.get(count, 0) and not count.startswith(EXPECTED_COUNTS)]
        self._reported_counts[driver.name] = dict(counts)
        level, message = diagnostics.OK, 'open'
        if self._stop_event is None or self._stop_event.is_set():
            message = 'not active'
        elif not any(t.name == driver.name and t.is_alive() for t in self._threads):
            level, message = diagnostics.ERROR, 'the driver thread has ended: restart the node'
        elif driver.fault:
            level, message = diagnostics.ERROR, driver.fault
        elif not driver.is_open:
            # No fault has occurred, and opening some devices takes seconds.
            message = 'opening'
        elif increases:
            level, message = diagnostics.WARN, '; '.join(increases)
        values: dict[str, object] = dict(sorted(counts.items()))
        for source, clock in driver.clocks().items():
            suffix = f' ({source})' if source else ''
            values[f'clock drift [ppm]{suffix}'] = f'{clock.drift_ppm:.2f}'
            values[f'delay above the minimum, 95 % [ms]{suffix}'] = f'{1e3 * clock.spread_s:.3g}'
            values[f'timestamp std [ms]{suffix}'] = f'{1e3 * clock.stamp_std:.3g}'
        return diagnostics.status_of(f'{self._diagnostics.title}: {driver.name}', message, level,
                                     values, hardware=driver.name)


main = partial(middleware.main, DriverNode)
