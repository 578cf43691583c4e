"""Requirements of the builds, for `make lock`.

`pins.py` prints all that is pinned besides what setup.py requires; `pins.py FILE` prints
constraints.txt from the output of uv.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MESSAGES = ROOT / 'msg_defs' / 'pyproject.toml'
# Installed by their names, not by a build or an extra.
TOOLS = 'pip', 'setuptools', 'uv', 'wheel'


def build_requires():
    """Build requirements of both packages, for builds without isolation."""
    systems = [tomllib.loads(project.read_text())['build-system']
               for project in (MESSAGES, ROOT / 'pyproject.toml')]
    return sorted({requirement for system in systems for requirement in system['requires']})


def colcon_requires():
    """What else colcon needs if ROS comes from PyPI."""
    return tomllib.loads(MESSAGES.read_text())['tool']['mag_tracking']['colcon-requires']


def constraints(text):
    """Content of constraints.txt from the output of uv, without what all lines share: the platform
    and the newest Python of [tool.uv] in pyproject.toml.
    """
    shared = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['uv']['environments'][0]
    lines = []
    for line in text.splitlines():
        name, _, marker = line.partition(' ; ')
        own = [part for part in marker.split(' and ') if part
               and part.replace('python_full_version', 'python_version') not in shared
               and 'platform_python_implementation' not in part]
        lines.append(' ; '.join([re.sub(r'\[.*?\]', '', name), *([' and '.join(own)] * bool(own))]))
    return '\n'.join([
        '# Exact versions of all that is installed here: to run, to test, to build the messages,',
        '# and colcon. Written by `make lock` for Linux on x86_64 with Python 3.11 to 3.14. After',
        '# that run `make test` and `make colcon`.', *sorted(lines, key=str.lower)])


if __name__ == '__main__':
    if len(sys.argv) > 1:
        print(constraints(Path(sys.argv[1]).read_text()))
    else:
        print('\n'.join([*build_requires(), *colcon_requires(), *TOOLS]))
