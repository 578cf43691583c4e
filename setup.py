import os
from glob import glob
from xml.etree import ElementTree

from pybind11.setup_helpers import Pybind11Extension
from setuptools import Distribution, find_packages, setup

NAME = 'mag_tracking'
# Version, description and licence stand in package.xml, where ROS tools expect them.
PACKAGE = ElementTree.parse('package.xml').getroot()
NODES = ('driver_node', 'replay_node', 'calibration_node', 'detection_node', 'tracker_node')

class DataFilesDistribution(Distribution):
    """Workaround: `pip install -e` leaves data_files out, as setuptools asks for `has_data`, which
    nobody defines. It can go when an editable install has share/mag_tracking/package.xml without.
    """

    def has_data(self):
        return self.has_data_files()

# What is computed for every reading and every frame. It may be copied to another machine, so it is
# not made for this processor alone: where that matters the module chooses by itself.
CORES = [
    Pybind11Extension(
        source.removesuffix('.cpp').replace('/', '.'), [source], cxx_std=17,
        extra_compile_args=['-O3', '-Wall', '-Wextra', '-Wno-psabi'],
        depends=sorted(glob(f'{NAME}/**/*.hpp', recursive=True)))
    for source in sorted(glob(f'{NAME}/**/core.cpp', recursive=True))]

setup(
    name=NAME,
    distclass=DataFilesDistribution,
    version=PACKAGE.findtext('version'),
    description=PACKAGE.findtext('description'),
    author='The mag_tracking authors',
    license=PACKAGE.findtext('license'),
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    ext_modules=CORES,
    options={'build_ext': {'parallel': os.cpu_count()}},
    package_data={NAME: ['py.typed', 'nodes/*.xml', 'report/page/*', '*/core.pyi',
                         'stages/*/core.pyi']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', sorted(glob('launch/*.py'))),
        (f'share/{NAME}/config', sorted(glob('config/*.yaml'))),
        (f'share/{NAME}/config/security', sorted(glob('config/security/*.xml'))),
        (f'share/{NAME}/config/viewers', sorted(glob('config/viewers/*'))),
    ],
    # ROS itself and mag_tracking_msgs stay out: people with a ROS from apt have them from there,
    # and pip would look for mag-tracking-msgs on the index, where it is not.
    install_requires=[
        'matplotlib',
        'mcap',
        'mcap-protobuf-support',
        'mcap-ros2-support',
        'numpy',
        'paho-mqtt>=2',
        'plotly',
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
        # ros-jazzy-*: the names without "jazzy" are another release of ROS.
        'ros': [
            'ros-jazzy-common-interfaces',
            'ros-jazzy-rclpy',
            # rclpy's wheel does not ask for a middleware and cannot be imported without one.
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
        # `colcon test` runs pytest only where the extra "test" names it.
        'test': [
            # Drivers for CircuitPython, as users have them.
            'adafruit-circuitpython-lis3mdl',
            'adafruit-circuitpython-mmc56x3',
            # What reads archives.
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
