"""Print requirements for the Makefile: `pins.py build-requires` or `pins.py freeze`."""

import sys
from importlib.metadata import distributions
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10; remove when 3.11 is the oldest supported version
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PROJECTS = ROOT / 'msg_defs' / 'pyproject.toml', ROOT / 'pyproject.toml'


def build_requires():
    """Build requirements of both packages, for builds without isolation."""
    systems = [tomllib.loads(project.read_text())['build-system'] for project in PROJECTS]
    return sorted({requirement for system in systems for requirement in system['requires']})


def freeze():
    """Exact versions of the packages that pip has installed from the index in this environment.

    `pip freeze` would list more: the ros-* wheels carry the metadata of the packages inside them
    (`rclpy` in `ros-rclpy`), under names that do not exist on the index or belong to other
    projects.
    """
    return sorted(
        f'{distribution.metadata["Name"].lower()}=={distribution.version}'
        for distribution in distributions()
        if (distribution.read_text('INSTALLER') or '').strip() == 'pip'
        and distribution.read_text('direct_url.json') is None
    )


if __name__ == '__main__':
    print('\n'.join({'build-requires': build_requires, 'freeze': freeze}[sys.argv[1]]()))
