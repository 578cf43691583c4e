"""Reference page of the command line, from the help texts."""

import argparse
import contextlib
import importlib
import io
import os

from mag_tracking.cli.commands import COMMANDS, parse

COLUMNS = '100'
COMMAND_LINE = """# Command line

The help of each command, as `mag-tracking COMMAND --help` prints it. Commands that need ROS 2 say
so.

| exit status | meaning |
|---|---|
| 0 | success |
| 1 | an error that a message explains; `archive`: at least one recording failed |
| 2 | a wrong command line; `doctor` and `calibrate`: faults that need an action were found |
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


def actions_of(command):
    """Names of the sub-commands of a command, such as `classes train`."""
    commands = argparse.ArgumentParser().add_subparsers()
    module = importlib.import_module(f'mag_tracking.cli.{COMMANDS[command].module}')
    module.add(commands)
    parser = commands.choices[command]
    return [name for action in parser._actions  # argparse has no public way to list them.
            if isinstance(action, argparse._SubParsersAction) for name in action.choices]


def command_page():
    """Markdown: the help of every command and sub-command."""
    lines = [COMMAND_LINE, '```text', help_of(), '```', '']
    for name in COMMANDS:
        lines += [f'## {name}', '', '```text', help_of(name), '```', '']
        for action in actions_of(name):
            lines += [f'### {name} {action}', '', '```text', help_of(name, action), '```', '']
    return '\n'.join(lines)
