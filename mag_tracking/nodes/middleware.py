"""Processes with ROS: initialisation, main loop, lifecycle nodes and shutdown."""

import gc
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from mag_tracking.errors import MagTrackingError, SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.nodes.core import Deadline, end_within
from mag_tracking.nodes.ros_params import fixed_parameter
from mag_tracking.settings import as_ros_parameters

RCLError, RMWError, UnknownROSArgsError = (
    rclpy_implementation.RCLError, rclpy_implementation.RMWError,
    rclpy_implementation.UnknownROSArgsError)
PROFILE = Path(__file__).with_name('fastdds.xml')
"""Fast DDS profile for fast discovery, also of nodes that were killed and restarted."""
PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Environment variable that selects a profile in Fast DDS 2.14 (Jazzy)."""
WORKING_FOLDER_PROFILE = 'DEFAULT_FASTRTPS_PROFILES.xml'
"""Name of the profile that Fast DDS loads from the working folder by default."""
SHUTDOWN_TIMEOUT_S = 4.0
"""[s] Maximum time for the shutdown, usually 0.3 s; `ros2 launch` waits 5 s."""
HUNG_MESSAGE = (f'the middleware did not shut down within {SHUTDOWN_TIMEOUT_S:g} s; '
                'the process was ended\n')


def init_ros(arguments: list[str] | None = None) -> None:
    """Call `rclpy.init` with the Fast DDS profile of this package, unless the user selects another.

    The signal handlers of rclpy are not installed: they raise KeyboardInterrupt at any point, even
    within C++ code. Parameter files (`--params-file`) may also have the plain format of `--params`.
    Raises SettingsError if the ROS arguments or a parameter file are invalid.
    """
    profile = os.environ.get(PROFILE_VARIABLE)
    if profile is None and not Path(WORKING_FOLDER_PROFILE).exists():
        os.environ[PROFILE_VARIABLE] = str(PROFILE)
    with tempfile.TemporaryDirectory(prefix='mag_tracking_') as folder:
        try:
            rclpy.init(args=_with_ros_parameter_files(arguments, Path(folder)),
                       signal_handler_options=SignalHandlerOptions.NO)
        except (RCLError, UnknownROSArgsError) as error:
            # The remainder of the message consists of source locations in rcl.
            raise SettingsError(f'ROS arguments: {str(error).partition(", at /")[0]}') from error
    if profile and not Path(profile).exists():
        rclpy.logging.get_logger('middleware').warning(
            f'{PROFILE_VARIABLE}: file {profile} does not exist: no Fast DDS profile is active, '
            'and messages of a restarted node may be lost for several seconds; correct or unset '
            'the variable')


def _with_ros_parameter_files(arguments: list[str] | None, folder: Path) -> list[str]:
    """Arguments, with plain parameter files replaced by ROS copies in `folder`."""
    converted = list(sys.argv if arguments is None else arguments)
    for k, argument in enumerate(converted[:-1]):
        # rclpy reports missing files and invalid arguments.
        if argument == '--params-file' and '--ros-args' in converted[:k] \
                and Path(converted[k + 1]).is_file() \
                and (content := as_ros_parameters(converted[k + 1])) is not None:
            converted[k + 1] = str(folder / f'{k}.yaml')
            Path(converted[k + 1]).write_text(content, encoding='utf-8')
    return converted


def shut_down(nodes: Sequence[Node], executor: Executor | None = None, status: int = 0) -> None:
    """Close and destroy nodes and shut ROS down; end the process if the middleware hangs.

    Workaround: Fast DDS 2.14 blocks forever, while it holds the interpreter lock, if a participant
    is destroyed while another one leaves (eProsima/Fast-DDS 6513). The deadline, which ends the
    process with `status`, can be removed once Fast DDS is fixed.
    """
    try:
        for node in nodes:
            if executor is not None:
                executor.remove_node(node)
            if isinstance(node, ManagedNode):
                # Closing devices has its own, longer timeout.
                node.close()
    finally:
        flush()
        with ExitStack() as stack:
            stack.callback(Deadline(SHUTDOWN_TIMEOUT_S, status, _final_message()).cancel)
            stack.callback(rclpy.try_shutdown)
            if executor is not None:
                stack.callback(executor.shutdown)
            for node in reversed(nodes):
                stack.callback(node.destroy_node)


def limit_exit_time(status: int) -> None:
    """Limit the time until the process ends with `status`: a remaining node may hang."""
    flush()
    end_within(SHUTDOWN_TIMEOUT_S, status, HUNG_MESSAGE.encode())


def flush() -> None:
    """Flush the standard streams; errors are left to Python, which reports them at exit."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.flush()


def _final_message() -> bytes:
    """Return the pending error, if any, which would otherwise be lost, and the timeout message."""
    error = sys.exc_info()[1]
    if error is None or isinstance(error, KeyboardInterrupt):
        pending = ''
    elif isinstance(error, MagTrackingError):
        pending = f'{error}\n'
    else:
        pending = ''.join(traceback.format_exception(error))
    return (pending + HUNG_MESSAGE).encode(errors='backslashreplace')


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

    def release(self) -> None:
        """Undo `prepare`."""
        raise NotImplementedError

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Release the resources of the node."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

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


def make_executor() -> Executor:
    """Create the events executor, which has little overhead, or else the single-threaded one."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def freeze() -> None:
    """Exclude all existing objects from garbage collection: scans would delay the readings."""
    gc.collect()
    gc.freeze()


def spin(executor: Executor, until: Callable[[], bool] = lambda: False) -> None:
    """Run an executor until ROS shuts down or `until`, polled a few times per s, is True."""
    try:
        while rclpy.ok() and not until():
            # EventsExecutor.spin() of the Jazzy wheels hangs because a timeout overflows. Waiting
            # for a future that never completes, with a finite timeout, works.
            executor.spin_until_future_complete(Future(), 0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def main(node_class: Callable[[], Node], arguments: list[str] | None = None) -> int:
    """Run a node as a process until SIGINT or SIGTERM; return its exit status."""
    logger = rclpy.logging.get_logger(node_class.__name__)
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        try:
            init_ros(arguments)
        except SettingsError as error:
            logger.fatal(str(error))
            return 1
        executor, nodes, status = make_executor(), list[Node](), 1
        try:
            nodes.append(node_class())
            executor.add_node(nodes[0])
            freeze()
            spin(executor, lambda: bool(signals))
            status = 0
        except (MagTrackingError, ParameterException) as error:
            logger.fatal(str(error))
            # A partly constructed node is destroyed when the error is deleted.
            limit_exit_time(status)
        except (KeyboardInterrupt, ExternalShutdownException):
            status = 0
        finally:
            shut_down(nodes, executor, status)
        return status
