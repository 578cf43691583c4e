"""All that is compiled at first use is compiled before, and without a cache it still is."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from mag_tracking.apps.warm_up import compiled_modules
from mag_tracking.cli import main
from mag_tracking.compiled import compiled_when_used, prepare_module
from support.bundled import ROOT

WITHOUT_CACHE = '''
import warnings
warnings.simplefilter('always')
from mag_tracking.physics.motion import coordinated_turn
import numpy as np
print(coordinated_turn(np.ones((1, 7)), 0.1)[0].shape)
'''


def test_every_module_with_a_compiled_function_is_found():
    marked = {str(p.relative_to(ROOT))[:-3].replace('/', '.')
              for p in (ROOT / 'mag_tracking').rglob('*.py')
              if re.search(r'^@compiled_when_used\(', p.read_text(), re.M)}
    assert marked and {*compiled_modules()} == marked


def test_the_command_says_how_many_there_are(capsys):
    assert main(['warm-up']) == 0
    n = sum(prepare_module(name) for name in compiled_modules())
    assert capsys.readouterr().out == f'{n} functions are compiled\n' and n > 0


def test_a_function_is_compiled_for_one_signature_when_it_is_called():
    calls = []

    @compiled_when_used('float64(float64)')
    def half(x):
        return 0.5 * x

    def plain(x):
        calls.append(x)
        return 0.5 * x
    # Nothing was compiled yet: what numba cannot compile is no error before the first call.
    compiled_when_used('float64(float64)')(plain)
    assert half(3.0) == 1.5 and half.__name__ == 'half' and not calls
    with pytest.raises(TypeError, match='No matching definition'):
        half('three')


def test_without_a_folder_for_the_cache_functions_are_compiled_all_the_same(tmp_path):
    """And it is said: each process waits for them again."""
    copy = tmp_path / 'site'
    shutil.copytree(ROOT / 'mag_tracking', copy / 'mag_tracking',
                    ignore=shutil.ignore_patterns('__pycache__'))
    (copy / 'mag_tracking' / 'physics' / '__pycache__').write_text('no folder')
    environment = {**os.environ, 'HOME': '/dev/null', 'XDG_CACHE_HOME': '/dev/null/cache',
                   'PYTHONPATH': str(copy), 'PYTHONDONTWRITEBYTECODE': '1'}
    environment.pop('NUMBA_CACHE_DIR', None)
    done = subprocess.run([sys.executable, '-c', WITHOUT_CACHE], env=environment, cwd=tmp_path,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert '(1, 7)' in done.stdout
    assert 'compiled functions cannot be kept' in done.stderr and 'NUMBA_CACHE_DIR' in done.stderr
