"""mag-tracking warm-up."""

import argparse

from tqdm import tqdm

from mag_tracking.apps.warm_up import compiled_modules, warm_up
from mag_tracking.cli.options import Commands, add_command

_WARM_UP = '''
What numba compiles is kept on disk and loaded from there. Without this command
each function is compiled when it is first used, which may take seconds in the
middle of a track. `make setup` does it; another version of numba, or another
processor, compiles anew.
'''


def add(commands: Commands) -> None:
    """Register the command."""
    add_command(commands, 'warm-up', _warm_up, _WARM_UP)


def _warm_up(args: argparse.Namespace) -> int:
    """mag-tracking warm-up."""
    with tqdm(total=len(compiled_modules()), desc='compiling', unit='module', disable=None) as bar:
        n = warm_up(bar.update)
    print(f'{n} functions are compiled')
    return 0
