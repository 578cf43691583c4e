"""How every process begins with ROS."""

import os
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

PROFILE = Path(__file__).with_name('fastdds.xml')
"""Nodes that find each other at once, also one that was killed and is started again."""
NAMES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
"""Where Fast DDS looks for a profile: of Jazzy, and of later releases."""
USUAL = ('DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml')
"""What it takes from the working folder by itself."""


def begin(arguments=None):
    """`rclpy.init`, with the project's profile of the middleware unless the user has his own.

    Other middlewares do not look at it. Signals stay with the caller: rclpy's own handlers raise
    KeyboardInterrupt wherever Python is, in its C++ too.
    """
    if not any(n in os.environ for n in NAMES) and not any(Path(n).exists() for n in USUAL):
        for name in NAMES:
            os.environ[name] = str(PROFILE)
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
