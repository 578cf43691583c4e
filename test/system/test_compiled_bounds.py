"""Compiled code does not look at the bounds of arrays; here it does, once."""

import os
import subprocess
import sys

import pytest

from support.bundled import ROOT

KERNELS = ('stages/calibrate', 'stages/align', 'stages/health', 'calibration', 'inference')


@pytest.mark.study
@pytest.mark.timeout(1200)
def test_no_kernel_leaves_its_arrays(tmp_path):
    environment = {**os.environ, 'NUMBA_BOUNDSCHECK': '1', 'NUMBA_CACHE_DIR': str(tmp_path)}
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider', '-m', 'not study',
         *(str(ROOT / 'test' / name) for name in KERNELS)],
        cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
