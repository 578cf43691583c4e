import os
from glob import glob
from xml.etree import ElementTree

from pybind11.setup_helpers import Pybind11Extension
from setuptools import Distribution, find_packages, setup

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

# Compiled code runs for every reading and every frame. Wheels may run on other machines, so the
# code is not optimised for this processor; some modules select faster versions at run time.
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
