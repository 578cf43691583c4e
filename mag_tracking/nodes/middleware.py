"""How every process begins with ROS."""

import os
import sys
import tempfile
from pathlib import Path

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from mag_tracking.errors import SettingsError
from mag_tracking.settings import as_ros_parameters

RCLError, UnknownROSArgsError = (rclpy_implementation.RCLError,
                                 rclpy_implementation.UnknownROSArgsError)

PROFILE = Path(__file__).with_name('fastdds.xml')
"""Nodes that find each other at once, also one that was killed and is started again."""
PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Names a profile to the Fast DDS of Jazzy (2.14)."""
PROFILE_IN_FOLDER = 'DEFAULT_FASTRTPS_PROFILES.xml'
"""What it takes by itself, if there is one in the working folder."""
ROS_ARGUMENTS, PARAMETER_FILE = '--ros-args', '--params-file'


def begin(arguments: list[str] | None = None) -> None:
    """`rclpy.init`, with the project's profile of the middleware unless the user has his own.

    Other middlewares do not look at it. Signals stay with the caller: rclpy's own handlers raise
    KeyboardInterrupt wherever Python is, in its C++ too. Parameter files (`--params-file`) may be
    plain files, as for `--params`.

    Raises SettingsError for arguments that are not those of ROS.
    """
    named = os.environ.get(PROFILE_VARIABLE)
    if named is None and not Path(PROFILE_IN_FOLDER).exists():
        os.environ[PROFILE_VARIABLE] = str(PROFILE)
    with tempfile.TemporaryDirectory(prefix='mag_tracking_') as folder:
        _init(_with_ros_files(arguments, Path(folder)))
    if named and not Path(named).exists():
        rclpy.logging.get_logger('middleware').warning(
            f'{PROFILE_VARIABLE} names {named}, which does not exist: no profile is in force, and '
            'a node that is started again may not be heard for seconds')


def _init(arguments: list[str] | None) -> None:
    """`rclpy.init`; raises SettingsError for arguments that are not those of ROS."""
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        # What follows are places in the source of rcl.
        raise SettingsError(f'arguments of ROS: {str(error).partition(", at /")[0]}') from error


def _with_ros_files(arguments: list[str] | None, folder: Path) -> list[str] | None:
    """Arguments in which plain parameter files are replaced by converted copies.

    None selects `sys.argv`. The files are read once, in `rclpy.init`. Raises SettingsError.
    """
    words = list(sys.argv if arguments is None else arguments)
    for k, word in enumerate(words[:-1]):
        # rclpy reports missing files and invalid arguments.
        if word != PARAMETER_FILE or ROS_ARGUMENTS not in words[:k] \
                or not Path(words[k + 1]).is_file():
            continue
        text = as_ros_parameters(words[k + 1])
        if text is not None:
            words[k + 1] = str(folder / f'{k}.yaml')
            Path(words[k + 1]).write_text(text, encoding='utf-8')
    return words
