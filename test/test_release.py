"""Version, licence and description agree in all files."""

import re
from importlib.metadata import metadata, version
from xml.etree import ElementTree

import yaml

import mag_tracking
from support.bundled import ROOT

PACKAGE_XML = ElementTree.parse(ROOT / 'package.xml').getroot()
MESSAGES_XML = ElementTree.parse(ROOT / 'msg_defs' / 'package.xml').getroot()
VERSION = PACKAGE_XML.findtext('version')


def test_the_version_is_taken_from_package_xml():
    assert re.fullmatch(r'\d+\.\d+\.\d+', VERSION)
    assert mag_tracking.__version__ == version('mag_tracking') == VERSION
    assert MESSAGES_XML.findtext('version') == version('mag_tracking_msgs') == VERSION
    for path in (ROOT / 'setup.py', ROOT / 'msg_defs' / 'setup.py',
                 ROOT / 'mag_tracking' / '__init__.py'):
        assert VERSION not in path.read_text(encoding='utf-8')


def test_the_changelog_has_the_version():
    text = (ROOT / 'CHANGELOG.md').read_text(encoding='utf-8')
    assert re.findall(r'^## \[(.+?)\]', text, re.M)[:2] == ['Unreleased', VERSION]


def test_licence_and_description_agree():
    wheel = metadata('mag_tracking')
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    licence = PACKAGE_XML.findtext('license')
    assert licence == MESSAGES_XML.findtext('license') == citation['license'] == 'Apache-2.0'
    assert licence in (wheel.get('License'), wheel.get('License-Expression'))
    assert 'Apache License' in (ROOT / 'LICENSE').read_text(encoding='utf-8')
    assert wheel['Summary'].rstrip('.') == ' '.join(PACKAGE_XML.findtext('description').split()
                                                    ).rstrip('.')
    assert citation['version'] == VERSION and citation['title'] == PACKAGE_XML.findtext('name')


def test_dependencies_of_package_xml_and_wheel_agree():
    """The apt package `python3-X` is X on PyPI. Comments in package.xml name dependencies without
    one."""
    text = (ROOT / 'package.xml').read_text(encoding='utf-8')
    names = {'python3-serial': 'pyserial', 'python3-yaml': 'PyYAML'}
    declared = {names.get(e.text, e.text.removeprefix('python3-')).lower()
                for e in PACKAGE_XML.iter('exec_depend') if e.text.startswith('python3-')}
    required = {re.match(r'[\w-]+', r).group().lower()
                for r in metadata('mag_tracking').get_all('Requires-Dist') if 'extra ==' not in r}
    assert declared <= required
    assert [n for n in required - declared if n not in text.lower()] == []
