import hashlib
import os
import re
import shutil
import subprocess
import sysconfig
import tempfile
from glob import glob
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

from pybind11.setup_helpers import Pybind11Extension
from setuptools import Distribution, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = 'mag_tracking'
# package.xml is the only source of version, description and licence: ROS tools read it there.
PACKAGE = ElementTree.parse('package.xml').getroot()
NODES = ('driver_node', 'replay_node', 'calibration_node', 'detection_node', 'tracker_node')


class DataFilesDistribution(Distribution):
    """Workaround: `pip install -e` omits data_files, because setuptools queries the undefined
    `has_data`. Remove it when editable installs contain share/mag_tracking/package.xml without it.
    """

    def has_data(self):
        return self.has_data_files()


COMPILER = (os.environ.get('CC') or sysconfig.get_config_var('CC')).split()
# Prints the newest generation of processors of processors.hpp that this computer supports.
GENERATION = '''
#include <stdio.h>
int main(void) {
    puts(__builtin_cpu_supports("x86-64-v4") ? "x86-64-v4"
         : __builtin_cpu_supports("x86-64-v3") ? "x86-64-v3" : "");
    return 0;
}
'''


def native_macros():
    """With MAG_TRACKING_PROCESSOR=native: the macro to compile for this computer's generation of
    processors besides the oldest one. Wheels contain versions for all generations.
    """
    if os.environ.get('MAG_TRACKING_PROCESSOR') != 'native':
        return []
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder, 'generation.c'), Path(folder, 'generation')
        source.write_text(GENERATION)
        try:
            subprocess.run([*COMPILER, source, '-o', program], check=True, capture_output=True)
            output = subprocess.run([program], check=True, capture_output=True, text=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return []
    generation = output.strip()
    return [('MAG_TRACKING_PROCESSOR', f'"{generation}"')] if generation else []


def included(path):
    """The source file `path` and all files of this package that it includes."""
    files, waiting = set(), {path}
    while waiting:
        path = waiting.pop()
        files.add(path)
        names = re.findall(r'^#include "(.+)"', path.read_text(encoding='utf-8'), re.M)
        waiting |= {(path.parent / name).resolve() for name in names} - files
    return files


class BuildCores(build_ext):
    """Keep the compiled modules in the folder MAG_TRACKING_CACHE, if set, and take them from there
    while nothing that they depend on has changed.
    """

    def build_extension(self, ext):
        folder = os.environ.get('MAG_TRACKING_CACHE')
        if not folder:
            super().build_extension(ext)
            return
        built, kept = Path(self.get_ext_fullpath(ext.name)), Path(folder, self.key(ext))
        if kept.is_file():
            built.parent.mkdir(parents=True, exist_ok=True)
            copy(kept, built)
            os.utime(kept)
            return
        # A module that is newer than its sources may have been compiled with other options.
        self.force = True
        super().build_extension(ext)
        kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        copy(built, kept)

    @staticmethod
    def key(ext):
        """Hash of everything that a compiled module depends on."""
        command = subprocess.run([*COMPILER, '--version'], capture_output=True).stdout
        settings = [
            ext.extra_compile_args, ext.define_macros, version('pybind11'),
            sysconfig.get_platform(), sysconfig.get_config_vars('SOABI', 'CFLAGS'),
            *(os.environ.get(name) for name in (
                'CC', 'CXX', 'CFLAGS', 'CXXFLAGS', 'CPPFLAGS', 'LDFLAGS'))]
        parts = [command, repr(settings).encode()]
        for path in sorted(included(Path(ext.sources[0]).resolve())):
            parts += [str(path.relative_to(Path.cwd())).encode(), path.read_bytes()]
        hashes = b''.join(hashlib.sha256(part).digest() for part in parts)
        return f'{ext.name}-{hashlib.sha256(hashes).hexdigest()[:32]}'


def copy(source, target):
    """Copy a file so that `target` is never incomplete, and a module in use keeps its old file."""
    partial = target.with_name(f'{target.name}.{os.getpid()}')
    shutil.copyfile(source, partial)
    partial.replace(target)


# Compiled code runs for every reading and every frame.
MACROS = native_macros()
CORES = [
    Pybind11Extension(
        source.removesuffix('.cpp').replace('/', '.'), [source], cxx_std=17, define_macros=MACROS,
        extra_compile_args=['-O3', '-Wall', '-Wextra', '-Wno-psabi'],
        depends=sorted(glob(f'{NAME}/**/*.hpp', recursive=True)))
    for source in sorted(glob(f'{NAME}/**/core.cpp', recursive=True))]

setup(
    name=NAME,
    distclass=DataFilesDistribution,
    cmdclass={'build_ext': BuildCores},
    version=PACKAGE.findtext('version'),
    description=PACKAGE.findtext('description'),
    author='The mag_tracking authors',
    license=PACKAGE.findtext('license'),
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    ext_modules=CORES,
    options={'build_ext': {'parallel': os.cpu_count()}},
    package_data={NAME: ['py.typed', 'nodes/*.xml', 'report/page/*', 'report/plotly/*',
                         '*/core.pyi', 'stages/*/core.pyi']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', sorted(glob('launch/*.py'))),
        (f'share/{NAME}/config', sorted(glob('config/*.yaml'))),
        (f'share/{NAME}/config/security', sorted(glob('config/security/*.xml'))),
        (f'share/{NAME}/config/viewers', sorted(glob('config/viewers/*'))),
    ],
    # ROS and mag_tracking_msgs are not listed: they may be installed from apt, and pip would look
    # for mag-tracking-msgs on PyPI, where it does not exist.
    install_requires=[
        'lz4',
        'matplotlib',
        'mcap',
        'mcap-protobuf-support',
        'mcap-ros2-support',
        'numpy',
        'paho-mqtt>=2',
        'pygeomag',
        'pyserial',
        'PyYAML',
        'rosbags',
        'scipy',
        'smbus2',
        'tqdm',
        'websockets>=14',
        'zstandard',
    ],
    extras_require={
        # The packages without "jazzy" in their names belong to another ROS release.
        'ros': [
            'ros-jazzy-common-interfaces',
            'ros-jazzy-rclpy',
            # The wheel of rclpy does not require a middleware, but fails to import without one.
            'ros-jazzy-rmw-fastrtps-cpp',
        ],
        'archive': ['dask', 'distributed', 'pyarrow'],
        'classes': ['scikit-learn'],
        'pandas': ['pandas'],
        'rerun': ['rerun-sdk'],
        'docs': [
            'furo',
            'myst-parser',
            'numpydoc',
            'pandas',
            'sphinx',
            'sphinx-copybutton',
            'sphinx-design',
            'sphinx-gallery',
        ],
        # `colcon test` runs pytest only if the extra "test" lists it.
        'test': [
            # CircuitPython drivers as users install them.
            'adafruit-circuitpython-bno055',
            'adafruit-circuitpython-bno08x',
            'adafruit-circuitpython-fxos8700',
            'adafruit-circuitpython-icm20x',
            'adafruit-circuitpython-lis2mdl',
            'adafruit-circuitpython-lis3mdl',
            'adafruit-circuitpython-lsm303agr-mag',
            'adafruit-circuitpython-lsm303dlh-mag',
            'adafruit-circuitpython-lsm9ds0',
            'adafruit-circuitpython-lsm9ds1',
            'adafruit-circuitpython-mlx90393',
            'adafruit-circuitpython-mlx90395',
            'adafruit-circuitpython-mmc56x3',
            'adafruit-circuitpython-qmc5883p',
            'adafruit-circuitpython-tlv493d',
            'adafruit-circuitpython-tmag5273',
            'circuitpython-qmc5883l',
            'circuitpython-rm3100',
            'clang-format',
            # Readers of archives.
            'duckdb',
            'filterpy',
            'hypothesis',
            'import-linter',
            'magpylib',
            'mypy',
            'pandas',
            'pandas-stubs',
            'playwright',
            'pybind11',
            'pytest',
            'pytest-timeout',
            'pytest-xdist',
            'ruff',
            'scipy-stubs',
            'types-PyYAML',
            'types-pyserial',
            'types-tqdm',
        ],
    },
    entry_points={
        'console_scripts': [
            'mag-tracking = mag_tracking.cli:command',
            *(f'{node} = mag_tracking.nodes.start:{node}' for node in NODES),
        ],
    },
    zip_safe=False,
)
