"""Reference page of the command line, from the help texts."""

import contextlib
import io
import itertools
import os

from mag_tracking.cli.commands import COMMANDS, GROUPS, parse

COLUMNS = '100'
COMMAND_LINE = """# Command line

The help of each command and subcommand, as `mag-tracking COMMAND --help` prints it. Commands that
need ROS 2 say so.

| exit status | meaning |
|---|---|
| 0 | success |
| 1 | an error that a message explains; `archive`: at least one recording failed |
| 2 | a wrong command line; `doctor` and `calibrate network`: faults that need an action |
| 130 | stopped with Ctrl-C; results so far are kept |
"""


def help_of(*words):
    """Return the help text of a command."""
    text = io.StringIO()
    before = os.environ.get('COLUMNS')
    os.environ['COLUMNS'] = COLUMNS
    try:
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            parse([*words, '--help'])
    finally:
        if before is None:
            del os.environ['COLUMNS']
        else:
            os.environ['COLUMNS'] = before
    return text.getvalue().rstrip()


def command_page():
    """Markdown: the help of every command and subcommand."""
    lines = [COMMAND_LINE, '```text', help_of(), '```', '']
    for command in itertools.chain(*GROUPS.values()):
        for name in (command, *(c for c in COMMANDS if c.startswith(f'{command} '))):
            words = name.split()
            lines += [f'{"#" * (len(words) + 1)} {name}', '', '```text', help_of(*words), '```', '']
    return '\n'.join(lines)
