"""Lets pip build mag_tracking_msgs: run the CMake build, put what it installs into a wheel.

For people without a ROS from apt: the generators are then wheels of the build environment.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

NAME = 'mag_tracking_msgs'
SOURCE = Path(__file__).resolve().parent
PROJECTS = {NAME: SOURCE, **{name: SOURCE / 'standard' / name for name in (
    'tf2_msgs', 'vision_msgs')}}
"""{package: folder of its CMakeLists.txt}: ours, and those of others that PyPI does not have."""


def ros_prefix():
    """The prefix under which pip has put the generators (`<prefix>/share/ament_cmake`)."""
    for entry in sys.path:
        for prefix in Path(entry).resolve().parents:
            if (prefix / 'share' / 'ament_cmake').is_dir():
                return prefix
    raise RuntimeError('ament_cmake is not in the build environment: build with `pip install`')


class CMakeBuild(build_ext):
    """Build with CMake in place of a compiler call; an extension makes the wheel platform's own."""

    def run(self):
        self.distribution.data_files = []
        for name, source in PROJECTS.items():
            self._build(name, source)

    def _build(self, name, source):
        work = Path(self.build_temp).resolve() / name
        installed = work / 'install'
        # An older CMake cache would name an older build environment, which pip has removed.
        shutil.rmtree(work, ignore_errors=True)
        self._cmake(source, work / 'build', installed)

        package = Path(self.build_lib) / name
        shutil.rmtree(package, ignore_errors=True)
        shutil.copytree(installed / 'python' / name, package)
        # Libraries and the ament index go below the environment's prefix, where rclpy looks.
        self.distribution.data_files += [
            (str(file.parent.relative_to(installed)), [str(file)])
            for folder in ('lib', 'share')
            for file in sorted((installed / folder).rglob('*'))
            if file.is_file()
        ]

    def _cmake(self, source, build, installed):
        prefix = ros_prefix()
        env = {**os.environ, 'AMENT_PREFIX_PATH': str(prefix), 'CMAKE_PREFIX_PATH': str(prefix)}
        options = {
            'CMAKE_BUILD_TYPE': 'Release',
            'CMAKE_INSTALL_PREFIX': installed,
            'PYTHON_INSTALL_DIR': 'python',
            'Python3_EXECUTABLE': sys.executable,
            'BUILD_TESTING': 'OFF',
            # From <prefix>/lib to itself, and from <prefix>/lib/pythonX.Y/site-packages/NAME.
            'CMAKE_INSTALL_RPATH': '$ORIGIN;$ORIGIN/../../..',
        }
        defines = [f'-D{key}={value}' for key, value in options.items()]
        for command in (
            ['cmake', '-G', 'Ninja', '-S', source, '-B', build, *defines],
            ['cmake', '--build', build, '--target', 'install'],
        ):
            subprocess.run(command, env=env, check=True)

    def get_source_files(self):
        return []

    def get_outputs(self):
        return []


setup(
    name=NAME,
    version=ElementTree.parse(SOURCE / 'package.xml').findtext('version'),
    description='ROS 2 messages and services of mag_tracking',
    author='The mag_tracking authors',
    license='Apache-2.0',
    python_requires='>=3.10',
    packages=[],
    ext_modules=[Extension(NAME, sources=[])],
    cmdclass={'build_ext': CMakeBuild},
    # The libraries of these are what ours are linked to.
    install_requires=[
        'numpy',
        'ros-jazzy-geometry-msgs',
        'ros-jazzy-rclpy',
        'ros-jazzy-rmw-fastrtps-cpp',
        'ros-jazzy-std-msgs',
    ],
    zip_safe=False,
)
