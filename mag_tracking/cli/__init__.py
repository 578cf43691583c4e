"""The command `mag-tracking`: entry point, signals and exit status."""

import argparse
import io
import os
import select
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

from mag_tracking.errors import MagTrackingError
from mag_tracking.interrupts import exit_on_signals
from mag_tracking.nodes.start import limit_exit_time

INTERRUPTED_MESSAGE = 'mag-tracking: interrupted'

BROKEN_PIPE_STATUS = 128 + signal.SIGPIPE
"""Exit status if the reader of stdout has closed the pipe, as for other Unix commands."""


def command() -> NoReturn:
    """Run the command as the main function of a process and exit with its status."""
    status = 1
    try:
        status = main()
    finally:
        limit_exit_time(status)
    sys.exit(status)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with `argv`, by default `sys.argv[1:]`; return its exit status: 0 for
    success, 1 for an error that has been printed, 130 after Ctrl-C, others as in the help text."""
    arguments = sys.argv[1:] if argv is None else argv
    for argument in arguments:
        # Paths cannot contain NUL, but functions that take a path report this in different ways.
        if '\0' in argument:
            print(f'mag-tracking: {argument!r} contains a NUL character', file=sys.stderr)
            return 1
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file that stdout is redirected to shows each line at once, and keeps it after a crash.
        # A file name may be invalid UTF-8. By default, stderr escapes it, but stdout raises an
        # error.
        errors = sys.stdout.errors
        sys.stdout.reconfigure(line_buffering=True,
                               errors='backslashreplace' if errors == 'strict' else errors)
    if arguments[:1] == ['run']:
        # Ending the nodes is not a failure, even before they have started.
        with exit_on_signals(0, signal.SIGINT, signal.SIGTERM):
            return _run(_parse(arguments))
    with exit_on_signals(130, signal.SIGINT, message=INTERRUPTED_MESSAGE):
        args = _parse(arguments)
    return _run(args)


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Import the parser, which is slow to import, and parse the command line."""
    from mag_tracking.cli.commands import parse

    return parse(arguments)


def _is_stdout_closed() -> bool:
    """Return whether the reader of stdout has closed the pipe; if so, discard further output."""
    if sys.stdout is None:
        return False
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    # Python would report the error again at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def _run(args: argparse.Namespace) -> int:
    try:
        status: int = args.run_command(args)
        # sys.stdout is None if the process was started with a closed stdout.
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except (MagTrackingError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _is_stdout_closed():
            return BROKEN_PIPE_STATUS
        # An OSError here is due to a full disk or a lost drive; its message names the file.
        print(f'mag-tracking: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(INTERRUPTED_MESSAGE, file=sys.stderr)
        return 130
