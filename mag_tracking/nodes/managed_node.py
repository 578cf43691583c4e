"""Lifecycle node with automatic start."""

from typing import Any

from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn

from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes.ros_params import fixed_parameter


class ManagedNode(LifecycleNode):
    """Lifecycle node that configures and activates itself unless `autostart` is false."""

    def __init__(self, name: str, **node_arguments: Any) -> None:
        super().__init__(name, **node_arguments)
        self._configuration_error: MagTrackingError | None = None

    def start_automatically(self) -> None:
        """Configure and activate the node if `autostart` is true; raises the error of `prepare`."""
        if not fixed_parameter(self, 'autostart', True,
                               'Configure and activate the node at startup.'):
            return
        result = self.trigger_configure()
        if self._configuration_error is not None:
            raise self._configuration_error
        if result == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def prepare(self) -> None:
        """Read files and advertise topics on configuration; raises MagTrackingError if invalid."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop the threads of the node; called before the node is destroyed."""

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Call `prepare`; if it fails, log the error and leave the node unconfigured."""
        try:
            self.prepare()
        except MagTrackingError as error:
            self._configuration_error = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._configuration_error = None
        return TransitionCallbackReturn.SUCCESS
