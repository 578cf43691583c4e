"""Initialisation of ROS, common to all processes."""

import os
import sys
import tempfile
from pathlib import Path

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from mag_tracking.errors import SettingsError
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
ROS_ARGUMENTS, PARAMETER_FILE = '--ros-args', '--params-file'


def init_ros(arguments: list[str] | None = None) -> None:
    """Call `rclpy.init` with the Fast DDS profile of this package, unless the user selects another.

    Other middlewares ignore the profile. No signal handlers are installed, because those of rclpy
    raise KeyboardInterrupt at any point, even within C++ code of rclpy. Parameter files
    (`--params-file`) may also have the plain format of `--params`. Raises SettingsError if the ROS
    arguments or a parameter file are invalid.
    """
    profile = os.environ.get(PROFILE_VARIABLE)
    if profile is None and not Path(WORKING_FOLDER_PROFILE).exists():
        os.environ[PROFILE_VARIABLE] = str(PROFILE)
    with tempfile.TemporaryDirectory(prefix='mag_tracking_') as folder:
        _init(_with_ros_parameter_files(arguments, Path(folder)))
    if profile and not Path(profile).exists():
        rclpy.logging.get_logger('middleware').warning(
            f'{PROFILE_VARIABLE}: file {profile} does not exist: no Fast DDS profile is active, '
            'and messages of a restarted node may be lost for several seconds; correct or unset '
            'the variable')


def _init(arguments: list[str] | None) -> None:
    """Call `rclpy.init`; raise SettingsError for invalid ROS arguments."""
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        # The remainder of the message consists of source locations in rcl.
        raise SettingsError(f'ROS arguments: {str(error).partition(", at /")[0]}') from error


def _with_ros_parameter_files(arguments: list[str] | None, folder: Path) -> list[str] | None:
    """Arguments (None: `sys.argv`), with plain parameter files replaced by copies in `folder`.

    The copies are only needed until `rclpy.init` has returned. Raises SettingsError for an invalid
    file.
    """
    converted = list(sys.argv if arguments is None else arguments)
    for k, argument in enumerate(converted[:-1]):
        # rclpy reports missing files and invalid arguments.
        if argument != PARAMETER_FILE or ROS_ARGUMENTS not in converted[:k] \
                or not Path(converted[k + 1]).is_file():
            continue
        content = as_ros_parameters(converted[k + 1])
        if content is not None:
            converted[k + 1] = str(folder / f'{k}.yaml')
            Path(converted[k + 1]).write_text(content, encoding='utf-8')
    return converted
