"""The scripts of `make bench` can be imported; they are run too seldom to notice a moved name."""

import runpy

import pytest

from support.bundled import ROOT


@pytest.mark.parametrize('path', sorted((ROOT / 'test' / 'bench').glob('*.py')),
                         ids=lambda p: p.stem)
def test_a_script_imports(path):
    assert runpy.run_path(str(path), run_name='imported')['__doc__']
