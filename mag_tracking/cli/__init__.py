"""The command `mag-tracking`: one module a command."""

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

INTERRUPTED = 'mag-tracking: interrupted'
"""What Ctrl-C has the command say."""

UNREAD = 128 + signal.SIGPIPE
"""Exit status where nobody reads on, as that of other programs."""


def command() -> NoReturn:
    """Run the command as a process; does not return."""
    status = 1
    try:
        status = main()
    finally:
        limit_exit_time(status)
    sys.exit(status)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status (1 for an error that a message explains)."""
    words = sys.argv[1:] if argv is None else argv
    for word in words:
        # No path can contain one, and each function that takes a path fails in its own way.
        if '\0' in word:
            print(f'mag-tracking: {word!r} contains a NUL character', file=sys.stderr)
            return 1
    # A file name may not be valid UTF-8; by default stderr escapes it and stdout fails.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == 'strict':
        sys.stdout.reconfigure(errors='backslashreplace')
    if words[:1] == ['run']:
        # To end the nodes is no failure, neither before they are up.
        with exit_on_signals(0, signal.SIGINT, signal.SIGTERM):
            return _run(_parse(words))
    with exit_on_signals(130, signal.SIGINT, message=INTERRUPTED):
        args = _parse(words)
    return _run(args)


def _parse(words: Sequence[str]) -> argparse.Namespace:
    """The parsed command line; the imports for it take most of a second."""
    from mag_tracking.cli.commands import parse

    return parse(words)


def _is_unread() -> bool:
    """Whether nobody reads what is printed, as behind `| head`; it is then thrown away."""
    if sys.stdout is None:
        return False
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    # Python would complain once more at its end.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def _run(args: argparse.Namespace) -> int:
    """Run a command; returns its exit status."""
    try:
        status: int = args.run_command(args)
        # A process that was started with its output closed has no stdout.
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except (MagTrackingError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _is_unread():
            return UNREAD
        # An OSError here is a full disk or a lost drive; its text names the file.
        print(f'mag-tracking: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(INTERRUPTED, file=sys.stderr)
        return 130
