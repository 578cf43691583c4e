"""Array bounds in compiled code, checked by a build with sanitizers."""

import os
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor

import pybind11
import pytest

from support.bundled import ROOT

TEST_PATHS = ('calibration', 'inference', 'physics', 'stages/align', 'stages/calibrate',
              'stages/detect', 'stages/health', 'stages/track/test_core.py')
COMPILER_FLAGS = ('-O1', '-g', '-std=c++17', '-shared', '-fPIC', '-fvisibility=hidden',
                  '-Wno-psabi', '-fsanitize=address,undefined', '-fno-sanitize-recover=undefined')


def build(source):
    """Compile a module with sanitizers, in the folder of its source."""
    module = source.with_name('core' + sysconfig.get_config_var('EXT_SUFFIX'))
    includes = (pybind11.get_include(), sysconfig.get_path('include'))
    subprocess.run(['g++', *COMPILER_FLAGS, *(f'-I{folder}' for folder in includes), str(source),
                    '-o', str(module)], check=True)


def sanitizer(name):
    """Path of the compiler's sanitizer library `name`."""
    return subprocess.run(['g++', f'-print-file-name={name}'], capture_output=True, text=True,
                          check=True).stdout.strip()


@pytest.mark.study
@pytest.mark.timeout(2400)
def test_compiled_code_stays_within_its_arrays(tmp_path):
    package = tmp_path / 'mag_tracking'
    shutil.copytree(ROOT / 'mag_tracking', package,
                    ignore=shutil.ignore_patterns('__pycache__', '*.so'))
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(build, package.rglob('core.cpp')))
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path), 'ASAN_OPTIONS': 'detect_leaks=0',
                   'LD_PRELOAD': f'{sanitizer("libasan.so")} {sanitizer("libubsan.so")}'}
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider', '-m', 'not study',
         *(str(ROOT / 'test' / name) for name in TEST_PATHS)],
        cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
