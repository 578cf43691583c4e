"""How every process begins with ROS."""

import os
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

PROFILE = Path(__file__).with_name('fastdds.xml')
"""Nodes that find each other at once, also one that was killed and is started again."""
NAME, USUAL = 'FASTRTPS_DEFAULT_PROFILES_FILE', 'DEFAULT_FASTRTPS_PROFILES.xml'
"""The variable that names a profile to the Fast DDS of Jazzy (2.14), and the file in the working
folder that it takes by itself."""


def begin(arguments=None):
    """`rclpy.init`, with the project's profile of the middleware unless the user has his own.

    Other middlewares do not look at it. Signals stay with the caller: rclpy's own handlers raise
    KeyboardInterrupt wherever Python is, in its C++ too.
    """
    if not Path(USUAL).exists():
        os.environ.setdefault(NAME, str(PROFILE))
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
