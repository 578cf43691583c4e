"""The command line of `mag-tracking`: all commands, with all that they import."""

import argparse
from collections.abc import Sequence
from importlib.metadata import version

from mag_tracking.cli import (
    board_geometry,
    calibrate,
    doctor,
    events,
    fit,
    graph,
    import_table,
    info,
    listen,
    live_page,
    plan,
    record,
    repair,
    replay,
    run,
    tumble,
)

PACKAGE = 'mag_tracking'
ROS_ARGUMENTS = '--ros-args'
WITH_ROS = ('run', 'record', 'doctor', 'topics', 'echo', 'param', 'lifecycle', 'watch')
"""Commands that take arguments of ROS."""


def parse(words: Sequence[str]) -> argparse.Namespace:
    """The parsed command line; its `run_command` takes it and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers.')
    parser.add_argument('--version', action='version', version=f'mag_tracking {version(PACKAGE)}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in (replay, events, calibrate, tumble, board_geometry, doctor, fit, plan, listen,
                   record, repair, run, info, import_table, graph, live_page):
        module.add(commands)
    words = list(words)
    split = words.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in words else len(words)
    args = parser.parse_args(words[:split])
    args.ros_arguments = words[split:]
    if args.ros_arguments and args.command not in WITH_ROS:
        parser.error(f'{ROS_ARGUMENTS}: {args.command} runs without ROS; only '
                     f'{", ".join(WITH_ROS)} take arguments of ROS')
    return args
