"""The scripts of `make bench` can be imported; they run too rarely to reveal renamed imports."""

import runpy

import pytest

from support.bundled import ROOT


@pytest.mark.parametrize('path', sorted((ROOT / 'test' / 'bench').glob('*.py')),
                         ids=lambda p: p.stem)
def test_a_bench_script_can_be_imported(path):
    assert runpy.run_path(str(path), run_name='imported')['__doc__']
