"""Lifecycle node with automatic start."""

from typing import Any

from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn

from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes.ros_params import fixed_parameter


class ManagedNode(LifecycleNode):
    """Lifecycle node that configures and activates itself unless `autostart` is false."""

    def __init__(self, name: str, **node_arguments: Any) -> None:
        super().__init__(name, **node_arguments)
        self._refused: MagTrackingError | None = None

    def start_by_itself(self) -> None:
        """Configure and activate the node if `autostart` is true.

        Raises MagTrackingError if the settings are invalid.
        """
        if not fixed_parameter(self, 'autostart', True, 'Configure and activate at the start.'):
            return
        done = self.trigger_configure()
        if self._refused is not None:
            raise self._refused
        if done == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def prepare(self) -> None:
        """Read files and advertise topics; called on configuration. Raises MagTrackingError."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop threads of the node; called before it is destroyed."""

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Call `prepare`; an error is logged and leaves the node unconfigured."""
        try:
            self.prepare()
        except MagTrackingError as error:
            self._refused = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._refused = None
        return TransitionCallbackReturn.SUCCESS
