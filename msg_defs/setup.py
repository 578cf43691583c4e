"""Lets pip build mag_tracking_msgs: the Python classes of the messages and the code they need.

For people without a ROS from apt: the generators are then wheels of the build environment.
"""

import os
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

NAME = 'mag_tracking_msgs'
SOURCE = Path(__file__).resolve().parent
PROJECTS = {NAME: SOURCE, **{name: SOURCE / 'standard' / name for name in (
    'tf2_msgs', 'vision_msgs')}}
"""{package: folder of its definitions}: ours, and those of others that PyPI does not have."""


def extension(name):
    """The extension module of a package; its sources are added when they have been generated.

    Everything is resolved on import, so that a missing symbol fails there. From
    <prefix>/lib/pythonX.Y/site-packages/NAME the libraries of ROS are in <prefix>/lib.
    """
    return Extension(
        f'{name}.{name}_s__rosidl_typesupport_c', [], language='c++',
        define_macros=[('NDEBUG', None)], extra_compile_args=['-O1', '-g0', '-Wno-cpp'],
        extra_link_args=['-Wl,--as-needed', '-Wl,-z,now', '-Wl,-rpath,$ORIGIN/../../..'])


class GenerateAndBuild(build_ext):
    """Generate the classes and the code before the compilation."""

    def run(self):
        sys.path.insert(0, str(SOURCE))
        import python_build
        work = Path(self.build_temp).resolve() / 'generated'
        shutil.rmtree(work, ignore_errors=True)
        self.distribution.data_files = []
        for (name, source), module in zip(PROJECTS.items(), self.extensions, strict=True):
            python_build.generate(name, source, work)
            for option, values in python_build.extension_options(name, source, work).items():
                getattr(module, option).extend(values)
            for folder, files in python_build.shared_files(name, source, work).items():
                self.distribution.data_files.append((folder, files))
            package = Path(self.build_lib) / name
            shutil.rmtree(package, ignore_errors=True)
            shutil.copytree(work / 'rosidl_generator_py' / name, package,
                            ignore=shutil.ignore_patterns('*.c'))
            (package / '__init__.py').touch()
        super().run()

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
    python_requires='>=3.11',
    packages=[],
    ext_modules=[extension(name) for name in PROJECTS],
    options={'build_ext': {'parallel': os.cpu_count()}},
    cmdclass={'build_ext': GenerateAndBuild},
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
