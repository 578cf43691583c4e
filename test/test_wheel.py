"""The wheel is complete, contains no other files, and works without ROS and the source tree."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from support.bundled import NETWORK_FILE, ROOT, vehicle_path

NAME = 'straight_car_fast_left'
RUNNING_VERSION = f'{sys.version_info.major}.{sys.version_info.minor}'
VERSIONS = sorted({'3.11', '3.14', RUNNING_VERSION}, key=lambda v: int(v.partition('.')[2]))
VERSION = ElementTree.parse(ROOT / 'package.xml').findtext('version')
SHARE = f'mag_tracking-{VERSION}.data/data/share'
METADATA = {f'mag_tracking-{VERSION}.dist-info/{name}' for name in (
    'METADATA', 'WHEEL', 'RECORD', 'entry_points.txt', 'top_level.txt', 'licenses/LICENSE')}
CORE_SOURCES = sorted(str(p.relative_to(ROOT)) for p in (ROOT / 'mag_tracking').rglob('core.cpp'))
UNRELATED_FILES = (
    'mag_tracking/notes.txt', 'mag_tracking/physics/__pycache__/dipole.cpython-311.pyc',
    'test/test_new.py', 'mag_tracking.egg-info/PKG-INFO', 'out/summary.json',
    'config/backup.yaml~')
SITE_NETWORK = '''
site: {latitude: 58.4, longitude: 15.6, height: 60, date: 2026-05-01, x_azimuth_deg: 90}
sensors:
  mag_1: {position: [0, 0, 0]}
'''
TRACK_SCRIPT = '''
import json, sys, mag_tracking as mt
result = mt.track(sys.argv[1], sys.argv[2])
try:
    message = result.poses_dataframe()
except mt.MissingDependencyError as error:
    message = str(error)
print(json.dumps({'file': mt.__file__, 'positions': result.poses['position'].tolist(),
                  'message': message, 'prefix': sys.prefix,
                  'earth': mt.read_network(sys.argv[3]).earth_field.tolist()}))
'''
TYPED_SCRIPT = '''
import mag_tracking as mt

result: mt.TrackingResult = mt.track('recording.mcap', 'network.yaml')
n: int = len(result.poses)
mt.track(5, 'network.yaml')  # type: ignore[arg-type]
mt.trakc  # type: ignore[attr-defined]
'''


def tracked_files():
    """Names of the files that git tracks."""
    if not (ROOT / '.git').exists() or shutil.which('git') is None:
        pytest.skip('not a git checkout: the tracked files are unknown')
    return subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, check=True, capture_output=True,
                          text=True).stdout.rstrip('\0').split('\0')


def expected_files():
    """Names of the files that a wheel must contain."""
    names = set(METADATA)
    for name in tracked_files():
        folder = name.partition('/')[0]
        if folder == 'mag_tracking' and not name.endswith(('.hpp', '.cpp')):
            names.add(name)
        elif folder in ('launch', 'config') or name == 'package.xml':
            names.add(f'{SHARE}/mag_tracking/{name}')
        elif folder == 'resource':
            names.add(f'{SHARE}/ament_index/resource_index/packages/{name.partition("/")[2]}')
    return names


def contained_files(wheel):
    """Names of the files in a wheel, except the compiled modules.

    Fails if a name is duplicated, or if the compiled modules do not match their sources.
    """
    with zipfile.ZipFile(wheel) as archive:
        names = [i.filename for i in archive.infolist() if not i.is_dir()]
    compiled = [name for name in names if name.endswith('.so')]
    assert len(set(names)) == len(names)
    assert sorted(name.partition('.')[0] + '.cpp' for name in compiled) == CORE_SOURCES
    return {*names} - {*compiled}


@pytest.fixture
def tree_copy(tmp_path):
    """Copy the tracked files of the working tree to a folder; return the folder."""
    folder = tmp_path / 'tree'
    for name in tracked_files():
        # The build does not need the tests. Git may list files that have been deleted.
        if (ROOT / name).is_file() and not name.startswith('test/'):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def bare_environment():
    """Environment without variables of ROS, the source tree or another interpreter."""
    excluded_prefixes = ('PYTHON', 'ROS_', '_ROS', 'AMENT_', 'COLCON_', 'VIRTUAL_ENV',
                         'LD_LIBRARY_PATH')
    return {k: v for k, v in os.environ.items() if not k.startswith(excluded_prefixes)}


def run(*command, cwd, **variables):
    """Run a command, assert that it succeeds, and return its output."""
    process = subprocess.run([str(c) for c in command], cwd=cwd,
                             env=bare_environment() | variables, capture_output=True, text=True)
    assert process.returncode == 0, f'{command}\n{process.stdout}\n{process.stderr}'
    return process.stdout


def interpreter(version):
    """Path of a Python interpreter of `version` with venv; skips the test if none is installed."""
    if version == RUNNING_VERSION:
        return sys.executable
    check = 'import sys, venv, ensurepip; print("%d.%d" % sys.version_info[:2])'
    candidates = [shutil.which(f'python{version}'), *sorted(
        Path.home().glob(f'.pyenv/versions/{version}.*/bin/python'))]
    for path in filter(None, candidates):
        process = subprocess.run([str(path), '-c', check], env=bare_environment(),
                                 capture_output=True, text=True)
        if process.returncode == 0 and process.stdout.strip() == version:
            return path
    pytest.skip(f'python{version} with venv is neither on PATH nor installed by pyenv')


@pytest.mark.timeout(900)
def test_the_wheel_contains_all_required_files_and_no_others(tmp_path, tree_copy):
    """The wheel is built without build isolation, which would need a network."""
    pytest.importorskip('setuptools', minversion='70.1', reason='builds wheels from 70.1 on')
    for name in UNRELATED_FILES:
        (tree_copy / name).parent.mkdir(parents=True, exist_ok=True)
        (tree_copy / name).write_text('')
    # The compiled modules are not run here, and `make` has compiled them: a program that only makes
    # the files that a compiler would make saves a minute.
    compiler = tmp_path / 'compiler'
    compiler.write_text('#!/bin/sh\nfor word; do\n  [ "$last" = -o ] && : > "$word"\n'
                        '  last=$word\ndone\nexit 0\n')
    compiler.chmod(0o755)
    run(sys.executable, '-c', 'import sys, setuptools.build_meta as b; b.build_wheel(sys.argv[1])',
        tmp_path, cwd=tree_copy, CC=str(compiler), CXX=str(compiler),
        MAG_TRACKING_PROCESSOR='native')
    wheel, = tmp_path.glob('*.whl')
    assert re.fullmatch(rf'mag_tracking-{re.escape(VERSION)}-cp3\d+-cp3\d+-linux_\w+\.whl',
                        wheel.name)
    assert contained_files(wheel) == expected_files()
    assert {'mag_tracking/py.typed', 'mag_tracking/nodes/fastdds.xml',
            f'{SHARE}/mag_tracking/config/network.yaml',
            f'{SHARE}/mag_tracking/launch/tracking.launch.py'} <= expected_files()


def csv_rows(path):
    with open(path, newline='', encoding='utf-8') as stream:
        return list(csv.DictReader(stream))


def assert_same_track(actual, expected):
    """Assert equal poses and summaries: numbers to 1e-9 of the column maximum, strings exactly."""
    for name in ('poses.csv', 'poses_smoothed.csv', 'detections.csv'):
        a, b = csv_rows(actual / name), csv_rows(expected / name)
        assert len(a) == len(b) > 0 and a[0].keys() == b[0].keys()
        for column in a[0]:
            x, y = ([row[column] for row in table] for table in (a, b))
            try:
                x, y = np.array(x, dtype=float), np.array(y, dtype=float)
            except ValueError:
                assert x == y, column
            else:
                np.testing.assert_allclose(
                    x, y, rtol=1e-9, atol=1e-9 * np.abs(y).max(),
                    err_msg=f'{name}: {column}')
    summaries = [json.loads((folder / 'summary.json').read_text())
                 for folder in (actual, expected)]
    assert summaries[0]['counts'] == summaries[1]['counts']
    (a,), (b,) = (summary['tracks'] for summary in summaries)
    assert a.keys() == b.keys()
    for key, value in b.items():
        if isinstance(value, (int, float, list)) and not isinstance(value, bool):
            assert a[key] == pytest.approx(value, rel=1e-9), key
        elif isinstance(value, str):
            assert a[key] == value, key


def install_wheel(version, tmp_path, tree_copy):
    """Install the wheel in a new virtual environment; return (bin folder, wheel)."""
    pins = ROOT / 'constraints.txt'
    run(interpreter(version), '-m', 'venv', tmp_path / 'venv', cwd=tmp_path)
    bin_folder = tmp_path / 'venv' / 'bin'
    pip = bin_folder / 'python', '-m', 'pip', '--quiet', '--disable-pip-version-check', '--no-input'
    run(*pip, 'install', '-c', pins, '--upgrade', 'pip', 'setuptools', 'pybind11', cwd=tmp_path)
    # Building from the source distribution, as `python -m build` does, must add or omit no file.
    run(bin_folder / 'python', '-c', 'import sys, setuptools.build_meta as b; b.build_sdist('
        'sys.argv[1])', tmp_path / 'sdist', cwd=tree_copy)
    source, = (tmp_path / 'sdist').glob('*.tar.gz')
    for name, project in (('wheel', tree_copy), ('wheel_of_sdist', source)):
        run(*pip, 'wheel', '--no-deps', '--build-constraint', pins, '-w', tmp_path / name, project,
            cwd=tmp_path)
    wheel, = (tmp_path / 'wheel').glob('*.whl')
    wheel_of_sdist, = (tmp_path / 'wheel_of_sdist').glob('*.whl')
    assert contained_files(wheel) == contained_files(wheel_of_sdist) == expected_files()
    run(*pip, 'install', '-c', pins, wheel, cwd=tmp_path)
    run(*pip, 'check', cwd=tmp_path)
    return bin_folder, wheel


@pytest.mark.study
@pytest.mark.alone
@pytest.mark.timeout(900)
@pytest.mark.parametrize('version', VERSIONS)
def test_the_wheel_works_without_ros_and_the_source_tree(version, tmp_path, tree_copy,
                                                         vehicle_replays):
    bin_folder, wheel = install_wheel(version, tmp_path, tree_copy)
    shutil.rmtree(tree_copy)
    venv, home = bin_folder.parent, tmp_path / 'elsewhere'
    home.mkdir()
    assert run(bin_folder / 'python', '-c', 'from importlib.util import find_spec as f; '
               'print(f("rclpy"), f("pandas"))', cwd=home).strip() == 'None None'
    package = next((venv / 'lib').glob('python*')) / 'site-packages' / 'mag_tracking'
    assert (package / 'py.typed').is_file() and (package / 'nodes' / 'fastdds.xml').is_file()
    assert (venv / 'share' / 'mag_tracking' / 'config' / 'network.yaml').read_text() == \
        NETWORK_FILE.read_text()

    text = run(bin_folder / 'mag-tracking', 'replay', vehicle_path(NAME), '--network',
               venv / 'share' / 'mag_tracking' / 'config' / 'network.yaml', '--out', home / 'out',
               cwd=home)
    assert ': 1 track' in text and len(list((home / 'out').glob('*.png'))) == 3
    assert_same_track(home / 'out', vehicle_replays[NAME][1])

    (home / 'site.yaml').write_text(SITE_NETWORK)
    found = json.loads(run(bin_folder / 'python', '-c', TRACK_SCRIPT, vehicle_path(NAME),
                           NETWORK_FILE, home / 'site.yaml', cwd=home))
    assert Path(found['file']).parent == package and Path(found['prefix']) == venv
    poses = csv_rows(home / 'out' / 'poses.csv')
    assert found['positions'] == [[float(row[axis]) for axis in 'xyz'] for row in poses]
    assert 'pip install mag_tracking[pandas]' in found['message']
    assert 4.5e-5 < np.linalg.norm(found['earth']) < 5.5e-5

    (home / 'typed.py').write_text(TYPED_SCRIPT)
    run(sys.executable, '-m', 'mypy', '--strict', '--config-file=', '--python-executable',
        bin_folder / 'python', 'typed.py', cwd=home)
    print(f'Python {version}: {wheel.name}, the same {len(poses)} poses as in the source tree')
