"""A lifecycle node that starts by itself unless it is told to wait."""

from typing import Any

from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn

from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes.ros_params import fixed_parameter


class ManagedNode(LifecycleNode):
    """Configuring prepares; with `autostart` (the default) it configures and activates itself."""

    def __init__(self, name: str, **node_arguments: Any) -> None:
        super().__init__(name, **node_arguments)
        self._refused: MagTrackingError | None = None

    def start_by_itself(self) -> None:
        """Configure and activate, if the parameter says so.

        Raises MagTrackingError where the settings are unusable.
        """
        if not fixed_parameter(self, 'autostart', True, 'Configure and activate at the start.'):
            return
        done = self.trigger_configure()
        if self._refused is not None:
            raise self._refused
        if done == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def prepare(self) -> None:
        """Read files and advertise topics; raises MagTrackingError."""
        raise NotImplementedError

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Prepare; what is wrong is logged, and the state stays."""
        try:
            self.prepare()
        except MagTrackingError as error:
            self._refused = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._refused = None
        return TransitionCallbackReturn.SUCCESS
