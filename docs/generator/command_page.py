"""Reference page of the command line, from the help texts."""

import argparse
import contextlib
import io
import os

from mag_tracking.cli.commands import COMMANDS, parse

COLUMNS = '100'


def help_of(*words):
    """The help text of a command."""
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
    made = argparse.ArgumentParser()
    commands = made.add_subparsers()
    module = __import__(f'mag_tracking.cli.{COMMANDS[command].module}', fromlist=['add'])
    module.add(commands)
    parser = commands.choices[command]
    return [name for action in parser._actions  # argparse has no public way to list them.
            if isinstance(action, argparse._SubParsersAction) for name in action.choices]


def command_page():
    """Markdown: the help of every command and sub-command."""
    lines = ['# Command line', '', 'The help of each command, as `mag-tracking COMMAND --help` '
                                   'prints '
             'it. Commands that need ROS 2 say so. The exit status is 0 on success, 1 for an '
             'error that '
             'a message explains, 2 for a wrong command line, 130 after Ctrl-C.', '',
             '```text', help_of(), '```', '']
    for name in COMMANDS:
        lines += [f'## {name}', '', '```text', help_of(name), '```', '']
        for action in actions_of(name):
            lines += [f'### {name} {action}', '', '```text', help_of(name, action), '```', '']
    return '\n'.join(lines)
