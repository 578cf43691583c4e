"""The service and the container of the guide "Deploy on a robot" run with few permissions."""

import re
import shutil
import subprocess

import pytest

from support.bundled import ROOT

GUIDE = (ROOT / 'docs' / 'guides' / 'deploy.md').read_text(encoding='utf-8')
MAX_EXPOSURE = 2.0
"""Maximum exposure level according to systemd-analyze; a service with default settings has 9.6."""


def block(language):
    """Text of the first code block of `language` in the guide."""
    return re.search(rf'^```{language}\n(.*?)^```', GUIDE, re.S | re.M)[1]


@pytest.mark.skipif(shutil.which('systemd-analyze') is None,
                    reason='systemd-analyze is not installed')
def test_the_service_is_valid_and_hardened(tmp_path):
    unit = tmp_path / 'mag-tracking.service'
    unit.write_text(re.sub(r'ExecStart=\S+', 'ExecStart=/bin/true', block('ini')))
    for arguments in (['verify', str(unit)], ['security', '--offline=true', str(unit)]):
        done = subprocess.run(['systemd-analyze', *arguments], capture_output=True, text=True,
                              check=True)
        assert 'Unknown' not in done.stderr
    exposure, = re.findall(r'exposure level for \S+: ([\d.]+)', done.stdout)
    assert float(exposure) <= MAX_EXPOSURE


def test_service_and_container_limit_discovery_and_are_not_root():
    unit, container = block('ini'), block('dockerfile')
    for text in (unit, container):
        assert 'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST' in text
    assert 'DynamicUser=yes' in unit
    (user,) = re.findall(r'^USER (\w+)$', container, re.M)
    assert user != 'root' and container.index(f'USER {user}') < container.index('ENTRYPOINT')
