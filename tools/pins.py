"""What the Makefile needs to know of requirements: `pins.py build-requires` or `pins.py freeze`."""

import sys
from importlib.metadata import distributions
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10 has none; it can go when 3.11 is the oldest
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PROJECTS = ROOT / 'msg_defs' / 'pyproject.toml', ROOT / 'pyproject.toml'


def build_requires():
    """The requirements for building both packages, for those who build without isolation."""
    systems = [tomllib.loads(project.read_text())['build-system'] for project in PROJECTS]
    return sorted({requirement for system in systems for requirement in system['requires']})


def freeze():
    """Exact pins of what pip has installed from the index in this environment.

    `pip freeze` would list more: the ros-* wheels carry the metadata of the package inside them
    (`rclpy` in `ros-rclpy`) under names that on the index are other people's or nobody's.
    """
    return sorted(
        f'{each.metadata["Name"].lower()}=={each.version}'
        for each in distributions()
        if (each.read_text('INSTALLER') or '').strip() == 'pip'
        and each.read_text('direct_url.json') is None
    )


if __name__ == '__main__':
    print('\n'.join({'build-requires': build_requires, 'freeze': freeze}[sys.argv[1]]()))
